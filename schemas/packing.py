"""Packed numbers as CF has them: value = code * scale_factor + add_offset, and a code for what is unknown."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError

CODE = np.dtype("i2")
UNKNOWN = np.int16(-32768)  # code of unknown values
LARGEST = 32767


@dataclass(frozen=True)
class Packing:
    """16-bit codes of a variable. step : between neighbouring values; offset : value of code 0; both in its unit.

    Steps that are powers of two, and offsets that are multiples of them, are decoded exactly in single precision.
    """

    step: float
    offset: float = 0.0

    @classmethod
    def over(cls, low: float, high: float) -> Packing:
        """The finest power of two as step with which ``low`` .. ``high`` fit, but no finer than float32 is there."""
        largest = max(abs(low), abs(high), 1e-30)
        step = 2.0 ** math.ceil(math.log2(max((high - low) / (2 * LARGEST - 1), largest * 2.0**-22)))
        return cls(step, step * round((low + high) / 2 / step))

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and largest value."""
        return self.offset - LARGEST * self.step, self.offset + LARGEST * self.step


def read_packing(data: h5py.Dataset) -> Packing | None:
    """How an open variable is packed into the codes that this module writes; None for other layouts."""
    if data.dtype != CODE or "scale_factor" not in data.attrs or data.attrs.get("_FillValue") != UNKNOWN:
        return None
    return Packing(*_scale(data))


def pack(data: h5py.Dataset, values: NDArray, where: str = "") -> NDArray:
    """Values for ``data``, as codes if it is packed; any shape, NaN = unknown.

    where : names their source in a message. Raises InputError for values that the codes do not reach.
    """
    packing = read_packing(data)
    if packing is None:
        return values
    known = np.isfinite(values)
    codes = np.rint((np.where(known, values, packing.offset) - packing.offset) / packing.step)
    beyond = np.abs(codes) > LARGEST
    if beyond.any():
        low, high = packing.bounds
        raise InputError(
            f"{where}{': ' * bool(where)}{data.name.strip('/')}: expected values of {low:g} .. {high:g}, which 16 bits hold, "
            f"found {float(values[beyond][0]):g}; check its units, or keep all digits (`exact`)."
        )
    return np.where(known, codes, UNKNOWN).astype(CODE)


def decoder(data: h5py.Dataset) -> Callable[[NDArray], NDArray]:
    """A function that decodes values read from ``data``, any shape, as :func:`unpack` does: it keeps the attributes."""
    packed = "scale_factor" in data.attrs or "add_offset" in data.attrs
    if data.dtype.kind != "f" and not packed:
        return lambda values: values
    single = not packed or data.dtype.itemsize <= 2  # single precision holds 16-bit codes: half of the time
    scale, offset = (np.float32(v) if single else np.float64(v) for v in _scale(data))
    fills = [np.ravel(data.attrs[k]) for k in ("_FillValue", "missing_value") if k in data.attrs]
    unknowns = [v for v in np.concatenate(fills).astype(data.dtype) if v == v] if fills else []

    def decode(values: NDArray) -> NDArray:
        if packed:
            result: NDArray = values * scale
            result += offset
            result = result.astype(np.float32, copy=False)
        else:
            result = values.astype(np.float32 if values.dtype.itemsize <= 4 else np.float64)
        for fill in unknowns:
            unknown = values == fill
            if unknown.any():
                result[unknown] = np.nan
        return result

    return decode


def unpack(data: h5py.Dataset, values: Any) -> NDArray:
    """Values read from ``data``, decoded as CF says: packed numbers are scaled, fill values of floats become NaN.

    Flags and other integers without ``scale_factor`` or ``add_offset`` stay as they are. values : any shape, kept
    """
    return decoder(data)(np.asarray(values))


def read(data: h5py.Dataset, key: Any) -> NDArray:
    """The part ``data[key]``, decoded by :func:`unpack`."""
    return unpack(data, data[key])


def _scale(data: h5py.Dataset) -> tuple[float, float]:
    """scale_factor and add_offset."""
    scale, offset = (np.ravel(data.attrs.get(k, v))[0] for k, v in (("scale_factor", 1.0), ("add_offset", 0.0)))
    return float(scale), float(offset)
