"""Physics: bodies, grids, geometry, light, photometry, cameras and the image-formation chain."""

import os

# MB. By itself GDAL would keep a twentieth of the machine's memory of rasters that pass through once. Read by GDAL when it
# opens its first raster; a user's own setting stands.
os.environ.setdefault("GDAL_CACHEMAX", "128")
