"""The first screen: what a run found, one sentence each, no stronger than its interval allows."""

from __future__ import annotations

import json
from typing import Any

import h5py

from schemas import read_strings
from stages.common.page.sentences import Sentence, compared, counted, listed
from stages.physics.photometry import get_model

# (row, what it may know of the scored crops)
CLAIMS = (
    ("learned", "none", "knowing nothing of the scored images, reflectance learned from terrain"),
    ("learned_gain_offset", "gain_offset", "with a gain and an offset for each scored crop, reflectance learned from terrain"),
)  # fmt: skip


def basis(result: dict[str, Any]) -> str:
    """What a gain rests on: pairs, ground, training runs."""
    ground = counted(result["tiles"], "ground tile")
    if result.get("interval_unit") == "site" and "sites" in result:
        ground = f"{counted(result['sites'], 'site')} of one ground tile"
    pairs = f"{result['pairs']:,} pairs on {ground}"
    return f"{pairs}, {counted(result['training_runs'], 'training run')}" if "training_runs" in result else pairs


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
    for ours, freedom, words in CLAIMS:
        rivals = [(result.get("strongest_baseline", {}).get(freedom), "the strongest model without a network")]
        if freedom == "none":
            rivals.append(("hapke_minmax", "the baseline of the Lunar-G2R paper"))
        for other, which in rivals:
            gain = result["gains"].get(ours, {}).get(other or "")
            if gain and gain["gain_percent"] is not None:
                title = result.get("titles", {}).get(other, str(other).replace("_", " "))
                who = f"{which}, '{title}'"
                found.append(compared(f"On unseen ground, {words}", who, gain, basis(result)))
    return found


def held_out_images(result: dict[str, Any]) -> list[Sentence]:
    """What albedo from photographs gains under images that had no part in it: another claim than unseen ground."""
    gain = result["gains"].get("albedo", {}).get("terrain")
    if not gain or gain.get("gain_percent") is None:
        return []
    sun = result.get("nearest_used_sun_deg") or {}
    unseen = f"{counted(len(result.get('images', [])), 'unseen image')}, {basis(result)}"
    if sun:
        unseen += f", their Suns {sun['least']:.0f} to {sun['most']:.0f} deg from the nearest one used"
    ours = "On seen ground under unseen images, which is another claim, albedo from the other photographs"
    return [compared(ours, "the map from terrain alone", gain, unseen)]


def albedo(file: h5py.File) -> list[Sentence]:
    """How many images made the albedo of a map."""
    if "albedo" not in file:
        return []
    count = len(read_strings(file, "albedo_image_id"))
    return [(f"The map also holds albedo from {counted(count, 'photograph')}, for what terrain does not show.", "")]
