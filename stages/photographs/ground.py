"""A map with the photographs of its scene, opened together, and the calibration of these."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import h5py

from schemas import SCENE, SVBRDF, InputError, open_artefact
from stages.common.progress import Progress
from stages.photographs.calibrate import Calibration, calibrate, take_samples
from stages.photographs.prior import terrain_variance
from stages.physics.bodies.spheres import find_body
from stages.physics.images.references import References, open_references
from stages.physics.images.registered import register
from stages.physics.images.table import Frame, load_frames
from stages.physics.images.windows import STACK_PX, Blocks, choose_blocks, choose_windows
from stages.physics.maps.grid import check_same_grid
from stages.physics.terrain.surface import Surface, open_surface


@dataclass(frozen=True)
class Ground:
    """A map, the scene's photographs of it, and whether they are in I/F. references : beside the map without its albedo"""

    svbrdf: Path
    scene: Path
    map: h5py.File
    references: References
    units: str
    surface: Surface

    def blocks(self, halo: int, stack_px: int = STACK_PX) -> Blocks:
        """In which the map is worked, see :func:`choose_blocks`."""
        return choose_blocks(self.map["valid"].shape, self.references.overlapping, halo, stack_px)

    def calibrate(self, form: str | None, progress: Progress) -> Calibration:
        """Gains and errors of the photographs. form : of displacement that is taken off each before, or None

        Raises InputError where none of them shows lit ground of the map.
        """
        references = self.references
        fields = tuple(register(references, form, progress)) if form else ()
        references.subtract_displacement(fields)
        windows = choose_windows(self.map["valid"].shape, len(references.frames), references.overlapping)
        samples = take_samples(references, windows, progress, lambda box: terrain_variance(self.surface, box))
        if not samples:
            raise InputError(
                f"{self.scene}: expected images that overlap the map {self.svbrdf}, found none whose sunlit pixels lie on valid ground."
            )
        return replace(calibrate(samples, len(references.frames), self.units), fields=fields)


@contextlib.contextmanager
def open_ground(
    svbrdf: Path,
    scene: Path,
    check: Callable[[h5py.File], None],
    choose: Callable[[Sequence[Frame], h5py.File], list[bool]],
) -> Iterator[Ground]:
    """A map and the photographs that may enter. Raises LunargrError.

    check : refuses a map; choose : which of the scene's frames enter, from these and the map
    """
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(open_artefact(svbrdf, SVBRDF))
        check(file)
        terrain = stack.enter_context(open_artefact(scene, SCENE))
        check_same_grid(svbrdf, file, scene, terrain)
        frames = load_frames(terrain, scene)
        used = choose(frames, file) if frames else []
        surface = stack.enter_context(open_surface(svbrdf, None, {}, find_body(str(file.attrs["body_radius_m"]))))
        references = stack.enter_context(open_references(scene, terrain, surface.without_errors(), used))
        yield Ground(svbrdf, scene, file, references, _units(svbrdf, file, scene, references.frames), surface)


def _units(svbrdf: Path, file: h5py.File, scene: Path, frames: Sequence[Frame]) -> str:
    units = {frame.units for frame in frames}
    if len(units) > 1:
        raise InputError(f"{scene}: expected one kind of units, found both 'iof' and 'dn'; ingest them apart.")
    found = units.pop()
    if found == "iof" and str(file.attrs.get("image_units", "iof")) == "dn":
        raise InputError(
            f"{scene}: expected images in DN as those that {svbrdf} was trained on, found I/F; its brightness scale is "
            "arbitrary. Train on images in I/F."
        )
    return found
