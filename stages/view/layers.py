"""What a page shows: terrain, coefficients and every other map of svbrdf.h5, at a size that a browser can hold."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from rasterio.transform import Affine

from schemas import SVBRDF, ArtefactError, InputError, RegistryError, open_artefact, read_strings
from schemas.reading import read_unit
from stages.common.arrays import Floats32
from stages.common.brightness import NAMES
from stages.physics.maps.grid import Grid, read_grid
from stages.physics.photometry import ReflectanceModel, get_model, model_names
from stages.physics.photometry.albedo_factor import FACTOR, AlbedoFactor

READ_ROWS = 512
_OWN = ("x", "y", "coefficients", "coefficient_name", "albedo", "elevation", "valid", "crs")


@dataclass(frozen=True)
class Layer:
    """One map beside the terrain. values : (H, W) float32, NaN where unknown"""

    name: str
    title: str
    unit: str
    values: Floats32


@dataclass(frozen=True)
class Content:
    """The map of one page.

    elevation : (H, W) float32, m above the sphere, NaN where unknown; coefficients in the model's order, then the rest
    factor : pixels of the file along each side of one pixel here; brightness : name of the image's unit
    """

    grid: Grid
    model: ReflectanceModel
    elevation: Floats32
    coefficients: list[Layer]
    others: list[Layer]
    factor: int
    brightness: str


def read_content(path: Path, max_px: int) -> Content:
    """The maps of svbrdf.h5, as means over blocks of pixels where it is larger than ``max_px``. Raises LunargrError."""
    with open_artefact(path, SVBRDF) as file:
        model = get_model(str(file.attrs["model"]))
        if model.glsl is None:
            able = [name for name in model_names() if get_model(name).glsl is not None]
            raise RegistryError(
                f"{path}: its model {model.name} has no formula for a page (glsl in its file); models that have one: {', '.join(able)}."
            )
        units = str(file.attrs.get("image_units", "iof"))
        names, expected = read_strings(file, "coefficient_name"), [p.name for p in model.parameters]
        if names != expected:
            raise ArtefactError(
                f"{path}:/coefficient_name: expected {', '.join(expected)} (model {model.name}), found {', '.join(names)}; write it again with 'lunargr infer'."
            )
        full = read_grid(file, path)
        factor = max(1, math.ceil(max(full.height, full.width) / max_px))
        if min(full.height, full.width) // factor < 2:
            raise InputError(f"{path}: expected a map of at least 2 x 2 pixels, found {full.height} x {full.width}.")
        elevation = _shrunk(file["elevation"], (), factor)
        coefficients = [
            Layer(p.name, p.description, p.unit, _shrunk(file["coefficients"], (k,), factor))
            for k, p in enumerate(model.parameters)
        ]
        if "albedo" in file:  # what `lunargr render` multiplies by, too
            model = AlbedoFactor(model)
            coefficients.append(Layer("albedo", FACTOR.description, FACTOR.unit, _shrunk(file["albedo"], (), factor)))
        others = _others(file, full, names, factor)
    known = np.isfinite(elevation)
    for layer in coefficients:
        known &= np.isfinite(layer.values)
    if not known.any():
        raise InputError(f"{path}: expected valid coefficients and elevations, found none; nothing to show.")
    grid = coarse_grid(full, factor, elevation.shape)
    return Content(grid, model, elevation, coefficients, others, factor, NAMES[units])


def coarse_grid(full: Grid, factor: int, shape: tuple[int, ...]) -> Grid:
    """The grid of means over ``factor`` x ``factor`` pixels, of which there are ``shape``."""
    return Grid(full.crs_wkt, full.transform @ Affine.scale(factor), shape[0], shape[1], full.radius)


def _others(file: h5py.File, grid: Grid, names: list[str], factor: int) -> list[Layer]:
    """Every further map on the grid, whoever wrote it: uncertainties, albedo, counts."""
    mapped = read_strings(file, "map_name") if "map_name" in file else names
    found = []
    for name, variable in file.items():
        if name in _OWN or not isinstance(variable, h5py.Dataset) or variable.dtype.kind not in "fiu":
            continue
        if variable.shape == (grid.height, grid.width):
            found.append(_layer(variable, name, name, (), factor))
        elif variable.ndim == 3 and variable.shape[1:] == (grid.height, grid.width):
            # of every coefficient, or of those that vary by place
            deviations = name == "coefficients_std"
            which = mapped if deviations else names
            if len(which) == len(variable):
                found += [
                    _layer(
                        variable,
                        f"{coefficient}_std" if deviations else f"{name}_{coefficient}",
                        f"{name} of {coefficient}",
                        (k,),
                        factor,
                    )
                    for k, coefficient in enumerate(which)
                ]
    return [layer for layer in found if np.isfinite(layer.values).any()]


def _layer(variable: h5py.Dataset, name: str, title: str, lead: tuple[int, ...], factor: int) -> Layer:
    long_name = variable.attrs.get("long_name")
    text = title.replace("_", " ") + (f": {long_name}" if long_name is not None else "")
    return Layer(name, text, read_unit(variable) or "1", _shrunk(variable, lead, factor))


def _shrunk(variable: h5py.Dataset, lead: tuple[int, ...], factor: int) -> Floats32:
    """(H // factor, W // factor) means of the known pixels of each block, NaN where most are unknown."""
    height, width = (n // factor for n in variable.shape[-2:])
    result = np.empty((height, width), np.float32)
    rows = max(1, READ_ROWS // factor)
    for row in range(0, height, rows):
        count = min(rows, height - row)
        part = np.asarray(variable[(*lead, np.s_[row * factor : (row + count) * factor])], np.float32)
        result[row : row + count] = block_mean(part[:, : width * factor], factor)
    return result


def block_mean(values: Floats32, factor: int) -> Floats32:
    """(H, W) -> (H // factor, W // factor), means of the pixels that are known, NaN where more than half of them are not."""
    if factor == 1:
        return values
    height, width = (n // factor for n in values.shape)
    blocks = values[: height * factor, : width * factor].reshape(height, factor, width, factor)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a block without any known pixel
        mean = np.asarray(np.nanmean(blocks, axis=(1, 3), dtype=np.float64))
    mean[np.isfinite(blocks).mean(axis=(1, 3)) < 0.5] = np.nan
    return np.asarray(mean, np.float32)
