"""Windows of an image as its camera took it: PNG, JPEG, EXR and plain TIFF by OpenImageIO, everything else by GDAL."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.io import DatasetReader
from rasterio.windows import Window

from schemas.errors import InputError
from stages.physics.bodies.ephemeris import parse_utc, utc_to_et
from stages.physics.cameras import Camera
from stages.physics.cameras.frame import Frame
from stages.physics.cameras.isis_cube import Extent, image_extent
from stages.physics.cameras.linescan import LineScan
from stages.physics.cameras.pushframe import PushFrame
from stages.physics.images.labels import Block, find_block, find_value, read_label
from stages.physics.maps import rasters

LABELLED = (".cub",)
TIME_TOLERANCE = 5.0  # s: clocks, prerolls and whole seconds of labels
PICTURES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff")


@dataclass(frozen=True)
class CameraImage:
    """An open image of ``lines`` x ``samples`` pixels, never read as a whole."""

    path: Path
    lines: int
    samples: int
    _dataset: DatasetReader | None
    _picture: Any | None
    _band: int = 1

    def read(self, line: int, sample: int, lines: int, samples: int) -> NDArray[np.float32]:
        """(lines, samples) float32 from (line, sample) on, counted from 0; NaN = nodata. Raises InputError."""
        if self._dataset is not None:
            window = Window(sample, line, samples, lines)
            return rasters.read_window(self._dataset, window, self._band).astype(np.float32)
        picture: Any = self._picture
        # read_scanlines wants whole rows: a few at a time bound the memory
        out = np.empty((lines, samples), np.float32)
        for first in range(0, lines, 256):
            last = min(lines, first + 256)
            rows = picture.read_scanlines(line + first, line + last, 0, 0, 1, picture.spec().format)
            if rows is None:
                raise InputError(
                    f"{self.path}: cannot be read to the end ({' '.join(picture.geterror().split())}); the file is damaged "
                    "or truncated, fetch it again."
                )
            out[first:last] = np.asarray(rows, np.float32).reshape(last - first, self.samples)[
                :, sample : sample + samples
            ]
        out[~np.isfinite(out) | (np.abs(out) >= rasters.SPECIAL)] = np.nan
        return out


@contextlib.contextmanager
def open_camera_image(path: Path, camera: Camera, what: str, band: int | None = None) -> Iterator[CameraImage]:
    """The image that ``camera`` took. band : of several, counted from 1. Raises InputError where it is missing, damaged, or of another size."""
    picture = _open_picture(path)
    if picture is not None:
        try:
            spec = picture.spec()
            _check_belongs(path, camera, spec.height, spec.width)
            yield CameraImage(path, spec.height, spec.width, None, picture)
        finally:
            picture.close()
        return
    with rasters.open_raster(path, what) as dataset:
        chosen = rasters.choose_band(path, dataset, band, what)
        _check_belongs(path, camera, dataset.height, dataset.width)
        yield CameraImage(path, dataset.height, dataset.width, dataset, None, chosen)


def _open_picture(path: Path) -> Any | None:
    """An OpenImageIO reader, or None where GDAL must read: other formats, tiles, several bands, nodata, scales, damaged files."""
    if path.suffix.lower() not in PICTURES or not path.is_file():
        return None
    import OpenImageIO as oiio

    if path.suffix.lower() in (".tif", ".tiff"):
        with rasters.open_raster(path) as dataset:
            if dataset.nodata is not None or (dataset.scales[0], dataset.offsets[0]) != (1.0, 0.0):
                return None
    picture = oiio.ImageInput.open(str(path))
    if picture is None:
        oiio.geterror()  # clears it, or it would be printed at exit; GDAL will say what is wrong
        return None
    if picture.spec().tile_width or picture.spec().nchannels != 1:
        picture.close()
        return None
    return picture


def _check_belongs(path: Path, camera: Camera, lines: int, samples: int) -> None:
    """Refuse the camera of another image, or of the whole or unbinned image. Raises InputError."""
    if (lines, samples) != (camera.lines, camera.samples):
        raise InputError(
            f"{path}: expected {camera.lines} lines x {camera.samples} samples as its camera model has, found {lines} x {samples}; "
            "is it cropped, summed or map-projected? Make the camera model for this very file."
        )
    label = read_label(path) if path.suffix.lower() in LABELLED else None
    if label is None or find_block(label, "Mapping") is not None:
        return
    extent = image_extent(label, str(path))
    _check_time(path, label, camera, extent)
    if isinstance(camera, (Frame, LineScan, PushFrame)):
        _check_window(path, label, camera, extent)


def _check_time(path: Path, label: Block, camera: Camera, extent: Extent) -> None:
    """Against StartTime, of the whole image: the camera's first line is that of the cube, not of the whole image."""
    started = find_value(label, "StartTime")
    times = camera.ephemeris_time(np.array([0.0, 1.0]))
    if started is None or times is None:
        return
    after = float(times[0]) - utc_to_et(parse_utc(str(started), f"{path}: StartTime"))
    expected = extent.corner[0] * float(times[1] - times[0]) / extent.scale[0]
    if abs(after - expected) > TIME_TOLERANCE and abs(after) > TIME_TOLERANCE:
        raise InputError(
            f"{path}: expected a camera of the image that began at {started}, found one {after:+.1f} s from it; make the "
            "camera model for this very file."
        )
    if abs(after) < abs(after - expected):
        raise _of_the_whole(path, f"its first line {after:.3f} s after the image's start", f"{expected:.3f} s")


def _check_window(path: Path, label: Block, camera: Frame | LineScan | PushFrame, extent: Extent) -> None:
    """The camera's summing and first detector pixel against the cube's crop, scale and summing."""
    detector, framing = camera.detector, isinstance(camera, Frame)
    summing = find_value(label, "SpatialSumming")
    for axis, name in ((0, "line"), (1, "sample")):
        if axis == 0 and not framing:
            continue  # lines of these are times
        binning = detector.summing[axis] / extent.scale[axis]
        least = float(summing or 1.0)  # a camera of the unreduced image sums less than that
        if binning < 0.999 * least or (summing is not None and binning > 1.001 * least):
            raise InputError(
                f"{path}: expected a camera that sums {least * extent.scale[axis]:g} detector pixels to one {name} of "
                f"the cube, as SpatialSumming and AlphaCube say, found {detector.summing[axis]:g}; make the camera model for "
                "this very file."
            )
        first = float(find_value(label, "SampleFirstPixel") or 0.0) if axis == 1 else 0.0
        corner = extent.corner[axis] * binning
        # of the two, the whole image's first pixel or the cube's: instruments begin some pixels into their detectors
        if abs(detector.start[axis] - first) < abs(detector.start[axis] - first - corner):
            found = f"its first {name} at detector pixel {detector.start[axis]:g}"
            raise _of_the_whole(path, found, f"{first + corner:g}")


def _of_the_whole(path: Path, found: str, expected: str) -> InputError:
    return InputError(
        f"{path}: expected the camera of this part of the image (AlphaCube), found one of the whole image, {found} instead of "
        f"{expected}; make the camera model for this very file."
    )
