"""Random access to the crops of a pairs file: scale-offset chunks of floats are decoded here, all else is read by HDF5.

HDF5 decodes such chunks byte by byte and takes 1.4 ms for a pair, where plain chunks take 0.14 ms. Here their index is
read once, and whole batches are decoded from the mapped file without Python's lock, in 0.2 ms a pair.
"""

from __future__ import annotations

import contextlib
import mmap
import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.reading import unpack

# bytes before the codes of a scale-offset chunk: their width, the size of the minimum, the minimum, padding
_HEADER = 21
_SLACK = 8  # bytes behind a chunk that decoding may read
_KEPT = 1 << 25  # bytes that stay mapped: what was read long ago would count as memory in use
_MIN_INDEX = 64  # records; for fewer, reading a large file's whole index costs more than HDF5 does


class Mapping:
    """A file's bytes, mapped: pages come from the system's cache without a call each."""

    def __init__(self, path: Path) -> None:
        with open(path, "rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            self._fd = os.dup(file.fileno())
        self.bytes: NDArray[np.uint8] = np.frombuffer(self._map, np.uint8)
        self._touched = 0

    def touch(self, end: int, count: int) -> None:
        """To be called before ``count`` bytes up to ``end`` are read. Raises OSError where the file became shorter."""
        if end > len(self.bytes) or end > os.fstat(self._fd).st_size:
            raise OSError("it ends early")
        self._touched += count
        if self._touched > _KEPT and hasattr(mmap, "MADV_DONTNEED"):
            self._touched = 0
            self._map.madvise(mmap.MADV_DONTNEED)

    def close(self) -> None:
        """Let go of the file."""
        self.bytes = np.empty(0, np.uint8)
        os.close(self._fd)
        with contextlib.suppress(BufferError):  # an array still refers to it: it is closed with the last of these
            self._map.close()


class Records:
    """A variable (record, y, x) of an open file, by record.

    packed : whether they are float32 chunks packed by scale-offset with decimals, which are decoded here
    """

    def __init__(self, data: h5py.Dataset, mapping: Mapping) -> None:
        self.data = data
        self.shape: tuple[int, int] = data.shape[1:]
        self._mapping = mapping
        self._asked = 0
        self._offset: NDArray[np.int64] | None = None  # (record, piece)
        self._size: NDArray[np.int64] | None = None
        self._decimals, self._code_fill = 0, np.float32(np.nan)
        self._has_fill = False
        self.packed = self._is_packed()
        declared = data.attrs.get("_FillValue")
        self._fill = np.float32(np.nan if declared is None else np.ravel(declared)[0])
        if self._code_fill == self._fill:
            self._code_fill = np.float32(np.nan)

    def _is_packed(self) -> bool:
        data = self.data
        decoded = {"scale_factor", "add_offset", "missing_value"} & set(data.attrs)
        if data.dtype != np.dtype("<f4") or decoded or data.chunks is None or data.file.userblock_size:
            return False
        pieces = data.chunks
        if 0 in data.shape or pieces[0] != 1 or any(n % edge for n, edge in zip(self.shape, pieces[1:], strict=True)):
            return False
        creation = data.id.get_create_plist()
        filters = [creation.get_filter(k) for k in range(creation.get_nfilters())]
        if [f[0] for f in filters] != [h5py.h5z.FILTER_SCALEOFFSET] or filters[0][2][0] != h5py.h5z.SO_FLOAT_DSCALE:
            return False
        # kind, decimals, values, class, size, sign, order, whether there is a fill value, fill value
        settings = np.array(filters[0][2], np.uint32)
        self._decimals = int(settings[1:2].view(np.int32)[0])
        self._has_fill = bool(settings[7])
        self._code_fill = settings[8:9].view(np.float32)[0]
        return True

    def prepare(self, count: int) -> None:
        """Announce that ``count`` more records will be read; from the thread that opened the file."""
        self._asked += count
        if not self.packed or self._offset is not None or self._asked < min(_MIN_INDEX, len(self.data)):
            return
        records = len(self.data)
        _, rows, cols = self.data.chunks
        across = self.shape[1] // cols
        offset = np.full((records, self.shape[0] // rows * across), -1, np.int64)
        size = np.zeros_like(offset)

        def note(chunk: Any) -> None:
            if not chunk.filter_mask:  # no filter was skipped
                record, row, col = chunk.chunk_offset
                piece = row // rows * across + col // cols
                offset[record, piece], size[record, piece] = chunk.byte_offset, chunk.size

        self.data.id.chunk_iter(note)
        self._offset, self._size = offset, size

    def empty(self, count: int) -> NDArray:
        """Room for some records: bytes for flags, float32 for all else."""
        return np.empty((count, *self.shape), np.uint8 if self.data.dtype == np.uint8 else np.float32)

    def read_into(self, out: NDArray, indices: NDArray[np.int64]) -> None:
        """Fill ``out`` (n, H, W) with records: NaN where unknown. Raises OSError for a damaged file."""
        offset, size = self._offset, self._size
        if offset is not None and size is not None and (offset[indices] >= 0).all():
            self._decode(out, offset[indices], size[indices])
        else:
            out[...] = unpack(self.data, np.stack([self.data[k] for k in indices.tolist()]))

    def _decode(self, out: NDArray, offset: NDArray[np.int64], size: NDArray[np.int64]) -> None:
        start, sizes = offset.ravel(), size.ravel()
        end = int((start + sizes).max())
        self._mapping.touch(end, int(sizes.sum()))
        buffer = self._mapping.bytes
        if end + _SLACK > len(buffer):  # the last chunk of the file
            first = int(start.min())
            buffer, start = np.concatenate([buffer[first:], np.zeros(_SLACK, np.uint8)]), start - first
        pieces = offset.shape[1]
        rows, cols = self.data.chunks[1:]
        head = buffer[start[:, None] + np.arange(_HEADER)]
        width = np.ascontiguousarray(head[:, :4]).view("<u4")[:, 0].astype(np.int64)
        minimum = np.ascontiguousarray(head[:, 5:9]).view("<f4")[:, 0]
        if (sizes < _HEADER + (rows * cols * width + 7) // 8).any() or width.max() > 32:
            raise OSError(f"a chunk of {self.data.name} is damaged")
        power, code_fill = np.float32(10.0**self._decimals), self._code_fill
        _unpack_floats(buffer, start, width, minimum, out, pieces, rows, cols, power, self._has_fill, code_fill)
        for number in np.flatnonzero(width == 32).tolist():  # the range is too wide to pack: floats as they are
            first = start[number] + _HEADER
            values = np.frombuffer(buffer[first : first + 4 * rows * cols].tobytes(), "<f4").copy()
            values[values == self._fill] = np.nan
            record, piece = divmod(number, pieces)
            row, col = piece // (out.shape[2] // cols) * rows, piece % (out.shape[2] // cols) * cols
            out[record, row : row + rows, col : col + cols] = values.reshape(rows, cols)


@njit(nogil=True, cache=True)
def _unpack_floats(buffer, start, width, minimum, out, pieces, rows, cols, power, has_fill, fill):
    """Scale-offset chunks to floats as HDF5 does: code / 10^decimals + minimum, in single precision. power : float32

    Codes are big-endian and follow each other without gaps. Unsigned indices spare numba's check for negative ones.
    """
    across = out.shape[2] // cols
    codes = np.empty(cols, np.int32)
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    for number in range(start.size):
        bits = width[number]
        if bits == 32:
            continue
        k, piece = number // pieces, number % pieces
        top, left = piece // across * rows, piece % across * cols
        least, each = minimum[number], np.uint64(bits)
        mask = (one << each) - one
        unknown = np.int32(mask) if has_fill and bits else np.int32(-1)  # the largest code is the fill value
        at, waiting, have = np.uint64(start[number] + _HEADER), np.uint64(0), np.uint64(0)
        for r in range(rows):
            for c in range(cols):
                if have < each:
                    high = (np.uint64(buffer[at]) << np.uint64(24)) | (np.uint64(buffer[at + one]) << np.uint64(16))
                    low = (np.uint64(buffer[at + two]) << np.uint64(8)) | np.uint64(buffer[at + three])
                    waiting = (waiting << np.uint64(32)) | high | low
                    have += np.uint64(32)
                    at += four
                have -= each
                codes[c] = np.int32((waiting >> have) & mask)
            row = out[k, top + r, left : left + cols]
            for c in range(cols):
                row[c] = fill if codes[c] == unknown else np.float32(codes[c]) / power + least
