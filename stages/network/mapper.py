"""A trained network ready to make maps of any size."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.common.threads import one_thread
from stages.network.predictor import Predictor
from stages.network.strips import Rows, StripUNet

STRIP = 128  # rows of terrain that the network takes at once
ROWS = 256  # rows of a map that are handed over at once, from a multiple of it on
TOGETHER = 16  # bytes of a value x windows at once: under 2 GB where windows are 4096 px wide

Terrain = Callable[[int, int, int, int], NDArray]


class Mapper:
    """Coefficients of any part of a map, with all the context that the network can see.

    precision : fp32 or bf16; threads : that could use it at once; ``together`` of them can, as memory allows
    deviations : whether the standard deviations of the maps come after the coefficients
    """

    def __init__(
        self,
        predictor: Predictor,
        device: torch.device,
        precision: str,
        threads: int = 1,
        deviations: bool = False,
    ) -> None:
        self.deviations = deviations
        self.predictor, self.device = predictor.eval(), device
        dtype = torch.bfloat16 if precision == "bf16" else torch.float32
        self.together = min(threads, TOGETHER // dtype.itemsize) if device.type == "cpu" else 1
        self._net = StripUNet(predictor.net, predictor.elevation_scale, dtype)

    def strips(
        self, terrain: Terrain, shape: tuple[int, int], part: tuple[int, int, int, int]
    ) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """(row, coefficients and deviations (C, n, w)) of the part (row, col, height, width) of a map of ``shape``, from north to south.

        ``terrain(r0, r1, c0, c1)`` gives float32 heights in m, holes filled, continued beyond the map's edges.
        """
        row, col, height, width = part
        lattice, reach = self.predictor.net.stride, self.predictor.net.reach
        r0, c0 = (max(0, (k - reach) // lattice * lattice) for k in (row, col))
        rows, columns = (-(-edge // lattice) * lattice for edge in shape)
        r1 = min(rows, -(-(row + height + reach) // lattice) * lattice)
        c1 = min(columns, -(-(col + width + reach) // lattice) * lattice)

        def heights() -> Rows:
            for first in range(r0, r1, STRIP):
                last = min(r1, first + STRIP)
                z = torch.from_numpy(terrain(first, last, c0, c1)).to(self.device)
                yield z[None, None], last == r1

        found = self._net.run(heights())
        above, known = [], r0  # rows that are not handed over yet, and the one after them
        while row < part[0] + height:
            end = min(part[0] + height, (row // ROWS + 1) * ROWS)
            while known < end:
                piece = self._next(found)
                above.append(piece[..., max(0, row - known) :, col - c0 : col - c0 + width])
                known += piece.shape[2]
            raw = torch.cat(above, dim=2)
            yield row, self._complete(raw[0, :, : end - row])
            above, row = [raw[:, :, end - row :]], end

    @staticmethod
    @torch.inference_mode()
    def _next(found: Iterator[Tensor]) -> Tensor:
        """On one thread: shared out among several a convolution adds up in another order, and bf16 shows it."""
        with one_thread():
            return next(found)

    @torch.inference_mode()
    def _complete(self, raw: Tensor) -> NDArray[np.float32]:
        """(channels, n, w) of the network -> coefficients, and deviations where wanted."""
        maps = self.predictor.maps
        # PyTorch's exponentials differ in the last bit at the end of a row, so by window: double has bits to spare
        exact = maps.unbounded(raw).double()
        found = maps.stack(exact, dim=0)
        return (torch.cat([found, maps.deviations(exact, dim=0)]) if self.deviations else found).float().cpu().numpy()
