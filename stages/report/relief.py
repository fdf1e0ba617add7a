"""Relief that photographs added to a DEM: before and after, where it is known, and at which wavelengths."""

from __future__ import annotations

import h5py
import numpy as np
from markupsafe import Markup

from schemas import read_strings
from stages.common import page
from stages.common.page import pictures
from stages.physics.images.spectrum import by_wavelength, waves
from stages.report.maps import draw_map, svbrdf

WINDOW = 256  # px, of the pair before and after


def with_relief(file: h5py.File) -> page.Section:
    """The section of a map, and its refined elevation where it has one."""
    section = svbrdf(file)
    if "elevation_correction" in file:
        section.add(page.heading("Relief from photographs"), *_relief(file))
    return section


def _relief(file: h5py.File) -> list[Markup]:
    """The correction of a map's elevation, or why there is none."""
    count = len(read_strings(file, "albedo_image_id"))
    gain, low, high = (float(v) for v in file["refine_gain_percent"][...])
    reason = str(file.attrs["refine_reason"])
    if reason:
        return [page.paragraph(f"The elevation stays as the DEM has it. Reason: {reason}.")]
    part = _window(file)
    after, change = (file[name][part].astype(float) for name in ("elevation", "elevation_correction"))
    limits = pictures.limits(_lit(after), 0.5)
    dem, new = (pictures.photo_uri(pictures.coloured(_lit(v), *limits, "gray")) for v in (after - change, after))
    pair = page.slider(dem, new, ("DEM", "refined"), f"Slopes towards the north-west, {change.shape[1]} px wide")
    maps = [
        draw_map(file, pictures.read_thinned(file[name])[0].astype(float), title, "m", colours)
        for name, title, colours in (
            ("elevation_correction", "Correction of the elevation", "RdBu"),
            ("elevation_std", "Standard deviation of the corrected elevation", "viridis"),
        )
    ]
    return [
        page.paragraph(
            f"{count} photographs corrected the elevation. Photographs left out in turn have a squared error that is {gain:.1f} % lower "
            f"({low:.1f} to {high:.1f}) than with albedo alone."
        ),
        page.grid([pair, *maps]),
        page.chart(_spectrum(file, change), "Standard deviation of a wave by its length"),
    ]


def _window(file: h5py.File) -> tuple[slice, slice]:
    """The middle of the map."""
    starts = [max(0, (n - WINDOW) // 2) for n in file["elevation"].shape]
    return tuple(slice(s, min(s + WINDOW, n)) for s, n in zip(starts, file["elevation"].shape, strict=True))  # type: ignore[return-value]


def _lit(elevation: np.ndarray) -> np.ndarray:
    """How ground faces the north-west, where lamps of maps stand."""
    south, east = np.gradient(elevation)
    return east + south


def _spectrum(file: h5py.File, change: np.ndarray) -> str:
    """What the DEM lacks as the photographs tell, and what was added here."""
    known = np.isfinite(change)
    count = by_wavelength(np.ones(change.shape, np.float32))
    length = file["refine_wavelength_px"][...]
    figure, axes = pictures.new_chart(6.4, 3.3)
    found = np.sqrt(by_wavelength(waves(np.where(known, change, 0).astype(np.float32)) ** 2) / np.maximum(count, 1))
    axes.plot(length, file["refine_elevation_wave_std"][...], "o-", color="#c08a2e", label="what the DEM lacks")
    axes.plot(length, found, "o-", color="#3b8ecb", label="correction")
    axes.set(xscale="log", yscale="log", xlabel="wavelength, px", ylabel="m")
    ticks = 2 ** np.arange(1, 7)
    axes.set_xticks(ticks, [str(t) for t in ticks])
    axes.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
    axes.legend(frameon=False, fontsize=8, labelcolor=pictures.INK)
    return pictures.chart_svg(figure, "relief")
