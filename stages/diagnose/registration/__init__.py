"""Step 1: where the images lie beside the ground."""
