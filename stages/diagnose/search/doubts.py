"""Why a cause, as it is fitted, is none: values that are impossible, ordinary, not sure, or known from no image but some."""

from __future__ import annotations

import math

from stages.common.intervals import student_quantile
from stages.diagnose.likelihood.tails import together
from stages.diagnose.search.refine import settle
from stages.diagnose.search.state import Cause, State, View
from stages.diagnose.settings import STILL, SURE
from stages.effects import Effect

# what reasons start with, for those who ask what kind of reason it was
ODD = "the values that fit best are impossible"
ORDINARY = "no more than is ordinary"


def doubt(state: State, cause: Cause, sure: float = SURE) -> str:
    """Why the fitted values cannot be a cause, or ''."""
    cls = type(cause.effect)
    if cls.scope == "image":
        return doubt_size(cause.rms, cause.errors.get("rms", math.inf), cls)
    values = {k: float(v) for k, v in cause.effect.values.items()}
    if not cls.plausible(values, state.data):
        return impossible(cause.effect)
    for name in [n for n in cause.errors if n not in cls.shaped]:  # a shape may end anywhere
        value, near = values[name], cause.of_given_shape.get(name, 1e-9)
        low, high = (
            math.inf * side if b == cls.null()[name] else b for b, side in zip(cls.bounds(name), (-1, 1), strict=True)
        )
        if not low + near <= value <= high - near:
            return f"{ODD} ({name} = {value:.3g}, at a bound of what is physical)"

    # an effect that may be nothing has no shape that could be uncertain
    if cause.away < together(sure, len(cause.of_given_shape)):
        return f"its value is only {cause.away:.1f} standard errors from zero"
    if cause.share_error * student_quantile(cause.share_freedom) > 1:
        return f"its value hangs on a few images (only {1 / cause.share_error:.1f} standard errors from zero where images are left out)"
    errors = cause.larger_errors
    reported = cls.report(values, errors)
    for name, least in cls.tolerance.items():
        size, error = reported[name]
        if name in values:
            size, error = abs(values[name] - cls.null()[name]), errors.get(name, 0.0)
        if size - 2 * error < least:
            return as_ordinary(name, size, least, error)
    for name, more in state.law_errors(cls).items():
        size, error = abs(values[name] - cls.null()[name]), math.hypot(errors.get(name, 0.0), more)
        if size - 2 * error < cls.tolerance.get(name, 0.0):
            return f"the law of the ground, which is not known, passes for as much ({name} = {values[name]:.2g} +- {error:.1g})"
    return ""


def doubt_size(size: float, error: float, cls: type[Effect]) -> str:
    """Why an rms size with a standard error is not surely more than nothing, and than what every data set has, or ''."""
    least = max(cls.tolerance.values(), default=0.0)
    if size - 2 * error < least:
        return as_ordinary("rms", size, least, error)
    return f"its rms is only {size / error:.1f} standard errors from zero" if size < SURE * error else ""


def surely_ordinary(cause: Cause) -> bool:
    """Whether a fitted effect of the scene is, two standard errors further off, still no more than what every data set has."""
    cls, errors = type(cause.effect), cause.larger_errors
    sizes = {n: abs(float(cause.effect.values[n]) - cls.null()[n]) for n in cls.tolerance if n in cause.effect.values}
    return bool(sizes) and all(size + 2 * errors.get(n, 0.0) < cls.tolerance[n] for n, size in sizes.items())


def as_ordinary(name: str, size: float, least: float, error: float = math.nan) -> str:
    """The reason that a size is not surely more than what every data set has."""
    found = f"{size:.2g}" if math.isnan(error) else f"{size:.2g} +- {error:.1g}"
    return f"{ORDINARY} ({name} = {found}; any data may have {least:.2g})"


def with_ordinary(size: float, error: float, cls: type[Effect]) -> float:
    """Error of the rms of an effect; what any data have of it is part of what was found, in quadrature."""
    without = math.sqrt(max(size**2 - max(cls.tolerance.values(), default=0.0) ** 2, 0.0))
    return math.hypot(error, size - without)


def impossible(effect: Effect) -> str:
    """The reason that an effect's values cannot be."""
    values = ", ".join(f"{k} = {float(v):.3g}" for k, v in effect.values.items())
    expected = f"; expected: {effect.possible}" if effect.possible else ""
    return f"{ODD} ({values}{expected})"


def doubt_any(state: State, cause: Cause) -> tuple[str, Cause | None]:
    """Why the cause, or another beside it, cannot be one, or ''; and which other."""
    if why := doubt(state, cause):
        return why, None
    for c in state.named:
        if why := doubt(state, c):
            return f"with it {c.effect.name} would lose its name ({why})", c
    return unknown_beside(state, cause), None


def unknown_beside(state: State, cause: Cause) -> str:
    """Why the cause is none beside another that it is confused with, or ''. Each may stand for the other: together they are sure, and how much
    there is of either is not known.
    """
    for c in state.named:
        alike = c.effect.name in cause.effect.confused_with and c is not cause
        if alike and not (_known_by_itself(cause) or _known_by_itself(c)):
            return f"with it neither its own size nor that of {c.effect.name} is known: each explains the other"
    return ""


def _known_by_itself(cause: Cause) -> bool:
    """Whether any of its values is surely not nothing, whatever all the others are."""
    null = type(cause.effect).null()
    amounts = [
        (float(cause.effect.values[n]) - null[n], e) for n, e in cause.errors.items() if n not in cause.effect.shaped
    ]
    return type(cause.effect).scope != "scene" or any(abs(value) > STILL * error for value, error in amounts)


def doubt_all(state: State, view: View, sure: float = SURE) -> dict[str, tuple[float, str]]:
    """Take out one by one the causes that cannot be any, as they are fitted now; effect -> nats, why.

    sure : standard errors from nothing that are asked
    """
    out = {}
    while doubted := [(c, why) for c in state.named if (why := doubt(state, c, sure) or unknown_beside(state, c))]:
        cause, why = doubted[-1]  # what was found last stands on the rest
        state.causes.remove(cause)
        out[cause.effect.name] = cause.found.gain, f"fitted together with all other causes, {why}"
        settle(state, view)
    return out


def ordinary(first: Effect) -> str:
    """Why the effect is nothing special already at a first estimate of its values, or ''."""
    cls = type(first)
    if cls.scope == "scene":
        for name, least in cls.tolerance.items():
            size = cls.size(first.values) if name not in first.values else abs(first.values[name] - cls.null()[name])
            if size < least / 2:
                return as_ordinary(name, size, least)
    return ""


__all__ = [
    "ODD",
    "ORDINARY",
    "doubt",
    "doubt_all",
    "doubt_any",
    "doubt_size",
    "impossible",
    "ordinary",
    "surely_ordinary",
    "with_ordinary",
]
