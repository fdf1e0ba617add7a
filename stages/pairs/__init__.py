"""Reading `pairs.h5`."""
