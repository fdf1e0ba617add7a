"""Map grids: where a pixel is on the body, which way its axes point, and how large it truly is.

The one place for pixel conventions. Ours counts pixel *centres* from 0: row r, column c is the centre of the pixel in
array[r, c]. GDAL counts corners from 0 (our centre 0 is its 0.5), CSM centres from 0.5, ISIS centres from 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import h5py
import numpy as np
from numpy.typing import ArrayLike
from rasterio.crs import CRS
from rasterio.errors import CRSError
from rasterio.transform import Affine

from schemas.errors import ArtefactError, GeometryError, InputError
from stages.common.arrays import Floats
from stages.physics.bodies.spheres import RADII, Body, find_body
from stages.physics.maps.projections import (
    ELLIPSOID,
    continued_crs,
    degrees_crs,
    ellipsoid_of,
    latitude_ratio,
    near_longitude,
    parse_crs,
    scale_tangent,
    transform,
)

GDAL_CENTRE = 0.5  # GDAL's coordinate of the centre of the first pixel
CSM_CENTRE = 0.5
ISIS_CENTRE = 1.0
BODY_TOLERANCE = 0.005  # of the radius: mean, equatorial and reference spheres of one body


@dataclass(frozen=True)
class Grid:
    """A north-up map grid on a body.

    transform : GDAL-style affine, corner convention; ``height`` x ``width`` pixels; ``radius`` of the sphere in metres
    """

    crs_wkt: str
    transform: Affine
    height: int
    width: int
    radius: float

    @cached_property
    def crs(self) -> CRS:
        """Its CRS, parsed."""
        return parse_crs(self.crs_wkt)

    @property
    def latitude_ratio(self) -> float:
        """Of its CRS, see ``projections.latitude_ratio``."""
        return latitude_ratio(self.crs_wkt)

    @cached_property
    def continued(self) -> bool:
        """Whether its map goes on beyond 180 degrees from its central meridian: see ``projections``."""
        return continued_crs(self.crs_wkt) is not None

    @cached_property
    def _whole(self) -> CRS:
        """Its CRS, continued where it can be."""
        return continued_crs(self.crs_wkt) or self.crs

    @cached_property
    def _degrees(self) -> tuple[CRS, CRS]:
        """Longitude and latitude of the kind that ``crs`` itself counts in; longitudes of -180..180, and of any turn."""
        figure = f"+R={self.radius!r}" if self.latitude_ratio == 1.0 else ellipsoid_of(self.crs_wkt)
        return degrees_crs(figure), degrees_crs(figure, any_turn=True)

    @cached_property
    def middle_longitude_deg(self) -> float:
        """Of the grid's middle, in the turn that its own coordinates count in; 0 where that is off the body."""
        lon = float(self.counted_longitude(*self.transform @ (self.width / 2, self.height / 2)))
        return lon if math.isfinite(lon) else 0.0

    @property
    def gsd(self) -> float:
        """Nominal ground sample distance, m (the grid's own unit must be the metre)."""
        return float(self.transform.a)

    def xy(self, row: ArrayLike, col: ArrayLike) -> tuple[Floats, Floats]:
        """Map coordinates of pixel centres.

        row, col : (...,) px, broadcastable; returns x and y, (...,) in the grid's unit
        """
        row, col = np.asarray(row, float), np.asarray(col, float)
        return self.transform @ (col + GDAL_CENTRE, row + GDAL_CENTRE)

    def rowcol(self, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """(row, col), fractional, of map coordinates.

        x, y : (...,) in the grid's unit, broadcastable; returns (...,) each
        """
        u, v = ~self.transform @ (np.asarray(x, float), np.asarray(y, float))
        return v - GDAL_CENTRE, u - GDAL_CENTRE

    def lonlat(self, row: ArrayLike, col: ArrayLike) -> tuple[Floats, Floats]:
        """East longitude and planetocentric latitude, degrees.

        row, col : (...,) px, broadcastable; returns (...,) each
        """
        return self.map_lonlat(*self.xy(row, col))

    def map_lonlat(self, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """East longitude and planetocentric latitude, degrees, of map coordinates.

        x, y : (...,) m, broadcastable; returns (...,) each
        """
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        if self.crs.is_geographic:
            return near_longitude(x, 0.0), scale_tangent(y, self.latitude_ratio)
        lon, lat = transform(self.crs, self._degrees[0], x, y)
        return lon, scale_tangent(lat, self.latitude_ratio)

    def counted_longitude(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """East longitude, degrees, of map coordinates, in the turn that a continued map itself counts in; NaN off the body.

        x, y : (...,) m, broadcastable; returns (...,)
        """
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        if self.crs.is_geographic:
            return np.where(np.abs(y) <= 90.0, x, np.nan)
        return transform(self._whole, self._degrees[1], x, y)[0]

    def rowcol_of_lonlat(self, longitude_deg: ArrayLike, latitude_deg: ArrayLike) -> tuple[Floats, Floats]:
        """(row, col), fractional, of places given in degrees.

        longitude_deg, latitude_deg : (...,), broadcastable; returns (...,) each
        """
        return self.rowcol(*self.map_xy(longitude_deg, latitude_deg))

    def map_xy(
        self, longitude_deg: ArrayLike, latitude_deg: ArrayLike, middle_deg: float | None = None
    ) -> tuple[Floats, Floats]:
        """Map coordinates of places given in degrees.

        longitude_deg, latitude_deg : (...,), broadcastable; returns x and y, (...,) m each, NaN off the map
        middle_deg : longitude about which the map is continued by half a turn on either side, the grid's own middle by default
        """
        lon, lat = np.broadcast_arrays(np.asarray(longitude_deg, float), np.asarray(latitude_deg, float))
        lon = near_longitude(lon, self.middle_longitude_deg if middle_deg is None else middle_deg)
        lat = scale_tangent(lat, 1 / self.latitude_ratio)
        if self.crs.is_geographic:
            return lon, lat
        x, y = transform(self._degrees[1], self._whole, lon, lat)
        return x, y

    def window(self, row: int, col: int, height: int, width: int) -> Grid:
        """The grid of array[row : row + height, col : col + width]."""
        moved = self.transform @ Affine.translation(col, row)
        return Grid(self.crs_wkt, moved, height, width, self.radius)

    def bounds(self) -> tuple[float, float, float, float]:
        """left, bottom, right, top of the outer pixel edges."""
        x0, y0 = self.transform @ (0, 0)
        x1, y1 = self.transform @ (self.width, self.height)
        return min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)

    def local_frames(self, row: ArrayLike, col: ArrayLike) -> LocalFrames:
        """Axes along the grid at each place, and the true size of a pixel there.

        The Sun's and the camera's directions must follow the crop's own rows and columns, which turn against true
        north by the meridian convergence (a full circle around the pole of a polar stereographic map).

        row, col : px, n places in any shape, broadcastable to (n,)
        """
        row, col = np.broadcast_arrays(np.asarray(row, float), np.asarray(col, float))
        n = row.size
        rows = np.concatenate([row.ravel() + d for d in (0, -0.5, 0.5, 0, 0)])
        cols = np.concatenate([col.ravel() + d for d in (0, 0, 0, -0.5, 0.5)])
        points = unit_vectors(*self.lonlat(rows, cols)).reshape(5, n, 3)
        up = points[0]
        towards_north = (points[1] - points[2]) * self.radius
        towards_east = (points[4] - points[3]) * self.radius
        pixel = np.stack([np.linalg.norm(towards_north, axis=1), np.linalg.norm(towards_east, axis=1)], axis=1)
        north = towards_north - (towards_north * up).sum(1, keepdims=True) * up
        north /= np.linalg.norm(north, axis=1, keepdims=True)
        east = np.cross(north, up)
        pole = np.array([0.0, 0.0, 1.0])
        true_east = np.cross(pole, up)
        true_north = np.cross(up, true_east)
        convergence = np.degrees(np.arctan2((true_north * east).sum(1), (true_north * north).sum(1)))
        return LocalFrames(np.stack([east, north, up], axis=1), pixel, convergence)


@dataclass(frozen=True)
class LocalFrames:
    """Local frames at n places.

    axes : (n, 3, 3), rows are grid-east, grid-north and up in body-fixed coordinates
    pixel_size : (n, 2), true metres from row to row and from column to column
    convergence_deg : (n,), azimuth of true north clockwise from grid north
    """

    axes: Floats
    pixel_size: Floats
    convergence_deg: Floats

    @property
    def up(self) -> Floats:
        """(n, 3) unit vectors, body-fixed."""
        return self.axes[:, 2]


def unit_vectors(longitude_deg: ArrayLike, latitude_deg: ArrayLike) -> Floats:
    """Body-fixed unit vectors (..., 3) of places in degrees."""
    lon, lat = np.radians(np.asarray(longitude_deg, float)), np.radians(np.asarray(latitude_deg, float))
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat) + 0 * lon], axis=-1)


