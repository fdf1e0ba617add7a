"""Writing and opening artefacts: HDF5 that is also valid netCDF-4 / CF, whole or absent, never half-written."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from schemas.declaration import SCHEMAS, STRING, Schema, Variable
from schemas.errors import ArtefactError, ConfigError, InputError, LunargrError
from schemas.locks import claim, partial_path
from schemas.provenance import describe_run, known_digests, sha256

_STANDARD_NAMES = {"x": "projection_x_coordinate", "y": "projection_y_coordinate"}
# What is not known, in datasets that keep so many decimals: NaN cannot pass HDF5's filter. netCDF's own default fill value.
UNKNOWN = np.float32(9.969209968386869e36)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# The netCDF-4 format's marker for a dimension without a coordinate variable of its own.
_BARE_DIMENSION = "This is a netCDF dimension but not a netCDF variable.%10d"


def silence_hdf5() -> None:
    """Keep the HDF5 C library from printing its own error stack: our one line says it.

    After a full disk every HDF5 object that is let go of fails once more, where no one can catch it, and Cython reports
    that through both hooks of ``sys``: these reports, and no others, are kept from the terminal, and remembered: what an
    object still held was not written, and the file must not become an artefact.
    """
    h5py._errors.silence_errors()
    if sys.excepthook is not _except_h5py_release:
        _hooks.append((sys.excepthook, sys.unraisablehook))
        sys.excepthook, sys.unraisablehook = _except_h5py_release, _except_h5py_unraisable


_lost: list[BaseException] = []  # what went wrong where HDF5 let go of objects
_abandoned: list[h5py.File] = []
_hooks: list[tuple[Callable[..., Any], Callable[[Any], Any]]] = []


def _is_release(trace: TracebackType | None) -> bool:
    """Whether a traceback is that of h5py letting go of an object."""
    return trace is not None and trace.tb_frame.f_code.co_filename.endswith("h5py/_objects.pyx")


def _except_h5py_release(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if _is_release(trace):
        _lost.append(error)
    else:
        _hooks[-1][0](kind, error, trace)


def _except_h5py_unraisable(unraisable: Any) -> None:
    if _is_release(unraisable.exc_traceback):
        _lost.append(unraisable.exc_value or OSError("HDF5 could not close an object"))
    else:
        _hooks[-1][1](unraisable)


def check_output(path: Path, inputs: Sequence[Path] = (), overwrite: bool = False) -> None:
    """Refuse, before any work is done, an output that would replace an input or an existing file.

    Raises ConfigError; the folder is created where it is missing.
    """
    path = Path(path)
    for source in inputs:
        if path.resolve() == Path(source).resolve():
            raise ConfigError(f"{path}: the output would replace the input of the same name; choose another --output.")
    if path.is_dir():
        raise ConfigError(f"{path}: expected a file name, found a folder; name the file in --output.")
    if path.exists() and not overwrite:
        raise ConfigError(f"{path}: exists already; add --overwrite to replace it or choose another --output.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"{path.parent}: cannot be made a folder ({error.strerror}); choose another --output."
        ) from None


def _is_full_disk(error: BaseException | None) -> bool:
    """HDF5 reports the system's error in words, and a failed close hides the failed write behind itself."""
    while error is not None:
        text = str(error).lower()
        if getattr(error, "errno", None) in _FULL or any(f"errno = {number}," in text for number in _FULL):
            return True
        if "no space left" in text or "disk quota" in text:
            return True
        error = error.__cause__ or error.__context__
    return False


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path`` that becomes ``path`` when the block ends well and vanishes when it does not.

    Also turns a full disk into one clear line (InputError), and refuses an output that another run is writing
    (ConfigError).
    """
    path = Path(path)
    partial = partial_path(path)
    with claim(path), _whole_or_absent(path, partial):
        yield partial
        os.replace(partial, path)


@contextlib.contextmanager
def _whole_or_absent(path: Path, partial: Path) -> Iterator[None]:
    try:
        yield
    except BaseException as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        if _is_full_disk(error):
            raise InputError(
                f"{path}: the disk is full or over quota; nothing half-written is left. "
                "Free some space and run the command again."
            ) from None
        raise


class ArtefactWriter:
    """Writes one artefact under a temporary name; use as a context manager.

    Dimensions are sized on entry; ``None`` is not allowed. Variables are created on first use, from their declaration.
    """

    def __init__(
        self,
        path: Path,
        schema: Schema,
        sizes: Mapping[str, int],
        *,
        config: Mapping[str, Any] | None = None,
        inputs: Sequence[Path] = (),
        seed: int | None = None,
        attributes: Mapping[str, Any] | None = None,
        overwrite: bool = False,
    ) -> None:
        check_output(path, inputs, overwrite)
        self.path = Path(path)
        self.schema = schema
        self.sizes = dict(sizes)
        self._root_attributes = describe_run(schema, config or {}, inputs, seed) | dict(attributes or {})
        self._stack = contextlib.ExitStack()
        self.file: h5py.File
        # A dataset that is let go of writes what it still holds where no one hears of a failure: they all stay to the end.
        self._kept: list[h5py.Dataset] = []
        self._lost_before = len(_lost)

    def __enter__(self) -> ArtefactWriter:
        silence_hdf5()
        self._stack.__enter__()
        try:
            partial = self._partial = self._stack.enter_context(atomic_path(self.path))
            self._stack.enter_context(_terminate_as_exception())
            try:
                self.file = h5py.File(partial, "w", track_order=True, libver=("earliest", "v110"))
                self._stack.callback(self._close)
            except OSError as error:
                if _is_full_disk(error):
                    raise
                raise ConfigError(f"{self.path}: cannot be written ({error}); choose another --output.") from None
            for key, value in self._root_attributes.items():
                self.file.attrs[key] = value
            for order, (name, size) in enumerate(self.sizes.items()):
                if name not in self.schema:  # a coordinate variable carries its own scale
                    scale = self.file.create_dataset(name, shape=(size,), dtype=">f4")
                    scale.make_scale(_BARE_DIMENSION % size)
                    scale.attrs["_Netcdf4Dimid"] = np.int32(order)
            for name, size in self.sizes.items():
                if name in self.schema:
                    self._create(self.schema[name], size_of_scale=size)
        except BaseException:
            if self._stack.__exit__(*sys.exc_info()):
                raise RuntimeError("an artefact's error was swallowed") from None
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            missing = [v.name for v in self.schema.variables if v.required and v.name not in self.file]
            missing += [a.name for a in self.schema.attributes if a.required and a.name not in self.file.attrs]
            if missing:
                error = RuntimeError(f"{self.schema.name}: written without {', '.join(missing)}")
                self._stack.__exit__(type(error), error, None)
                raise error
            error = self._flush()
        if _is_full_disk(error):
            # Give back the room that the partial file took: HDF5 can then flush and close without failing once more.
            os.truncate(self._partial, 0)
        self._stack.__exit__(None if error is None else type(error), error, trace)
        self._kept.clear()
        if kind is None and error is not None:
            raise error

    def _flush(self) -> BaseException | None:
        """Write everything that HDF5 still holds; what went wrong, now or where a dataset was let go of."""
        if len(_lost) > self._lost_before:
            return _lost[self._lost_before]
        try:
            self.file.flush()
        except (OSError, RuntimeError) as error:
            return error
        return None

    def _close(self) -> None:
        if len(_lost) > self._lost_before:
            # HDF5 would follow a pointer into what it failed to let go of, and take the process down.
            _abandoned.append(self.file)
        else:
            self.file.close()

    def _create(
        self,
        variable: Variable,
        size_of_scale: int | None = None,
        unit: str | None = None,
        decimals: int | None = None,
    ) -> h5py.Dataset:
        shape = tuple(self.sizes[d] for d in variable.dims)
        options: dict[str, Any] = {}
        if shape and 0 not in shape:
            chunks = variable.chunks
            if chunks is None and len(shape) >= 3:  # one record (a pair, a band) a chunk: random access stays fast
                chunks = (1,) * (len(shape) - 2) + shape[-2:]
                if decimals is not None:  # a smaller piece spans less and takes fewer bits
                    chunks = (1,) * (len(shape) - 2) + tuple(_piece(edge) for edge in shape[-2:])
            if chunks is not None:
                options["chunks"] = tuple(min(c, s) for c, s in zip(chunks, shape, strict=True))
            if variable.compress:
                options |= {"compression": "gzip", "compression_opts": 1, "shuffle": True}
                options.setdefault("chunks", True)
        if variable.dtype == STRING:
            dtype: Any = h5py.string_dtype()
        else:
            dtype = np.dtype(variable.dtype)
            if dtype.kind == "f":
                options["fillvalue"] = np.nan
                if decimals is not None and shape and 0 not in shape:
                    options |= {"scaleoffset": decimals, "fillvalue": UNKNOWN}
        data = self.file.create_dataset(variable.name, shape=shape, dtype=dtype, track_order=True, **options)
        if size_of_scale is not None:
            data.make_scale(variable.name)
            if variable.name in _STANDARD_NAMES:
                data.attrs["standard_name"] = _STANDARD_NAMES[variable.name]
            data.attrs["_Netcdf4Dimid"] = np.int32(list(self.sizes).index(variable.name))
        self._describe(data, variable, unit, scale=size_of_scale is not None)
        self._kept.append(data)
        return data

    def _describe(self, data: h5py.Dataset, variable: Variable, unit: str | None, scale: bool = False) -> None:
        if not scale:
            for axis, dim in enumerate(variable.dims):
                data.dims[axis].attach_scale(self.file[dim])
        if variable.dtype != STRING:
            data.attrs["units"] = unit or variable.unit
            if data.dtype.kind == "f":
                data.attrs["_FillValue"] = np.array(data.fillvalue, data.dtype)
        data.attrs["long_name"] = variable.description
        if variable.flags:
            data.attrs["flag_values"] = np.array([value for _, value in variable.flags], variable.dtype)
            data.attrs["flag_meanings"] = " ".join(meaning for meaning, _ in variable.flags)
        if variable.georeferenced:
            data.attrs["grid_mapping"] = "crs"

    def dataset(self, name: str, unit: str | None = None, decimals: int | None = None) -> h5py.Dataset:
        """The open dataset ``name``, created from its declaration on first use, for block-wise writing.

        ``decimals`` keeps so many digits after the point, by HDF5's scale-offset filter, which every reader undoes: a
        chunk takes as many bits a value as its range needs. Unknown values are then UNKNOWN, and never NaN.
        """
        if name not in self.file:
            return self._create(self.schema[name], unit=unit, decimals=decimals)
        return self.file[name]

    def write(self, name: str, data: Any, unit: str | None = None) -> h5py.Dataset:
        """Write a whole variable; shapes must match the declared dimensions."""
        target = self.dataset(name, unit)
        if self.schema[name].dtype == STRING:
            target[...] = np.asarray(list(data), dtype=object) if target.shape else data
        else:
            target[...] = data
        return target

    def link(self, name: str, sources: Sequence[tuple[tuple[slice, ...], h5py.Dataset, tuple[slice, ...]]]) -> None:
        """Make a variable a view of datasets in other files: (where it goes, whole dataset, what of it).

        The files are named relative to this one, and must stay; :func:`open_artefact` checks that they are there.
        """
        variable = self.schema[name]
        shape = tuple(self.sizes[d] for d in variable.dims)
        dtype = np.dtype(variable.dtype)
        layout = h5py.VirtualLayout(shape, dtype)
        for target, source, part in sources:
            file = os.path.relpath(os.path.realpath(source.file.filename), os.path.realpath(self.path.parent))
            view = h5py.VirtualSource(file, source.name, source.shape, source.dtype)
            layout[target] = view[part]
        fill = sources[0][1].fillvalue if sources and sources[0][1].scaleoffset is not None else np.nan
        data = self.file.create_virtual_dataset(name, layout, fillvalue=fill if dtype.kind == "f" else 0)
        unit = sources[0][1].attrs.get("units") if sources and variable.unit_choices else None
        self._describe(data, variable, str(unit) if unit is not None else None)

    def write_crs(self, wkt: str, transform: Sequence[float]) -> None:
        """The scalar ``crs`` variable that CF and GDAL look for; ``transform`` is affine (a, b, c, d, e, f)."""
        data = self.file.create_dataset("crs", shape=(), dtype="i4", data=0)
        a, b, c, d, e, f = (float(v) for v in transform[:6])
        data.attrs["crs_wkt"] = wkt
        data.attrs["spatial_ref"] = wkt
        data.attrs["GeoTransform"] = " ".join(repr(v) for v in (c, a, b, f, d, e))


def _piece(edge: int) -> int:
    """The edge of a packed chunk: 64 or the nearest above it that divides ``edge``."""
    return edge // (edge // 64) if edge > 64 and edge % (edge // 64) == 0 else edge


@contextlib.contextmanager
def _terminate_as_exception() -> Iterator[None]:
    """Let SIGTERM (a Slurm time limit, ``kill``) unwind like Ctrl-C, so that the partial file is removed."""
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    ):
        yield
        return

    def stop(number: int, frame: Any) -> None:
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def open_artefact(path: Path, schema: Schema, *, need: Sequence[str] = ()) -> h5py.File:
    """Open an artefact for reading after checking that it is what it should be.

    ``need`` names optional variables that this caller cannot do without. Raises ArtefactError.
    """
    path = Path(path)
    file = _open_hdf5(path)
    try:
        _check_kind(path, file, schema)
        for variable in schema.variables:
            if variable.name in file:
                _check_variable(path, file, variable)
            elif variable.required or variable.name in need:
                raise ArtefactError(
                    f"{path}:/{variable.name}: expected a variable ({variable.description}), found none; "
                    f"write it again with 'lunargr {schema.stage}'."
                )
        for attribute in schema.attributes:
            if attribute.required and attribute.name not in file.attrs:
                raise ArtefactError(
                    f"{path}: expected the root attribute '{attribute.name}' ({attribute.description}), found none; "
                    f"write it again with 'lunargr {schema.stage}'."
                )
        _check_sizes(path, file, schema)
        _check_views(path, file)
    except BaseException:
        file.close()
        raise
    return file


def read_kind(path: Path) -> Schema:
    """The schema that an artefact says it follows. Raises ArtefactError."""
    with _open_hdf5(Path(path)) as file:
        name = _text(file.attrs.get("lunargr_schema", ""))
    if name not in SCHEMAS:
        raise ArtefactError(
            f"{path}: expected a lunargr artefact (root attribute 'lunargr_schema'), found '{name or 'none'}'; "
            f"artefacts are: {', '.join(SCHEMAS)}."
        )
    return SCHEMAS[name]


def _open_hdf5(path: Path) -> h5py.File:
    silence_hdf5()
    if not path.exists():
        raise ArtefactError(f"{path}: no such file; check the path or run the stage that writes it.")
    if path.is_dir():
        raise ArtefactError(f"{path}: expected an HDF5 file, found a folder.")
    try:
        return h5py.File(path, "r")
    except OSError as error:
        kind = (
            "a damaged or truncated HDF5 file"
            if h5py.is_hdf5(path) or "truncated" in str(error)
            else "another kind of file"
        )
        raise ArtefactError(f"{path}: expected an HDF5 artefact, found {kind}; write it again.") from None


def _check_kind(path: Path, file: h5py.File, schema: Schema) -> None:
    found = _text(file.attrs.get("lunargr_schema", ""))
    if not found and schema.foreign_writers:
        return
    if found != schema.name:
        what = f"a '{found}'" if found else "an HDF5 file without 'lunargr_schema'"
        raise ArtefactError(
            f"{path}: expected a '{schema.name}' artefact (from 'lunargr {schema.stage}'), found {what}; check the order of the files."
        )
    version = int(file.attrs.get("schema_version", schema.version))
    if version != schema.version:
        raise ArtefactError(
            f"{path}: expected version {schema.version} of '{schema.name}', found {version}; write it again with 'lunargr {schema.stage}'."
        )


def _check_variable(path: Path, file: h5py.File, variable: Variable) -> None:
    where = f"{path}:/{variable.name}"
    data = file[variable.name]
    if not isinstance(data, h5py.Dataset) or data.ndim != len(variable.dims):
        found = f"{data.ndim}" if isinstance(data, h5py.Dataset) else "a group"
        raise ArtefactError(
            f"{where}: expected {len(variable.dims)} dimensions ({', '.join(variable.dims)}), found {found}."
        )
    if variable.dtype == STRING:
        return
    if data.dtype.kind not in "iufb":
        raise ArtefactError(f"{where}: expected numbers ({variable.dtype}), found {data.dtype}.")
    unit = _text(data.attrs.get("units", ""))
    allowed = (variable.unit, *variable.unit_choices)
    if unit and unit not in allowed:
        expected = " or ".join(f"'{u}'" for u in dict.fromkeys(allowed))
        stage = _text(file.attrs.get("lunargr_schema", "")) or "it"
        writer = SCHEMAS[stage].stage if stage in SCHEMAS else None
        advice = f"write it again with 'lunargr {writer}'." if writer else "mend the writer of the file."
        raise ArtefactError(f"{where}: expected units {expected}, found '{unit}'; {advice}")


def _check_sizes(path: Path, file: h5py.File, schema: Schema) -> None:
    sizes: dict[str, tuple[int, str]] = {}
    for variable in schema.variables:
        if variable.name not in file:
            continue
        for dim, size in zip(variable.dims, file[variable.name].shape, strict=True):
            first = sizes.setdefault(dim, (size, variable.name))
            if first[0] != size:
                raise ArtefactError(
                    f"{path}:/{variable.name}: expected {first[0]} along '{dim}' as in /{first[1]}, found {size}; write it again."
                )


def _check_views(path: Path, file: h5py.File) -> None:
    """HDF5 reads what a lost file held as fill values, without a word: such an artefact must not look whole."""
    for data in file.values():
        if isinstance(data, h5py.Dataset) and data.is_virtual:
            plan = data.id.get_create_plist()
            for source in {plan.get_virtual_filename(k) for k in range(plan.get_virtual_count())}:
                if not (path.resolve().parent / source).exists():
                    raise ArtefactError(
                        f"{path}:{data.name}: expected the file '{source}' that it is a view of, found none; "
                        "bring it back, or merge the parts again without --virtual."
                    )


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def unpack(data: h5py.Dataset, values: Any) -> np.ndarray:
    """Values read from ``data``, as CF means them: fill values become NaN in floats, and packed numbers are scaled.

    Flags and other integers without ``scale_factor`` or ``add_offset`` stay as they are.
    """
    values = np.asarray(values)
    packed = "scale_factor" in data.attrs or "add_offset" in data.attrs
    if values.dtype.kind != "f" and not packed:
        return values
    fills = [data.attrs[k] for k in ("_FillValue", "missing_value") if k in data.attrs]
    result = values.astype(np.float32 if values.dtype != np.float64 else np.float64)
    if packed:
        scale, offset = (float(np.ravel(data.attrs.get(k, v))[0]) for k, v in (("scale_factor", 1), ("add_offset", 0)))
        result = (values * scale + offset).astype(np.float32)
    for fill in fills:
        known = values == np.asarray(np.ravel(fill)[0], values.dtype)
        if known.any():
            result[known] = np.nan
    return result


def read_strings(file: h5py.File, name: str) -> list[str]:
    """A string variable as a list of ``str``."""
    return [_text(v) for v in file[name][...]]


def read_config(file: h5py.File) -> dict[str, Any]:
    """The configuration that an artefact was made with."""
    return json.loads(_text(file.attrs.get("config", "{}")))


__all__ = [
    "UNKNOWN",
    "ArtefactWriter",
    "LunargrError",
    "atomic_path",
    "check_output",
    "known_digests",
    "open_artefact",
    "read_config",
    "read_kind",
    "read_strings",
    "sha256",
    "silence_hdf5",
    "unpack",
]
