"""A terrain on a metric grid with its reflectance, read window by window."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from rasterio.io import DatasetReader
from rasterio.windows import Window

from schemas.artefacts import SCENE, SVBRDF
from schemas.errors import ArtefactError, ConfigError, InputError
from schemas.reading import open_artefact, read_kind, read_strings
from stages.common.arrays import Floats32
from stages.physics.bodies.spheres import Body
from stages.physics.maps.grid import Grid, read_grid, require_crs
from stages.physics.maps.rasters import check_metres, check_single_band, open_raster, pixel_size_at, read_window
from stages.physics.photometry import ReflectanceModel, in_radians, named_model
from stages.physics.photometry.albedo_factor import AlbedoFactor
from stages.physics.photometry.published import find_reflectance

_HDF5_SUFFIXES = (".h5", ".hdf5", ".nc")
SHADOWED = 0.5  # of the Sun's disc: from there on a pixel counts as shadow
_UNEVEN = 0.01  # a raw DEM's pixels may differ in true width and height by this share


class Elevation:
    """A DEM that is read by slicing, whether it is a raster or an HDF5 variable; m, NaN where unknown.

    source : HDF5 dataset or open raster; radius_offset : m, taken off a raster that holds radii
    """

    def __init__(self, source: h5py.Dataset | DatasetReader, radius_offset: float = 0.0) -> None:
        self._source, self._offset = source, radius_offset
        self.shape: tuple[int, int] = source.shape
        self.dtype = np.dtype(np.float32)
        self.ndim = 2

    def __getitem__(self, key: tuple[slice, slice]) -> Floats32:
        (r0, r1, rs), (c0, c1, cs) = (s.indices(n) for s, n in zip(key, self.shape, strict=True))
        if isinstance(self._source, h5py.Dataset):
            return np.asarray(self._source[r0:r1, c0:c1], np.float32)[::rs, ::cs]
        block = read_window(self._source, Window(c0, r0, c1 - c0, r1 - r0))
        return (block - self._offset).astype(np.float32)[::rs, ::cs]


@dataclass(frozen=True)
class AlbedoError:
    """Errors of a map with albedo, as `lunargr albedo` found them from the residuals of photographs.

    albedo, std : (H, W) datasets; own : () relative standard deviation of a photograph's own error
    cos_incidence, interval : (B, 2) half-widths of the 68 and 95 % intervals, in standard deviations, by cos(incidence) (B,)
    shadow : (2,) half-widths of both in shadow, where errors are those of the shadow's edge, over sin(Sun's elevation)
    """

    albedo: h5py.Dataset
    std: h5py.Dataset
    own: float
    cos_incidence: NDArray[np.float64]
    interval: NDArray[np.float64]
    shadow: NDArray[np.float64]

    @staticmethod
    def read(file: h5py.File) -> AlbedoError | None:
        """The errors that a map holds, None where it has no albedo or no errors of it."""
        if not all(name in file for name in ("albedo", "albedo_std", "albedo_image_std")):
            return None
        own = math.sqrt(float(np.median((file["albedo_image_std"][...] ** 2).sum(axis=1))))
        names = ("albedo_bin_cos_incidence", "albedo_interval_68", "albedo_interval_95")
        cosines, inner, outer = (file[n][...] for n in names) if names[0] in file else ([1.0], [1.0], [1.96])
        shadow = file["albedo_interval_shadow"][...] if "albedo_interval_shadow" in file else np.zeros(2)
        interval = np.stack([inner, outer], axis=1)
        return AlbedoError(file["albedo"], file["albedo_std"], own, np.asarray(cosines), interval, shadow)

    def half_widths(
        self, row: int, col: int, image: NDArray, cos_incidence: NDArray, shadow: NDArray, sun_sine: float | NDArray
    ) -> list[Floats32]:
        """Half-widths of the 68 and 95 % intervals of an unseen photograph's pixels, (h, w) I/F each.

        image : (h, w) I/F of the map; cos_incidence : (h, w); shadow : (h, w) bool; sun_sine : of the Sun's elevation
        """
        part = np.s_[row : row + image.shape[0], col : col + image.shape[1]]
        std = np.hypot(self.std[part] / np.maximum(self.albedo[part], 1e-6), self.own) * np.abs(image)
        found = []
        for level in (0, 1):
            lit = np.interp(cos_incidence, self.cos_incidence, self.interval[:, level]) * std
            found.append(np.where(shadow, self.shadow[level] * sun_sine, lit).astype(np.float32))
        return found


@dataclass
class Surface:
    """Terrain and reflectance on one grid.

    elevation : windows (h, w), m; coefficients : (C, H, W) dataset or None where ``uniform`` (C,) holds everywhere
    albedo : (H, W) dataset of the factor that is the last parameter of ``model``, None where the map has none
    deviations : (M, H, W) dataset, standard deviations of the coefficients ``mapped``, or None where unknown
    image_noise : I/F, standard deviation of photographs about renderings that the coefficients do not explain
    albedo_error : None where the map holds none
    image_units : 'dn' where the map was learned from images in DN: its brightness is relative
    """

    path: Path
    grid: Grid
    elevation: Elevation
    model: ReflectanceModel
    coefficients: h5py.Dataset | None
    uniform: NDArray[np.float32]
    albedo: h5py.Dataset | None = None
    deviations: h5py.Dataset | None = None
    mapped: tuple[str, ...] = ()
    image_noise: float = 0.0
    albedo_error: AlbedoError | None = None
    image_units: str = "iof"

    @property
    def knows_errors(self) -> bool:
        """Whether renderings have standard deviations."""
        return self.deviations is not None or self.albedo_error is not None

    def without_errors(self) -> Surface:
        """The same without standard deviations and without albedo."""
        if self.albedo is None:
            return replace(self, deviations=None)
        model = self.model.model if isinstance(self.model, AlbedoFactor) else self.model
        return replace(self, model=model, albedo=None, deviations=None, albedo_error=None)

    def read_deviations(self, row: int, col: int, height: int, width: int) -> dict[str, Floats32]:
        """(h, w) standard deviations by name; none where they are unknown."""
        if self.deviations is None:
            return {}
        planes = self.deviations[:, row : row + height, col : col + width]
        return dict(zip(self.mapped, planes, strict=True))

    def read_coefficients(self, row: int, col: int, height: int, width: int) -> Floats32:
        """(C, h, w), or (C, 1, 1) where they are the same everywhere."""
        if self.coefficients is None:
            return self.uniform[:, None, None]
        part = np.s_[row : row + height, col : col + width]
        if self.albedo is None:
            return self.coefficients[:, *part]
        return np.concatenate([self.coefficients[:, *part], self.albedo[part][None]])

    def read_padded(self, row: int, col: int, height: int, width: int, margin: int) -> Floats32:
        """(height + 2 margin, width + 2 margin) elevations, m, NaN outside the map."""
        result = np.full((height + 2 * margin, width + 2 * margin), np.nan, np.float32)
        top, left = max(0, row - margin), max(0, col - margin)
        bottom = min(self.grid.height, row + height + margin)
        right = min(self.grid.width, col + width + margin)
        inner = np.s_[top - row + margin : bottom - row + margin, left - col + margin : right - col + margin]
        result[inner] = self.elevation[top:bottom, left:right]
        return result

    def height_range(self) -> tuple[float, float]:
        """Lowest and highest elevation, m, by one pass over the DEM. Raises InputError where there is none."""
        low, high = np.inf, -np.inf
        rows = max(1, (1 << 23) // self.grid.width)
        for row in range(0, self.grid.height, rows):
            block = self.elevation[row : row + rows, 0 : self.grid.width]
            known = block[np.isfinite(block)]
            if known.size:
                low, high = min(low, float(known.min())), max(high, float(known.max()))
        if not np.isfinite(low):
            raise InputError(f"{self.path}: expected elevations, found only nodata; is it the right band and file?")
        return low, high


@contextlib.contextmanager
def open_surface(path: Path, model: str | None, parameters: Mapping[str, float], body: Body) -> Iterator[Surface]:
    """Open svbrdf.h5 (its own model), or a DEM or scene.h5 with one model and one set of parameters everywhere.

    Raises LunargrError.
    """
    if path.suffix.lower() not in _HDF5_SUFFIXES:
        with open_raster(path, "a DEM, scene.h5 or svbrdf.h5", "elevation") as dataset:
            grid = _metric_grid(path, dataset, body)
            yield _uniform_surface(path, grid, _raw_elevation(dataset, body), model, parameters)
        return
    kind = read_kind(path).name
    if kind not in ("svbrdf", "scene"):
        raise ArtefactError(
            f"{path}: expected an 'svbrdf' (from 'lunargr infer') or a 'scene' (from 'lunargr ingest'), found a '{kind}'; check the order of the files."
        )
    with open_artefact(path, SVBRDF if kind == "svbrdf" else SCENE) as file:
        grid, elevation = read_grid(file, path), Elevation(file["elevation"])
        if kind == "svbrdf":
            yield _mapped_surface(path, file, grid, elevation, model)
        else:
            yield _uniform_surface(path, grid, elevation, model, parameters)


@contextlib.contextmanager
def open_terrain(path: Path, model: str | None, parameters: Mapping[str, float], body: Body) -> Iterator[Surface]:
    """Like :func:`open_surface`, but only the terrain of svbrdf.h5 is used."""
    if path.suffix.lower() in _HDF5_SUFFIXES and read_kind(path).name == "svbrdf":
        with open_artefact(path, SVBRDF) as file:
            yield _uniform_surface(path, read_grid(file, path), Elevation(file["elevation"]), model, parameters)
        return
    with open_surface(path, model, parameters, body) as surface:
        yield surface


def _mapped_surface(path: Path, file: h5py.File, grid: Grid, elevation: Elevation, model: str | None) -> Surface:
    """An svbrdf.h5 with its own model and maps. Raises ConfigError where another model is named, ArtefactError."""
    name = str(file.attrs["model"])
    if model is not None:
        raise ConfigError(
            f"`model`: {path.name} holds its own reflectance ({name}); to render its terrain with another model give `dem` {path.name}."
        )
    reflectance = named_model(path, file)
    expected, found = [p.name for p in reflectance.parameters], read_strings(file, "coefficient_name")
    if found != expected:
        raise ArtefactError(
            f"{path}:/coefficient_name: expected {', '.join(expected)} (model {reflectance.name}), found {', '.join(found)}; write it again with 'lunargr infer'."
        )
    albedo = file.get("albedo")
    if albedo is not None:
        reflectance = AlbedoFactor(reflectance)
    surface = Surface(path, grid, elevation, reflectance, file["coefficients"], np.empty(0, np.float32), albedo)
    surface.albedo_error = AlbedoError.read(file)
    surface.image_units = str(file.attrs.get("image_units", "iof"))
    if "coefficients_std" in file:
        surface.deviations = file["coefficients_std"]
        surface.mapped = tuple(read_strings(file, "map_name"))
        surface.image_noise = float(np.nan_to_num(file.attrs.get("image_noise", 0.0)))
    return surface


def _uniform_surface(
    path: Path, grid: Grid, elevation: Elevation, model: str | None, parameters: Mapping[str, float]
) -> Surface:
    """A terrain with one model and one set of parameters everywhere."""
    reflectance, values = _named_model(path, model)
    return Surface(path, grid, elevation, reflectance, None, uniform_coefficients(reflectance, values, parameters))


def _raw_elevation(dataset: DatasetReader, body: Body) -> Elevation:
    """The heights of a raw DEM; LOLA cubes keep radii instead."""
    size = min(512, dataset.height, dataset.width)
    middle = Window((dataset.width - size) // 2, (dataset.height - size) // 2, size, size)
    sample = read_window(dataset, middle)
    finite = sample[np.isfinite(sample)]
    holds_radii = finite.size and abs(float(np.median(finite))) > 0.5 * body.radius
    return Elevation(dataset, body.radius if holds_radii else 0.0)


def _named_model(path: Path, model: str | None) -> tuple[ReflectanceModel, dict[str, float]]:
    """A model with its values, since a terrain has no reflectance of its own. Raises ConfigError where none is named."""
    if model is None:
        raise ConfigError(
            f"{path}: holds a terrain and no reflectance; name one with `dem` {path} `model` NAME ('lunargr models' lists them), "
            "or render the svbrdf.h5 of 'lunargr infer'."
        )
    return find_reflectance(model)


def uniform_coefficients(
    model: ReflectanceModel, values: Mapping[str, float], parameters: Mapping[str, float]
) -> NDArray[np.float32]:
    """(C,) in the model's order. Raises RegistryError or ConfigError.

    values : of all parameters, for those that ``parameters`` lacks
    parameters : name -> value; angles in radians, or in degrees under their name with ``_deg``
    """
    found = dict(values) | in_radians(model, parameters)
    for p in model.parameters:
        if not p.lower <= found[p.name] <= p.upper:
            raise ConfigError(
                f"`parameters`: expected {p.name} of {model.name} in {p.lower:g}..{p.upper:g}{f' {p.unit}' if p.unit == 'rad' else ''}, "
                f"found {found[p.name]:g}."
            )
    return np.array([found[p.name] for p in model.parameters], np.float32)


def _metric_grid(path: Path, dataset: DatasetReader, body: Body) -> Grid:
    """The grid of a raw DEM that can be rendered as it stands: north up, square metres."""
    crs = require_crs(str(path), dataset.crs, dataset.transform, body)
    check_single_band(path, dataset, "a DEM")
    check_metres(path, dataset)
    t = dataset.transform
    advice = "bring it to a metric grid with 'lunargr ingest' and render its scene.h5."
    if crs.is_geographic or abs(crs.linear_units_factor[1] - 1.0) > 1e-9:
        raise InputError(f"{path}: expected a DEM on a grid of metres, found degrees or other units; {advice}")
    if t.b != 0 or t.d != 0 or t.a <= 0 or t.e >= 0 or abs(t.a + t.e) > _UNEVEN * t.a:
        raise InputError(
            f"{path}: expected a north-up DEM with square pixels, found the transform {tuple(t)[:6]}; {advice}"
        )
    east, north = pixel_size_at(dataset, body.radius, dataset.height / 2, dataset.width / 2)
    if abs(east - north) > _UNEVEN * max(east, north):
        raise InputError(
            f"{path}: expected pixels as wide as high on the ground, found {east:.4g} x {north:.4g} m (its projection stretches them here); {advice}"
        )
    return Grid(crs.to_wkt(), t, dataset.height, dataset.width, body.radius)
