"""One scene under every reflectance model and several Suns, as a contact sheet.

    python examples/contact_sheet.py -o contact_sheet.png
    python examples/contact_sheet.py --dem dem.tif --size 256 --models M2,lunar_lambert,hapke

Columns are light and camera, rows are models with their default parameters. Every picture runs from black at I/F 0 to
white at its own brightest pixels, for models differ by more than a common scale could show; the numbers below say how
bright it is: mean I/F, and the I/F that is shown white.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import torch

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from stages.physics.bodies.spheres import find_body
from stages.physics.formation.chain import Observation, form
from stages.physics.horizon import horizon
from stages.physics.photometry import get_model, model_names


@dataclass
class Light:
    """Sun and camera, degrees; azimuths clockwise from north."""

    title: str
    sun_elevation: float
    sun_azimuth: float
    camera_zenith: float = 0.0
    camera_azimuth: float = 0.0


LIGHTS = [
    Light("Sun overhead", 88, 100),
    Light("morning, 45 deg", 45, 90),
    Light("low Sun, 15 deg", 15, 70),
    Light("grazing, 5 deg", 5, 270),
    Light("camera in the Sun, 40 deg", 40, 250, 50, 250),
    Light("camera against the Sun, 40 deg", 40, 250, 50, 70),
]


def make_terrain(size: int, gsd: float) -> np.ndarray:
    """Cratered ground from `lunargr simulate`, (size, size) float32, m."""
    from stages.simulate.recipe import Config
    from stages.simulate.terrain import Terrain

    config = Config(seed=3, size_px=size, gsd=gsd, dem_gsd=gsd)
    return Terrain(config).block(0, 0, size, size).elevation


def read_terrain(path: Path, size: int) -> tuple[np.ndarray, float]:
    """The middle of a DEM on a metric grid: elevation and metres per pixel."""
    import rasterio

    from stages.physics.maps.rasters import read_window

    with rasterio.open(path) as data:
        size = min(size, data.height, data.width)
        window = rasterio.windows.Window((data.width - size) // 2, (data.height - size) // 2, size, size)
        elevation = read_window(data, window).astype(np.float32)
        return np.nan_to_num(elevation, nan=float(np.nanmean(elevation))), float(data.transform.a)


def direction(elevation: float, azimuth: float) -> list[float]:
    """Unit vector (east, north, up) of angles in degrees."""
    up, around = math.radians(elevation), math.radians(azimuth)
    return [math.cos(up) * math.sin(around), math.cos(up) * math.cos(around), math.sin(up)]


def observe(elevation: np.ndarray, gsd: float, light: Light) -> Observation:
    """The scene as seen from 100 km, lit with penumbra by a Sun whose horizon is the terrain's."""
    radius = find_body("moon").radius
    skyline = horizon(elevation, gsd, math.radians(light.sun_azimuth), radius)
    camera = direction(90 - light.camera_zenith, light.camera_azimuth)
    return Observation(
        elevation=torch.from_numpy(np.ascontiguousarray(elevation))[None],
        sun_direction=torch.tensor([direction(light.sun_elevation, light.sun_azimuth)]),
        camera_position=torch.tensor([camera]) * 100e3,
        gsd=gsd,
        body_radius=radius,
        sun_horizon=torch.from_numpy(skyline)[None],
    )


def render(
    elevation: np.ndarray, gsd: float, models: list[str], lights: list[Light]
) -> dict[tuple[str, int], np.ndarray]:
    """I/F of every model under every light, (H, W) each."""
    images = {}
    with torch.no_grad():
        for column, light in enumerate(lights):
            scene = observe(elevation, gsd, light)
            for name in models:
                model = get_model(name)
                defaults = torch.tensor(list(model.defaults().values())).view(1, -1, 1, 1)
                images[name, column] = form(scene, model, defaults)[0].numpy()
    return images


def draw(images: dict[tuple[str, int], np.ndarray], models: list[str], lights: list[Light], path: Path) -> None:
    figure, axes = plt.subplots(
        len(models), len(lights), figsize=(2 * len(lights) + 1, 2.12 * len(models)), squeeze=False, layout="constrained"
    )
    for column, light in enumerate(lights):
        for row, name in enumerate(models):
            axis, image = axes[row, column], images[name, column]
            white = max(float(np.percentile(image, 99.8)), 1e-6)
            axis.imshow(image, cmap="gray", vmin=0, vmax=white, interpolation="nearest")
            axis.set_xticks([])
            axis.set_yticks([])
            axis.set_xlabel(f"mean {image.mean():.3f}, white {white:.3f}", fontsize=7, labelpad=2)
            if row == 0:
                axis.set_title(light.title, fontsize=8)
            if column == 0:
                axis.set_ylabel(name, fontsize=8)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("contact_sheet.png"))
    parser.add_argument("--dem", type=Path, help="a DEM in metres instead of simulated ground")
    parser.add_argument("--size", type=int, default=192, help="pixels along an edge")
    parser.add_argument("--gsd", type=float, default=5.0, help="metres per pixel of simulated ground")
    parser.add_argument("--models", default="", help="names with commas between (default: all)")
    options = parser.parse_args()
    models = options.models.split(",") if options.models else model_names()
    if options.dem is None:
        elevation, gsd = make_terrain(options.size, options.gsd), options.gsd
    else:
        elevation, gsd = read_terrain(options.dem, options.size)
    images = render(elevation, gsd, models, LIGHTS)
    draw(images, models, LIGHTS, options.output)
    print(f"{options.output}: {len(models)} models x {len(LIGHTS)} lights, {elevation.shape[0]} px at {gsd:g} m")


if __name__ == "__main__":
    main()
