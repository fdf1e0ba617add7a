"""Write every figure of an evaluation into README.md and docs/, from the files that commands left. Run: make figures

Between `<!-- figures:NAME -->` and `<!-- end -->` stands what the function of that name makes of demo-full/ and results/.
Where a file is absent the block stays as it is, and the command that makes the file is printed.
"""

from __future__ import annotations

import csv
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "examples")]

from figure_text import gained, percent, power_of, ssim, table, unit_of, with_bounds  # noqa: E402

from stages.common.page.sentences import basis, counted, listed, words  # noqa: E402
from stages.report.held_out import TITLES as MAPS  # noqa: E402

BLOCK = re.compile(r"(<!-- figures:([a-z0-9-]+) -->\n)(.*?)(<!-- end -->)", re.S)
FITTED = {
    "none": "nothing",
    "minmax": "range and mean",
    "gain": "gain",
    "gain_offset": "gain and offset",
}
DEMO, APOLLO, PAPER = "make demo-full", "make reproduce-apollo15", "make reproduce-models"
ALBEDO = "make demo-albedo"
SCALING = "python tests/validation/benchmarks/bench_scaling.py --docs docs/resources.md"
# Of two rows that are one model under two names the table keeps one: (model of the network, row left out, row that is kept)
TWICE = (
    ("hapke", "global", "hapke_fitted"),
    ("hapke", "global_gain_offset", "hapke_fitted_gain_offset"),
    ("kernels", "global", "kernels"),
    ("kernels", "kernels_gain_offset", "global_gain_offset"),
)


class Absent(Exception):
    """A figure has no file to come from: (file, the command that makes it)."""


def read(root: Path, name: str, command: str) -> dict[str, Any]:
    try:
        return json.loads((root / name).read_text())
    except FileNotFoundError:
        raise Absent(name, command) from None


def evaluated(result: dict[str, Any], more: dict[str, Any] | None = None) -> list[str]:
    """A table of errors, what it rests on, and the conclusions. more : the paper's model, on the same pairs"""
    twice = {(model, left) for model, left, kept in TWICE if kept in result["models"]}
    names = [name for name in result["models"] if (result["model"], name) not in twice]
    rows = [(result["models"][name], result.get("titles", {}).get(name, name)) for name in names]
    for name, row in (more or {"models": {}})["models"].items():
        rows.append(
            (row, f"M2 with the paper's network, {counted(more['training_runs'], 'run')}: {name.replace('_', ' ')}")
        )
    power = power_of(row for row, _ in rows)
    lines = [
        f"Model {result['model']}; {basis(result)}; training used none of this ground. ± is the standard deviation "
        "of training runs; brackets hold 95 % intervals. The second column lists what is fitted to each scored crop."
    ]
    order = list(FITTED)
    cells = [
        [title, FITTED[row["freedom"]],
         with_bounds(row["mse"], row["mse_low"], row["mse_high"], row.get("mse_run_std"), power), ssim(row)]
        for row, title in sorted(rows, key=lambda pair: order.index(pair[0]["freedom"]))
    ]  # fmt: skip
    notes = [f"- Note: {text}." for text in result.get("warnings", [])]
    return [
        *lines,
        *table(["model", "fitted to each crop", unit_of(result, power), "SSIM"], cells),
        *won(result),
        *covered(result),
        *notes,
    ]


def won(result: dict[str, Any]) -> list[str]:
    """The learned reflectance against the strongest baseline of its kind, and against the paper's."""
    best, lines = result["strongest_baseline"], []
    for ours, theirs, name in (
        ("learned", best.get("none"), "the strongest model without a network"),
        ("learned", "hapke_minmax", "the paper's baseline"),
        ("learned_gain_offset", best.get("gain_offset"), "the strongest model without a network, both with gain and offset"),
    ):  # fmt: skip
        gain = result["gains"].get(ours, {}).get(theirs or "")
        if gain and gain["gain_percent"] is not None:
            lines.append(f"- Squared error of the learned reflectance: {gained(gain, f'{name} ({theirs})')}.")
    return lines


