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
from stages.physics.cameras import Camera
from stages.physics.maps import rasters

PICTURES = (".png", ".jpg", ".jpeg", ".exr", ".tif", ".tiff")


@dataclass(frozen=True)
class CameraImage:
    """An open image of ``lines`` x ``samples`` pixels, never read as a whole."""

    path: Path
    lines: int
    samples: int
    _dataset: DatasetReader | None
    _picture: Any | None

    def read(self, line: int, sample: int, lines: int, samples: int) -> NDArray[np.float32]:
        """(lines, samples) float32 from (line, sample) on, counted from 0; NaN = nodata. Raises InputError."""
        if self._dataset is not None:
            window = Window(sample, line, samples, lines)
            return rasters.read_window(self._dataset, window).astype(np.float32)
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
def open_camera_image(path: Path, camera: Camera, what: str) -> Iterator[CameraImage]:
    """The image that ``camera`` took. Raises InputError where it is missing, damaged, or of another size."""
    picture = _open_picture(path)
    if picture is not None:
        try:
            spec = picture.spec()
            bands = spec.nchannels - (spec.alpha_channel >= 0)
            if bands > 1:
                raise InputError(
                    f"{path}: expected {what} of one band, found {bands}; take the one that is meant (gdal_translate -b N)."
                )
            _check_size(path, camera, spec.height, spec.width)
            yield CameraImage(path, spec.height, spec.width, None, picture)
        finally:
            picture.close()
        return
    with rasters.open_raster(path, what) as dataset:
        rasters.check_single_band(path, dataset, what)
        _check_size(path, camera, dataset.height, dataset.width)
        yield CameraImage(path, dataset.height, dataset.width, dataset, None)


def _open_picture(path: Path) -> Any | None:
    """An OpenImageIO reader, or None where GDAL must read: other formats, tiles, nodata, scales, damaged files."""
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
    if picture.spec().tile_width or picture.spec().nchannels < 1:
        picture.close()
        return None
    return picture


def _check_size(path: Path, camera: Camera, lines: int, samples: int) -> None:
    if (lines, samples) != (camera.lines, camera.samples):
        raise InputError(
            f"{path}: expected {camera.lines} lines x {camera.samples} samples as its camera model has, found {lines} x {samples}; "
            "is it cropped, summed or map-projected? Make the camera model for this very file."
        )
