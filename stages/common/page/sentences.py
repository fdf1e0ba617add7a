"""Sentences that claim no more than their interval allows."""

from __future__ import annotations

from typing import Any, NamedTuple

Sentence = tuple[str, str]  # text, '' | 'good' | 'bad'


class Number(NamedTuple):
    """A result in large type: '-18.0 %', its interval, what it is; kind : '' | 'good' | 'bad'"""

    value: str
    interval: str
    label: str
    kind: str = ""


def verdict(gain: dict[str, Any]) -> str:
    """'better', 'worse', 'no difference' or 'unknown', by the 95 % interval of a gain."""
    low, high = gain.get("gain_percent_low"), gain.get("gain_percent_high")
    if low is None or high is None:
        return "unknown"
    return "better" if low > 0 else "worse" if high < 0 else "no difference"


def bounds(gain: dict[str, Any]) -> str:
    """The interval of a gain, in percent; no error falls by more than all of it."""
    low, high = gain.get("gain_percent_low"), gain.get("gain_percent_high")
    return "no interval" if low is None or high is None else f"95 %: {low:+.1f} .. {min(high, 100.0):+.1f}"


def listed(names: list[str]) -> str:
    """'a, b and c', as words."""
    spoken = [words(name) for name in names]
    return spoken[0] if len(spoken) == 1 else f"{', '.join(spoken[:-1])} and {spoken[-1]}" if spoken else "nothing"


def words(name: str) -> str:
    """'sun_azimuth' as 'sun azimuth'"""
    return name.replace("_", " ")


def compared(ours: str, other: str, gain: dict[str, Any], on: str) -> Sentence:
    """A sentence on a gain over another model. on : the data that it comes from"""
    value, word = float(gain["gain_percent"]), verdict(gain)
    tail = f"gain {value:+.1f} % ({bounds(gain)}; {on})"
    if word == "no difference":
        return f"{ours} shows no sure difference from {other}: {tail}.", ""
    if word == "unknown":
        return f"{ours} cannot be compared with {other} with any certainty: {tail}.", ""
    if word == "better":
        return f"{ours} has a squared error {value:.1f} % lower than {other} ({bounds(gain)}; {on}).", "good"
    return f"{ours} has a squared error {-value:.1f} % higher than {other}; {tail}.", "bad"


def error_change(gain: dict[str, Any], label: str) -> Number:
    """By how many percent a squared error changes: a gain with the opposite sign. label : which error, against which"""
    value, low, high = (gain.get(f"gain_percent{end}") for end in ("", "_low", "_high"))
    kind = {"better": "good", "worse": "bad"}.get(verdict(gain), "")
    interval = "no interval" if low is None or high is None else f"95 %: {-min(high, 100.0):+.1f} .. {-low:+.1f} %"
    sure = "" if kind else "not surely different: "
    return Number(f"{-float(value or 0):+.1f} %", interval, sure + label, kind)


def counted(number: int, noun: str) -> str:
    """'1 place', '1,200 places'"""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def basis(result: dict[str, Any]) -> str:
    """What a gain rests on: pairs, ground, training runs."""
    ground = counted(result["tiles"], "ground tile")
    if result.get("interval_unit") == "site" and "sites" in result:
        ground = f"{counted(result['sites'], 'site')} of one ground tile"
    pairs = f"{result['pairs']:,} pairs on {ground}"
    return f"{pairs}, {counted(result['training_runs'], 'training run')}" if "training_runs" in result else pairs
