"""The columns of the linear model: what a small amount of everything would add to the images of a site."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from stages.diagnose.model.chain import Chain
from stages.effects import Effect, Survey, Trial, get_effect


@dataclass(frozen=True)
class Guise:
    """An effect in one of its guises; ``columns`` are its places among the shared columns, or among those per frame."""

    effect: str
    trial: Trial
    columns: tuple[int, ...]
    per_frame: bool = False


@dataclass
class Plan:
    """Which columns there are, the same for every site.

    base : effects that are rendered; shared : names of the columns with one amount for all images; per_frame : of those with one for every frame
    prior : standard deviations of the nuisance among them, in multiples of the column (inf: free)
    """

    base: list[Effect] = field(default_factory=list)
    shared: list[str] = field(default_factory=list)
    per_frame: list[str] = field(default_factory=list)
    prior: dict[int, float] = field(default_factory=dict)
    frame_prior: dict[int, float] = field(default_factory=dict)
    ordinary: dict[str, list[int]] = field(default_factory=dict)  # effect -> its columns among the nuisance
    # of the law's departures: a nuisance of all but effects of the law, which are judged beside the nominal law alone
    form: list[int] = field(default_factory=list)
    dem_errors: list[int] = field(default_factory=list)  # of what the DEM has and the ground has not
    # of what all images of one place share, by its own amount on every piece of ground
    ground: list[int] = field(default_factory=list)
    # columns whose prior is not about what is rendered: its distance, in the column's unit
    pull: dict[int, float] = field(default_factory=dict)
    guises: list[Guise] = field(default_factory=list)
    steps: list[tuple[int, str, float]] = field(default_factory=list)  # base effect, coordinate, step: tangents
    # base effects that act on one side: beside them stands what is alike on both, which is a matter of optics and of relief
    one_sided: list[int] = field(default_factory=list)

    def shared_keys(self) -> list[tuple[str, int]]:
        """What each shared column is, to find it in another plan: a name, and of effects its number among their columns."""
        return [(name, self.shared[:k].count(name)) for k, name in enumerate(self.shared)]

    def frame_keys(self) -> list[tuple[str, int]]:
        """The same of the columns per frame."""
        return [(name, self.per_frame[:k].count(name)) for k, name in enumerate(self.per_frame)]


def make_plan(
    chain: Chain,
    names: Sequence[str],
    data: Survey,
    candidates: Container[str] | None = None,
    law_scatter: float = 1.0,
) -> Plan:
    """Columns for the nominal model's freedom, the effects in the chain, and the effects ``names``.

    candidates : those that stand there in every way they may look (None: all); of the others, what every data set has of them
    law_scatter : standard deviation of the law's departures
    """
    plan = Plan(base=list(chain.base))

    def shared(name: str, prior: float | None = None) -> int:
        plan.shared.append(name)
        if prior is not None:
            plan.prior[len(plan.shared) - 1] = prior
        return len(plan.shared) - 1

    free = range(chain.coefficients.shape[1]) if chain.free is None else torch.nonzero(chain.free)[:, 0].tolist()
    for k in free:
        shared(f"coefficient {k}", math.inf)
    for k in range(len(chain.laws) if chain.laws is not None else 0):
        plan.form.append(shared(f"form {k}", law_scatter))
        if chain.amounts is not None:
            plan.pull[plan.form[-1]] = float(chain.amounts[k])
    shared("slopes within a pixel", 1.0)
    # relief that runs one way hides errors across it: what is wrong with its waves is up to half as uneven as it is large
    plan.dem_errors += [shared("errors of the DEM", prior) for prior in (1.0, 0.5, 0.5)]
    plan.ground += [shared("brighter to the east"), shared("brighter to the south")]
    for place, effect in enumerate(chain.base):
        if effect.scope == "scene":
            for p in effect.fitted():
                if p.name not in effect.held:
                    step = type(effect).step(p.name, data)
                    plan.steps.append((place, p.name, step))
                    shared(f"{effect.name}.{p.name}", float("inf"))
    for place, effect in enumerate(chain.base):  # after all steps, which stand together
        if effect.one_sided:
            plan.one_sided.append(place)
            shared(f"both sides.{effect.name}", math.inf)
    named = [e.name for e in chain.base if e.scope == "image"]
    for name in [*named, *(n for n in names if n not in named)]:
        cls = get_effect(name)
        if cls.edges_tell or (cls.judged_apart and not cls.always):
            continue
        if cls.scope == "scene":
            for trial in cls.trials(data) if candidates is None or name in candidates else cls.trials(data)[:1]:
                places = tuple(shared(name) for _ in trial.columns)
                plan.guises.append(Guise(name, trial, places))
                if name not in plan.ordinary and (size := cls.ordinary(trial)) > 0:
                    plan.ordinary[name] = list(places)
                    plan.prior |= {k: size for k in places}
        elif cls.scope == "image":
            first = len(plan.per_frame)
            plan.per_frame += [name] * len(cls.fitted())
            places = tuple(range(first, len(plan.per_frame)))
            trial = Trial(tuple({p.name: cls.strong[p.name]} for p in cls.fitted()))
            plan.guises.append(Guise(name, trial, places, True))
            if cls.always and name not in named:
                plan.frame_prior |= {k: cls.always for k in places}
    return plan


def shared_columns(chain: Chain, plan: Plan, data: Survey, kept: Callable[[Tensor], Tensor]) -> Iterator[Tensor]:
    """(n, H, W) each: the residual first, then the shared columns in the plan's order. kept : share of the DEM's waves without its errors

    Albedo that all images of a place share is part of the residual's covariance.
    """
    moved = moved_columns(chain, plan, data)
    yield moved[0]
    yield from chain.surface_tangents()
    yield from chain.form_tangents()
    yield chain.unresolved_slopes()
    yield from chain.without_dem_errors(kept)
    yield from chain.brighter()
    yield from moved[1:]
    for guise in plan.guises:
        if not guise.per_frame:
            cls = get_effect(guise.effect)
            for column in guise.trial.columns:
                yield chain.render(cls({**guise.trial.fixed, **column}, data)) - chain.rendered


def moved_columns(chain: Chain, plan: Plan, data: Survey) -> Tensor:
    """(1 + steps + one-sided effects, n, H, W): the residual, what a small step of every value of the causes in the chain changes, and what they would
    change if they were alike on both sides.
    """
    out = [chain.site.image - chain.rendered]
    for place, coordinate, step in plan.steps:
        effect = chain.base[place]
        moved = type(effect)({**effect.values, coordinate: float(effect.values[coordinate]) + step}, data)
        out.append((chain.replace(place, moved) - chain.rendered) / step)
    for place in plan.one_sided:
        effect = chain.base[place]
        cls, side = type(effect), effect.one_sided
        here = {**effect.values, **cls.trials(data)[0].columns[0]}
        both = torch.zeros_like(chain.rendered)
        for at in (float(here[side]), -float(here[side])):
            one = cls({**here, side: at}, data)
            # the measured image has the echo in it: laid over itself from the other side, it would explain as much
            one.of_model = True
            both += chain.render(one) - chain.rendered
        out.append(both)
    return torch.stack(out)


def frame_columns(chain: Chain, plan: Plan, data: Survey, named: bool = False) -> Tensor:
    """(k, n, H, W): what each coordinate of the effects with values per frame adds to the frame's own image.

    named : of the causes in the chain only
    """
    out = []
    frames = int(chain.site.frames.max()) + 1
    base = {e.name: k for k, e in enumerate(chain.base)}
    for guise in plan.guises:
        if not guise.per_frame or (named and guise.effect not in base):
            continue
        cls = get_effect(guise.effect)
        for column in guise.trial.columns:
            ((name, size),) = column.items()
            if cls.displaces:
                out.append(chain.displaced(cls({name: torch.full((frames,), size)}, data)))
                continue
            if guise.effect in base:
                effect = chain.base[base[guise.effect]]
                moved = chain.replace(
                    base[guise.effect], cls({**effect.values, name: effect.values[name] + size}, data)
                )
            else:
                moved = chain.render(cls({name: torch.full((frames,), size)}, data))
            out.append(moved - chain.rendered)
    return torch.stack(out) if out else torch.zeros(0, *chain.rendered.shape)


__all__ = ["Guise", "Plan", "frame_columns", "make_plan", "moved_columns", "shared_columns"]
