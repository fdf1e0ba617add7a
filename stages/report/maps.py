"""Coefficient maps and albedo: formula, colour bars, scale and north."""

from __future__ import annotations

import math

import h5py
import numpy as np
from markupsafe import Markup

from schemas import read_strings
from stages.common import page
from stages.common.page import pictures
from stages.physics.photometry import get_model

LONGEST, MANY = 800, 10  # px of a map on the page, where there are no more maps than so many
ALBEDO = {
    "albedo": ("Albedo: factor on the I/F of the coefficients", "gray"),
    "albedo_std": ("Standard deviation of the albedo", "viridis"),
    "albedo_images": ("Images that made a pixel's albedo", "cividis"),
}


def svbrdf(file: h5py.File) -> page.Section:
    """The maps that vary, the coefficients that do not, standard deviations, albedo."""
    section = page.Section("Reflectance maps")
    model = get_model(str(file.attrs["model"]))
    units = {p.name: p.unit for p in model.parameters}
    names = read_strings(file, "coefficient_name")
    longest = _longest(file)
    known = pictures.read_thinned(file["valid"], longest=longest)[0] > 0
    figures, constant = [], []
    for k, name in enumerate(names):
        values = np.where(known, pictures.read_thinned(file["coefficients"], k, longest=longest)[0], np.nan)
        present = values[np.isfinite(values)]
        if len(present) and np.ptp(present) <= 1e-6 * max(1e-12, abs(float(present.mean()))):
            constant.append([name, _unit(units.get(name, "1")) or "-", f"{float(present.mean()):.4g}"])
        else:
            figures.append(draw_map(file, values, f"Coefficient {name}", units.get(name, "1")))
    height, width = file["valid"].shape
    gsd = float(file.attrs["gsd_m"])
    section.add(
        page.paragraph(
            f"{model.name}: {model.title}. I/F = {model.formula}, with incidence i, emission e and phase g. "
            f"{width:,} x {height:,} px at {gsd:g} m: {width * gsd / 1000:.1f} x {height * gsd / 1000:.1f} km."
        ),
        page.grid(figures),
    )
    if constant:
        section.add(page.table("Coefficients that are the same everywhere", ["coefficient", "unit", "value"], constant))
    if "coefficients_std" in file and "map_name" in file:
        section.add(page.heading("Standard deviations of single pixels' coefficients"))
        section.add(page.grid(_deviations(file, known, units)))
    if "albedo" in file:
        section.add(page.heading("Albedo from photographs"), *_albedo(file, known))
    return section


def _longest(file: h5py.File) -> int:
    """px along the longer side of each map: the page stays light, however many coefficients a model has."""
    count = len(file["coefficients"]) + sum(name in file for name in ALBEDO)
    count += len(file["coefficients_std"]) if "coefficients_std" in file else 0
    return round(LONGEST * min(1.0, math.sqrt(MANY / count)))


def _deviations(file: h5py.File, known: np.ndarray, units: dict[str, str]) -> list[Markup]:
    figures = []
    for k, name in enumerate(read_strings(file, "map_name")):
        values = pictures.read_thinned(file["coefficients_std"], k, longest=_longest(file))[0]
        title = f"Standard deviation of {name}"
        figures.append(draw_map(file, np.where(known, values, np.nan), title, units.get(name, "1"), "viridis"))
    return figures


def _albedo(file: h5py.File, known: np.ndarray) -> list[Markup]:
    """Albedo, its standard deviation, and how many images made it."""
    shown = []
    for name, (title, colours) in ALBEDO.items():
        if name in file:
            values = pictures.read_thinned(file[name], longest=_longest(file))[0].astype(float)
            shown.append(draw_map(file, np.where(known, values, np.nan), title, "1", colours))
    count = len(read_strings(file, "albedo_image_id"))
    text = (
        f"What {count} photographs show in the same way and the terrain does not. It is 1 where they say nothing or do "
        "not agree: there the map stays as the terrain gave it."
    )
    return [page.paragraph(text), page.grid(shown)]


def draw_map(file: h5py.File, values: np.ndarray, title: str, unit: str, colours: str = "magma") -> Markup:
    """One map with statistics, colour bar, scale bar and north arrow."""
    low, high = pictures.limits(values, 1.0)
    present = values[np.isfinite(values)]
    statistics = "no valid pixel"
    if len(present):
        statistics = f"mean {present.mean():.4g}, standard deviation {present.std():.2g}"
    extent = file["valid"].shape[1] * float(file.attrs["gsd_m"])
    length = round_length(extent / 4)
    label = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    return page.picture(
        pictures.photo_uri(pictures.coloured(values, low, high, colours)),
        f"{title}{f', {_unit(unit)}' if _unit(unit) else ''}: {statistics}. Colours end at the 1st and 99th percentile.",
        alt=title,
        below=page.scale_bar(100 * length / extent, label) + page.colour_bar(low, high, colours, _unit(unit)),
    )


def round_length(longest: float) -> float:
    """The largest of 1, 2, 5 x 10^n that is not above ``longest``."""
    power = 10.0 ** math.floor(math.log10(longest))
    return max(step * power for step in (1, 2, 5) if step * power <= longest * (1 + 1e-9))


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit
