"""Levels that GDAL wrote as GeoTIFFs of their own become one cloud-optimised GeoTIFF, whose tiles are moved as they are packed.

GDAL's own COG driver would unpack and pack every tile once more. Directories come first, then tiles, those of the smallest
level first, each between its size and its last bytes: https://gdal.org/drivers/raster/cog.html#low-level
"""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

SHORT, LONG, LONG8 = 3, 4, 16
SIZES = {
    1: 1,
    2: 1,
    SHORT: 2,
    LONG: 4,
    5: 8,
    6: 1,
    7: 1,
    8: 2,
    9: 4,
    10: 8,
    11: 4,
    12: 8,
    13: 4,
    LONG8: 8,
    17: 8,
    18: 8,
}
KINDS = {SHORT: "<u2", LONG: "<u4", LONG8: "<u8"}
SUBFILE, TILE_OFFSETS, TILE_COUNTS = 254, 324, 325
GEOREFERENCE = (33550, 33922, 34264, 34735, 34736, 34737)  # an overview has that of the map
AROUND = 8  # bytes around a tile
TOGETHER = 16  # tiles written at once
CLASSIC = 1 << 32  # bytes, at which a TIFF's own places end: a BigTIFF's go on
STRUCTURE = (
    "LAYOUT=IFDS_BEFORE_DATA\nBLOCK_ORDER=ROW_MAJOR\nBLOCK_LEADER=SIZE_AS_UINT4\nBLOCK_TRAILER=LAST_4_BYTES_REPEATED\n"
    "KNOWN_INCOMPATIBLE_EDITION=NO\n "  # room for YES, which other programs put there
)

Tags = dict[int, tuple[int, int, bytes]]  # code -> (kind, count, little-endian values)


@dataclass(frozen=True)
class _Level:
    """tags : all but the places of the tiles; offsets, counts : (tiles,) bytes, row by row"""

    file: BinaryIO
    tags: Tags
    offsets: NDArray[np.int64]
    counts: NDArray[np.int64]


def join(levels: Sequence[Path], target: Path) -> None:
    """levels : little-endian BigTIFFs of one directory, in tiles, from the map to its smallest overview."""
    with contextlib.ExitStack() as files:
        found = [_read(files.enter_context(open(level, "rb"))) for level in levels]
        for level in found[1:]:
            for code in GEOREFERENCE:
                level.tags.pop(code, None)
            level.tags[SUBFILE] = (LONG, 1, struct.pack("<I", 1))
        head, length = _head_and_length(found, big=False)
        if length >= CLASSIC:
            head, _ = _head_and_length(found, big=True)
        out = files.enter_context(open(target, "wb"))
        out.write(head)
        for level in reversed(found):
            _move_tiles(level, out)


def _read(file: BinaryIO) -> _Level:
    start = struct.unpack("<8xQ", file.read(16))[0]
    file.seek(start)
    entries = file.read(20 * struct.unpack("<Q", file.read(8))[0])
    tags: Tags = {}
    for code, kind, count, value in struct.iter_unpack("<HHQ8s", entries):
        size = SIZES[kind] * count
        if size > len(value):
            file.seek(struct.unpack("<Q", value)[0])
            value = file.read(size)
        tags[code] = (kind, count, value[:size])
    offsets, counts = (_integers(*tags.pop(code)) for code in (TILE_OFFSETS, TILE_COUNTS))
    return _Level(file, tags, offsets, counts)


def _integers(kind: int, count: int, values: bytes) -> NDArray[np.int64]:
    return np.frombuffer(values, KINDS[kind], count).astype(np.int64)


def _move_tiles(level: _Level, out: BinaryIO) -> None:
    out.flush()
    for first in range(0, level.counts.size, TOGETHER):
        some = slice(first, first + TOGETHER)
        # Mapped and gathered, not read and buffered: one copy from page to page. Anew each time: mapped pages count as memory.
        with mmap.mmap(level.file.fileno(), 0, access=mmap.ACCESS_READ) as whole:
            _gather(whole, level.offsets[some].tolist(), level.counts[some].tolist(), out)


def _gather(level: mmap.mmap, offsets: Sequence[int], counts: Sequence[int], out: BinaryIO) -> None:
    """Write tiles of a level, each with what stands around it."""
    view = memoryview(level)
    tiles = [view[offset : offset + count] for offset, count in zip(offsets, counts, strict=True)]
    whole = [len(tile) for tile in tiles] == list(counts) and min(counts) >= 4
    parts = [part for tile in tiles for part in (struct.pack("<I", len(tile)), tile, tile[-4:])]
    if not whole or os.writev(out.fileno(), parts) < sum(map(len, parts)):
        raise OSError(errno.ENOSPC, "not all tiles could be written", out.name)


def _head_and_length(levels: Sequence[_Level], big: bool) -> tuple[bytes, int]:
    """What stands before the tiles, and the bytes of the whole file."""
    place = len(_head(levels, [level.offsets for level in levels], big))
    offsets = []
    for level in reversed(levels):
        ends = place + np.cumsum(level.counts + AROUND)
        offsets.append(ends - level.counts - AROUND // 2)
        place = int(ends[-1])
    return _head(levels, offsets[::-1], big), place


def _head(levels: Sequence[_Level], offsets: Sequence[NDArray[np.int64]], big: bool) -> bytes:
    ghost = f"GDAL_STRUCTURAL_METADATA_SIZE={len(STRUCTURE):06d} bytes\n{STRUCTURE}".encode()
    first = _aligned((16 if big else 8) + len(ghost))
    head = bytearray(struct.pack("<2sHHHQ", b"II", 43, 8, 0, first) if big else struct.pack("<2sHI", b"II", 42, first))
    head += ghost
    for k, (level, own) in enumerate(zip(levels, offsets, strict=True)):
        head += bytes(_aligned(len(head)) - len(head))
        kind = LONG8 if big else LONG
        places: Tags = {
            TILE_OFFSETS: (kind, own.size, own.astype(KINDS[kind]).tobytes()),
            TILE_COUNTS: (LONG, own.size, level.counts.astype(KINDS[LONG]).tobytes()),
        }
        head += _directory(level.tags | places, len(head), big, last=k == len(levels) - 1)
    return bytes(head)


def _directory(tags: Mapping[int, tuple[int, int, bytes]], place: int, big: bool, last: bool) -> bytes:
    """One directory that stands at ``place``, its longer values after it; the next one follows these."""
    number, entry, word = ("<Q", "<HHQ8s", "<Q") if big else ("<H", "<HHI4s", "<I")
    room = struct.calcsize(word)
    after = place + struct.calcsize(number) + len(tags) * struct.calcsize(entry) + room
    table, values = bytearray(struct.pack(number, len(tags))), bytearray()
    for code, (kind, count, data) in sorted(tags.items()):
        if len(data) > room:
            values += bytes(_aligned(after + len(values)) - after - len(values))
            here = struct.pack(word, after + len(values))
            values += data
        else:
            here = data
        table += struct.pack(entry, code, kind, count, here)  # shorter values are filled up with zeros
    return bytes(table + struct.pack(word, 0 if last else _aligned(after + len(values))) + values)


def _aligned(place: int) -> int:
    return -(-place // 8) * 8
