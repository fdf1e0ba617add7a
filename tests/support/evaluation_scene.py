"""A small measured scene with known reflectance for the tests of evaluate and match, rendered here in plain numpy.

Nothing of ``stages.physics`` makes these images: slopes come from numpy.gradient and I/F from the formula of M2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch

from stages.physics.formation.chain import Observation
from stages.physics.photometry import get_model

GSD, RADIUS = 5.0, 1e9  # a body so large that crops are flat
A, B, C = 0.09, 0.03, 0.01


@dataclass
class Scene:
    """In-memory pairs with the reader's interface; ``truth`` holds the coefficient a of every crop."""

    elevation: np.ndarray
    images: np.ndarray
    mask: np.ndarray
    sun: np.ndarray
    camera: np.ndarray
    split: np.ndarray
    tile: np.ndarray
    frame: np.ndarray
    a: np.ndarray
    noise: float
    image_ids: list[str] = field(default_factory=list)
    units: str = "iof"
    wavelength_nm: float = math.nan

    @property
    def site(self) -> np.ndarray:
        return np.arange(len(self.tile))

    def observation(self, indices) -> Observation:
        pick = np.asarray(indices)
        return Observation(
            torch.from_numpy(self.elevation[pick]),
            torch.from_numpy(self.sun[pick]),
            torch.from_numpy(self.camera[pick]),
            GSD,
            RADIUS,
            frame=torch.from_numpy(self.frame[pick]),
        )

    def image(self, indices):
        return torch.from_numpy(self.images[np.asarray(indices)])

    def valid(self, indices):
        return torch.from_numpy(self.mask[np.asarray(indices)])


def render(elevation: np.ndarray, sun: np.ndarray, a: np.ndarray) -> np.ndarray:
    """I/F of M2 under a camera at the zenith, infinitely far: cos(g) is then the Sun's height."""
    north, east = np.gradient(elevation.astype(float), GSD)
    normal = np.stack([-east, north, np.ones_like(east)])
    normal /= np.linalg.norm(normal, axis=0)
    incidence = np.tensordot(sun, normal, axes=1)
    return np.where(incidence > 0, a * incidence + B * sun[2] + C, 0.0)


def make_scene(rng: np.random.Generator, pairs: int = 60, size: int = 32, frames: int = 4, noise: float = 0.002):
    """Crops of smooth random relief; coefficient a varies with elevation, as a network could know it."""
    relief = rng.normal(size=(pairs, size, size))
    relief = np.stack([cv2.GaussianBlur(r, (0, 0), size / 10) for r in relief])
    relief *= 12.0 / relief.std(axis=(1, 2), keepdims=True)
    elevation = relief.astype(np.float32)
    frame = np.arange(pairs) % frames
    angles = np.radians(np.linspace(25, 60, frames))
    azimuth = np.radians(np.linspace(60, 200, frames))
    sun = np.stack([np.sin(azimuth) * np.cos(angles), np.cos(azimuth) * np.cos(angles), np.sin(angles)], axis=1)[frame]
    a = A + 0.02 * np.tanh(elevation.astype(float) / 12)
    image = np.stack([render(e, s, t) for e, s, t in zip(elevation, sun, a, strict=True)])
    image += noise * rng.normal(size=image.shape)
    mask = np.ones(image.shape, bool)
    mask[::5, :6, :4] = False
    split = np.where(np.arange(pairs) < pairs // 2, 0, 2).astype(np.uint8)
    return Scene(
        elevation,
        image.astype(np.float32),
        mask,
        sun,
        np.tile([0.0, 0.0, 1e9], (pairs, 1)),
        split,
        np.arange(pairs) // 2,
        frame,
        a,
        noise,
        [f"frame{k}" for k in range(frames)],
    )


class KnowsTheTruth:
    """A predictor that returns the planted coefficients: its error is the noise."""

    image_units = "iof"
    image_noise = float("nan")  # predicts no standard deviations

    def __init__(self, model: str = "M2") -> None:
        self.model = get_model(model)

    def parameters(self):
        return iter(())

    def coefficients(self, elevation: torch.Tensor) -> torch.Tensor:
        a = A + 0.02 * torch.tanh(elevation.double() / 12)
        return torch.stack([a, torch.full_like(a, B), torch.full_like(a, C)], dim=1).float()


def write_pairs(path, scene: Scene, units: str = "1"):
    """The scene as a pairs.h5."""
    from schemas import PAIRS, ArtefactWriter

    count, height, width = scene.images.shape
    sizes = {"pair": count, "y": height, "x": width, "enu": 3, "frame": len(scene.image_ids)}
    places = {"gsd_m": GSD, "body_radius_m": RADIUS}
    with ArtefactWriter(path, PAIRS, sizes, attributes=places, seed=0) as out:
        out.write("elevation", np.where(scene.mask, scene.elevation, np.nan))
        out.write("image", scene.images, unit=units)
        out.write("valid", scene.mask)
        out.write("sun_horizon_deg", np.full(scene.images.shape, -90.0))
        out.write("sun_direction_enu", scene.sun)
        out.write("camera_position_enu", scene.camera)
        for name in ("longitude_deg", "latitude_deg", "row", "col"):
            out.write(name, np.arange(count))
        out.write("image_index", scene.frame)
        out.write("site", np.arange(count))
        out.write("tile", scene.tile)
        out.write("split", scene.split)
        out.write("image_id", scene.image_ids)
    return path


def run_command(*arguments) -> tuple[int, str]:
    """Exit code of the command line and what it printed: the result, or the one line of an error."""
    from typer.testing import CliRunner

    from lunargr_cli.main import app
    from schemas.errors import EXIT_CODE, LunargrError

    result = CliRunner().invoke(app, [str(a) for a in arguments])
    if isinstance(result.exception, LunargrError):
        return EXIT_CODE, str(result.exception)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout
