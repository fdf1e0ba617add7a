"""An image held against its rendering: what is right stands out of chance, what is wrong does not."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest

from lunargr_cli.commands.project import _say_resemblances
from schemas import SCENE, InputError, open_artefact
from stages.physics.horizon.scene import SceneTerrain
from stages.physics.images.register_frame import choose_blocks
from stages.physics.images.source_images import open_source
from stages.physics.images.table import load_frames
from stages.physics.images.table_checks import check_distinct
from stages.physics.maps.grid import read_grid
from stages.project.resemblance import BLOCKS, compare_with_rendering
from stages.project.summary import Resemblance

FOOT = 0.3048  # m


@pytest.fixture(scope="module")
def compare(small_artefacts):
    """Compares the second image of the small scene with a rendering of ``heights`` under ``sun`` degrees more to the east."""
    with open_artefact(small_artefacts["scene"], SCENE) as file:
        grid, frame = read_grid(file, small_artefacts["scene"]), load_frames(file, small_artefacts["scene"])[1]
        known = file["elevation"][...]
    with h5py.File(small_artefacts["crops"]) as crops:
        mine = crops["image_index"][...] == 1
        blocks = choose_blocks(crops["row"][...][mine], crops["col"][...][mine], 32, grid, BLOCKS)

    def run(heights=lambda z: z, sun=0.0, seen=lambda image: image):
        z = heights(known)
        other = replace(frame, subsolar_longitude_deg=frame.subsolar_longitude_deg + sun)
        with open_source(frame, grid, z, (-400.0, 400.0)) as source:

            class Seen:
                def read(self, *box):
                    pixels = source.read(*box)
                    return replace(pixels, values=seen(pixels.values))

            return compare_with_rendering(other, Seen(), SceneTerrain.of(z, grid), blocks)

    return run


def test_the_right_ground_stands_out(compare):
    found = compare()
    assert found.correlation > 0.95 and not found.is_chance
    # heights in feet taken for metres: slopes are 1 / 0.3048 times as steep, and still small
    feet = compare(lambda z: z / FOOT)
    assert not feet.is_chance and feet.contrast / found.contrast == pytest.approx(FOOT, rel=0.1)


@pytest.mark.parametrize(
    "wrong",
    [
        {"heights": lambda z: z[:, ::-1].copy()},
        {"heights": lambda z: z.T.copy()},
        {"heights": lambda z: -z},
        {"heights": lambda z: np.roll(z, 20, 0)},  # a quarter of the ripples' period
        {"sun": 90.0},
        {"seen": np.zeros_like},
        {"seen": lambda image: np.random.default_rng(4).normal(size=image.shape).astype(np.float32)},
    ],
    ids=["mirrored", "transposed", "negative", "shifted", "Sun in the east", "dark", "noise"],
)
def test_what_is_wrong_is_chance(compare, wrong):
    assert compare(**wrong).is_chance


def test_the_command_warns_where_it_is_chance():
    said, tables = [], []

    class Console:
        def say(self, text):
            said.append(text)

        def table(self, title, columns, rows):
            tables.append(rows)

    good, poor = Resemblance("good", 0.8, 0.1, 1.0, 0.05), Resemblance("poor", 0.09, 0.1, 1.0, 128.0)
    negative, unseen = Resemblance("negative", -0.8, 0.1, -1.0, 0.05), Resemblance("unseen", *[np.nan] * 4)
    _say_resemblances(Console(), [good, poor, negative, unseen], "iof")
    assert [row[0] for row in tables[0]] == ["good", "poor", "negative"]
    assert [text.split("'")[1] for text in said] == ["poor", "poor", "negative"]
    assert "its units may be dn" in said[1] and "reversed" in said[2]


def test_one_photograph_under_two_ids_is_refused(small_artefacts):
    with open_artefact(small_artefacts["scene"], SCENE) as file:
        frames = load_frames(file, small_artefacts["scene"])
    check_distinct(frames)
    with pytest.raises(InputError, match="image 'copy' is the photograph of 'IMG0' again"):
        check_distinct([*frames, replace(frames[0], image_id="copy")])