def lonlat_of_points(points: Floats) -> tuple[Floats, Floats]:
    """East longitude and planetocentric latitude, degrees, of body-fixed points (..., 3)."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z / np.linalg.norm(points, axis=-1)))


@lru_cache(maxsize=256)
def sphere_crs(radius: float) -> CRS:
    """Longitude and latitude on the reference sphere."""
    return _named(f"+proj=longlat +R={radius!r} +no_defs", radius)


def local_metric_crs(longitude_deg: float, latitude_deg: float, radius: float) -> CRS:
    """Oblique stereographic about a place: conformal, its scale grows by (d / 2R)^2 at distance d."""
    return _named(
        f"+proj=stere +lat_0={latitude_deg:.6f} +lon_0={longitude_deg:.6f} +k=1 +x_0=0 +y_0=0 +R={radius!r} +units=m +no_defs",
        radius,
        f"local stereographic at {abs(latitude_deg):.3f} {'S' if latitude_deg < 0 else 'N'} {longitude_deg:.3f} E",
    )


def _named(proj: str, radius: float, projection: str = "") -> CRS:
    """The CRS with names that QGIS and gdalinfo can show, in place of 'unknown'."""
    body = next((name.capitalize() for name, r in RADII.items() if r == radius), "sphere")
    sphere = f"{body}, radius {radius:.10g} m"
    wkt = CRS.from_proj4(proj).to_wkt()
    for kind, name in (("PROJCS", f"{body} {projection}"), ("GEOGCS", sphere), ("DATUM", sphere), ("SPHEROID", sphere)):
        wkt = wkt.replace(f'{kind}["unknown"', f'{kind}["{name}"')
    return CRS.from_wkt(wkt)


def crs_radius(crs: CRS) -> float | None:
    """Equatorial radius of a CRS's ellipsoid in metres, None where it names none."""
    match = ELLIPSOID.search(crs.to_wkt())
    return float(match.group(1)) if match else None


