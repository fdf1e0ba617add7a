"""What each image shows that the others of its place do not foretell: where ground and law are gone, the camera's own faults stand out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.diagnose.likelihood.covariance import Covariance
from stages.diagnose.likelihood.products import Rows, precision
from stages.diagnose.model.sites import Site
from stages.diagnose.rows.patches import Grid, Patch

WITHIN = 0.5  # of the window: nearer to its border a pixel is mostly noise
LARGEST = 5.0  # standard deviations: one pixel tells no more


@dataclass
class Innovation:
    """Of one piece of ground. value : (n, h, w) in standard deviations of each image, 0 where ``seen`` is not; seen : (n, h, w) bool

    detector : (n, 2, h, w) line and sample; in the crop where the detector is not known
    """

    patch: Patch
    value: Tensor
    seen: Tensor
    detector: Tensor

    @property
    def limited(self) -> Tensor:
        """(n, h, w) value, of which no single pixel decides."""
        return self.value.clamp(-LARGEST, LARGEST)


def innovations(rows: Sequence[Rows], model: Covariance, grid: Grid, sites: Sequence[Site]) -> list[Innovation]:
    """Residual of each image given all others, whitened, pixel by pixel."""
    out = []
    for row in rows:
        patch, z = row.patch, row.shared[0]
        inverse = precision(model, patch, grid)
        own = inverse.diagonal(dim1=-2, dim2=-1).real.sqrt()[grid.bins].T
        given = torch.einsum("kij,jk->ik", inverse[grid.bins], z) / own
        plane = torch.zeros(len(z), grid.height * (grid.width // 2 + 1), dtype=given.dtype)
        plane[:, grid.keep] = given / grid.root
        value = torch.fft.irfft2(plane.unflatten(1, (grid.height, -1)), s=(grid.height, grid.width))
        seen = patch.weight > WITHIN
        value = torch.where(seen, value / patch.weight.clamp(min=WITHIN), 0.0)
        rms = (value.square().sum((-2, -1)) / seen.sum((-2, -1)).clamp(min=1)).sqrt().clamp(min=1e-9)
        detector = sites[patch.site].on_detector()[patch.images][:, :, patch.rows, patch.columns]
        out.append(Innovation(patch, value / rms[:, None, None], seen, detector))
    return out


__all__ = ["Innovation", "innovations"]