def covered(result: dict[str, Any]) -> list[str]:
    """The share of pixels inside the error bars."""
    found = result.get("coverage_percent")
    if not found:
        return []
    bands = [band["95"] for band in found.get("by_incidence", []) if band["pixels"]]
    spread = f" ({min(bands):.1f} to {max(bands):.1f} % by incidence)" if bands else ""
    return [
        f"- {found['95']:.1f} % of the pixels lie inside the 95 % intervals{spread}, and {found['68']:.1f} % inside the 68 % intervals."
    ]


def demo_rows(root: Path) -> list[str]:
    result = read(root, "demo-full/evaluation.json", DEMO)
    try:
        paper = read(root, "demo-full/m2.json", "make demo-paper")
    except Absent:
        return evaluated(result)
    learned = {name: row for name, row in paper["models"].items() if name.startswith("learned")}
    return evaluated(result, {**paper, "models": learned})


def held_out(root: Path, name: str, command: str) -> list[str]:
    """Seen ground under unseen images."""
    result = read(root, name, command)
    power = power_of(result["models"].values())
    rows = [
        [MAPS.get(name, name), with_bounds(row["mse"], row["mse_low"], row["mse_high"], None, power), ssim(row)]
        for name, row in result["models"].items()
    ]
    unit = f"MSE, 1e{power} {'I/F' if result.get('image_units') == 'iof' else 'DN'} squared"
    lines = [f"Claim: {result['claim']}; {basis(result)}, {len(result['images'])} images."]
    sun = result["nearest_used_sun_deg"]
    low, high = round(sun["least"]), round(sun["most"])
    apart = f"{low} to {high} deg from" if high > 0 else "less than 1 deg from"
    gain = gained(result["gains"]["albedo"]["terrain"], "the map from terrain alone")
    lines += table(["map", unit, "SSIM"], rows)
    lines += [f"- Squared error with albedo: {gain}.",
              f"- The Sun of each unseen image is {apart} the nearest Sun used."]  # fmt: skip
    return lines + covered(result)


def matched(root: Path, name: str, command: str) -> list[str]:
    """Shares of matches within 1 px."""
    result = read(root, name, command)
    rows = []
    for matcher, renderings in result["matchers"].items():
        for name, row in renderings.items():
            share, low, high = (row[f"within_1_px_percent{end}"] for end in ("", "_low", "_high"))
            text = "-" if share is None else f"{share:.1f} %" if low is None else percent(share, low, high)
            rows.append([matcher, name.replace("_", " "), str(row["matches"]), text])
    lines = [f"{result['crops']} crops on {result['tiles']} ground tiles, one training run, 95 % intervals over tiles."]
    return lines + table(["matcher", "rendering", "matches", "within 1 px"], rows)[:-1]


def diagnosed(root: Path, folder: str, command: str) -> list[str]:
    """The named causes with their values, and the gain on unseen pairs."""
    result = read(root, f"{folder}/diagnosis.json", command)
    data, judged = result["data"], result.get("held_out") or {}
    rows = []
    for cause in result.get("causes", []):
        values = [f"{name} = {v['value']:.3g} ± {v['error']:.1g}{'' if v['unit'] == '1' else ' ' + v['unit']}"
                  for name, v in cause["parameters"].items()]  # fmt: skip
        rows.append([words(cause["effect"]), "; ".join(values)])
    lines = [f"{data['pairs']} pairs of {counted(data['sites'], 'site')}; verdict: {words(result['verdict'])}."]
    lines += table(["cause", "value"], rows) if rows else []
    if rows and judged.get("gain_percent") is not None:
        gain = percent(judged["gain_percent"], judged["gain_percent_low"], judged["gain_percent_high"])
        pairs = f"{judged['pairs']} unseen pairs"
        sure = (judged["gain_percent_low"] or 0.0) > 0
        lines.append(
            f"- With these causes the squared error on {pairs} is lower by {gain}."
            if sure
            else f"- With these causes the squared error on {pairs} shows no sure difference: gain {gain}."
        )
    return lines