def check_body(where: str, crs: CRS, body: Body) -> None:
    """Refuse a CRS of another body. Raises GeometryError."""
    found = crs_radius(crs)
    if found is not None and abs(found - body.radius) > BODY_TOLERANCE * body.radius:
        earth = abs(found - RADII["earth"]) < BODY_TOLERANCE * RADII["earth"]
        advice = "" if earth else "name the body with `body`, or "
        raise GeometryError(
            f"{where}: expected a CRS on a sphere of {body.radius:g} m ({body.name}), found radius {found:g} m"
            f"{' (the Earth, which some programs write for any body)' if earth else ''}; {advice}{_assign_crs(body.radius)}."
        )


def _assign_crs(radius: float) -> str:
    """How to give a raster the CRS of a body of that radius, m."""
    degrees = "IAU_2015:30100" if radius == RADII["moon"] else f"'+proj=longlat +R={radius:.10g}'"
    return (
        f"assign the CRS that the map truly has: gdal_edit.py -a_srs {degrees} for degrees, "
        f"'+proj=eqc +R={radius:.10g} +units=m' or the like for metres"
    )


def check_same_body(where: object, radius: float, body: str | None) -> None:
    """Refuse a `body` that contradicts what a file says. Raises GeometryError."""
    if body is not None and abs(find_body(body).radius - radius) > BODY_TOLERANCE * radius:
        raise GeometryError(
            f"{where}: lies on a body of {radius:g} m radius, found `body` {body} ({find_body(body).radius:g} m); leave `body` away."
        )


