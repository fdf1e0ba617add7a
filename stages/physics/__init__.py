"""Physics: bodies, grids, geometry, light, photometry, cameras and the image-formation chain."""