def brief(root: Path, folder: str) -> list[str]:
    """What an evaluation rests on and its conclusions, without the table that its report has."""
    result = read(root, f"{folder}/evaluation.json", APOLLO)
    notes = [f"- Note: {text}." for text in result.get("warnings", [])]
    return [
        f"Model {result['model']}; {basis(result)}. Brackets hold 95 % intervals.",
        "",
        *won(result),
        *covered(result),
        *notes,
    ]


def three_results(root: Path) -> list[str]:
    """The short table of README: what was tested, the result, and a caveat."""
    rows = []
    for name, command, tested, caveat in (
        ("demo-full/evaluation.json", DEMO, "Simulated scene, unseen ground",
         "A Hapke law lights the scene, and a part of its albedo follows the terrain."),
        ("results/apollo15/evaluation.json", APOLLO, "Apollo 15 photographs, unseen ground",
         "All frames share one Sun. Frames were aligned with the terrain on test ground, too."),
    ):  # fmt: skip
        result = read(root, name, command)
        best = result["strongest_baseline"]["none"]
        rows.append([f"{tested} ({counted(result['tiles'], 'tile')})",
                     gained(result["gains"]["learned"][best], f"the best law with one coefficient set ({best})"), caveat])  # fmt: skip
    result = read(root, "results/apollo15/held_out.json", APOLLO)
    rows.append([f"Apollo 15 photographs, unseen frame over seen ground ({len(result['images'])} frames)",
                 gained(result["gains"]["albedo"]["terrain"], "the map from terrain alone"),
                 "The frames share one Sun: this shows nothing about another Sun."])  # fmt: skip
    return table(["test", "squared error of the learned map", "caveat"], rows) + ["Brackets hold 95 % intervals."]


def models(root: Path) -> list[str]:
    """The paper's comparison of reflectance models."""
    result = read(root, "results/models.json", PAPER)
    power, rows = power_of(result["models"].values()), []
    for name, row in result["models"].items():
        error = with_bounds(row["mse"], row["mse_low"], row["mse_high"], row["mse_seed_std"], power)
        paper = "-" if row.get("paper_mse_crop_sum") is None else f"{row['paper_mse_crop_sum']:.2f}"
        rows.append([name, error, f"{row['mse_crop_sum']:.4f}", paper])
    lines = [
        f"{result['crops']} validation crops on {result['tiles']} ground tiles, {result['seeds']} training runs of each model. ± is the "
        "standard deviation of runs; brackets hold 95 % intervals over tiles and runs. The paper scores its own pairs."
    ]
    lines += table(["model", f"MSE, 1e{power}", "MSE summed over a crop", "in the paper"], rows)
    known: dict[str, list[str]] = {}
    for pair in result["differences"]:
        if pair["larger_than_noise"]:
            known.setdefault(pair["better"], []).append(f"{pair['worse']} ({pair['difference_percent']:.1f}%)")
    text = "; ".join(f"{better} below {listed(worse)}" for better, worse in known.items())
    return [*lines, f"Differences larger than their noise: {text or 'none'}."]


SIZES = (
    ("scene.h5", "Mpx of the working grid", "scene.h5:elevation"),
    ("crops.h5", "", ""),
    ("pairs.h5", "pair", "pairs.h5:elevation"),
    ("checkpoint_0.h5", "", ""),
    ("svbrdf.h5", "Mpx", "svbrdf.h5:elevation"),
    ("svbrdf.tif", "Mpx", "svbrdf.h5:elevation"),
    ("svbrdf_albedo.h5", "Mpx", "svbrdf_albedo.h5:elevation"),
    ("evaluation.h5", "crop", "evaluation.h5:measured"),
    ("render.exr", "Mpx", "svbrdf.h5:elevation"),
    ("view.html", "Mpx", "svbrdf.h5:elevation"),
)


