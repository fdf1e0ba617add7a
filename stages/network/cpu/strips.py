"""A network over a map from north to south, strip by strip: every layer keeps the last rows that its next ones still need.

No row is worked on twice, however far the network sees, and memory follows the width of what is asked for, not its height.
Rows and columns are counted on the whole map at the resolution of each level, which is continued to multiples of ``stride``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator

import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.network.cpu import inference_kernels as row_kernels
from stages.network.cpu.folded_unet import Conv, FoldedUNet
from stages.network.cpu.training_kernels import empty, pixels_of

STRIP = 256  # rows at full resolution: what each strip's convolutions work on once more is 1.5 % of the work, of 64 rows 6 %
MARGIN = 4  # px: upsampled to 8, less the 3 that a level's convolutions spoil at an edge, leaves more than it needs
CARRIED = 4  # rows of its input that a block of two 3 x 3 convolutions needs again

Terrain = Callable[[int, int, int, int], NDArray]


class Rows:
    """Consecutive rows of a field, in the pieces (1, C, n, W) in which they were made."""

    def __init__(self, first: int) -> None:
        self.end = first
        self._pieces: deque[tuple[int, Tensor]] = deque()

    def add(self, piece: Tensor) -> None:
        """Put the rows that follow, (1, C, h, W), at the end."""
        self._pieces.append((self.end, piece))
        self.end += piece.shape[2]

    def between(self, first: int, last: int) -> Iterator[tuple[int, Tensor]]:
        """(row, what of a piece begins there)"""
        for row, piece in self._pieces:
            a, b = max(first, row), min(last, row + piece.shape[2])
            if a < b:
                yield a, piece[:, :, a - row : b - row]

    def forget(self, before: int) -> None:
        """Let go of pieces that end before a row."""
        while self._pieces and self._pieces[0][0] + self._pieces[0][1].shape[2] <= before:
            self._pieces.popleft()


class _Carried:
    """The end of a block's input, which the rows after it need as well. Row -1 and the row after the last are copies."""

    def __init__(self) -> None:
        self.first, self.rows = 0, torch.empty(0)

    def extend(self, first: int, last: int, shape: tuple[int, int], dtype: torch.dtype) -> tuple[Tensor, int]:
        """(a field (1, C, last - first, W) that begins with what is known already, the first row to fill in)."""
        channels, columns = shape
        out = empty(1, channels, last - first, columns, dtype)
        if not self.rows.numel():
            return out, max(0, first)
        end = self.first + self.rows.shape[2]
        out[:, :, : end - first] = self.rows[:, :, first - self.first :]
        return out, end

    def keep(self, x: Tensor, last: int) -> None:
        kept = min(CARRIED, x.shape[2])
        self.rows = x[:, :, x.shape[2] - kept :].clone(memory_format=torch.channels_last)
        self.first = last - kept