def read_grid(file: h5py.File, path: object) -> Grid:
    """The grid of an artefact with a ``crs`` variable."""
    attributes = file["crs"].attrs  # whose numbers were checked when the file was opened
    c, a, b, f, d, e = (float(v) for v in str(attributes["GeoTransform"]).split())
    wkt = str(attributes["crs_wkt"])
    try:
        crs = parse_crs(wkt)
        metres = crs.is_projected and abs(crs.linear_units_factor[1] - 1) < 1e-6
    except CRSError as error:
        raise ArtefactError(
            f"{path}:/crs: expected a CRS as WKT, found what PROJ does not read ({error}); write it again."
        ) from None
    if not metres:
        raise ArtefactError(f"{path}:/crs: expected a map projection in metres, found another CRS; write it again.")
    radius = crs_radius(crs)
    if radius is not None and abs(radius - file.attrs["body_radius_m"]) > BODY_TOLERANCE * radius:
        raise ArtefactError(
            f"{path}: expected body_radius_m near its CRS's radius of {radius:g} m, found {file.attrs['body_radius_m']:g}; "
            "write it again."
        )
    height, width = file["y"].size, file["x"].size
    return Grid(wkt, Affine(a, b, c, d, e, f), height, width, float(file.attrs["body_radius_m"]))


def check_same_grid(svbrdf: object, file: h5py.File, scene: object, terrain: h5py.File) -> None:
    """Whether a map lies on the grid of a scene. svbrdf, scene : their paths. Raises ArtefactError."""
    mine, other = read_grid(file, svbrdf), read_grid(terrain, scene)
    if abs(mine.radius - other.radius) > 1e-6 * other.radius:
        raise ArtefactError(
            f"{svbrdf}: expected a map of a body of {other.radius:g} m as {scene}, found one of {mine.radius:g} m; "
            "infer the map from this scene."
        )
    same = np.allclose(mine.transform, other.transform, rtol=0, atol=1e-6 * other.gsd) and mine.crs == other.crs
    if not same or (mine.height, mine.width) != (other.height, other.width):
        raise ArtefactError(
            f"{svbrdf}: expected the grid of {scene} ({other.height} x {other.width} px at {other.gsd:g} m), found another "
            f"({mine.height} x {mine.width} px at {mine.gsd:g} m); infer the map from this scene."
        )


def require_crs(where: str, crs: CRS | None, transform: Affine, body: Body) -> CRS:
    """The CRS of a raster that must be a map of the body. Raises InputError, and GeometryError for another body."""
    if crs is None or transform == Affine.identity():
        raise InputError(
            f"{where}: expected a map-projected raster, found no CRS; give the camera of a raw image, or {_assign_crs(body.radius)}."
        )
    if not all(map(math.isfinite, tuple(transform)[:6])) or transform.determinant == 0:
        raise InputError(
            f"{where}: expected pixels of a finite size, found the transform {tuple(transform)[:6]}; set it with gdal_edit.py -a_ullr."
        )
    try:
        on_body = bool((crs.is_geographic or crs.is_projected) and crs.to_wkt() and crs.to_proj4())
    except CRSError:
        on_body = False
    if not on_body:
        raise InputError(
            f"{where}: expected longitude and latitude or a map projection, found another CRS (local, three-dimensional or "
            f"unknown to PROJ); {_assign_crs(body.radius)}."
        )
    if crs.is_geographic and not -360.0 <= transform.c <= 540.0:
        raise InputError(
            f"{where}: expected longitudes of -360 .. 540 deg, found a raster that begins at {transform.c:g}; take off whole "
            "turns (gdal_edit.py -a_ullr)."
        )
    check_body(where, crs, body)
    return crs
