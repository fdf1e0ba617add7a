"""Writing artefacts: HDF5 that is also valid netCDF-4 / CF."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from schemas.declaration import STRING, Schema, Variable
from schemas.errors import ArtefactError, ConfigError
from schemas.files.hdf5 import abandoned, whole_hdf5
from schemas.files.references import is_inside
from schemas.packing import CODE, UNKNOWN, Packing, read_packing
from schemas.provenance import describe_run
from schemas.reading import open_artefact

_STANDARD_NAMES = {"x": "projection_x_coordinate", "y": "projection_y_coordinate"}
# The netCDF-4 format's marker for a dimension without a coordinate variable of its own.
_BARE_DIMENSION = "This is a netCDF dimension but not a netCDF variable.%10d"


class ArtefactWriter:
    """Writes one artefact under a temporary name, and checks it before it gets its own; use as a context manager.

    Dimensions are sized on entry; ``None`` is not allowed. Variables are created on first use, from their declaration.
    Raises ArtefactError where what was written is not what its schema declares; then nothing is left.
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
    ) -> None:
        self.path = Path(path)
        self.schema = schema
        self.sizes = dict(sizes)
        self._root_attributes = describe_run(schema, config or {}, inputs, seed) | dict(attributes or {})
        self._stack = contextlib.ExitStack()
        self.file: h5py.File
        # A dataset that is released writes what it still holds, and no one hears of a failure: all are kept to the end.
        self._kept: list[h5py.Dataset] = []

    def __enter__(self) -> ArtefactWriter:
        with contextlib.ExitStack() as stack:
            self.file = stack.enter_context(whole_hdf5(self.path, self._check))
            for key, value in self._root_attributes.items():
                self.file.attrs[key] = value
            for order, (name, size) in enumerate(self.sizes.items()):
                if name not in self.schema:  # a coordinate variable carries its own scale
                    named = f"{name}_name" in self.schema
                    scale = self.file.create_dataset(name, (size,), h5py.string_dtype() if named else ">f4")
                    scale.make_scale(name if named else _BARE_DIMENSION % size)
                    scale.attrs["_Netcdf4Dimid"] = np.int32(order)
            for name in self.sizes:
                if name in self.schema:
                    self._create(self.schema[name], scale=True)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            with self._stack:
                if error is not None:
                    raise error
                self._finish()
        except BaseException:
            abandoned.extend(self._kept)  # after a full disk HDF5 would crash where it releases them
            raise
        self._kept.clear()

    def _finish(self) -> None:
        missing = [v.name for v in self.schema.variables if v.required and v.name not in self.file]
        missing += [a.name for a in self.schema.attributes if a.required and a.name not in self.file.attrs]
        if missing:
            raise RuntimeError(f"{self.schema.name}: written without {', '.join(missing)}")
        self._name_coordinates()

    def _name_coordinates(self) -> None:
        """A dimension whose entries have names gets them as its coordinate: xarray's ``sel(coefficient="a")`` takes them."""
        for dim in self.sizes:
            if f"{dim}_name" in self.schema and f"{dim}_name" in self.file:
                self.file[dim][...] = self.file[f"{dim}_name"][...]
                self.file[dim].attrs["long_name"] = self.schema[f"{dim}_name"].description

    def _check(self, partial: Path) -> None:
        """Refuse what the next stage would refuse, while it has no name yet. Raises ArtefactError."""
        try:
            open_artefact(partial, self.schema).close()
        except ArtefactError as error:
            problem = str(error).replace(str(partial), str(self.path)).rpartition("; ")[0]
            raise ArtefactError(
                f"{problem}; nothing was written. Look for such values in the inputs; if there are none, report it."
            ) from None

    def _create(
        self, variable: Variable, scale: bool = False, unit: str | None = None, packing: Packing | None = None
    ) -> h5py.Dataset:
        shape = tuple(self.sizes[d] for d in variable.dims)
        options: dict[str, Any] = {}
        if shape and 0 not in shape:
            chunks = variable.chunks
            if chunks is None and len(shape) >= 3:  # one record (a pair, a band) a chunk: random access stays fast
                chunks = (1,) * (len(shape) - 2) + shape[-2:]
            if chunks is not None:
                options["chunks"] = tuple(min(c, s) for c, s in zip(chunks, shape, strict=True))
            if variable.compress:
                options |= {"compression": "gzip", "compression_opts": 1, "shuffle": True}
                options.setdefault("chunks", True)
        if variable.dtype == STRING:
            dtype: Any = h5py.string_dtype()
        else:
            dtype = CODE if packing else np.dtype(variable.dtype)
            if packing or dtype.kind == "f":
                options["fillvalue"] = UNKNOWN if packing else np.nan
        data = self.file.create_dataset(variable.name, shape=shape, dtype=dtype, track_order=True, **options)
        if scale:
            data.make_scale(variable.name)
            if variable.name in _STANDARD_NAMES:
                data.attrs["standard_name"] = _STANDARD_NAMES[variable.name]
            data.attrs["_Netcdf4Dimid"] = np.int32(list(self.sizes).index(variable.name))
        self._describe(data, variable, unit, scale, packing)
        self._kept.append(data)
        return data

    def _describe(
        self,
        data: h5py.Dataset,
        variable: Variable,
        unit: str | None,
        scale: bool = False,
        packing: Packing | None = None,
    ) -> None:
        if not scale:
            for axis, dim in enumerate(variable.dims):
                data.dims[axis].attach_scale(self.file[dim])
        if variable.dtype != STRING:
            data.attrs["units"] = unit or variable.unit
            if packing or data.dtype.kind == "f":
                data.attrs["_FillValue"] = np.array(data.fillvalue, data.dtype)
            if packing:
                data.attrs["scale_factor"], data.attrs["add_offset"] = packing.step, packing.offset
        data.attrs["long_name"] = variable.description
        if variable.flags:
            data.attrs["flag_values"] = np.array([value for _, value in variable.flags], variable.dtype)
            data.attrs["flag_meanings"] = " ".join(meaning for meaning, _ in variable.flags)
        if variable.georeferenced:
            data.attrs["grid_mapping"] = "crs"

    def dataset(self, name: str, unit: str | None = None, packing: Packing | None = None) -> h5py.Dataset:
        """The open dataset ``name``, created from its declaration on first use, for block-wise writing.

        packing : of 16-bit codes, which :func:`schemas.packing.pack` makes
        """
        if name not in self.file:
            return self._create(self.schema[name], unit=unit, packing=packing)
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
        """Make a variable a view of datasets in other files: (target part, source dataset, source part) of each.

        The sources are packed alike. The files are named relative to this one, and must stay; :func:`open_artefact`
        checks that they are there.
        """
        variable, packing = self.schema[name], read_packing(sources[0][1]) if sources else None
        shape = tuple(self.sizes[d] for d in variable.dims)
        dtype = CODE if packing else np.dtype(variable.dtype)
        layout = h5py.VirtualLayout(shape, dtype)
        for target, source, part in sources:
            file = os.path.relpath(os.path.abspath(source.file.filename), os.path.abspath(self.path.parent))
            if not is_inside(file):
                raise ConfigError(
                    f"{self.path}: expected the parts in its own folder or below it, found '{file}'; "
                    "choose an `output` beside them, or merge without `virtual`."
                )
            view = h5py.VirtualSource(file, source.name, source.shape, source.dtype)
            layout[target] = view[part]
        fill = UNKNOWN if packing else np.nan if dtype.kind == "f" else 0
        data = self.file.create_virtual_dataset(name, layout, fillvalue=fill)
        unit = sources[0][1].attrs.get("units") if sources and variable.unit_choices else None
        self._describe(data, variable, str(unit) if unit is not None else None, packing=packing)

    def write_crs(self, wkt: str, transform: Sequence[float]) -> None:
        """The scalar ``crs`` variable that CF and GDAL look for; ``transform`` is affine (a, b, c, d, e, f)."""
        data = self.file.create_dataset("crs", shape=(), dtype="i4", data=0)
        a, b, c, d, e, f = (float(v) for v in transform[:6])
        data.attrs["crs_wkt"] = wkt
        data.attrs["spatial_ref"] = wkt
        data.attrs["GeoTransform"] = " ".join(repr(v) for v in (c, a, b, f, d, e))
