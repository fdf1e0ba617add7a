"""What every planted effect or fault has: a strength that can be calibrated, and what it changes at that strength."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .exposure import Departure, expose
from .fields import Array
from .layout import Needs
from .scene import Scene

FID = "fid"
ABSOLUTE = "fid_abs_all_pixels"  # for what shows in shadows, where relative changes mean little
GAINS = "rms_of_pair_gains"  # for what a plane per pair takes away whole


@dataclass
class Clean:
    """The images of a case with nothing planted, (pairs, size, size) each."""

    images: Array
    noise: Array
    samples: Array
    lines: Array


def clean_images(scene: Scene) -> Clean:
    images, noise, samples, lines = [], [], [], []
    for pair in range(len(scene.pairs)):
        bare, sample, line = expose(scene, pair, scene.plain(pair), noise=False)
        noisy, _, _ = expose(scene, pair, scene.plain(pair))
        images.append(bare)
        noise.append(noisy - bare)
        samples.append(sample)
        lines.append(line)
    return Clean(np.array(images), np.array(noise), np.array(samples), np.array(lines))


class Plant:
    """One effect or fault at a strength x > 0; `sign` says which way, where it has two ways.

    start, low, high: where the calibration of x begins and may go; equal ones: drawn, not calibrated.
    """

    name: ClassVar[str] = ""
    needs: ClassVar[Needs] = Needs()
    measure: ClassVar[str] = FID  # what its strength is calibrated on
    of_inputs: ClassVar[bool] = False  # the file's Sun or DEM is wrong, not its images
    needs_noise: ClassVar[bool] = False  # acts on noisy images only
    start: float = 1.0
    low: float = 1e-4
    high: float = 1e3

    def __init__(self, scene: Scene, clean: Clean, rng: np.random.Generator):
        self.scene = scene
        self.clean = clean
        self.sign = float(rng.choice([-1, 1]))
        self.draw(rng)

    def draw(self, rng: np.random.Generator) -> None:
        """Draw whatever else the effect has: its range, its pattern, its sign."""

    def iof(self, pair: int, x: float) -> Array:
        """I/F of the pair's fine window; for wrong inputs: as those would have it."""
        return self.scene.plain(pair)

    def departure(self, x: float) -> Departure:
        """What changes between ground and map."""
        return Departure()

    def parameters(self, x: float) -> dict:
        """What was planted, by the names and units of `lunargr diagnose --list`."""
        return {"x": x}

    def image(self, pair: int, x: float, noise: bool) -> Array:
        """(size, size): the map image with the effect."""
        return expose(self.scene, pair, self.iof(pair, x), self.departure(x), noise)[0]

    def given_sun(self, x: float) -> Array:
        """(pairs, 3): the Sun that the file gives."""
        return self.scene.geometry.sun

    def given_dem(self, x: float) -> Array | None:
        """(grid, grid), m: the DEM that the file gives, and that its images were projected with, if it is not the usual one."""
        return None
