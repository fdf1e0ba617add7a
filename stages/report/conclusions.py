"""The first screen: what a run found, one sentence each, no stronger than its interval allows."""

from __future__ import annotations

import json
from typing import Any

import h5py

from schemas import read_strings
from stages.physics.photometry import get_model

Sentence = tuple[str, str]  # text, '' | 'good' | 'bad'
# (row, what it may know of the scored crops)
CLAIMS = (
    ("learned", "none", "knowing nothing of the scored images, reflectance learned from terrain"),
    ("learned_gain_offset", "gain_offset", "with a gain and an offset for each scored crop, reflectance learned from terrain"),
)  # fmt: skip


def verdict(gain: dict[str, Any]) -> str:
    """What a paired interval says."""
    low, high = gain.get("gain_percent_low"), gain.get("gain_percent_high")
    if low is None or high is None:
        return "unknown"
    return "better" if low > 0 else "worse" if high < 0 else "no difference"


def bounds(gain: dict[str, Any]) -> str:
    """The interval of a gain, in percent."""
    low, high = gain.get("gain_percent_low"), gain.get("gain_percent_high")
    return "no interval" if low is None or high is None else f"95 %: {low:+.1f} .. {high:+.1f}"


def basis(result: dict[str, Any]) -> str:
    """What a gain rests on: pairs, ground, training runs."""
    ground = _count(result["tiles"], "ground tile")
    if result.get("interval_unit") == "site" and "sites" in result:
        ground = f"{_count(result['sites'], 'site')} of one ground tile"
    said = f"{result['pairs']:,} pairs on {ground}"
    return f"{said}, {_count(result['training_runs'], 'training run')}" if "training_runs" in result else said


def learned(file: h5py.File) -> list[Sentence]:
    """What a checkpoint predicts, and from what."""
    names = json.loads(str(file.attrs["coefficients"]))
    maps = json.loads(str(file.attrs["maps"])) if "maps" in file.attrs else names
    model = get_model(str(file.attrs["model"]))
    rest = len(names) - len(maps)
    other = (
        f"; {_count(rest, 'other coefficient')} {'have' if rest > 1 else 'has'} one value for all ground"
        if rest
        else ""
    )
    return [
        (
            f"Learned from heights and {_count(len(file['image_id']), 'image')}: {listed(maps)} of the model {model.name} "
            f"({model.title}), place by place{other}.",
            "",
        )
    ]


def evaluation(result: dict[str, Any]) -> list[Sentence]:
    """What learned reflectance gains on ground that training never saw, over the strongest baseline and the paper's."""
    found = []
    for ours, freedom, words in CLAIMS:
        rivals = [(result.get("strongest_baseline", {}).get(freedom), "the strongest model without a network")]
        if freedom == "none":
            rivals.append(("hapke_minmax", "the baseline of the Lunar-G2R paper"))
        for other, which in rivals:
            gain = result["gains"].get(ours, {}).get(other or "")
            if gain and gain["gain_percent"] is not None:
                title = result.get("titles", {}).get(other, str(other).replace("_", " "))
                who = f"{which}, '{title}'"
                found.append(_compared(f"On unseen ground, {words}", who, gain, basis(result)))
    return found


def held_out_images(result: dict[str, Any]) -> list[Sentence]:
    """What albedo from photographs gains under images that had no part in it: another claim than unseen ground."""
    gain = result["gains"].get("albedo", {}).get("terrain")
    if not gain or gain.get("gain_percent") is None:
        return []
    sun = result.get("nearest_used_sun_deg") or {}
    unseen = f"{_count(len(result.get('images', [])), 'unseen image')}, {basis(result)}"
    if sun:
        unseen += f", their Suns {sun['least']:.0f} to {sun['most']:.0f} deg from the nearest one used"
    what = "On seen ground under unseen images, which is another claim, albedo from the other photographs"
    return [_compared(what, "the map from terrain alone", gain, unseen)]


def diagnosis(result: dict[str, Any]) -> list[Sentence]:
    """What the simulation lacks, what naming it is worth, and what these data could not tell."""
    known = result.get("verdict", "")
    said = str(result.get("sentence") or VERDICTS.get(known, known) or "The diagnosis holds no verdict.")
    if known == "named" and not result.get("sentence"):
        said = f"The simulation lacks {listed([c['effect'] for c in result.get('causes', [])])}."
    data = result.get("data") or {}
    if data.get("pairs"):
        said = f"Diagnosis of {data['pairs']:,} pairs of {_count(data.get('sites', 0), 'place')}: {said}"
    found = [(said, "")]
    held_out = result.get("held_out") or {}
    if result.get("causes") and held_out.get("gain_percent") is not None:
        on = f"{held_out['pairs']:,} unseen pairs" if held_out.get("pairs") else "unseen pairs"
        if held_out.get("sites"):
            on += f" of {_count(held_out['sites'], 'place')}"
        found.append(_compared("With what was named, the simulation", "the simulation without it", held_out, on))
    if result.get("blind"):
        found.append((f"These data could not show, whether it is there or not: {listed(result['blind'])}.", ""))
    return found


VERDICTS = {
    "nothing_significant": "Nothing significant is missing from the simulation.",
    "unexplained": "Something is missing from the simulation that nothing in the catalogue explains.",
    "cannot_tell": "These data cannot tell whether something is missing from the simulation.",
}


def albedo(file: h5py.File) -> list[Sentence]:
    """How many images made the albedo of a map."""
    if "albedo" not in file:
        return []
    count = len(read_strings(file, "albedo_image_id"))
    return [(f"The map also holds albedo from {_count(count, 'photograph')}, for what terrain does not show.", "")]


def listed(names: list[str]) -> str:
    """'a, b and c', as words."""
    words = [name.replace("_", " ") for name in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}" if words else "nothing"


def _compared(ours: str, other: str, gain: dict[str, Any], on: str) -> Sentence:
    value, word = float(gain["gain_percent"]), verdict(gain)
    tail = f"gain {value:+.1f} % ({bounds(gain)}; {on})"
    if word == "no difference":
        return f"{ours} shows no difference from {other}: {tail}.", ""
    if word == "unknown":
        return f"{ours} cannot be compared with {other} with any certainty: {tail}.", ""
    if word == "better":
        return f"{ours} has a squared error {value:.1f} % lower than {other} ({bounds(gain)}; {on}).", "good"
    return f"{ours} has a squared error {-value:.1f} % higher than {other}; {tail}.", "bad"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"
