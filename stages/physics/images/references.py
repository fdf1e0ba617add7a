"""Photographs of a scene beside what the map predicts for them, window by window."""

from __future__ import annotations

import contextlib
import math
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from stages.common.arrays import Floats, Floats32
from stages.physics.bodies.ephemeris import AU
from stages.physics.horizon.scene import SceneTerrain
from stages.physics.images.angles import GivenAngles, open_angles
from stages.physics.images.displacement import Field
from stages.physics.images.footprints import Footprint, read_footprint
from stages.physics.images.source_images import Pixels, Source, open_source
from stages.physics.images.table import Frame, load_frames
from stages.physics.light.sun_disc import SUN_RADIUS
from stages.physics.maps.window import Box, Window
from stages.physics.terrain.shading import Light, shade_block
from stages.physics.terrain.sun import Sun
from stages.physics.terrain.surface import SHADOWED, Surface

OPEN_IMAGES = 64  # files that stay open between windows
SHADOW_MARGIN_PX = 2  # a shadow's edge lies so well where the DEM and the registration say
TURN = 30e3  # m over which the Sun's azimuth turns by 1 deg on the Moon


@dataclass(frozen=True)
class Seen:
    """One photograph beside its rendering on the part ``box`` of a window, (h, w) each.

    measured : as in the file, NaN where it shows no known ground; usable : bool, lit and away from shadows
    planes : the rendering and its backplanes, see ``shade_block``; given : angles in degrees from the image's own file of
        angles, by plane, empty without one
    """

    box: Box
    measured: Floats32
    usable: NDArray[np.bool_]
    planes: dict[str, Floats32]
    given: dict[str, Floats32]


@dataclass(frozen=True)
class Observed:
    """One photograph on a window. measured : (h, w) as in the file, NaN where it shows no known ground; predicted : (h, w)
    I/F, 0 in shadow; usable : (h, w) bool, lit and away from shadows; shadow : (h, w) bool; sun_sine : of the Sun's elevation
    """

    measured: Floats32
    predicted: Floats32
    cos_incidence: Floats32
    usable: NDArray[np.bool_]
    shadow: NDArray[np.bool_]
    sun_sine: float

    def padded(self, own: Box, box: Box) -> Observed:
        """The same on a larger window, of which the photograph shows nothing beside its own."""
        part = np.s_[own[0] - box[0] : own[0] - box[0] + own[2], own[1] - box[1] : own[1] - box[1] + own[3]]

        def pad(values: NDArray, around: float) -> NDArray:
            whole = np.full(box[2:], around, values.dtype)
            whole[part] = values
            return whole

        return Observed(
            pad(self.measured, np.nan), pad(self.predicted, np.nan), pad(self.cos_incidence, np.nan),
            pad(self.usable, False), pad(self.shadow, False), self.sun_sine,
        )  # fmt: skip


def _sun_at(position: Floats) -> Sun:
    return Sun(position, SUN_RADIUS * AU / float(np.linalg.norm(position)))


def far_from_shadow(shadow: Floats32) -> NDArray[np.bool_]:
    """Where the Sun is whole, SHADOW_MARGIN_PX around included. shadow : (h, w) share of the disc that is hidden"""
    side = 2 * SHADOW_MARGIN_PX + 1
    lit = (shadow == 0).astype(np.uint8)
    return cv2.erode(lit, np.ones((side, side), np.uint8), borderValue=1).astype(bool)


class SceneHorizon:
    """The terrain horizon towards one Sun for any window, from an overview of the scene that all Suns share."""

    def __init__(self, terrain: SceneTerrain, sun: Sun) -> None:
        self._terrain, self._sun = terrain, sun
        self._piece = 1 << min(10, max(6, int(math.log2(max(1.0, TURN / terrain.grid.gsd)))))

    def window(self, row: int, col: int, height: int, width: int) -> Floats32:
        """(height, width), rad"""
        edge = self._piece
        result = np.empty((height, width), np.float32)
        for r in range(row, row + height, edge):
            for c in range(col, col + width, edge):
                h, w = min(edge, row + height - r), min(edge, col + width - c)
                azimuth, elevation = self._sun.over(self._terrain.grid, r + (h - 1) / 2, c + (w - 1) / 2)
                piece = self._terrain.horizon(Window(r, c, h, w), azimuth, elevation)
                result[r - row : r - row + h, c - col : c - col + w] = piece
        return result


