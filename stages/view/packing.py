"""Arrays for a page: quantised, predicted from their neighbours, deflated.

A map becomes whole numbers, each pixel the difference to what its neighbours predict, and the differences' bytes lie
plane by plane, lowest first, in one deflate stream. A browser undoes this with its own inflater and two running sums.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEVELS = 1 << 24  # what three bytes hold after the sign is folded in twice


@dataclass(frozen=True)
class Packed:
    """A map as a page holds it: value = offset + step x code.

    order : 1 = each code predicted from its left neighbour, 2 = from the plane through three neighbours
    """

    data: bytes
    shape: tuple[int, int]
    offset: float
    step: float
    order: int
    planes: int


def pack_map(values: NDArray, known: NDArray[np.bool_], step: float) -> Packed:
    """Values (H, W), kept to half a ``step``; where not ``known`` (H, W) the page gets something smooth, to be ignored."""
    filled = fill_along_rows(values, known)
    offset = float(filled.min())
    step = max(step, (float(filled.max()) - offset) / (LEVELS // 8), 1e-30)
    codes = np.rint((filled - offset) / step).astype(np.int64)
    left = np.diff(codes, axis=1, prepend=0)
    both = np.diff(left, axis=0, prepend=0)
    order, residual = (1, left) if np.abs(left[:, 1:]).sum() <= np.abs(both[1:, 1:]).sum() else (2, both)
    folded = np.where(residual >= 0, 2 * residual, -2 * residual - 1)
    planes = max(1, (int(folded.max()).bit_length() + 7) // 8)
    streams = b"".join((folded >> (8 * k) & 255).astype(np.uint8).tobytes() for k in range(planes))
    # what is left is noise: Huffman codes alone pack it as well as longest matches do, which take ten times as long to find
    deflate = zlib.compressobj(6, strategy=zlib.Z_FILTERED)
    data = deflate.compress(streams) + deflate.flush()
    return Packed(data, (values.shape[0], values.shape[1]), offset, step, order, planes)


def spread_step(values: NDArray, known: NDArray[np.bool_], levels: int) -> float:
    """The step that divides the range between the 1st and 99th percentiles of the known values (H, W) into ``levels``."""
    sample = values[known]
    if sample.size == 0:
        return 1.0
    low, high = np.percentile(sample[:: max(1, sample.size // 500_000)], (1, 99))
    return float(high - low) / levels or max(abs(float(high)), 1e-6) * 1e-4


def fill_along_rows(values: NDArray, known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(H, W) in which unknown pixels take the last known value before them in reading order (the first known at the start)."""
    flat, mask = np.asarray(values, np.float64).ravel(), known.ravel()
    if not mask.any():
        return np.zeros(values.shape)
    last = np.maximum.accumulate(np.where(mask, np.arange(flat.size), -1))
    last[last < 0] = int(np.argmax(mask))
    return flat[last].reshape(values.shape)


class Blob:
    """Streams one after another, as one base64 text; each is found again by (start, length)."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self.size = 0

    def add(self, data: bytes) -> list[int]:
        """Append bytes; their place as [first, count]."""
        place = [self.size, len(data)]
        self._parts.append(data)
        self.size += len(data)
        return place

    def add_map(self, packed: Packed) -> dict[str, object]:
        """What the page needs to unpack a map."""
        return {
            "place": self.add(packed.data),
            "shape": list(packed.shape),
            "offset": packed.offset,
            "step": packed.step,
            "order": packed.order,
            "planes": packed.planes,
        }

    def add_mask(self, mask: NDArray[np.bool_]) -> dict[str, object]:
        """A mask (H, W) as a map of 0 and 1."""
        return self.add_map(pack_map(mask, np.ones_like(mask), 1.0))

    def text(self) -> str:
        """All of it in base64."""
        return base64.b64encode(b"".join(self._parts)).decode("ascii")
