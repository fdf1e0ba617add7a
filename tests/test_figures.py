"""Figures of an evaluation stand in marked blocks only, and come from files only."""

from __future__ import annotations

import json
import re
import runpy

import h5py
import numpy as np
import pytest
from conftest import ROOT

figures = runpy.run_path(str(ROOT / "examples" / "figures.py"), run_name="figures")
PAGES = (ROOT / "README.md", *sorted(p for p in (ROOT / "docs").glob("*.md") if "<!-- figures:" in p.read_text()))
NUMBER = re.compile(r"\d\.\d+e-\d|\d(?:\.\d+)? ?%|\bp ?= ?\d")  # errors, gains and shares


def row(mse, freedom):
    return {
        "mse": mse,
        "mse_low": mse / 2,
        "mse_high": mse * 2,
        "mse_run_std": mse / 50,
        "ssim": 0.8,
        "freedom": freedom,
    }


def gain(value, low, high):
    return {"gain_percent": value, "gain_percent_low": low, "gain_percent_high": high}


EVALUATION = {
    "models": {"learned": row(3.1e-5, "none"), "hapke_fitted": row(4.2e-5, "none"), "hapke_minmax": row(5.3e-5, "minmax")},
    "gains": {"learned": {"hapke_fitted": gain(26.2, -3.0, 41.0), "hapke_minmax": gain(41.5, 20.0, 55.0)}},
    "strongest_baseline": {"none": "hapke_fitted"},
    "titles": {"learned": "learned reflectance", "hapke_fitted": "Hapke fitted", "hapke_minmax": "Hapke min-max"},
    "pairs": 321, "tiles": 22, "training_runs": 3, "interval_unit": "tile", "image_units": "iof", "model": "hapke",
}  # fmt: skip
HELD_OUT = {
    "claim": "seen ground, unseen images",
    "models": {"terrain": row(3.3e-5, ""), "albedo": row(4.4e-6, "")},
    "gains": {"albedo": {"terrain": gain(86.7, 80.0, 91.0)}},
    "images": [{}, {}], "pairs": 77, "tiles": 9, "image_units": "iof",
    "nearest_used_sun_deg": {"least": 2.0, "mean": 5.0, "most": 8.0}, "coverage_percent": {"68": 70.1, "95": 94.2},
}  # fmt: skip
PAGE = "before\n<!-- figures:NAME -->\nold 9.99e-5\n<!-- end -->\nafter 1\n"


def filled(name, tmp_path, files):
    for file, content in files.items():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(json.dumps(content))
    return figures["rewrite"](PAGE.replace("NAME", name), tmp_path)


def test_a_block_is_replaced_by_what_the_file_holds(tmp_path):
    text = filled("demo-rows", tmp_path, {"demo-full/evaluation.json": EVALUATION})
    assert "9.99e-5" not in text and text.startswith("before\n<!-- figures:demo-rows -->\n")
    assert text.endswith("-->\nafter 1\n")
    assert "|model|fitted to each crop|MSE, 1e-5 I/F squared|SSIM|" in text
    assert "|learned reflectance|nothing|3.10 ± 0.06 (1.55 to 6.20)|0.800|" in text
    assert (
        "no sure difference from the strongest model without a network (hapke_fitted): gain 26.2 % (-3.0 to 41.0)"
        in text
    )
    assert "41.5 % (20.0 to 55.0) lower than the paper's baseline (hapke_minmax)" in text
    assert "321 pairs on 22 ground tiles, 3 training runs" in text
    assert figures["rewrite"](text, tmp_path) == text


def test_the_papers_model_stands_in_the_table_where_it_was_trained(tmp_path):
    other = {**EVALUATION, "model": "M2", "models": {"learned": row(8.7e-5, "none")}, "training_runs": 1}
    text = filled("demo-rows", tmp_path, {"demo-full/evaluation.json": EVALUATION, "demo-full/m2.json": other})
    assert re.search(r"\|M2 .*1 run: learned\|nothing\|8\.70", text)


def test_a_model_under_two_names_stands_once(tmp_path):
    twice = {**EVALUATION, "models": EVALUATION["models"] | {"global": row(4.2e-5, "none")}}
    text = filled("demo-rows", tmp_path, {"demo-full/evaluation.json": twice})
    assert text.count("|4.20 ") == 1


def test_the_short_table_claims_no_more_than_the_intervals(tmp_path):
    files = {
        "demo-full/evaluation.json": EVALUATION,
        "results/apollo15/evaluation.json": EVALUATION,
        "results/apollo15/held_out.json": HELD_OUT,
    }
    text = filled("three-results", tmp_path, files)
    assert text.count("no sure difference from the best law with one coefficient set (hapke_fitted): gain 26.2 %") == 2
    assert "86.7 % (80.0 to 91.0) lower than the map from terrain alone" in text


def test_a_diagnosis_lists_causes_with_units_and_what_stays_open(tmp_path):
    cause = {"effect": "sun_azimuth", "parameters": {"error_deg": {"value": 4.321, "error": 0.91, "unit": "degree"}}}
    result = {"verdict": "named", "data": {"pairs": 7, "sites": 2}, "causes": [cause], "blind": ["dem_scale", "echo"],
              "held_out": gain(22.7, 10.6, 34.7) | {"pairs": 3}}  # fmt: skip
    text = filled("demo-diagnosis", tmp_path, {"demo-full/diagnosis.json": result})
    assert "|sun azimuth|error_deg = 4.32 ± 0.9 degree|" in text and "lower by 22.7 % (10.6 to 34.7)" in text


