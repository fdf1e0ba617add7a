"""Projections of maps, where they need more than PROJ's defaults: beyond 180 degrees, and between kinds of latitude.

PROJ wraps longitudes into 180 degrees on either side of a map's central meridian. Maps of planets reach beyond it: an
equirectangular map about 0 E may show 170 to 190 E, one in degrees may begin at 359.8. Such maps are *continued* here
(PROJ's ``+over``), and a longitude is given by the whole turn that the map counts in.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import Any

import numpy as np
import rasterio
import rasterio.warp
from numpy.typing import ArrayLike
from rasterio._err import CPLE_BaseError  # what rasterio.warp lets through
from rasterio.crs import CRS

from stages.common.arrays import Floats

TURN = 360.0  # degrees
ELLIPSOID = re.compile(r"(?:SPHEROID|ELLIPSOID)\[\"[^\"]*\",\s*([0-9.eE+]+),\s*([0-9.eE+]+)")


@lru_cache(maxsize=256)
def parse_crs(wkt: str) -> CRS:
    """The CRS in a WKT string."""
    with rasterio.Env():  # keeps GDAL's own messages off the terminal
        return CRS.from_wkt(wkt)


@lru_cache(maxsize=256)
def continued_crs(wkt: str) -> CRS | None:
    """The CRS with its map continued beyond 180 degrees; None where that is no shift along x (as on polar maps)."""
    proj4 = parse_crs(wkt).to_proj4()
    if not proj4:
        return None
    with rasterio.Env():
        crs = CRS.from_proj4(f"{proj4} +over")
        (x0, x1), (y0, y1) = rasterio.warp.transform(
            degrees_crs(ellipsoid_of(wkt), True), crs, [0.0, TURN], [10.0, 10.0]
        )
    return crs if math.isclose(y0, y1, abs_tol=1e-6 * abs(x1 - x0)) and abs(x1 - x0) > 1e-3 else None


@lru_cache(maxsize=256)
def degrees_crs(figure: str, any_turn: bool = False) -> CRS:
    """Longitude and latitude, longitudes of any turn if asked for. figure : the ellipsoid as PROJ parameters"""
    return CRS.from_proj4(f"+proj=longlat {figure} +no_defs{' +over' if any_turn else ''}")


def transform(source: CRS, target: CRS, x: Floats, y: Floats) -> Floats:
    """Coordinates in another CRS, NaN where it has none: PROJ refuses all points for a single one that it cannot project.

    x, y : (...,); returns (2, ...)
    """
    try:
        found = np.asarray(rasterio.warp.transform(source, target, x.ravel(), y.ravel())).reshape(2, *x.shape)
        return np.where(np.isfinite(found), found, np.nan)
    except CPLE_BaseError:
        if x.size == 1:
            return np.full((2, *x.shape), np.nan)
        middle = x.size // 2
        parts = [transform(source, target, x.ravel()[part], y.ravel()[part]) for part in np.s_[:middle, middle:]]
        return np.concatenate(parts, axis=1).reshape(2, *x.shape)


def near_longitude(longitude_deg: ArrayLike, middle_deg: float) -> Floats:
    """The same longitudes, by whole turns within 180 degrees of ``middle_deg``.

    longitude_deg : (...,); returns the same shape
    """
    longitude = np.asarray(longitude_deg, float)
    with np.errstate(invalid="ignore"):
        return longitude - TURN * np.round((longitude - middle_deg) / TURN)


def operation(source_wkt: str, target_wkt: str, middle_deg: float) -> dict[str, Any]:
    """Arguments of GDAL's reprojection from a raster to a grid, the raster's map continued about ``middle_deg``.

    A PROJ pipeline, of which GDAL uses the inverse: ``lon_wrap`` works on the inverse of its step alone.
    """
    # CRSs from PROJ strings count east first, as the pipeline does; those from files may not
    source, to_degrees = _degrees_and_back(source_wkt, True)
    target, to_map = _degrees_and_back(target_wkt, False)
    wrap = f"+step +inv +proj=longlat {ellipsoid_of(source_wkt)} +over +lon_wrap={middle_deg!r} "
    steps = to_degrees + (wrap if continued_crs(source_wkt) is not None else "") + to_map
    return {"src_crs": source, "dst_crs": target, "COORDINATE_OPERATION": f"+proj=pipeline {steps}"}


@lru_cache(maxsize=256)
def _degrees_and_back(wkt: str, inverse: bool) -> tuple[CRS, str]:
    """A CRS, and PROJ's steps from planetocentric longitude and latitude, rad, to its coordinates, or their inverse."""
    crs, figure = parse_crs(wkt), ellipsoid_of(wkt)
    proj4 = crs.to_proj4()
    if crs.is_geographic:
        units = ("deg", "rad") if inverse else ("rad", "deg")
        steps = [f"+step +proj=unitconvert +xy_in={units[0]} +xy_out={units[1]} "]
    else:
        dropped = ("+no_defs", "+type", "+wktext", "+vunits")
        words = [word for word in proj4.split() if not word.startswith(dropped)]
        words += ["+over"] if continued_crs(wkt) is not None else []
        steps = [f"+step {'+inv ' if inverse else ''}{' '.join(words)} "]
    if latitude_ratio(wkt) != 1.0:
        steps.append(f"+step {'' if inverse else '+inv '}+proj=geoc {figure} ")
    return CRS.from_proj4(proj4), "".join(steps if inverse else steps[::-1])


@lru_cache(maxsize=256)
def latitude_ratio(wkt: str) -> float:
    """tan(planetocentric latitude) over the tangent of the latitude that a CRS counts in: (b/a)^2 for planetographic ones.

    1 for spheres and where the CRS says 'ocentric'. PROJ does not convert latitudes between an ellipsoid and a sphere, which
    on Mars would be 20 km in the middle latitudes.
    """
    match = ELLIPSOID.search(wkt)
    inverse = float(match.group(2)) if match else 0.0
    return 1.0 if inverse == 0 or "ocentric" in wkt.lower() else (1 - 1 / inverse) ** 2


@lru_cache(maxsize=256)
def ellipsoid_of(wkt: str) -> str:
    """A CRS's ellipsoid as PROJ parameters."""
    match = ELLIPSOID.search(wkt)
    if match is None:
        return ""
    return f"+a={match.group(1)} +rf={match.group(2)}" if float(match.group(2)) else f"+R={match.group(1)}"


def scale_tangent(latitude_deg: Floats, factor: float) -> Floats:
    """Latitudes whose tangents are ``factor`` times as large. latitude_deg : (...,); returns the same shape"""
    if factor == 1.0:
        return latitude_deg
    latitude = np.radians(latitude_deg)
    return np.degrees(np.arctan2(factor * np.sin(latitude), np.cos(latitude)))