def sizes(root: Path) -> list[str]:
    """Bytes of the demo's files, and of each unit in them."""
    import h5py

    rows = []
    for name, unit, variable in SIZES:
        try:
            size = (root / "demo-full" / name).stat().st_size
            per = "-"
            if variable:
                file, path = variable.split(":")
                with h5py.File(root / "demo-full" / file) as opened:
                    shape = opened[path].shape
                amount = shape[0] if len(shape) == 3 else shape[0] * shape[1] / 1e6
                per = (
                    f"{size / amount / 1e3:,.0f} kB a {unit}"
                    if len(shape) == 3
                    else f"{size / amount / 1e6:.1f} MB a {unit}"
                )
        except FileNotFoundError:
            raise Absent(f"demo-full/{name}", DEMO) from None
        rows.append([f"`{name}`", f"{size / 1e6:.1f} MB", per])
    return table(["file of the demo", "size", "each"], rows)


# Tycho: a DEM of 95 x 90 km at 1 m worked on at 5 m, 667 images of 5,000 x 50,000 px and the Lunar-G2R paper's pairs.
# Global: the Moon at 100 m and a tenth of overlap, in local maps. (stage, work at Tycho, at global scale, in the table's unit)
CAMPAIGNS = (
    ("ingest", 8550.0, 4180.0),
    ("ingest --images", 667 * 250.0, None),
    ("sample", 83.614, None),
    ("project", 83.614, None),
    ("train", 66.662, None),
    ("infer", 342.0, 4180.0),
    ("render", 342.0, 4180.0),
    ("evaluate", 8.337, None),
)


def detail(root: Path) -> list[str]:
    """Invented relief beside real: features in pictures, and power about the Nyquist frequency."""
    found = read(root, "results/detail.json", "python tests/validation/detail.py")
    names = ("whole", "with detail", "without")
    features = [
        [f"SIFT features a km2, Sun at {sun:g} deg", *(f"{found['sift_per_km2'][name][k]:.0f}" for name in names)]
        for k, sun in enumerate(found["suns_deg"])
    ]
    power = [
        [
            f"power of {kind}, octave {side} Nyquist",
            "1",
            *(f"{found['power_of_whole'][kind][name][k]:.2f}" for name in names[1:]),
        ]
        for kind in ("slope", "brightness")
        for k, side in enumerate(("below", "above"))
    ]
    return table(["", "whole DEM", "with detail", "without"], features + power)


def campaigns(root: Path) -> list[str]:
    """Processor time of large work, from the rates that bench_scaling measured and wrote into the page."""
    try:
        text = (root / "docs" / "resources.md").read_text()
    except FileNotFoundError:
        raise Absent("docs/resources.md", SCALING) from None
    rates = {m[1]: (m[2], float(m[3]), m[4]) for m in RATE.finditer(text)}
    rows = []
    for stage, *works in CAMPAIGNS:
        if stage not in rates:
            raise Absent(f"the rate of {stage}", SCALING)
        peaks, rate, unit = rates[stage]
        memory = max(float(p.replace(",", "")) for p in peaks.split(", ")) / 1e3
        times = ["" if work is None else duration(rate * work) for work in works]
        rows.append(
            [
                f"`{stage}`",
                f"{works[0]:,.3g} {unit}" if works[0] < 1e3 else f"{works[0]:,.0f} {unit}",
                *times,
                f"{memory:.1f} GB",
            ]
        )
    return table(["stage", "work at Tycho", "Tycho", "global 100 m map", "memory"], rows)


RATE = re.compile(r"^\| ?`([a-z -]+)` ?\|[^|]*\| ?([^|]*?) ?\|.*\| ?([0-9.]+) s per ([^|]*?) ?\|$", re.M)


def duration(seconds: float) -> str:
    return f"{seconds / 60:.1f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h"


KINDS = (
    ("real photographs", lambda row: row["data"] == "photographs"),
    ("simulators by other people, law given", lambda row: row["law"] == "given" and row["data"] != "own scenes"),
    ("simulators by other people, law unknown", lambda row: row["law"] == "unknown" and row["data"] != "own scenes"),
    ("own scenes", lambda row: row["data"] == "own scenes"),
)


