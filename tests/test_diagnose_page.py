"""The page of `lunargr diagnose`: of the report's parts, in the order of its story, with pictures that say what they are."""

from __future__ import annotations

import json
import math
import re

import numpy as np

from stages import report
from stages.common.page import diagnosis as common
from stages.diagnose.judge.claim import Reason, Refusal
from stages.diagnose.result import drawings, page
from stages.diagnose.result.answer import Answer, HeldOut, Named
from stages.effects import get_effect


def answer() -> Answer:
    cause = Named(get_effect("sun_azimuth"), {"error_deg": (4.25, 0.33, "degree")}, 0.01, 2298.0, 280.0, 0.0210, 0.0195,
                  (2.06, 1.5, 2.6), ["sun_azimuth", "line_jitter"])  # fmt: skip
    return Answer(
        "named",
        [cause],
        {"named": 0.12, "common_to_images": 0.8, "own_to_image": 0.06, "noise": 0.02},
        [],
        {"echo": Refusal(Reason.IMPOSSIBLE, "<that>", 151.4)},
        {"none": (0.0, 0.0, 0.0), "constant": (0.85, 0.26, 1.44)},
        blind=["penumbra"],
        held_out=HeldOut(54, 5, 2e-5, 1e-5, 40.0, 60.0),
        pairs=156,
        sites=15,
        images=16,
        config={"model": "hapke"},
    )


def test_the_page_tells_its_story_in_order_and_escapes_what_it_was_given(tmp_path):
    page.write_page(tmp_path / "d.html", answer(), None, [])
    text = (tmp_path / "d.html").read_text()
    titles = re.findall(r"<h2>(.*?)</h2>", text)
    assert titles == [
        "How much of it is what",
        "What each named cause takes away",
        "What got no name, and why",
        "What would settle the rest",
    ]
    for said in ("error_deg\u00a0=\u00a04.25\u00a0+-\u00a00.3\u00a0degree", "0.0210 to 0.0195", "+2.1 % (+1.5 .. +2.6)",
                 "width: 80.00%", "&lt;that&gt;", "+0.8 % (+0.3 .. +1.4)", get_effect("penumbra").separate,
                 get_effect("sun_azimuth").separate, "squared error 50.0 % lower"):  # fmt: skip
        assert said in text, said


def test_report_and_diagnose_show_a_diagnosis_alike(tmp_path):
    """The same tables, cell by cell, and the same look."""
    page.write_page(tmp_path / "d.html", answer(), None, [])
    (tmp_path / "d.json").write_text(json.dumps(answer().to_json()))
    report.run([tmp_path / "d.json"], tmp_path / "r.html", report.Config())
    own, other = ((tmp_path / name).read_text() for name in ("d.html", "r.html"))
    assert re.findall(r"<style>.*?</style>", own, re.S) == re.findall(r"<style>.*?</style>", other, re.S)
    tables = [re.findall(r"<table>.*?</table>", text, re.S) for text in (own, other)]
    assert tables[0][:3] == tables[1][:3] and len(tables[1]) >= 3


def crop(name: str, scale: float) -> drawings.Crop:
    ramp = np.linspace(0, 1, 64, dtype=np.float32).reshape(8, 8)
    hole = ramp.copy()
    hole[0, 0] = np.nan
    return drawings.Crop(name, 0.1 * ramp, 0.1 * ramp, scale * hole, 0.5 * scale * hole, {"echo": 0.1 * scale * hole})


def test_crops_carry_image_names_and_one_colour_bar_for_all(rng):
    parts = drawings._differs([crop("M101", 10.0), crop("M102", 20.0)])
    text = "".join(parts)
    assert text.count("<img") == 8 and text.count('class="bar"') == 2
    assert 'alt="measured, M101"' in text and "<h3>M102</h3>" in text
    wide = drawings._reach([crop("M101", 10.0).before, crop("M102", 20.0).before])
    assert 10 < wide < 20 and f"{wide:.3g} %" in text
    footprints = "".join(drawings._footprints([crop("M101", 10.0)]))
    assert "What echo changes" in footprints and footprints.count("<img") == 1
    assert drawings._differs([]) == [] and drawings._footprints([]) == []


def test_a_verdict_without_numbers_is_still_a_page(tmp_path):
    page.write_page(tmp_path / "d.html", Answer("cannot_tell", note="too few pixels"), None, [])
    text = (tmp_path / "d.html").read_text()
    assert "Too few pixels." in text and "<h2>" not in text
    assert common.percent(None, None, None) == "not scored" and common.formatted(math.pi, ".2f") == "3.14"
