"""A frame camera over the scene: rays, detector coordinates, optics and orthorectification."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter

OVERSAMPLING = 3  # odd, so that a detector pixel's centre is a sample
BORDER = 14  # detector pixels around a crop, for blur, echoes and displacement


@dataclass(frozen=True)
class Camera:
    """Position in map pixels (row, col, height over the scene's mean), and the detector's turn and scale."""

    row: float
    col: float
    height: float
    centre: tuple[float, float]
    turn_deg: float
    pixel_px: float
    first: tuple[float, float]

    @classmethod
    def over_scene(
        cls, shape: tuple[int, int], height_px: float, tilt_deg: float, azimuth_deg: float, turn_deg: float,
        pixel_px: float, first_px: tuple[float, float],
    ) -> "Camera":  # fmt: skip
        """A camera that sees the scene's centre at an emission of tilt_deg, from an azimuth."""
        centre = ((shape[0] - 1) / 2, (shape[1] - 1) / 2)
        away = height_px * np.tan(np.radians(tilt_deg))
        azimuth = np.radians(azimuth_deg)
        reach = 0.5 * float(np.hypot(*shape)) / pixel_px + 30  # so that all coordinates are positive
        return cls(
            float(centre[0] - away * np.cos(azimuth)), float(centre[1] + away * np.sin(azimuth)), float(height_px),
            centre, turn_deg, pixel_px, (float(reach + first_px[0]), float(reach + first_px[1])),
        )  # fmt: skip

    def on_plane(self, row: np.ndarray, col: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the ray through a ground point meets the scene's mean level."""
        factor = self.height / (self.height - height)
        return self.row + (row - self.row) * factor, self.col + (col - self.col) * factor

    def to_detector(self, row: np.ndarray, col: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Line and sample of a point of the mean level."""
        cos, sin = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        r, c = row - self.centre[0], col - self.centre[1]
        line = (r * cos - c * sin) / self.pixel_px + self.first[0]
        return line, (r * sin + c * cos) / self.pixel_px + self.first[1]

    def to_plane(self, line: np.ndarray, sample: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column on the mean level that a line and sample look at."""
        cos, sin = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        r, c = (line - self.first[0]) * self.pixel_px, (sample - self.first[1]) * self.pixel_px
        return r * cos + c * sin + self.centre[0], c * cos - r * sin + self.centre[1]

    def direction_from(self, row: np.ndarray, col: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, ...]:
        """Unit vectors (east, north, up) from ground points to the camera."""
        east, north, up = self.col - col, row - self.row, self.height - height
        length = np.sqrt(east**2 + north**2 + up**2)
        return east / length, north / length, up / length


@dataclass(frozen=True)
class Chip:
    """The part of a detector that sees one crop: first line and sample, and size."""

    line: int
    sample: int
    lines: int
    samples: int

    @classmethod
    def around(cls, line: np.ndarray, sample: np.ndarray) -> "Chip":
        """The chip that holds these detector coordinates with a border."""
        first = int(line.min()) - BORDER, int(sample.min()) - BORDER
        return cls(*first, int(line.max()) + BORDER - first[0], int(sample.max()) + BORDER - first[1])


def seen_points(
    camera: Camera, chip: Chip, relief: np.ndarray, top: float, left: float, fine: int
) -> tuple[np.ndarray, np.ndarray]:
    """Places on a relief window (its cell coordinates) that the finely sampled chip sees.

    top and left: row and column, map pixels, of the window's first cell.
    """
    step = (np.arange(OVERSAMPLING) - (OVERSAMPLING - 1) / 2) / OVERSAMPLING
    lines = (chip.line + np.arange(chip.lines)[:, None] + step).ravel()
    samples = (chip.sample + np.arange(chip.samples)[:, None] + step).ravel()
    row, col = camera.to_plane(lines[:, None].astype(np.float32), samples[None, :].astype(np.float32))
    height: np.ndarray | float = 0.0
    for _ in range(4):  # the ray's point of the mean level, moved up the ray to the height found there
        factor = 1 - height / camera.height
        at_row = ((camera.row + (row - camera.row) * factor) - top) * fine
        at_col = ((camera.col + (col - camera.col) * factor) - left) * fine
        height = map_coordinates(relief, [at_row, at_col], order=1, mode="nearest")
    return at_row.astype(np.float32), at_col.astype(np.float32)


def expose(radiance: np.ndarray, points: tuple[np.ndarray, np.ndarray], optics_variance: float) -> np.ndarray:
    """Signal of each detector pixel: optics of a variance in detector px2, then the pixel's own area."""
    picture = map_coordinates(radiance, list(points), order=1, mode="nearest")
    picture = gaussian_filter(picture, OVERSAMPLING * np.sqrt(optics_variance))
    picture = uniform_filter(picture, OVERSAMPLING)
    first = OVERSAMPLING // 2
    return picture[first::OVERSAMPLING, first::OVERSAMPLING]


def lay_on_map(image: np.ndarray, chip: Chip, line: np.ndarray, sample: np.ndarray, cubic: bool) -> np.ndarray:
    """The chip's image at the detector coordinates of each map pixel."""
    place = [line - chip.line, sample - chip.sample]
    return map_coordinates(image, place, order=3 if cubic else 1, mode="nearest")
