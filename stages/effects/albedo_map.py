"""A broad pattern of albedo that terrain does not tell."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import ClassVar

import torch
from torch import Tensor

from stages.effects.base import Effect, Values, register
from stages.effects.fields import cosine_field
from stages.physics.formation.chain import State
from stages.physics.photometry import Parameter

ORDERS = tuple((m, n) for m in range(4) for n in range(4) if 0 < m + n <= 4)
# orders both ways of ordinary texture: a broad field that does not end as cosines do leaks along the axes only
FINE = 4, 16
STEEPEST = 3.0  # spectra of ground fall as k^-3 where units of it meet at sharp borders (Porod 1951), and less steeply elsewhere
WHOLE = 0.9  # of a site: holes tear texture up, and what is torn has no spectrum


@register
class AlbedoMap(Effect):
    name = "albedo_map"
    slot = "reflectance"
    linear = True
    scope = "site"
    table = ("site_albedo", "term")
    title = "broad albedo pattern (rays, mare borders)"
    mechanism = (
        "Crater rays, swirls and mare borders change albedo over tens of pixels without a trace in the terrain: a low-order cosine "
        "field per site. Reported only where it stands out above the red spectrum of ordinary texture."
    )
    reference = "Hawke et al. (2004), Icarus 170, 1 (lunar rays)"
    confused_with = ("elevation_albedo", "slope_albedo")
    separate = "neighbouring sites: the pattern goes on across their borders, whatever the terrain"
    parameters = (Parameter("per_std", "1", 0.0, 1.0, 0.0, "rms of the field, relative to albedo"),)
    coordinates = tuple(Parameter(f"c{m}{n}", "1", -0.5, 0.5, 0.0, f"cosine {m} down, {n} across") for m, n in ORDERS)
    strong: ClassVar = {p.name: 0.05 for p in coordinates}
    # broad brightness within 64 to 128 px of a NAC frame of mare at nadir (M143947267L) varies by 2 to 7 % outside its fresh craters
    tolerance: ClassVar = {"per_std": 0.08}

    @classmethod
    def read_off_ground(cls, albedo: Tensor, seen: Tensor) -> tuple[Values, Tensor, Tensor]:
        """Cosines by least squares; what a spectrum as steep as that of ground would have of them, going by finer ones, is ordinary.

        albedo, seen : (sites, H, W), as of :meth:`Effect.read_off_ground`
        """
        low, fine, ordinary = _fields(*albedo.shape[-2:])
        known = seen.double().flatten(1)
        share = known.mean(1)
        x = albedo.double().flatten(1) * known
        gram = torch.einsum("kp,sp,lp->skl", low, known, low) + 1e-6 * torch.eye(len(low)) * len(low.T)
        amounts = torch.linalg.solve(gram, x @ low.T)  # (sites, 1 + orders): the level is each site's own
        rest = (x - amounts @ low * known) @ fine.T / len(low.T)
        usual = ordinary * (rest.square() / share[:, None]).sum(1)
        whole = share > WHOLE
        size = torch.where(whole, amounts[:, 1:].square().sum(1), torch.nan)
        fitted = torch.where(whole[:, None], amounts[:, 1:], 0.0).float()
        return {p.name: fitted[:, k] for k, p in enumerate(cls.coordinates)}, size, usual

    def apply(self, state: State) -> None:
        height, width = state.elevation.shape[-2:]
        factor = torch.ones(height, width)
        for m, n in ORDERS:
            factor = factor + self.value(f"c{m}{n}", state) * cosine_field((m, n), height, width)
        state.reflectance = state.reflectance * factor


@lru_cache(maxsize=4)
def _fields(height: int, width: int) -> tuple[Tensor, Tensor, float]:
    """(1 + orders, H W) level and broad cosines; (F, H W) fine ones, each over its own power in a spectrum of the steepest slope; (...)

    and by which their mean square is multiplied to give the broad ones' sum of squares.
    """
    fine = [(m, n) for m in range(*FINE) for n in range(*FINE) if m < height // 2 and n < width // 2]

    def stacked(orders: list[tuple[int, int]]) -> Tensor:
        return torch.stack([cosine_field(o, height, width) for o in orders]).double().flatten(1)

    steep = torch.tensor([math.hypot(*o) ** (STEEPEST / 2) for o in fine], dtype=torch.float64)
    broad = sum(math.hypot(*o) ** -STEEPEST for o in ORDERS)
    return stacked([(0, 0), *ORDERS]), stacked(fine) * steep[:, None], broad / max(len(fine), 1)
