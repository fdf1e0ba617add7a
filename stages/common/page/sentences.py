"""Sentences that claim no more than their interval allows."""

from __future__ import annotations

from typing import Any

Sentence = tuple[str, str]  # text, '' | 'good' | 'bad'


def verdict(gain: dict[str, Any]) -> str:
    """'better', 'worse', 'no difference' or 'unknown', by the 95 % interval of a gain."""
    low, high = gain.get("gain_percent_low"), gain.get("gain_percent_high")
    if low is None or high is None:
        return "unknown"
    return "better" if low > 0 else "worse" if high < 0 else "no difference"


def bounds(gain: dict[str, Any]) -> str:
    """The interval of a gain, in percent."""
    low, high = gain.get("gain_percent_low"), gain.get("gain_percent_high")
    return "no interval" if low is None or high is None else f"95 %: {low:+.1f} .. {high:+.1f}"


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
        return f"{ours} shows no difference from {other}: {tail}.", ""
    if word == "unknown":
        return f"{ours} cannot be compared with {other} with any certainty: {tail}.", ""
    if word == "better":
        return f"{ours} has a squared error {value:.1f} % lower than {other} ({bounds(gain)}; {on}).", "good"
    return f"{ours} has a squared error {-value:.1f} % higher than {other}; {tail}.", "bad"


def counted(number: int, noun: str) -> str:
    """'1 place', '1,200 places'"""
    return f"{number:,} {noun}{'s' * (number != 1)}"
