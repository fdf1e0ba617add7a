"""What a camera takes from an ISIS cube that went through ``spiceinit``: its label, NAIF keywords and SPICE tables."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from stages.common.arrays import Floats
from stages.physics.images.labels import Block, find_block, find_value, isis_table, read_label
from stages.physics.maps.grid import CSM_CENTRE, ISIS_CENTRE

ISIS_SHIFT = ISIS_CENTRE - CSM_CENTRE


def is_cube(path: Path) -> bool:
    """Whether a path is an ISIS cube that can be read."""
    if not os.path.isfile(path):  # Path.is_file raises for names that are too long
        return False
    try:
        with path.open("rb") as file:
            return file.read(32).lstrip().startswith(b"Object = IsisCube")
    except OSError:
        return False


def is_own_camera(path: Path) -> bool:
    """Whether a file is an ISIS cube as an instrument took it: not a map, and not a raster of other origin."""
    label = (read_label(path) if is_cube(path) else None) or {}
    return find_block(label, "Instrument") is not None and find_block(label, "Mapping") is None


@dataclass(frozen=True)
class Extent:
    """Which part of the image that was taken a cube holds, cropped and reduced as AlphaCube says; pairs are (line, sample).

    lines, samples : of the cube; corner : of its first pixel in the whole image, px, 0 at the outer corner
    scale : pixels of the whole image to one of the cube; whole : size of the whole image
    """

    lines: int
    samples: int
    corner: tuple[float, float]
    scale: tuple[float, float]
    whole: tuple[float, float]


def image_extent(label: Block, where: str) -> Extent:
    """The part of its image that a cube holds. Raises InputError."""
    size = find_block(label, "Dimensions")
    if size is None:
        raise InputError(f"{where}: expected the cube's Dimensions, found none.")
    lines, samples = int(size["Lines"]), int(size["Samples"])
    alpha = find_block(label, "AlphaCube")
    if alpha is None:
        return Extent(lines, samples, (0.0, 0.0), (1.0, 1.0), (lines, samples))
    try:
        # ISIS puts the outer corner at 0.5
        first = [float(alpha[f"AlphaStarting{axis}"]) - ISIS_SHIFT for axis in ("Line", "Sample")]
        last = [float(alpha[f"AlphaEnding{axis}"]) - ISIS_SHIFT for axis in ("Line", "Sample")]
        whole = float(alpha["AlphaLines"]), float(alpha["AlphaSamples"])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{where}: expected numbers in its AlphaCube group, found others; crop it again.") from None
    scale = (last[0] - first[0]) / lines, (last[1] - first[1]) / samples
    if min(scale) <= 0:
        raise InputError(f"{where}: expected an AlphaCube with starts before ends, found {dict(alpha)!r:.120}.")
    return Extent(lines, samples, (first[0], first[1]), scale, whole)


@dataclass(frozen=True)
class Cube:
    """label : the whole label; keywords : its NAIF keywords; spice : the SPICE tables under the keys of an ISD"""

    where: str
    label: Block
    keywords: Block
    spice: dict[str, Any]

    @classmethod
    def open(cls, path: Path) -> Cube:
        """The label, keywords and tables of a file. Raises InputError where spiceinit left none."""
        where = str(path)
        label = read_label(path)
        if label is None:
            raise InputError(f"{where}: expected an ISIS label, found none.")
        if find_block(label, "Mapping") is not None:
            raise InputError(
                f"{where}: expected a cube as its camera took it, found a map-projected one; leave 'camera' empty."
            )
        keywords = find_block(label, "NaifKeywords")
        if keywords is None:
            raise InputError(
                f"{where}: expected SPICE data attached to the cube, found none; run spiceinit on it first."
            )
        spice = {
            "instrument_position": _states(path, label, "InstrumentPosition"),
            "sun_position": _states(path, label, "SunPosition"),
            "instrument_pointing": _rotations(path, label, "InstrumentPointing"),
            "body_rotation": _rotations(path, label, "BodyRotation"),
        }
        return cls(where, label, keywords, spice)

    @property
    def code(self) -> int:
        """NAIF's number of the instrument."""
        found = find_value(self.label, "NaifIkCode")
        return int(self.value("NaifFrameCode") if found is None else found)

    def value(self, key: str) -> Any:
        """A value of the label. Raises InputError where there is none."""
        return self._required(self.label, key, "the cube's label")

    def kernel(self, name: str, count: int = 1, code: int | None = None) -> Floats:
        """(count,) numbers of the instrument kernel, spiceinit's copy. code : the cube's own where None. Raises InputError."""
        key = f"INS{self.code if code is None else code}_{name}"
        found = np.atleast_1d(np.array(self._required(self.keywords, key, "its NAIF keywords"), float))
        if found.size < count:
            raise InputError(
                f"{self.where}: expected {count} numbers in {key}, found {found.size}; run spiceinit again."
            )
        return found[:count]

    def clock_time(self) -> float:
        """Ephemeris time of the clock count before the exposure, which spiceinit keeps as the bytes of a double."""
        for key, value in self.keywords.items():
            if key.startswith("CLOCK_ET_") and key.endswith("_COMPUTED"):
                digits = f"{value:016d}" if isinstance(value, int) else str(value)  # bytes may happen to be all digits
                try:
                    return float(struct.unpack("<d", bytes.fromhex(digits))[0])
                except (ValueError, struct.error):
                    break
        raise InputError(
            f"{self.where}: expected the clock's computed time among its NAIF keywords, found none; run spiceinit again."
        )

    def extent(self) -> Extent:
        """The part of the image that the cube holds. Raises InputError."""
        return image_extent(self.label, self.where)

    def common(self, extent: Extent) -> dict[str, Any]:
        """The keys of an ISD that every instrument's cube fills alike."""
        radii = next((v for k, v in self.keywords.items() if k.startswith("BODY") and k.endswith("_RADII")), None)
        if radii is None:
            raise InputError(
                f"{self.where}: expected the body's radii among its NAIF keywords, found none; run spiceinit again."
            )
        return {
            "image_lines": extent.lines,
            "image_samples": extent.samples,
            "radii": {"semimajor": radii[0], "semiminor": radii[2], "unit": "km"},
            **self.spice,
        }

    def _required(self, block: Block, key: str, what: str) -> Any:
        value = find_value(block, key)
        if value is None:
            raise InputError(f"{self.where}: expected '{key}' in {what}, found none; run spiceinit on it again.")
        return value


def _table(path: Path, label: Block, name: str, fields: tuple[int, int]) -> NDArray[np.float64]:
    """(records, fields) of a table with one or the other number of fields. Raises InputError."""
    table = isis_table(path, label, name)
    if table.shape[1] not in fields:
        raise InputError(
            f"{path}: expected {fields[0]} or {fields[1]} fields in table '{name}', found {table.shape[1]}; run spiceinit again."
        )
    return table


def _states(path: Path, label: Block, name: str) -> dict[str, Any]:
    table = _table(path, label, name, (4, 7))
    states: dict[str, Any] = {"positions": table[:, :3], "ephemeris_times": table[:, -1], "unit": "km"}
    if table.shape[1] == 7:
        states["velocities"] = table[:, 3:6]
    return states


def _rotations(path: Path, label: Block, name: str) -> dict[str, Any]:
    table = _table(path, label, name, (5, 8))
    rotations: dict[str, Any] = {"quaternions": table[:, :4], "ephemeris_times": table[:, -1]}
    constant = (find_block(label, "Table", name) or {}).get("ConstantRotation")
    if constant is not None:
        rotations["constant_rotation"] = constant
    return rotations