@contextlib.contextmanager
def open_references(scene: Path, terrain: h5py.File, surface: Surface, used: Sequence[bool]) -> Iterator[References]:
    """Those images of a scene that are ``used``, beside a surface on the same grid. Raises InputError where none overlaps."""
    frames, boxes = load_frames(terrain, scene), terrain["frame_window"][...].tolist()
    chosen = [k for k, use in enumerate(used) if use]
    footprints = [read_footprint(terrain["valid"], k, tuple(boxes[k])) for k in chosen]
    if not any(f.cells.any() for f in footprints):
        raise InputError(f"{scene}: expected images that overlap the map {surface.path}, found none.")
    ground = SceneTerrain.of(terrain["elevation"], surface.grid)
    with References(surface, ground, [frames[k] for k in chosen], footprints) as references:
        yield references


class References(contextlib.AbstractContextManager):
    """The images of a scene. footprints : where each shows something; use as a context manager."""

    def __init__(
        self, surface: Surface, terrain: SceneTerrain, frames: Sequence[Frame], footprints: Sequence[Footprint]
    ) -> None:
        self.surface, self.terrain, self.frames, self.footprints = surface, terrain, frames, footprints
        self._fields: Sequence[Field | None] = [None] * len(frames)
        self.reads_angles = False  # whether ``see`` reads the images' own angles
        self._open: OrderedDict[int, tuple[tuple[Source, GivenAngles | None], contextlib.ExitStack]] = OrderedDict()

    def __exit__(self, *error: object) -> None:
        while self._open:
            self._open.popitem()[1][1].close()

    def subtract_displacement(self, fields: Sequence[Field | None]) -> None:
        """Read each image from now on without the displacement that registration found; none where empty."""
        if fields:
            self._fields = fields

    def overlapping(self, box: Box) -> list[int]:
        """Images that may show something of a window."""
        return [k for k, footprint in enumerate(self.footprints) if footprint.within(box)]

    def observe(self, k: int, box: Box) -> Observed | None:
        """Image ``k`` on a window, None where it shows nothing that counts."""
        seen = self.see(k, box)
        if seen is None:
            return None
        (row, col, height, width), planes = seen.box, seen.planes
        cosine = np.cos(np.radians(planes["incidence_deg"]))
        position = self.frames[k].sun_position()
        _, elevation = _sun_at(position).over(self.surface.grid, row + (height - 1) / 2, col + (width - 1) / 2)
        observed = Observed(
            seen.measured, planes["image"], cosine, seen.usable, planes["shadow"] > SHADOWED,
            math.sin(max(0.0, elevation)),
        )  # fmt: skip
        return observed if seen.box == box else observed.padded(seen.box, box)

    def see(self, k: int, box: Box) -> Seen | None:
        """Image ``k`` beside its rendering on what it shows of a window, None where nothing of that is lit."""
        inner = self.footprints[k].within(box)
        if inner is None:
            return None
        pixels = self.read(k, inner)
        if not pixels.valid.any():
            return None
        planes = shade_block(self.surface, self.light(k, pixels), *inner)
        far = far_from_shadow(planes["shadow"])
        known = pixels.valid & np.isfinite(pixels.values) & np.isfinite(planes["image"])
        usable = far & known & (planes["image"] > 0)
        if not usable.any():
            return None
        angles = self._file(k)[1] if self.reads_angles else None
        given = angles.read(inner, self._fields[k]) if angles else {}
        return Seen(inner, np.where(known, pixels.values, np.nan).astype(np.float32), usable, planes, given)

    def read(self, k: int, box: Box) -> Pixels:
        """Image ``k`` on a window of its footprint, without its displacement."""
        return self.source(k).read(*box, self._fields[k])

    def light(self, k: int, pixels: Pixels) -> Light:
        """The light of image ``k`` and its camera, as ``pixels`` of it have them."""
        frame = self.frames[k]
        sun = _sun_at(frame.sun_position())
        camera = frame.camera_position(self.surface.grid.radius)
        if pixels.ortho is not None:
            camera = pixels.ortho.camera_position
        horizon: Any = SceneHorizon(self.terrain, sun)
        return Light(sun, horizon, camera)

    def source(self, k: int) -> Source:
        """The open image ``k``."""
        return self._file(k)[0]

    def _file(self, k: int) -> tuple[Source, GivenAngles | None]:
        """The open image ``k`` and its angles."""
        if k in self._open:
            self._open.move_to_end(k)
            return self._open[k][0]
        while len(self._open) >= OPEN_IMAGES:
            self._open.popitem(last=False)[1][1].close()
        with contextlib.ExitStack() as stack:
            terrain = self.terrain
            where = self.frames[k], terrain.grid, terrain.elevation, terrain.heights
            opened = stack.enter_context(open_source(*where)), stack.enter_context(open_angles(*where))
            self._open[k] = opened, stack.pop_all()
        return opened
