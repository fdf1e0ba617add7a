"""Step 5: what is left that neither ground nor noise has, and no effect of the catalogue explains."""
