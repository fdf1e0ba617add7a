"""What effects, small changes of them and the nominal model's own freedom add to the images of a site: columns of a linear model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.diagnose.chain import Chain
from stages.effects import Effect, Survey, Trial, get_effect
from stages.physics.formation.chain import State

# What every data set has a little of, always fitted along, with the size that is ordinary (multiples of the column):
# without a bound on it a strange amount of one imitates other effects.
BASELINE = {"dem_smoothing": 0.7, "psf_blur": 0.4}
RELIEF = (math.radians(6.0), math.radians(20.0))  # blur of a shadow's edge by relief, at a distance of one px
MOST_BLUR = 0.3  # rad
DRIFTING = 4  # directions in which the nominal model may drift across a crop
FLAT = 1e-3  # rms texture below which ground is one albedo


@dataclass(frozen=True)
class Candidate:
    """An effect in one of its guises, and which columns are its."""

    effect: str
    trial: Trial
    columns: slice

    @property
    def size(self) -> int:
        return self.columns.stop - self.columns.start


def nuisance_columns(chain: Chain, dn: bool, named: bool = True) -> Tensor:
    """(n, k, H, W): shift east and south, for dn images gain and offset, and image-wide effects ``named`` already."""
    image = chain.textured
    east = torch.zeros_like(image)
    south = torch.zeros_like(image)
    east[..., 1:-1] = (image[..., 2:] - image[..., :-2]) / 2
    south[..., 1:-1, :] = (image[..., 2:, :] - image[..., :-2, :]) / 2
    columns = [east, south]
    if dn:
        columns += [image, torch.full_like(image, float(image.mean()))]
    for k, effect in enumerate(chain.base if named else ()):
        if effect.scope == "image":
            columns += list(image_columns(chain, type(effect), k))
    for effect in chain.moved if named else ():
        if effect.name != "misregistration":  # shifts are there already
            columns += list(image_columns(chain, type(effect)))
    return torch.stack(columns, 1)


def image_columns(chain: Chain, cls: type[Effect], place: int | None = None) -> list[Tensor]:
    """d image / d coordinate for an effect with one value per image, (n, H, W) each.

    Shifts show on lit ground alone: in shadow their template is all of neighbouring edges, whose place is not known so well.
    """
    lit = chain.lit() if cls.displaces else 1.0
    frames = int(chain.site.observation.frame.max()) + 1
    out = []
    for parameter in cls.fitted():
        step = 0.2 * cls.strong[parameter.name]
        if place is None:
            moved = chain.render(cls({parameter.name: torch.full((frames,), step)}, None))
        else:
            values = dict(chain.base[place].values)
            values[parameter.name] = values[parameter.name] + step
            moved = chain.replace(place, cls(values, chain.base[place].survey))
        out.append((moved - chain.textured) * lit / step)
    return out


def make_candidates(names: Sequence[str], data: Survey) -> list[Candidate]:
    """Every guise of every effect, with its place among the columns."""
    out, start = [], 0
    for name in names:
        for trial in get_effect(name).trials(data):
            out.append(Candidate(name, trial, slice(start, start + len(trial.columns))))
            start += len(trial.columns)
    return out


def trial_columns(chain: Chain, effect: str, trial: Trial, data: Survey) -> list[Tensor]:
    """(n, H, W) each: what the effect at the trial's values adds to the image."""
    cls = get_effect(effect)
    return [chain.render(cls({**trial.fixed, **column}, data)) - chain.textured for column in trial.columns]


def tangent_columns(chain: Chain, data: Survey) -> tuple[list[str], list[Tensor]]:
    """d image / d coordinate for the scene-wide effects that are in the chain already."""
    names, columns = [], []
    for k, effect in enumerate(chain.base):
        if effect.scope != "scene" or effect.channel in ("albedo", "relief"):
            continue  # what stays with the ground is estimated there
        for coordinate in free_coordinates(effect):
            names.append(f"{effect.name}.{coordinate}")
            columns.append(tangent(chain, k, coordinate, data))
    return names, columns


def tangent(chain: Chain, place: int, coordinate: str, data: Survey) -> Tensor:
    """d image / d coordinate of the effect at ``place`` in the chain, (n, H, W)."""
    effect = chain.base[place]
    step = derivative_step(type(effect), coordinate, data)
    moved = type(effect)({**effect.values, coordinate: float(effect.values[coordinate]) + step}, data)
    return (chain.replace(place, moved) - chain.textured) / step


def free_coordinates(effect: Effect) -> list[str]:
    """The coordinates that stay free once an effect is named: those of its best guise and its shape."""
    return [p.name for p in effect.fitted() if p.name not in effect.held]


def derivative_step(cls: type[Effect], coordinate: str, data: Survey) -> float:
    """A step for finite differences: a tenth of a realistic size."""
    for trial in cls.trials(data):
        for column in trial.columns:
            if coordinate in column:
                return 0.1 * abs(column[coordinate] - cls.null()[coordinate]) or 1e-3
    parameter = next(p for p in cls.fitted() if p.name == coordinate)
    return max(0.05 * abs(parameter.default), 1e-3 * (parameter.upper - parameter.lower))


class ReliefBlur:
    """Shadow edges softened by errors of the DEM's heights: by an angle that falls with the distance of what casts them."""

    slot = "illumination"

    def __init__(self, at_one_px: float, distance: Tensor) -> None:
        self.blur = at_one_px / distance

    def apply(self, state: State) -> None:
        disc = torch.as_tensor(state.sun_radius)
        state.sun_radius = torch.sqrt(disc**2 + self.blur**2).clamp(max=MOST_BLUR)


def relief_blur(chain: Chain) -> tuple[str, list[Tensor]]:
    """Nuisance columns about shadow edges, (n, H, W) each: what relief that the DEM has not does to them."""
    distance = chain.site.occluders()
    return "relief", [chain.render(ReliefBlur(r, distance)) - chain.textured for r in RELIEF]


def nominal_columns(chain: Chain) -> list[Tensor]:
    """The nominal model's freedom within a site: each coefficient may change, drift across the crop, and follow the albedo.

    Bright ground scatters light more often within itself: its reflectance has another shape, and not just another size.
    Of a model with many coefficients, which imitate each other, only the main directions drift.
    """
    tangents = chain.surface_tangents()
    height, width = tangents[0].shape[-2:]
    y = torch.linspace(-1, 1, height)[:, None]
    x = torch.linspace(-1, 1, width)
    texture = chain.site.texture - 1
    bright = texture / texture.std().clamp(min=FLAT)
    return [*tangents, *(t * f for t in _main(tangents, chain.textured) for f in (x, y, bright))]


def _main(tangents: list[Tensor], image: Tensor) -> list[Tensor]:
    """At most so many combinations of the tangents as drift, those that change the images most for their brightness."""
    if len(tangents) <= DRIFTING:
        return tangents
    columns = torch.stack(tangents)
    relative = columns / image.mean((-2, -1), keepdim=True).clamp(min=1e-6)
    flat = relative.flatten(1).double()
    flat = flat / flat.square().sum(1, keepdim=True).sqrt().clamp(min=1e-30)  # coefficients have units of their own
    _, axes = torch.linalg.eigh(flat @ flat.T)
    size = relative.flatten(1).norm(dim=1).clamp(min=1e-30)
    share = (axes[:, -DRIFTING:] / size[:, None].double()).float()
    return list(torch.einsum("ck,cnhw->knhw", share, columns))
