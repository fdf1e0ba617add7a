"""An image table that contradicts its own times, or an orbit, is refused with what it looks like.

The right values are those of Apollo 15's frames AS15-M-0295 and 0298, from reconstructed SPICE kernels.
"""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest
from small_scene import write_scene

from schemas import GeometryError, InputError
from stages import ingest
from stages.physics.bodies.spheres import Body, find_body
from stages.physics.images.table import Frame
from stages.physics.images.table_checks import check_table

MOON = find_body("moon")
FIRST = Frame(
    "AS15-M-0295", Path("a.tif"), "dn", None, "1971-07-31T01:24:11.817Z", 78.7453, 0.241, 1.0154759, 147.391, -21.505, 118854.0
)  # fmt: skip
LATER = replace(  # half a lunation
    FIRST,
    image_id="later",
    start_time="1971-08-14T19:30:00Z",
    subsolar_longitude_deg=-101.235,
    subsolar_latitude_deg=-0.226,
    solar_distance_au=1.0122,
)


def check(*frames: Frame, body: Body = MOON) -> list[str]:
    return check_table(Path("images.csv"), frames, body)


def test_real_frames_pass(shared):
    from stages.physics.images.table import read_frames

    table = shared / "data/apollo15/images.csv"
    assert check_table(table, read_frames(table), MOON) == []


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"start_time": "1972-07-31T01:24:11.817Z"}, "expected the Sun of start_time 1972-07-31T01:24:11.817Z over"),
        ({"subsolar_longitude_deg": 79.4}, "78.7[45] E, 0.24 N, found 79.4 E, 0.241 N, 0.7 deg away; mend the table"),
        ({"subsolar_longitude_deg": 0.241, "subsolar_latitude_deg": 78.7453}, "longitude and latitude look exchanged"),
        ({"subsolar_longitude_deg": 1.37437, "subsolar_latitude_deg": 0.0042}, "they look like radians"),
        ({"subsolar_longitude_deg": -78.7453}, "counted to the west"),
        ({"subsolar_longitude_deg": -101.235, "subsolar_latitude_deg": -0.226}, "it is the Sun of image 'later'"),
        ({"solar_distance_au": 1.5}, "expected solar_distance_au 1.0155 at start_time .*, found 1.5; mend"),
        ({"spacecraft_altitude_m": 118.854}, "at least 1737 m, found 118.854 .in kilometres"),
    ],
)
def test_contradictions_are_refused_with_what_they_look_like(wrong, words):
    assert check(FIRST, LATER) == []
    with pytest.raises(InputError, match=f"^images.csv: image 1 .AS15-M-0295.: [^\n]*{words}[^\n]*`trust_table`"):
        check(replace(FIRST, **wrong), LATER)


def test_what_cannot_be_compared_passes():
    """A table without times, a body without ephemeris, and the radius that an orbit about a small body has."""
    wrong = replace(FIRST, subsolar_longitude_deg=10.0, solar_distance_au=2.0)
    assert check(replace(wrong, start_time="")) == []
    assert check(wrong, body=find_body("1737400")) == []
    high = replace(FIRST, spacecraft_altitude_m=1737400.0 + 118854.0)
    assert [s.partition(": spacecraft")[0] for s in check(high)] == ["images.csv: image 1 (AS15-M-0295)"]
    assert check(replace(wrong, start_time="", spacecraft_altitude_m=270.0), body=find_body("bennu")) == []


def test_a_spacecraft_over_another_place_is_refused_unless_trusted(tmp_path):
    """From 100 km over (10 E, 20 N) the scene at (20 E, 10 N) lies beyond the horizon; over (20 E, 10 N) it does not."""
    files = write_scene(tmp_path / "scene", images=1)
    with files.images.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    rows[0] |= {"spacecraft_longitude_deg": "10", "spacecraft_latitude_deg": "20", "spacecraft_altitude_m": "1e5"}
    with files.images.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    with pytest.raises(GeometryError, match=r"'IMG0'.*longitude and latitude look exchanged; mend the table"):
        ingest.run(files.dem, files.images, tmp_path / "refused.h5", ingest.Config(crop=32))
    assert not (tmp_path / "refused.h5").exists()
    ingest.run(files.dem, files.images, tmp_path / "scene.h5", ingest.Config(crop=32, trust_table=True))
