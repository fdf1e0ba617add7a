"""What a file may refer to. A file from elsewhere must not make a run read system files, devices or the network.

HDF5: all data lie in the file. A virtual data set may show data of HDF5 files in the file's own folder or below it.
Rasters: further files lie in the raster's own folder or below it. A VRT lists rasters: these may lie anywhere on this
machine, but it may not describe raw bands.
"""

from __future__ import annotations

import functools
import os
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import TYPE_CHECKING

import h5py

from schemas.errors import ArtefactError, InputError

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

DataSet = tuple[str, str]  # (file, name in it)
# GDAL's drivers for data that lie on the network, or wherever the file says
_REMOTE = {
    "DAAS",
    "EEDA",
    "EEDAI",
    "GTI",
    "HTTP",
    "KMLSUPEROVERLAY",
    "MRF",
    "PLMOSAIC",
    "STACIT",
    "STACTA",
    "WCS",
    "WMS",
}
_REMOTE |= {"WMTS", "Zarr"}
_VRT_HEAD, LARGEST_VRT = 1024, 1 << 26  # bytes: in which GDAL looks for the word VRTDataset; of a whole VRT
_VIRTUAL = re.compile(r"\s*/vsi", re.IGNORECASE)


def is_inside(name: str) -> bool:
    """Whether a relative name leads into a folder or below it, and not out of it."""
    return not os.path.isabs(name) and os.path.normpath(name).split(os.sep)[0] != os.pardir


# --- HDF5 -----------------------------------------------------------------------------------------------------------

_DAMAGED = (KeyError, OSError, RuntimeError)  # raised by h5py for bytes that are no HDF5


def check_hdf5(path: Path, file: h5py.File) -> None:
    """Refuse data outside the file, and links and views that lead nowhere or in a circle. Raises ArtefactError."""
    try:
        graph = _scan(path, file)
    except UnicodeError:
        raise ArtefactError(f"{path}: expected names in UTF-8, found other bytes; write it again.") from None
    except _DAMAGED:
        raise ArtefactError(f"{path}: expected a whole HDF5 file, found a damaged one; write it again.") from None
    waiting, done = _files_behind(graph), {os.path.realpath(path)}
    while waiting:
        if (source := waiting.pop()) in done:
            continue
        done.add(source)
        try:
            with h5py.File(source, "r") as other:
                found = _scan(Path(source), other)
        except _DAMAGED:
            raise ArtefactError(
                f"{source}: expected an HDF5 file behind {path}, found something else; write it again."
            ) from None
        graph |= found
        waiting |= _files_behind(found)
    for (place, name), sources in graph.items():
        if lost := sources - graph.keys():
            source, missing = sorted(lost)[0]
            raise ArtefactError(
                f"{place}:{name}: expected the data set '{missing}' in {source}, found none; write it again."
            )
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        place, name = error.args[1][0]
        raise ArtefactError(
            f"{place}:{name}: expected data, found a virtual data set that refers to itself; write it again."
        ) from None


def _files_behind(graph: Mapping[DataSet, set[DataSet]]) -> set[str]:
    return {source for sources in graph.values() for source, _ in sources}


def _scan(path: Path, file: h5py.File) -> dict[DataSet, set[DataSet]]:
    """All data sets of a file, and the data sets that each one shows. Raises ArtefactError."""
    place = os.path.realpath(path)
    groups, seen = [file["/"]], {h5py.h5o.get_info(file.id).addr}
    found: dict[DataSet, set[DataSet]] = {}
    while groups:
        group = groups.pop()
        list(group.attrs)  # HDF5 compares their checksum
        for name in group:
            within = f"{group.name.rstrip('/')}/{name}"
            where = f"{path}:{within}"
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                raise ArtefactError(
                    f"{where}: expected data in this file, found a link into '{link.filename}'; copy them in with h5copy."
                )
            try:
                node = group[name]
                list(node.attrs)
            except _DAMAGED:
                raise ArtefactError(
                    f"{where}: expected data, found a link to nothing or to itself; write it again."
                ) from None
            if isinstance(node, h5py.Dataset):
                found[place, within] = set(_sources(where, place, node))
            elif isinstance(node, h5py.Group):
                address = h5py.h5o.get_info(node.id).addr
                if address not in seen:
                    seen.add(address)
                    groups.append(node)
    return found


def _sources(where: str, place: str, data: h5py.Dataset) -> Iterator[DataSet]:
    """The data sets that a virtual one shows. Raises ArtefactError."""
    if data.external:
        raise ArtefactError(
            f"{where}: expected data in this file, found them kept in '{data.external[0][0]}'; repack it (h5repack)."
        )
    folder = os.path.dirname(place)
    for name in {(part.file_name, part.dset_name) for part in data.virtual_sources()} if data.is_virtual else ():
        file, inner = name
        if not is_inside(file):
            raise ArtefactError(
                f"{where}: expected a view of files in its own folder or below it, found '{file}'; "
                "merge the parts again beside them, or without `virtual`."
            )
        source = place if file == "." else os.path.join(folder, file)
        if not os.path.isfile(source):
            raise ArtefactError(
                f"{where}: expected the file '{file}' that it is a view of, found none; "
                "bring it back, or merge the parts again without `virtual`."
            )
        yield os.path.realpath(source), inner if inner.startswith("/") else f"/{inner}"