def test_campaigns_of_diagnose_are_sums_of_the_list(tmp_path):
    (tmp_path / "docs").mkdir()
    columns = "version,data,seeds,law,nulls,false_names,plants,named_first,another_first,values,values_within_3_errors,faults,faults_in_words,notes"
    lines = [
        "current,photographs,1,film,6,1,24,20,1,,,,,",
        "current,photographs,2,film,4,0,26,20,,,,2,1,",
        "current,own scenes,3,given,,,5,1,0,,,,,",
    ]
    (tmp_path / "docs" / "diagnose_campaigns.csv").write_text("\n".join([columns, *lines]))
    text = figures["rewrite"](PAGE.replace("NAME", "diagnose-campaigns"), tmp_path)
    assert "|real photographs, this version|1 of 10 (10 %)|40 of 50 (80 %)|1 of 24 (4 %)|1 of 2 (50 %)|" in text
    assert "|own scenes, this version|-|1 of 5 (20 %)|0 of 5 (0 %)|-|" in text


def test_unseen_images_are_a_claim_of_their_own(tmp_path):
    text = filled("demo-albedo", tmp_path, {"demo-full/held_out_all.json": HELD_OUT})
    assert (
        "|with albedo from the other photographs|0.440 (0.220 to 0.880)|0.800|" in text
        and "MSE, 1e-5 I/F squared" in text
    )
    assert "unseen images" in text and "86.7 % (80.0 to 91.0) lower" in text and "77 pairs on 9 ground tiles" in text
    assert "2 to 8 deg" in text and "94.2 % of the pixels lie inside the 95 % intervals, and 70.1 %" in text


@pytest.mark.parametrize("name", [*figures["BLOCKS"]])
def test_without_a_file_the_block_stays_and_the_command_is_named(name, tmp_path, capsys):
    page = PAGE.replace("NAME", name)
    assert figures["rewrite"](page, tmp_path) == page
    assert re.search(
        rf"{name}: kept as it is; `(make|python) [^`]+` makes (demo-full|results|docs)/", capsys.readouterr().err
    )
    text = figures["rewrite"](page.replace("old 9.99e-5\n", ""), tmp_path)
    assert re.search(r"`(make|python) [^`]+` makes `(demo-full|results|docs)/", text) and not NUMBER.search(text)


def test_a_file_of_something_else_is_refused(tmp_path):
    for folder in ("demo-full", "docs"):
        (tmp_path / folder).mkdir()
    (tmp_path / "README.md").write_text(PAGE.replace("NAME", "demo-rows"))
    (tmp_path / "demo-full" / "evaluation.json").write_text('{"a": 1}')
    with pytest.raises(SystemExit) as ended:
        figures["main"](tmp_path)
    assert ended.value.code == 3 and "9.99e-5" in (tmp_path / "README.md").read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_marker_is_whole_and_has_a_writer(page):
    text = page.read_text()
    names = re.findall(r"<!-- figures:(\S+) -->", text)
    assert names and set(names) <= set(figures["BLOCKS"]) and len(figures["BLOCK"].findall(text)) == len(names)


def test_readme_holds_no_figure_of_an_evaluation_outside_the_blocks():
    outside = figures["BLOCK"].sub("", PAGES[0].read_text())
    assert NUMBER.search("lowers it by 18 %") and NUMBER.search("7.95e-5")
    assert not [line for line in outside.splitlines() if NUMBER.search(line)]
    assert "fairest" not in outside


def test_campaigns_follow_from_the_rates_of_the_scaling_table(tmp_path):
    row = "| `{}` | map, edge in px: 10, 20 | {} | 1.0 | 2, 3 | +5 % | {} s per {} |"
    rows = [row.format(stage, "1,165, 1,401", 0.5, unit) for stage, unit in (
        ("ingest", "Mpx"), ("ingest --images", "Mpx"), ("sample", "thousand crops"), ("project", "thousand pairs"), ("train", "thousand pairs"),
        ("infer", "Mpx"), ("render", "Mpx"), ("evaluate", "thousand pairs"))]  # fmt: skip
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "resources.md").write_text("\n".join(rows))
    text = figures["rewrite"](PAGE.replace("NAME", "campaigns"), tmp_path)
    assert "|`infer`|342 Mpx|2.9 min|34.8 min|1.4 GB|" in text
    assert "|`project`|83.6 thousand pairs|0.7 min||1.4 GB|" in text
    (tmp_path / "docs" / "resources.md").write_text("\n".join(rows[:-1]))
    assert figures["rewrite"](text, tmp_path) == text
    assert "No figures yet" in figures["rewrite"](
        PAGE.replace("NAME", "campaigns").replace("old 9.99e-5\n", ""), tmp_path
    )


def test_sizes_are_those_of_the_files(tmp_path):
    (tmp_path / "demo-full").mkdir()
    for name, _, _ in figures["SIZES"]:
        (tmp_path / "demo-full" / name).write_bytes(b"x" * 2000)
    for name, shape in (("scene", (1000, 2000)), ("svbrdf", (1000, 2000)), ("svbrdf_albedo", (1000, 2000)),
                        ("crops", (4, 8, 8)), ("pairs", (4, 8, 8)), ("evaluation", (4, 8, 8))):  # fmt: skip
        with h5py.File(tmp_path / "demo-full" / f"{name}.h5", "w") as file:
            file["measured" if name == "evaluation" else "elevation"] = np.zeros(shape, np.float32)
    text = figures["rewrite"](PAGE.replace("NAME", "demo-sizes"), tmp_path)
    assert "|`scene.h5`|8.0 MB|4.0 MB a Mpx of the working grid|" in text
    assert "|`checkpoint_0.h5`|0.0 MB|-|" in text and "kB a pair" in text
