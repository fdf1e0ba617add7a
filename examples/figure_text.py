"""Numbers, intervals and tables of figures.py, in words."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any


def table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    columns = list(columns)
    return ["", *(f"|{'|'.join(row)}|" for row in (columns, ["---"] * len(columns), *rows)), ""]


def power_of(rows: Iterable[dict[str, Any]]) -> int:
    """The power of ten that all errors of a table are given in: that of the row in the middle."""
    errors = sorted(row["mse"] for row in rows if row["mse"] > 0)
    return math.floor(math.log10(errors[len(errors) // 2])) if errors else 0


def number(value: float) -> str:
    """Three digits, never as a power of ten."""
    return f"{value:.3g}" if value >= 100 else f"{value:#.3g}".removesuffix(".")


def with_bounds(value: float, low: float | None, high: float | None, spread: float | None, power: int) -> str:
    """'7.95 ± 0.12 (5.78 to 12.2)' in units of ten to the ``power``."""
    text = number(value / 10**power)
    if spread is not None:
        text += f" ± {spread / 10**power:.{len(text.partition('.')[2])}f}"
    if low is None:
        return f"{text} (no interval)"
    return f"{text} ({number(low / 10**power)} to {'unbounded' if high is None else number(high / 10**power)})"


def percent(value: float, low: float, high: float) -> str:
    return f"{value:.1f} % ({low:.1f} to {high:.1f})"


def ssim(row: dict[str, Any]) -> str:
    return "-" if row.get("ssim") is None else f"{row['ssim']:.3f}"


def unit_of(result: dict[str, Any], power: int) -> str:
    unit = "I/F squared" if result["image_units"] == "iof" else "of the full DN range squared"
    return f"MSE, 1e{power} {unit}" if power else f"MSE, {unit}"


def gained(gain: dict[str, Any], over: str) -> str:
    """'25.3 % lower (11.4 to 37.0) than ...', no stronger than the interval allows."""
    value, low, high = (gain[f"gain_percent{end}"] for end in ("", "_low", "_high"))
    if low is None or high is None or low <= 0 <= high:
        interval = "no interval" if low is None or high is None else f"{low:.1f} to {high:.1f}"
        return f"no sure difference from {over}: gain {value:.1f} % ({interval})"
    return f"{percent(abs(value), *sorted((abs(low), abs(high))))} {'lower' if value > 0 else 'higher'} than {over}"
