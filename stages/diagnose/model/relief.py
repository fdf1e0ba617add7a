"""The DEM as images see it: extensions of the model that stand for no effect."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from stages.effects.filters import directed, plane
from stages.physics.formation import geometry
from stages.physics.formation.chain import State


class SharpSlopes:
    """Slopes by fourth-order differences, as an extension of the model.

    Second-order ones, which the simulation uses, take the mean over two pixels: a third of a squared pixel along the
    slope, that images do not have. Judged with them every image looks sharper than it is, and every DEM smoother.
    """

    slot = "illumination"

    def __init__(self, gsd: float, body_radius: float) -> None:
        self.gsd, self.body_radius = gsd, body_radius
        self.made: object = None

    def apply(self, state: State) -> None:
        """Put the slopes that the images resolve in place of the central differences."""
        if state.slopes is self.made:  # taken over from the state that they were made for
            return
        z = state.elevation
        east, north = geometry.slopes(z, self.gsd)
        far, near = z[..., 4:] - z[..., :-4], z[..., 3:-1] - z[..., 1:-3]
        east[..., 2:-2] = (8 * near - far) / (12 * self.gsd)
        far, near = z[..., 4:, :] - z[..., :-4, :], z[..., 3:-1, :] - z[..., 1:-3, :]
        north[..., 2:-2, :] = (far - 8 * near) / (12 * self.gsd)
        state.slopes = geometry.curvature_slopes(east, north, self.gsd, self.body_radius)
        self.made = self.made or state.slopes


class ShareOfRelief:
    """Of every wave of the DEM a share, as an extension of the model.

    kept : of wave numbers, rad/px; towards : of the part that is not kept, what is taken away of waves along (east, south), unit vectors
    """

    slot = "geometry"

    def __init__(self, kept: Callable[[Tensor], Tensor], towards: Callable[[Tensor, Tensor], Tensor]) -> None:
        self.kept, self.towards = kept, towards

    def apply(self, state: State) -> None:
        """Filter what is not plane."""
        z = state.elevation
        flat = plane(z)

        def gain(kx: Tensor, ky: Tensor) -> Tensor:
            number = torch.hypot(kx, ky)
            length = number.clamp(min=1e-9)
            return 1 - (1 - self.kept(number)) * self.towards(kx / length, ky / length)

        state.elevation = flat + directed(z - flat, gain, slopes=True)


__all__ = ["ShareOfRelief", "SharpSlopes"]
