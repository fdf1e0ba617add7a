"""The small scene as a camera takes it, not map-projected: the image, its camera model, its table, and the stages on them."""

from __future__ import annotations

import csv
import json
import math

import h5py
import numpy as np
import OpenImageIO as oiio
import small_scene
from camera_rays import image_to_terrain, looking_at
from small_scene import LAT, LON, RADIUS, local_xy

from schemas.files.outputs import Output
from schemas.packing import read
from stages import ingest, project, sample
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.maps.grid import unit_vectors

ALTITUDE = 120e3


def overhead_camera(east: float = 0.0, north: float = 0.0) -> Pinhole:
    """Nearly overhead; ``east`` and ``north`` metres off, pointing with it, so that the ground it sees moves by as much."""
    up = unit_vectors(LON, LAT)
    to_east = np.cross([0, 0, 1.0], up)
    to_east /= np.linalg.norm(to_east)
    shift = east * to_east + north * np.cross(up, to_east)
    return looking_at(up * (RADIUS + ALTITUDE) + shift, up * RADIUS + shift, math.radians(3.4), (400, 380))


def photograph(view: Pinhole, height=small_scene.height, reflect=small_scene.radiance_factor) -> np.ndarray:
    """What ``view`` sees of the small scene's closed form along the ray of each pixel's centre."""

    def height_at(longitude, latitude):
        return height(*local_xy(longitude, latitude))

    line, sample_ = np.meshgrid(np.arange(view.lines) + 0.5, np.arange(view.samples) + 0.5, indexing="ij")
    points = image_to_terrain(view, line, sample_, height_at, tolerance=0.05)
    radius = np.linalg.norm(points, axis=-1)
    x, y = local_xy(
        np.degrees(np.arctan2(points[..., 1], points[..., 0])), np.degrees(np.arcsin(points[..., 2] / radius))
    )
    return reflect(x, y).astype(np.float32)


def write_image(path, image):
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), oiio.ImageSpec(image.shape[1], image.shape[0], 1, oiio.FLOAT))
    assert output.write_image(np.ascontiguousarray(image[..., None]))
    output.close()


def write_frame(folder, view, image, **columns):
    """images.csv of one raw image and its camera model, both beside it; ``columns`` add to the row or change it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.json").write_text(json.dumps(view.to_document()))
    write_image(folder / "raw.tif", image)
    row = {
        "image_id": "RAW", "path": "raw.tif", "units": "iof", "camera": "camera.json",
        "subsolar_longitude_deg": small_scene.SUN[0], "subsolar_latitude_deg": small_scene.SUN[1], "solar_distance_au": 1.0,
    } | columns  # fmt: skip
    with (folder / "images.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, row.keys())
        writer.writeheader()
        writer.writerow(row)
    return folder / "images.csv"


def run_all(dem, images, folder, **config):
    """project's summary and pairs.h5, with scene.h5 and crops.h5 beside it; ``config`` is project's.

    Suns and times of the made-up cameras are not those of any year: the table is trusted.
    """
    gridding = ingest.Config(gsd=20, crop=32, trust_table=True)
    ingest.run(dem, images, Output(folder / "scene.h5", overwrite=True), gridding)
    sample.run(folder / "scene.h5", Output(folder / "crops.h5", overwrite=True), sample.Config(count=60, crop=32))
    summary = project.run(folder / "crops.h5", Output(folder / "pairs.h5", overwrite=True), project.Config(**config))
    return summary, folder / "pairs.h5"


def truth(file, k, east=0.0):
    """I/F of pair ``k`` in closed form, of the ground ``east`` metres away."""
    size = file["elevation"].shape[1]
    half = small_scene.SIZE * small_scene.GSD / 2
    col = file["col"][k] - size // 2 + np.arange(size) + 0.5
    row = file["row"][k] - size // 2 + np.arange(size) + 0.5
    x, y = np.meshgrid(col * small_scene.GSD - half + east, half - row * small_scene.GSD)
    return small_scene.radiance_factor(x, y)


def residual(path, east=0.0):
    """RMS difference between the pairs' images and the truth ``east`` metres away."""
    with h5py.File(path) as file:
        found = [read(file["image"], k) - truth(file, k, east) for k in range(file["row"].shape[0])]
    found = np.concatenate([f[np.isfinite(f)] for f in found])
    return float(np.sqrt(np.mean(found**2)))
