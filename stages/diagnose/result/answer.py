"""The diagnosis as data: the verdict and everything that the JSON says."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from stages.diagnose.judge.claim import Refusal
from stages.effects import Effect, get_effect


@dataclass
class Named:
    """A cause as it is reported. parameters : name -> (value, error, unit); nothing that is not calibrated is given."""

    effect: Effect
    parameters: dict[str, tuple[float, float, str]]
    p: float
    gain: float
    gain_error: float
    rms_before: float
    rms_after: float
    percent: tuple[float, float, float]
    group: list[str]

    def to_json(self) -> dict[str, Any]:
        """As it stands in the report."""
        return {
            "effect": self.effect.name,
            "parameters": {
                k: {"value": number(v), "error": number(e), "unit": u} for k, (v, e, u) in self.parameters.items()
            },
            "p_family_wise": number(self.p),
            "gain_nats": number(self.gain),
            "gain_error": number(self.gain_error),
            "residual_rms_before": number(self.rms_before),
            "residual_rms_after": number(self.rms_after),
            "held_out_gain_percent": number(self.percent[0]),
            "held_out_low": number(self.percent[1]),
            "held_out_high": number(self.percent[2]),
            "group": self.group,
            "to_separate": get_effect(self.effect.name).separate,
        }


@dataclass
class HeldOut:
    """Mean squared errors on pairs that no estimate saw; the interval is a jackknife over sites."""

    pairs: int = 0
    sites: int = 0
    nominal: float = math.nan
    extended: float = math.nan
    low: float = math.nan
    high: float = math.nan

    @property
    def gain(self) -> float:
        """Share of the squared error that is gone, per cent."""
        return 100 * (1 - self.extended / self.nominal) if self.nominal > 0 else math.nan

    def to_json(self) -> dict[str, Any]:
        """As it stands in the report."""
        return {
            "pairs": self.pairs,
            "sites": self.sites,
            "mse_nominal": number(self.nominal),
            "mse_extended": number(self.extended),
            "gain_percent": number(self.gain),
            "gain_percent_low": number(self.low),
            "gain_percent_high": number(self.high),
        }


@dataclass
class Answer:
    """Everything that the report says."""

    verdict: str
    causes: list[Named] = field(default_factory=list)
    budget: dict[str, float] = field(default_factory=dict)
    ordinary: list[Named] = field(default_factory=list)  # sure, and of a size that any data set has
    rejected: dict[str, Refusal] = field(default_factory=dict)
    registration: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    unexplained_fraction: float = 0.0
    structure: dict[str, float] = field(
        default_factory=dict
    )  # nothing in the catalogue explains it: words -> share of the waves where it is
    blind: list[str] = field(default_factory=list)
    held_out: HeldOut = field(default_factory=HeldOut)
    pairs: int = 0
    sites: int = 0
    images: int = 0
    note: str = ""
    law: float = math.nan  # departures of the law that are fitted, in standard deviations of measured laws
    config: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """As it stands in the report."""
        return {
            "verdict": self.verdict,
            "causes": [c.to_json() for c in self.causes],
            "budget": {k: number(v) for k, v in self.budget.items()},
            "ordinary": [c.to_json() for c in self.ordinary],
            "rejected": [
                {"effect": k, "gain_nats": number(r.gain), "reason": r.reason.name.lower(), "why": str(r)}
                for k, r in self.rejected.items()
            ],
            "registration": [
                {"form": k, "held_out_gain_percent": number(g), "low": number(a), "high": number(b)}
                for k, (g, a, b) in self.registration.items()
            ],
            "unexplained_fraction": number(self.unexplained_fraction),
            "structure": [{"what": k, "share": number(v)} for k, v in self.structure.items()],
            "blind": self.blind,
            "held_out": self.held_out.to_json(),
            "data": {"pairs": self.pairs, "sites": self.sites, "images": self.images},
            "note": self.note,
            "law_departure": number(self.law),
            "sentence": self.sentence(),
            "config": self.config,
        }

    def sentence(self) -> str:
        """The diagnosis in plain words."""
        if self.note:
            return self.note[0].upper() + self.note[1:] + ("" if self.note.endswith(".") else ".")
        if self.verdict == "named":
            parts = [f"{c.effect.title} ({describe(c.to_json()['parameters'])})" for c in self.causes]
            more = (
                f". What is left holds {' and '.join(self.structure)}, which nothing named explains"
                if self.structure
                else ""
            )
            return f"The simulation lacks {' and '.join(parts)}{more}."
        if self.verdict == "unexplained":
            return f"The residual holds {' and '.join(self.structure) or 'structure'}, which nothing in the catalogue explains."
        if self.verdict == "cannot_tell":
            return f"Nothing significant was found, but the data cannot tell whether any of these is there: {', '.join(self.blind)}."
        return "Nothing in the catalogue explains a significant part of the residual, and no structure is left over."


def describe(found: dict[str, dict[str, Any]]) -> str:
    """Reported parameters as 'error_deg = 0.31 +- 0.02 degree'."""
    return ", ".join(
        f"{k} = {p['value']:.3g} +- {p['error'] or 0:.1g}{'' if p['unit'] == '1' else ' ' + p['unit']}"
        for k, p in found.items()
    )


def number(value: float) -> float | None:
    """A number for JSON: None where it is not finite."""
    return float(value) if math.isfinite(value) else None


__all__ = ["Answer", "HeldOut", "Named", "describe", "number"]
