"""The first screen: what a run found, one sentence each, no stronger than its interval allows."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import h5py

from schemas import read_strings
from stages.common.page.sentences import Number, Sentence, basis, compared, counted, error_change, listed
from stages.physics.photometry import get_model

# (row, what it may know of the scored crops)
CLAIMS = (
    ("learned", "none", "On unseen ground the learned reflectance"),
    ("learned_gain_offset", "gain_offset", "On unseen ground, with a gain and an offset fitted to each scored crop, the learned reflectance"),
)  # fmt: skip


def learned(file: h5py.File) -> list[Sentence]:
    """What a checkpoint predicts, and from what."""
    names = json.loads(str(file.attrs["coefficients"]))
    maps = json.loads(str(file.attrs["maps"])) if "maps" in file.attrs else names
    model = get_model(str(file.attrs["model"]))
    rest = len(names) - len(maps)
    text = (
        f"Learned from heights and {counted(len(file['image_id']), 'image')}: {listed(maps)} of the model {model.name} "
        f"({model.title}), place by place"
    )
    if rest:
        text += f"; {counted(rest, 'other coefficient')} {'have' if rest > 1 else 'has'} one value for all ground"
    return [(f"{text}.", "")]


def evaluation(result: dict[str, Any]) -> list[Sentence]:
    """What learned reflectance gains on ground that training never saw, over the strongest baseline and the paper's."""
    found = []
    for words, which, title, gain in _gains(result):
        found.append(compared(words, f"{which}, '{title}'", gain, basis(result)))
    return found


def evaluation_numbers(result: dict[str, Any]) -> list[Number]:
    """The same gains as changes of the squared error, of models that know nothing of the scored crops."""
    claim = CLAIMS[0][2]
    return [
        error_change(gain, f"squared error on unseen ground, against {which}")
        for words, which, _, gain in _gains(result)
        if words == claim
    ]


def _gains(result: dict[str, Any]) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """(claim, kind of the other model, its title, gain)"""
    for ours, freedom, words in CLAIMS:
        rivals = [(result.get("strongest_baseline", {}).get(freedom), "the strongest model without a network")]
        if freedom == "none":
            rivals.append(("hapke_minmax", "the baseline of the Lunar-G2R paper"))
        for other, which in rivals:
            gain = result["gains"].get(ours, {}).get(other or "")
            if gain and gain["gain_percent"] is not None:
                yield words, which, result.get("titles", {}).get(other, str(other).replace("_", " ")), gain


UNSEEN = (  # (map, what it is compared with, both in words), the first that a result has
    ("refined", "albedo", "refined elevations and albedo", "albedo alone"),
    ("albedo", "terrain", "albedo from the other photographs", "the map from terrain alone"),
)


def held_out_images(result: dict[str, Any]) -> list[Sentence]:
    """What photographs gain under images that had no part in it: another claim than unseen ground."""
    sun = result.get("nearest_used_sun_deg") or {}
    unseen = f"{counted(len(result.get('images', [])), 'unseen image')}, {basis(result)}"
    if sun:
        unseen += f", their Suns {sun['least']:.0f} to {sun['most']:.0f} deg from the nearest one used"
    what = "Another claim: on seen ground, under unseen images"
    return [compared(f"{what}, {ours}", other, gain, unseen) for ours, other, gain in _unseen(result)]


def held_out_numbers(result: dict[str, Any]) -> list[Number]:
    """The same gain as a change of the squared error."""
    return [
        error_change(gain, f"squared error under unseen images, {ours} against {other}")
        for ours, other, gain in _unseen(result)
    ]


def _unseen(result: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """Both maps in words and the gain, of the first comparison that there is."""
    found = [(ours, other, result["gains"].get(key, {}).get(base)) for key, base, ours, other in UNSEEN]
    return [(ours, other, gain) for ours, other, gain in found if gain and gain.get("gain_percent") is not None][:1]


def albedo(file: h5py.File) -> list[Sentence]:
    """How many images made the albedo of a map."""
    if "albedo" not in file:
        return []
    count = len(read_strings(file, "albedo_image_id"))
    return [(f"The map also holds albedo from {counted(count, 'photograph')}, for what terrain does not show.", "")]