def diagnose_campaigns(root: Path) -> list[str]:
    """Sums over the campaigns of diagnose, from the list that docs/diagnose_campaigns.csv keeps."""
    try:
        listed_rows = list(csv.DictReader((root / "docs" / "diagnose_campaigns.csv").read_text().splitlines()))
    except FileNotFoundError:
        raise Absent("docs/diagnose_campaigns.csv", "make campaign") from None
    rows = []
    for version, name in (("current", "this version"), ("earlier", "earlier versions")):
        for kind, belongs in KINDS:
            chosen = [row for row in listed_rows if row["version"] == version and belongs(row)]
            if chosen:
                found = [share(chosen, *columns) for columns in (
                    ("false_names", "nulls"), ("named_first", "plants"), ("another_first", "plants"), ("faults_in_words", "faults"))]  # fmt: skip
                rows.append([f"{kind}, {name}", *found])
    columns = ("data", "name although nothing was planted", "planted effect named first", "another effect named first")
    return table([*columns, "camera fault described"], rows)


def share(rows: list[dict[str, str]], part: str, whole: str) -> str:
    """'34 of 77 (44 %)', over the rows that have both numbers."""
    both = [(int(row[part]), int(row[whole])) for row in rows if row[part] and row[whole]]
    some, every = (sum(numbers) for numbers in zip(*both, strict=True)) if both else (0, 0)
    return f"{some} of {every} ({100 * some / every:.0f} %)" if every else "-"


BLOCKS: dict[str, Callable[[Path], list[str]]] = {
    "three-results": three_results,
    "demo-rows": demo_rows,
    "demo-albedo": lambda root: held_out(root, "demo-full/held_out_all.json", ALBEDO),
    "demo-albedo-match": lambda root: matched(root, "demo-full/match_albedo.json", ALBEDO),
    "demo-match": lambda root: matched(root, "demo-full/match.json", DEMO),
    "demo-diagnosis": lambda root: diagnosed(root, "demo-full", DEMO),
    "apollo15": lambda root: brief(root, "results/apollo15"),
    "apollo15-cubes": lambda root: brief(root, "results/apollo15_cubes"),
    "apollo15-held-out": lambda root: held_out(root, "results/apollo15/held_out.json", APOLLO),
    "apollo15-diagnosis": lambda root: diagnosed(root, "results/apollo15", APOLLO),
    "models": models,
    "diagnose-campaigns": diagnose_campaigns,
    "demo-sizes": sizes,
    "campaigns": campaigns,
    "detail": detail,
}


def block(name: str, root: Path, before: str) -> str:
    """The text between the markers; ``before`` where its file is absent. Raises KeyError for an unknown name."""
    try:
        lines = BLOCKS[name](root)
    except Absent as absent:
        file, command = absent.args
        if before.strip():
            print(f"{name}: kept as it is; `{command}` makes {file}", file=sys.stderr)
            return before
        lines = [f"*No figures yet: `{command}` makes `{file}`, then `make figures` writes them here.*"]
    return "\n" + "\n".join(lines).strip("\n") + "\n\n"


def rewrite(text: str, root: Path) -> str:
    """A page with all its blocks as the files of ``root`` have them."""
    return BLOCK.sub(lambda found: found[1] + block(found[2], root, found[3]) + found[4], text)


def main(root: Path) -> None:
    for page in (root / "README.md", *sorted((root / "docs").glob("*.md"))):
        before = page.read_text()
        try:
            after = rewrite(before, root)
        except (KeyError, TypeError, ValueError) as error:
            print(
                f"{page.name}: a figure's file is not as its command writes it ({type(error).__name__}: {error}); run it again.",
                file=sys.stderr,
            )
            raise SystemExit(3) from None
        if after != before:
            page.write_text(after)
            print(page)


if __name__ == "__main__":
    main(ROOT)
    import runpy

    runpy.run_path(str(ROOT / "examples" / "figure_pictures.py"), run_name="__main__")
