"""A trained network ready to make maps: strip by strip on the CPU, a window at a time elsewhere."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.network.cpu import inference_kernels as row_kernels
from stages.network.cpu.folded_unet import FoldedUNet
from stages.network.cpu.strips import STRIP, Strips, Terrain
from stages.network.cpu.training_kernels import pixels_of
from stages.network.predictor import Predictor

MEMORY = 1024  # windows side by side x rows of a strip x bytes a value: under 2 GB where windows are 2048 px wide


class Mapper:
    """Coefficients of any part of a map, with all the context that the network can see.

    precision : fp32 or bf16; threads : how many would work with it side by side, of which ``together`` do
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
        self.predictor, self.device, self.precision = predictor.eval(), device, precision
        self.in_strips = device.type == "cpu"
        self.together = 1
        self._start = predictor.maps.start.detach().cpu().float().numpy()
        if self.in_strips:
            dtype = torch.bfloat16 if precision == "bf16" else torch.float32
            self.together = min(threads, MEMORY // (64 * dtype.itemsize))
            self._strip = STRIP
            while self._strip * self.together * dtype.itemsize > MEMORY:
                self._strip //= 2
            self._folded = FoldedUNet(predictor.net, predictor.elevation_scale, dtype)

    def strips(
        self, terrain: Terrain, shape: tuple[int, int], part: tuple[int, int, int, int]
    ) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """(row, coefficients and deviations (C, n, w)) of the part (row, col, height, width) of a map of ``shape``, from north to south.

        ``terrain(r0, r1, c0, c1)`` gives float32 heights in m, holes filled, continued beyond the map's edges.
        """
        if not self.in_strips:
            yield part[0], self._window(terrain, shape, part).float().cpu().numpy()
            return
        strips = Strips(self._folded, terrain, shape, part, self._strip)
        while (found := self._next(strips)) is not None:
            row, raw, first = found
            yield row, self._finish(raw, first, part[3])

    @staticmethod
    def _next(strips: Strips) -> tuple[int, Tensor, int] | None:
        """On one thread: shared out among several a convolution adds up in another order, and bf16 shows it."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            return strips.next()
        finally:
            torch.set_num_threads(threads)

    @torch.inference_mode()
    def _finish(self, raw: Tensor, first: int, width: int) -> NDArray[np.float32]:
        out = np.empty((raw.shape[1], raw.shape[2], width), np.float32)
        scale = np.float32(self.predictor.maps.output_scale)
        row_kernels.finish(pixels_of(raw)[0], first, first + width, scale, self._start, out)
        return self._complete(torch.from_numpy(out)).numpy()

    def _complete(self, shifted: Tensor) -> Tensor:
        """(channels, n, w) before their bounds -> coefficients, and deviations where wanted."""
        maps = self.predictor.maps
        # PyTorch's exponentials differ in the last bit where a row ends, which hangs on the window: double has bits to spare
        exact = shifted.double()
        found = maps.stack(exact, dim=0)
        return (torch.cat([found, maps.deviations(exact, dim=0)]) if self.deviations else found).float()

    @torch.no_grad()
    def _window(self, terrain: Terrain, shape: tuple[int, int], part: tuple[int, int, int, int]) -> Tensor:
        row, col, height, width = part
        lattice, reach = self.predictor.net.stride, self.predictor.net.reach
        r0, c0 = (max(0, (k - reach) // lattice * lattice) for k in (row, col))
        rows, columns = (-(-edge // lattice) * lattice for edge in shape)
        r1 = min(rows, -(-(row + height + reach) // lattice) * lattice)
        c1 = min(columns, -(-(col + width + reach) // lattice) * lattice)
        x = torch.from_numpy(terrain(r0, r1, c0, c1)).to(self.device)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bf16"):
            shifted = self.predictor.shifted(x[None])[0, :, row - r0 : row - r0 + height, col - c0 : col - c0 + width]
        return self._complete(shifted)
