"""The headers of GeoTIFF and EXR files: bands, tags, and the record of the run that made them, as one line of JSON."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from schemas.errors import ArtefactError
from schemas.files.references import open_raster_file

TIFF_TAG = "LUNARGR_RECORD"
EXR_ATTRIBUTE = "lunargr:record"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_EXR = (b"v/1\x01",)


@dataclass(frozen=True)
class Raster:
    """The header of a raster. bands : (name, unit, type) of each; shape : rows, columns; tags : without the record"""

    kind: str
    shape: tuple[int, int]
    bands: list[tuple[str, str, str]]
    tags: dict[str, str]
    record: str


def raster_kind(path: Path) -> str:
    """'GeoTIFF', 'EXR' or '' by a file's first bytes; '' for devices and pipes, which might never answer."""
    try:
        if not path.is_file():  # opening a pipe waits for who writes into it
            return ""
        with open(path, "rb") as file:
            start = file.read(4)
    except (OSError, ValueError):
        return ""
    return "GeoTIFF" if start in _TIFF else "EXR" if start in _EXR else ""


def read_raster(path: Path) -> Raster:
    """The header of a GeoTIFF or EXR. Raises ArtefactError."""
    return _read_exr(path) if raster_kind(path) == "EXR" else _read_tiff(path)


def _read_tiff(path: Path) -> Raster:
    from rasterio.errors import RasterioError

    try:
        with open_raster_file(path) as file:
            tags = {str(k): str(v) for k, v in file.tags().items()}
            bands = [
                (name or f"band {k + 1}", unit or "", kind)
                for k, (name, unit, kind) in enumerate(zip(file.descriptions, file.units, file.dtypes, strict=True))
            ]
            if file.crs:
                tags["crs"] = str(file.crs.to_wkt()).split('"')[1]
            shape = (file.height, file.width)
    except RasterioError as error:
        raise ArtefactError(
            f"{path}: expected a whole GeoTIFF, found a damaged one ({error}); write it again."
        ) from None
    return Raster("GeoTIFF", shape, bands, tags, tags.pop(TIFF_TAG, ""))


def _read_exr(path: Path) -> Raster:
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(str(path))
    if source is None:
        words = " ".join(oiio.geterror().split())
        raise ArtefactError(f"{path}: expected a whole EXR image, found a damaged one ({words}); write it again.")
    spec = source.spec()
    source.close()
    tags = {a.name: str(a.value) for a in spec.extra_attribs if not a.name.startswith("oiio:")}
    kinds = [str(kind) for kind in spec.channelformats] or [str(spec.format)] * spec.nchannels
    bands = [(name, "", kind) for name, kind in zip(spec.channelnames, kinds, strict=True)]
    return Raster("EXR", (spec.height, spec.width), bands, tags, tags.pop(EXR_ATTRIBUTE, ""))
