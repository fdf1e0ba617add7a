"""Files that are whole or absent: outputs, locks, companions, HDF5."""
