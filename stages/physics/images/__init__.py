"""Source images: their table, labels and places on the ground."""
