"""Map grids, and the rasters on them."""
