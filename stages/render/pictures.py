"""Writing rendered images: EXR with named channels, and PNG previews that look right.

Writers take bands of rows from the top down, so that an image of any size passes through little memory, and leave
nothing behind where they are interrupted.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from schemas.errors import InputError
from schemas.files.outputs import atomic_path
from stages.common.arrays import Floats32

DISPLAY_GAMMA = 2.2


def _write_error(path: Path, message: str) -> OSError | InputError:
    """What to raise. OpenImageIO reports a full disk like any other failure: an OSError lets atomic_path tell them apart."""
    with contextlib.suppress(OSError):
        stat = os.statvfs(path.parent)
        if stat.f_bavail * stat.f_frsize < 1 << 20:
            return OSError(28, "No space left on device")
    return InputError(
        f"{path}: cannot be written ({' '.join(message.split())}); free some space or choose another `output`."
    )


def _open_output(path: Path, partial: Path, spec: Any) -> Any:
    """The open file ``partial`` that becomes ``path``. Raises OSError, InputError."""
    output = oiio.ImageOutput.create(str(partial))
    if output is None or not output.open(str(partial), spec):
        raise _write_error(path, output.geterror() if output else oiio.geterror())
    return output


class ExrWriter:
    """Rows of a float32 EXR as they come; channels by name."""

    def __init__(self, path: Path, output: Any, channels: Sequence[str]) -> None:
        self._path, self._output, self.channels = path, output, list(channels)
        self._row = 0

    def write(self, band: Mapping[str, Floats32]) -> None:
        """Append rows: name -> (rows, W)."""
        block = np.ascontiguousarray(np.stack([band[c] for c in self.channels], axis=-1), np.float32)
        rows = block.shape[0]
        if not self._output.write_scanlines(self._row, self._row + rows, 0, block):
            raise _write_error(self._path, self._output.geterror())
        self._row += rows


@contextlib.contextmanager
def write_exr(
    path: Path, height: int, width: int, channels: Sequence[str], metadata: Mapping[str, Any] | None = None
) -> Iterator[ExrWriter]:
    """An EXR file (scan lines, ZIP, float32) to append rows to. Raises InputError where it cannot be written."""
    with atomic_path(path) as partial:
        spec = oiio.ImageSpec(width, height, len(channels), oiio.FLOAT)
        spec.channelnames = tuple(channels)
        spec.attribute("compression", "zip")
        spec.attribute("Software", "lunargr")
        for key, value in (metadata or {}).items():
            spec.attribute(f"lunargr:{key}", value if isinstance(value, (int, float)) else str(value))
        output = _open_output(path, partial, spec)
        try:
            yield ExrWriter(path, output, channels)
        except BaseException:
            output.close()
            raise
        if not output.close() or not _has_last_line(partial, height):
            raise _write_error(
                path, output.geterror() or "its last lines are not there: the disk is full or over quota"
            )


def _has_last_line(path: Path, height: int) -> bool:
    """OpenEXR keeps quiet about what it could not write when it closes a file."""
    source = oiio.ImageInput.open(str(path))
    if source is None:
        return False
    try:
        return source.read_scanlines(height - 1, height, 0, 0, 1, oiio.FLOAT) is not None
    finally:
        source.close()


def write_dn(path: Path, image: NDArray[np.uint16]) -> None:
    """A linear 16-bit TIFF of (H, W) DN. Raises InputError where it cannot be written."""
    height, width = image.shape
    with atomic_path(path) as partial:
        spec = oiio.ImageSpec(width, height, 1, oiio.UINT16)
        spec.attribute("compression", "zip")
        spec.attribute("oiio:ColorSpace", "Linear")
        output = _open_output(path, partial, spec)
        if not output.write_image(np.ascontiguousarray(image[..., None])) or not output.close():
            raise _write_error(path, output.geterror())


def read_exr(path: Path) -> dict[str, Floats32]:
    """Channels of an EXR by name, each (H, W) float32. Raises InputError."""
    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise InputError(f"{path}: expected an EXR image, found something else ({' '.join(oiio.geterror().split())}).")
    try:
        names = source.spec().channelnames
        pixels = source.read_image(oiio.FLOAT)
    finally:
        source.close()
    if pixels is None:
        raise InputError(f"{path}: expected a whole EXR image, found a truncated one; write it again.")
    return {name: np.ascontiguousarray(pixels[..., k]) for k, name in enumerate(names)}


class Preview:
    """A picture of at most ``limit`` pixels a side, gathered from rows as they come (means of whole pixels)."""

    def __init__(self, height: int, width: int, limit: int = 3072) -> None:
        self.factor = max(1, -(-max(height, width) // limit))
        self._shape = (-(-height // self.factor), -(-width // self.factor))
        self._sum = np.zeros(self._shape, np.float32)
        self._count = np.zeros(self._shape, np.int32)
        self._row = 0

    def add(self, rows: Floats32) -> None:
        """Append rows (rows, W), NaN where there is nothing."""
        known = np.isfinite(rows)
        values = np.where(known, rows, 0.0)
        target = (self._row + np.arange(rows.shape[0])) // self.factor
        starts = np.arange(0, rows.shape[1], self.factor)
        np.add.at(self._sum, target, np.add.reduceat(values, starts, axis=1))
        np.add.at(self._count, target, np.add.reduceat(known.astype(np.int32), starts, axis=1))
        self._row += rows.shape[0]

    def image(self) -> Floats32:
        """(h, w) float32, NaN where nothing was seen."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self._sum / self._count.astype(np.float32), np.float32)