# --- rasters --------------------------------------------------------------------------------------------------------


def open_raster_file(path: Path) -> DatasetReader:
    """A raster opened by GDAL, from files of this machine alone.

    Raises InputError or ArtefactError where it refers to what it may not, RasterioError where GDAL cannot open it.
    """
    state = os.stat(path)
    _check_raster(path, state.st_size, state.st_mtime_ns)
    return _open(path)


def _open(path: Path) -> DatasetReader:
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.io import DatasetReader

    with rasterio.Env(), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return DatasetReader(path, driver=_local_drivers())  # rasterio.open takes one driver only


@functools.cache
def _local_drivers() -> list[str]:
    import rasterio

    with rasterio.Env() as environment:
        return sorted(environment.drivers().keys() - _REMOTE)


@functools.lru_cache(maxsize=1 << 14)
def _check_raster(path: Path, size: int, modified: int) -> None:
    """Checked once while a file stays as it is: a VRT may list thousands. Raises InputError, ArtefactError."""
    waiting, seen = [path], {os.path.realpath(path)}
    while waiting:
        file = waiting.pop()
        _check_beside(file)
        with open(file, "rb") as stream:
            is_vrt = b"<VRTDataset" in stream.read(_VRT_HEAD)
        if is_vrt:
            for source in _listed(file):
                if (place := os.path.realpath(source)) not in seen:
                    seen.add(place)
                    waiting.append(source)
        elif h5py.is_hdf5(file):
            with h5py.File(file, "r") as data:
                check_hdf5(file, data)
        else:
            _check_further(file, listed=file != path)


def _check_beside(path: Path) -> None:
    """Refuse pipes and devices beside a raster under its name, where GDAL looks for statistics, masks and labels."""
    folder = path.absolute().parent
    for name in _endless_in(folder, folder.stat().st_mtime_ns):
        if name.startswith(path.stem) and name != path.name:
            raise InputError(f"{path}: expected files beside it, found the device or pipe '{name}'; remove it.")


@functools.lru_cache(maxsize=256)
def _endless_in(folder: Path, modified: int) -> tuple[str, ...]:
    """The pipes and devices in a folder, listed once while it stays as it is."""
    with os.scandir(folder) as entries:
        odd = [Path(entry.path) for entry in entries if not (entry.is_file() or entry.is_dir())]
    return tuple(path.name for path in odd if path.is_fifo() or path.is_char_device())


def _check_further(path: Path, listed: bool) -> None:
    """Refuse further files outside a raster's folder. listed : in a VRT, which GDAL opens by any driver"""
    from rasterio.errors import RasterioError

    try:
        with _open(path) as dataset:
            names = dataset.files
    except RasterioError:
        if listed:
            raise InputError(
                f"{path}: expected a raster that the VRT lists, found another file; mend the VRT."
            ) from None
        return  # whoever opens it says so
    folder = os.path.abspath(path.parent)
    for name in names:
        if not is_inside(os.path.relpath(os.path.abspath(name), folder)):
            raise InputError(
                f"{path}: expected its data in its own folder or below it, found '{name}'; copy them beside it."
            )


def _listed(path: Path) -> Iterator[Path]:
    """The rasters that a VRT lists. Raises InputError."""
    if path.stat().st_size > LARGEST_VRT:
        raise InputError(f"{path}: expected a VRT of at most {LARGEST_VRT >> 20} MiB; make a GeoTIFF (gdal_translate).")
    text = path.read_bytes()
    try:
        root = ElementTree.fromstring(text) if b"<!" not in text.replace(b"<!--", b"") else None
    except (ElementTree.ParseError, ValueError):
        root = None
    if root is None:
        raise InputError(f"{path}: expected a VRT of plain XML, found something else; make it again (gdalbuildvrt).")
    for element in root.iter():
        inside = {key.lower(): value for key, value in element.attrib.items()}  # GDAL takes both in any case
        name = (element.text or "").strip()
        if inside.get("subclass", "").lower() == "vrtrawrasterband":
            raise InputError(f"{path}: expected a VRT of rasters, found a raw band; make a GeoTIFF (gdal_translate).")
        if _is_name(element.tag.lower(), inside) and name:
            source = path.parent / name if inside.get("relativetovrt", "0") == "1" else Path(name)
            if not source.is_file() or inside.get("relativetovrt", "0") not in ("0", "1"):
                raise InputError(
                    f"{path}: expected rasters on this machine, found '{name[:160]}'; "
                    "make them GeoTIFFs (gdal_translate) and the VRT again."
                )
            yield source
        elif any(map(_VIRTUAL.match, (name, *inside.values()))):
            raise InputError(
                f"{path}: expected a VRT of files, found a name of GDAL's virtual file systems; make a GeoTIFF (gdal_translate)."
            )


def _is_name(tag: str, attributes: Mapping[str, str]) -> bool:
    """Whether an element of a VRT names a file."""
    key = attributes.get("key" if tag == "mdi" else "name", "").lower()
    return tag.endswith(("filename", "sourcedataset", "path")) or (
        tag in ("mdi", "argument") and key.endswith(("dataset", "filename", "overview_file"))
    )
