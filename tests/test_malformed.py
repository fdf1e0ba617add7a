"""Malformed inputs end in one line: a sample of `make fuzz`, with what has once gone on silently, crashed or hung."""

from __future__ import annotations

import malformed
import pytest

SAMPLE = [
    # went on silently
    "scene: attribute gsd_m = '-1e+30'",
    "pairs: /sun_direction_enu zero",
    "pairs: /sun_direction_enu NaN",
    "pairs: /sun_horizon_deg missing",
    "checkpoint: weights NaN",
    "checkpoint: attribute elevation_scale_m = 'nan'",
    'checkpoint: config {"widths": [4, 4, 8], "dropout": [0.0, 0.0, 0.0], ',
    "image of other contents than sample saw",
    "table: subsolar_longitude_deg = ''",
    "table: start_time = 'yesterday'",
    "DEM in feet",
    "DEM in feet by its CRS",
    "DEM of three bands",
    "DEM complex",
    "infer --body mars on a scene",
    "sample --crop '0'",
    "infer --window '0'",
    "render --altitude '0'",
    "no validation pairs",
    "image all nodata",
    # tracebacks
    "scene: /path a group",
    "trajectory: fov_deg = 'nan'",
    "trajectory: a column twice",
    "ISD: focal_length_model.focal_length = nan",
    "parts: gsd_m of one is nan",
    "convert: bands 'a=1,b=2,c=99'",
    "pairs: attribute inputs = '{'",
    "pairs: attribute provenance = '5'",
    "pairs: nothing valid",
    "pairs: images all NaN",
    "pairs: heights all NaN",
    "pairs: attribute gsd_m = '0.0'",
    "pairs: attribute gsd_m = 'text'",
    "crops: /row an external link",
    "crops: /row a link to itself",
    "scene: another data set kept in a system file",
    "checkpoint: attribute config = '{'",
    'checkpoint: config {"widths": [100000000000, 8], "dropout": [0.0]}',
    "checkpoint: weights text",
    "scene: attribute body_radius_m = 'nan'",
    "scene: crs_wkt 'nonsense'",
    "scene: attribute schema_version = 'text'",
    "crops: /image_index above",
    "crops: /subsolar_latitude_deg NaN",
    "DEM: HDF5 garbage",
    "DEM at longitude +720 deg",
    "train --seed '-1'",
    "sample --tile-m 'nan'",
    "sample --tile-m 'inf'",
    "ingest --crop '1000000000'",
    "sample --shard '1/1000000000'",
    "sample --scheduler 'local:0'",
    "train --device 'meta'",
    "simulate --extent-m 'nan'",
    "simulate --size-px '1000000000'",
    "JSON table 1: 5",
    "JSON table 4: [1, 2]",
    'JSON table 13: [{"image_id": "\\ud',
    # hangs, and what a terminal would obey
    "DEM sparse and all nodata, 300,000 px a side",
    "table: --images /dev/zero",
    "table: image_id = '\\x1b[31mred\\x1b[0m'",
]


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return malformed.good_files(tmp_path_factory.mktemp("good"))


@pytest.fixture(scope="module")
def cases():
    return {case.name: case for case in malformed.all_cases()}


def test_there_are_hundreds_of_them(cases):
    assert len(cases) >= 300


@pytest.mark.parametrize("name", SAMPLE)
def test_it_is_refused_in_one_line(name, cases, good):
    outcome = malformed.run_case(cases[name], good)
    assert not outcome.fault, (outcome.fault, outcome.code, outcome.error)


def test_a_process_ends_as_the_function_does(cases, good):
    outcome = malformed.run_case(cases["pairs: nothing valid"], good, malformed.run_command)
    assert not outcome.fault, (outcome.fault, outcome.code, outcome.error)


@pytest.mark.parametrize(
    ("code", "error", "changed", "fault"),
    [
        (0, "", False, "accepted"),
        (1, "Traceback: ValueError", False, "traceback"),
        (3, "lunargr: a.h5: expected b; do c.", True, "left something"),
        (3, "noise\nlunargr: a.h5: expected b; do c.", False, "2 lines"),
        (3, "lunargr: a.h5: expected b.", False, "no remedy"),
        (3, "lunargr: b.h5: expected b; do c.", False, "does not name a.h5"),
        (124, "", False, "hangs"),
        (3, "lunargr: a.h5: expected b; do c.", False, ""),
    ],
)
def test_the_judge_sees_every_fault(code, error, changed, fault):
    assert malformed._judge(malformed.Case("a case", ["train"], "a.h5"), code, error, changed) == fault
