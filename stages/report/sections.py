"""Terrain, pairs and training: one function per artefact, from the open file to a section."""

from __future__ import annotations

import json

import h5py
import numpy as np

from schemas import SPLITS, UNITS, read_strings
from schemas.packing import read
from stages.common import page
from stages.common.page import pictures

SPLIT_COLOURS = {"train": "#7f8a97", "validation": "#c08a2e", "test": "#3b8ecb"}


def scene(file: h5py.File) -> page.Section:
    """The DEM and where images cover it."""
    section = page.Section("Terrain and images")
    gsd = float(file.attrs["gsd_m"])
    height, width = file["elevation"].shape
    elevation, step = pictures.read_thinned(file["elevation"])
    known, _ = pictures.read_thinned(file["dem_valid"])
    elevation = np.where(known > 0, elevation, np.nan)
    relief, low, high = pictures.shaded_relief(elevation, gsd * step)
    cover = np.zeros(elevation.shape)
    frames = len(file["valid"])
    for k in range(frames):
        cover += pictures.read_thinned(file["valid"], k)[0] > 0
    cover = np.where(cover > 0, cover, np.nan)
    top = max(1.0, float(np.nanmax(cover)) if np.isfinite(cover).any() else 1.0)
    section.add(
        page.paragraph(
            f"{width:,} x {height:,} px at {gsd:g} m: {width * gsd / 1000:.1f} x {height * gsd / 1000:.1f} km, "
            f"{100 * np.mean(known > 0):.1f} % of it valid; {frames} images."
        ),
        page.grid(
            [
                page.picture(
                    pictures.photo_uri(relief),
                    "Elevation above the reference sphere, with relief shading",
                    below=page.colour_bar(low, high, "cividis", "m"),
                ),
                page.picture(
                    pictures.data_uri(pictures.coloured(cover, 0, top, "viridis")),
                    "How many images show each pixel",
                    below=page.colour_bar(0, top, "viridis", "images"),
                ),
            ]
        ),
    )
    units = {value: name for name, value in UNITS}
    columns = [
        file[n][...] for n in ("units", "subsolar_longitude_deg", "subsolar_latitude_deg", "spacecraft_altitude_m")
    ]
    times = read_strings(file, "start_time")
    area = file["valid_area_m2"][...] / 1e6
    rows = [
        [name, time or "-", units.get(int(unit), "-"), f"{lon:.2f}", f"{lat:.2f}", f"{alt / 1000:.1f}", f"{km2:,.1f}"]
        for name, time, unit, lon, lat, alt, km2 in zip(
            read_strings(file, "image_id"), times, *columns, area, strict=True
        )
    ]
    header = ["image", "time (UTC)", "units", "sub-solar lon, deg", "sub-solar lat, deg", "altitude, km"]
    section.add(page.table("Images", [*header, "valid ground, km2"], rows))
    return section


def pairs(file: h5py.File) -> page.Section:
    """How many crops there are, where they lie, and what some look like."""
    section = page.Section("Pairs of terrain and image")
    split = file["split"][...]
    tile = file["tile"][...] if "tile" in file else file["site"][...]
    frame = file["image_index"][...]
    sun = np.degrees(np.arcsin(np.clip(file["sun_direction_enu"][:, 2], -1, 1)))
    camera = file["camera_position_enu"][...]
    tilt = np.degrees(np.arctan2(np.hypot(camera[:, 0], camera[:, 1]), camera[:, 2]))
    rows = []
    for name, value in SPLITS:
        mine = split == value
        if mine.any():
            rows.append(
                [
                    name, f"{mine.sum():,}", str(len(np.unique(frame[mine]))), str(len(np.unique(tile[mine]))),
                    f"{90 - sun[mine].max():.1f} .. {90 - sun[mine].min():.1f}",
                    f"{tilt[mine].min():.1f} .. {tilt[mine].max():.1f}",
                ]
            )  # fmt: skip
    size = file["elevation"].shape[1:]
    section.add(
        page.paragraph(f"{len(split):,} crops of {size[1]} x {size[0]} px, split by ground tile."),
        page.table(
            "The geographic split",
            ["part", "pairs", "images", "tiles", "Sun from zenith, deg", "view from nadir, deg"],
            rows,
        ),
        page.chart(_chart_of_places(file, split), "Crop centres, coloured by part of the split"),
    )
    chosen = np.linspace(0, len(split) - 1, min(8, len(split))).astype(int)
    figures = []
    for k in chosen:
        valid = file["valid"][k] > 0
        image = np.where(valid, read(file["image"], k), np.nan)
        low, high = pictures.limits(image)
        caption = f"pair {k}: Sun {90 - sun[k]:.0f} deg, view {tilt[k]:.0f} deg"
        figures.append(page.picture(pictures.data_uri(pictures.coloured(image, low, high, "gray")), caption))
    section.add(page.heading("Some measured crops, each in its own range"), page.crops(figures))
    return section


def _chart_of_places(file: h5py.File, split: np.ndarray) -> str:
    """SVG of the crops' centres. split : (N,)"""
    figure, axes = pictures.new_chart(6.2, 3.9)
    longitude, latitude = file["longitude_deg"][...], file["latitude_deg"][...]
    for name, value in SPLITS:
        mine = np.flatnonzero(split == value)
        mine = mine[:: max(1, len(mine) // 1500)]
        style = {"color": SPLIT_COLOURS[name], "markersize": 3, "label": name, "alpha": 0.8}
        axes.plot(longitude[mine], latitude[mine], ".", rasterized=True, **style)  # as shapes, a third of the page
    axes.set(xlabel="east longitude, deg", ylabel="latitude, deg")
    axes.set_aspect(1 / max(0.05, np.cos(np.radians(np.mean(latitude)))), adjustable="datalim")
    axes.legend(frameon=False, markerscale=3, fontsize=8)
    return pictures.chart_svg(figure, "where")


def checkpoint(file: h5py.File) -> page.Section:
    """Training curves."""
    section = page.Section("Training")
    train, validation, seconds = (file[n][...] for n in ("train_loss", "validation_loss", "epoch_seconds"))
    best = int(file.attrs["best_epoch"])
    names = json.loads(str(file.attrs["coefficients"]))
    figure, axes = pictures.new_chart(6.4, 3.3)
    epochs = np.arange(1, len(train) + 1)
    axes.plot(epochs, train, color="#8a929c", label="training", marker="o", markersize=2.5)
    axes.plot(epochs, validation, color="#3b8ecb", label="validation", marker="o", markersize=2.5)
    axes.axvline(best, color="#c08a2e", linewidth=1, linestyle=":", label=f"kept: epoch {best}")
    axes.locator_params(axis="x", integer=True)
    positive = np.concatenate([train, validation])
    if np.all(positive[np.isfinite(positive)] > 0):
        axes.set_yscale("log")
    axes.set(xlabel="epoch", ylabel="mean squared error")
    axes.legend(frameon=False, fontsize=8)
    section.add(
        page.paragraph(
            f"Model {file.attrs['model']} with coefficients {', '.join(names)}; {len(train)} epochs in "
            f"{seconds.sum() / 60:.1f} min. The kept weights have a validation error of {validation[best - 1]:.4g}."
        ),
        page.chart(pictures.chart_svg(figure, "training"), "Training and validation loss"),
    )
    return section
