"""What all images have on the same columns of their detector: each too faint to be seen in one image."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stages.diagnose.settings import LINE
from stages.diagnose.structure.innovations import Innovation
from stages.diagnose.structure.kinds import SEAM, STRAIGHT, UNEVEN
from stages.diagnose.structure.profiles import bands, columns_that_stand_out, lines_of_their_own, profiles, seam

SIZE, PIECES, WIDE = 48, 40, 200


def left(seed: int, **faults: float) -> list[Innovation]:
    """White noise on pieces of ground that lie anywhere on a detector which is turned against the map by a few degrees, and a fault of the camera.

    steps : at column 101, another one in every image; waves : 14 lines long, of any phase; column : number 101; pattern : of every column
    lines : each with a brightness of its own
    """
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(float)
    flat = np.random.default_rng(1).normal(0, 1, WIDE + SIZE)
    out = []
    for piece in range(PIECES):
        turn = np.radians(rng.uniform(-4, 4))
        sample = 4 + rng.uniform(0, WIDE - SIZE) + x * np.cos(turn) - y * np.sin(turn)
        line = 4 + rng.uniform(0, 4000) + x * np.sin(turn) + y * np.cos(turn)
        value = rng.normal(0, 1, (SIZE, SIZE))
        value += faults.get("steps", 0.0) * rng.normal() * np.sign(sample - 101.5)
        value += faults.get("waves", 0.0) * np.sin(2 * np.pi * line / 14 + rng.uniform(0, 6.3))
        value += faults.get("column", 0.0) * (np.abs(sample - 101) < 0.5)
        value += faults.get("pattern", 0.0) * flat[np.clip(np.round(sample).astype(int), 0, len(flat) - 1)]
        value += (
            faults.get("lines", 0.0)
            * np.random.default_rng([seed, piece]).normal(0, 1, 4200)[np.round(line).astype(int)]
        )
        detector = torch.from_numpy(np.stack([line, sample]))[None].float()
        seen = torch.ones(1, SIZE, SIZE, dtype=torch.bool)
        out.append(Innovation(SimpleNamespace(site=piece // 4), torch.from_numpy(value)[None].float(), seen, detector))
    return out


@pytest.mark.parametrize(
    ("faults", "found"),
    [
        ({}, ()),
        ({"steps": 0.25}, ("seam",)),
        ({"waves": 0.3}, ("bands", "lines")),
        ({"lines": 0.15}, ("lines",)),
        ({"column": 0.5}, ("column",)),
        ({"pattern": 0.1}, ()),  # as a flat field that is off a little everywhere
    ],
)
def test_what_images_have_on_the_same_columns_of_the_detector_is_seen_and_nothing_else(faults, found):
    for seed in range(3):
        columns, lines = (profiles(left(seed, **faults), axis) for axis in (1, 0))
        sure = {
            "seam": seam(columns)[0] > SEAM,
            "bands": bands(lines)[0] > LINE,
            "column": columns_that_stand_out(columns)[0] > STRAIGHT,
            "lines": lines_of_their_own(left(seed, **faults))[1] > UNEVEN,
        }
        assert {k for k, v in sure.items() if v} == set(found)
        assert seam(lines)[0] < SEAM and bands(columns)[0] < LINE / 2


def test_one_steep_image_is_no_seam():
    """What shading under a low Sun leaves is steep in one image: a seam is there in several."""
    every = left(3)
    y, x = np.mgrid[0:SIZE, 0:SIZE]
    one = every[7]
    one.value[...] += torch.from_numpy(np.sin(x / 4.0) + np.sin(y / 5.0)).float()
    assert seam(profiles(every, 1))[0] < SEAM


def test_shares_are_those_of_the_squares():
    """A wave of amplitude a has half of a square in units of the noise's variance; a step of +-s a square of s beside it."""
    assert bands(profiles(left(5, waves=0.4), 0))[1] == pytest.approx(0.08 / 1.08, rel=0.25)
    near = seam(profiles(left(5, steps=0.4), 1))[1]
    assert near == pytest.approx(0.16, rel=0.5)
    assert seam([])[1] == bands([])[1] == columns_that_stand_out([])[1] == 0.0


def test_steps_of_one_ground_are_no_seam():
    """Pieces of one ground that lie at the same place of the detector show the same step of it, however many images there are."""
    every = left(4)
    rng = np.random.default_rng(9)
    for one in every[8:12]:
        one.value[...] += 1.5 * rng.choice([-1, 1]) * torch.sign(one.detector[:, 1] - 101.5)
    assert {one.patch.site for one in every[8:12]} == {2}
    assert seam(profiles(every, 1))[0] < SEAM