class Strips:
    """Raw coefficients of the part (row, col, height, width) of a map of ``shape``, from ``terrain(r0, r1, c0, c1)``.

    ``terrain`` gives float32 (r1 - r0, c1 - c0), m, continued beyond the map's edges; ``strip`` : rows made at once.
    """

    def __init__(
        self,
        net: FoldedUNet,
        terrain: Terrain,
        shape: tuple[int, int],
        target: tuple[int, int, int, int],
        strip: int = STRIP,
    ) -> None:
        self.net, self.terrain, self.strip = net, terrain, strip
        stride, levels = net.stride, net.levels
        rows, columns = (-(-edge // stride) * stride for edge in shape)
        self.row, self.col, height, self.width = target
        self.last = self.row + height
        self.heights = [rows >> k for k in range(levels)]
        ends = [columns >> k for k in range(levels)]
        right = self.col + self.width
        self.x0 = max(0, (self.col - net.reach) // stride * stride)
        self.x1 = min(columns, -(-(right + net.reach) // stride) * stride)
        # Columns (first, last) of each level on the way down, of what is raised from it, and of it on the way up.
        self.wide = [(self.x0 >> k, self.x1 >> k) for k in range(levels)]
        self.cut = [
            (max(a, (self.col >> k) - MARGIN), min(b, -(-right >> k) + MARGIN)) for k, (a, b) in enumerate(self.wide)
        ]
        for k in reversed(range(1, levels - 1)):  # no more than is raised to a level
            below = self.cut[k + 1]
            self.cut[k] = max(self.cut[k][0], 2 * below[0]), min(self.cut[k][1], 2 * below[1])
        self.narrow = [(2 * a, 2 * b) for a, b in self.cut[1:]]

        def edges(spans: list[tuple[int, int]]) -> list[tuple[bool, bool]]:
            return [(a == 0, b == end) for (a, b), end in zip(spans, ends, strict=False)]

        self.wide_edges, self.cut_edges, self.narrow_edges = edges(self.wide), edges(self.cut), edges(self.narrow)
        # The first row that each level is needed from, on the way up and on the way down.
        up, joined = [self.row], []
        for _ in range(levels - 1):
            joined.append(max(0, up[-1] - 2))
            up.append(max(0, (joined[-1] + 1) // 2 - 1))
        down = [up[-1]]
        for first in reversed(joined):
            down.insert(0, min(first, 2 * max(0, down[0] - 2)) // 2 * 2)
        self.joined_to = joined
        self.kept = [Rows(first) for first in down]
        self.raised = [Rows(first) for first in up[:-1]] + [self.kept[-1]]
        self.quarters = [Rows((first + 1) // 2) for first in joined]
        self.into_down, self.into_up = ([_Carried() for _ in range(levels)] for _ in range(2))

    @torch.inference_mode()
    def next(self) -> tuple[int, Tensor, int] | None:
        """(row, raw coefficients (1, C, n, W), the part's first column in them), or None after the last."""
        row = self.row
        if row >= self.last:
            return None
        self.row = min(self.last, (row // self.strip + 1) * self.strip)
        self._quarters_to(0, self._quarters_for(self.row))
        found = []
        for first in range(row, self.row, self.strip // 2):  # half a strip: nothing is as large as this level
            last = min(self.row, first + self.strip // 2)
            self._up_to(0, last)
            ((_, y),) = self.raised[0].between(first, last)
            self.raised[0].forget(last)
            found.append(self.net.head(y))
            del y
        raw = torch.cat(found, dim=2).contiguous(memory_format=torch.channels_last)
        return row, raw, self.col - self.narrow[0][0]

    def _down_to(self, level: int, row: int) -> None:
        """Let the way down of ``level`` be known up to ``row``."""
        height, kept = self.heights[level], self.kept[level]
        row = min(height, row + (row & 1)) if level < self.net.levels - 1 else row  # pairs of rows are pooled
        step = max(2, self.strip >> max(1, level))
        while kept.end < row:
            last = min(row, kept.end + step)
            kept.add(self._block(self.net.down[level], self._pooled, level, kept.end, last, self.wide_edges[level]))

    def _up_to(self, level: int, row: int) -> None:
        """Let the way up of ``level`` be known up to ``row``."""
        if level == self.net.levels - 1:
            self._down_to(level, row)
            return
        raised = self.raised[level]
        if raised.end < row:
            raised.add(self._block(self.net.up[level], self._joined, level, raised.end, row, self.narrow_edges[level]))

    def _block(
        self,
        pair: tuple[Conv | None, Conv],
        take: Callable[[int, int, int], Tensor],
        level: int,
        first: int,
        last: int,
        edges: tuple[bool, bool],
    ) -> Tensor:
        """Rows ``first`` .. ``last`` of a block; at the map's edges each convolution's own input is continued."""
        height = self.heights[level]
        upper, lower = max(0, first - 1), min(height, last + 1)
        x = take(level, upper - 1, lower + 1)
        entry, after = pair
        y = self.net.first(x[0, 0]) if entry is None else entry(x, *edges)
        del x
        if upper == first or lower == last:
            y = torch.cat([y[:, :, :1]] * (upper == first) + [y] + [y[:, :, -1:]] * (lower == last), dim=2)
            y = y.contiguous(memory_format=torch.channels_last)
        return after(y, *edges)

    def _pooled(self, level: int, first: int, last: int) -> Tensor:
        """Rows ``first`` .. ``last`` of what enters a level on the way down; the outermost may be copies at the map's edge."""
        if level == 0:
            return torch.from_numpy(self.terrain(first, last, self.x0, self.x1))[None, None]
        height, above = self.heights[level], self.kept[level - 1]
        channels = self.net.down[level - 1][1].outputs
        a, b = self.wide[level]
        out, row = self.into_down[level].extend(first, last, (channels, b - a), self.net.dtype)
        end = min(height, last)
        self._down_to(level - 1, 2 * end)
        field = pixels_of(out)[0]
        for start, piece in above.between(2 * row, 2 * end):
            row_kernels.pool(pixels_of(piece)[0], field, start // 2 - first)
        above.forget(min(2 * end, self.joined_to[level - 1]))
        return self._edged(out, first, last, height, self.into_down[level])

    def _joined(self, level: int, first: int, last: int) -> Tensor:
        """The same on the way up: what is raised from below, beside what was kept."""
        height, kept = self.heights[level], self.kept[level]
        beside, channels = self.net.down[level][1].outputs, self.net.rise[level].outputs // 4
        a, b = self.narrow[level]
        out, row = self.into_up[level].extend(first, last, (channels + beside, b - a), self.net.dtype)
        end = min(height, last)
        quarters = self.quarters[level]
        self._quarters_to(level, self._quarters_for(end))
        self._down_to(level, end)
        field = pixels_of(out)[0]
        for start, piece in quarters.between((row + 1) // 2, quarters.end):
            # Quarters of a row serve the odd row above it and the even one in it.
            r0, r1 = max(row, 2 * start - 1), min(end, 2 * (start + piece.shape[2]) - 1)
            words = row_kernels.as_words(pixels_of(piece)[0], field, parts=4)
            row_kernels.raise_rows(words[0], start, r0, r1, words[1], r0 - first)
        for start, piece in kept.between(row, end):
            words = row_kernels.as_words(pixels_of(piece)[0], field)
            row_kernels.place_rows(words[0], a - self.wide[level][0], words[1], start - first)
        quarters.forget((end + 1) // 2)
        self.joined_to[level] = end
        return self._edged(out, first, last, height, self.into_up[level])

    @staticmethod
    def _quarters_for(row: int) -> int:
        """How many rows of quarters the rows before ``row`` are made of."""
        return row // 2 + 1

    def _quarters_to(self, level: int, row: int) -> None:
        """Raise the level below as far as ``row`` of its quarters, each of which sees the row above it and its own."""
        quarters, height = self.quarters[level], self.heights[level + 1]
        if quarters.end >= row:
            return
        below = self.raised[level + 1]
        first, last = quarters.end - 1, row  # rows of the level below
        self._up_to(level + 1, min(height, last))
        (a, b), origin = self.cut[level + 1], (self.narrow if level + 2 < self.net.levels else self.wide)[level + 1][0]
        x = empty(1, self.net.rise[level].inputs, last - first, b - a, self.net.dtype)
        for start, piece in below.between(max(0, first), min(height, last)):
            x[:, :, start - first : start - first + piece.shape[2]] = piece[..., a - origin : b - origin]
        if first < 0:
            x[:, :, 0] = x[:, :, 1]
        if last > height:
            x[:, :, -1] = x[:, :, -2]
        below.forget(last - 1)
        quarters.add(self.net.rise[level](x, *self.cut_edges[level + 1]))

    def _edged(self, x: Tensor, first: int, last: int, height: int, carried: _Carried) -> Tensor:
        if first < 0:
            x[:, :, 0] = x[:, :, 1]
        if last > height:
            x[:, :, -1] = x[:, :, -2]
        carried.keep(x, last)
        return x