def stretch(
    image: Floats32, limits: tuple[float, float] | None = None
) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """A linear image (H, W) as 8-bit grey for the eye, and the limits (black, white) that were used.

    White is the 99.5th percentile, black a little under the 0.2th and never below 0 (0 where there are shadows), with
    display gamma.
    """
    if limits is None:
        every = max(1, image.size // 2_000_000)
        known = image.ravel()[::every]
        known = known[np.isfinite(known)]
        if known.size == 0:
            limits = (0.0, 1.0)
        else:
            low, high = (float(v) for v in np.percentile(known, (0.2, 99.5)))
            low = max(0.0, 0.9 * low)
            limits = (low, max(1.05 * high - 0.05 * low, low + 1e-6))
    low, high = limits
    grey = np.empty(image.shape, np.uint8)
    for row in range(0, len(image), 256):  # a preview may have millions of pixels, and each needs several floats
        scaled = np.clip((np.nan_to_num(image[row : row + 256], nan=low) - low) / (high - low), 0.0, 1.0)
        grey[row : row + 256] = np.round(255.0 * scaled ** (1.0 / DISPLAY_GAMMA))
    return grey, limits


def write_png(path: Path, image: Floats32, limits: tuple[float, float] | None = None) -> tuple[float, float]:
    """A stretched 8-bit preview, transparent (and black beneath) where ``image`` is NaN; returns the limits used.

    image : (H, W), I/F; limits : as in :func:`stretch`
    """
    grey, limits = stretch(image, limits)
    alpha = np.isfinite(image).astype(np.uint8)
    pixels = np.stack([grey * alpha, alpha * np.uint8(255)], axis=-1)
    height, width = image.shape
    with atomic_path(path) as partial:
        spec = oiio.ImageSpec(width, height, 2, oiio.UINT8)
        spec.channelnames = ("Y", "A")
        spec.alpha_channel = 1
        spec.attribute("oiio:UnassociatedAlpha", 1)
        output = _open_output(path, partial, spec)
        if not output.write_image(np.ascontiguousarray(pixels)):
            raise _write_error(path, output.geterror())
        if not output.close() or b"IEND" not in partial.read_bytes()[-12:]:
            raise _write_error(path, output.geterror() or "its end is not there: the disk is full or over quota")
    return limits
