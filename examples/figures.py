"""Write every figure of an evaluation into README.md and docs/, from the files that commands left. Run: make figures

Between `<!-- figures:NAME -->` and `<!-- end -->` stands what the function of that name makes of demo-full/ and results/.
Where a file is absent the block names the command that makes it: no figure is kept from another run.
"""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from stages.common.page.diagnosis import conclusions as diagnosis_sentences  # noqa: E402
from stages.common.page.sentences import Sentence  # noqa: E402
from stages.report import conclusions  # noqa: E402
from stages.report.held_out import TITLES as MAPS  # noqa: E402

BLOCK = re.compile(r"(<!-- figures:([a-z0-9-]+) -->\n).*?(<!-- end -->)", re.S)
KNOWS = {
    "none": "nothing of the scored crops",
    "minmax": "each crop's range and mean",
    "gain": "each crop's gain",
    "gain_offset": "each crop's gain and offset",
}
BRIEF = ("learned", "global", "hapke_fitted", "hapke_raw", "hapke_minmax", "learned_gain_offset", "hapke_gain_offset")
DEMO, APOLLO, PAPER = "make demo-full", "make reproduce-apollo15", "make reproduce-models"
ALBEDO = "make demo-albedo"


class Absent(Exception):
    """A figure has no file to come from: (file, the command that makes it)."""


def read(root: Path, name: str, command: str) -> dict[str, Any]:
    try:
        return json.loads((root / name).read_text())
    except FileNotFoundError:
        raise Absent(name, command) from None


def table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    columns = list(columns)
    return ["", *(f"| {' | '.join(row)} |" for row in (columns, ["---"] * len(columns), *rows)), ""]


def with_bounds(value: float, low: float | None, high: float | None, spread: float | None = None) -> str:
    """'7.95e-5 +- 0.12 (5.78 .. 12.2)': bounds and spread with the exponent of the value."""
    power = math.floor(math.log10(value)) if value > 0 else 0
    text = f"{value / 10**power:.2f}" + (f"e{power}" if power else "")
    text += "" if spread is None else f" +- {spread / 10**power:.2f}"
    if low is None:
        return f"{text} (no interval)"
    low_text, high_text = ("unbounded" if x is None else f"{x / 10**power:#.3g}".removesuffix(".") for x in (low, high))
    return f"{text} ({low_text} .. {high_text})"


def bullets(sentences: list[Sentence]) -> list[str]:
    """Sentences as a list in Markdown."""
    return [f"- {text}" for text, _ in sentences]


def table_rows(result: dict[str, Any], names: Iterable[str], prefix: str = "") -> list[list[str]]:
    """Lines of an evaluation's table."""
    lines = []
    for name in names:
        row = result["models"][name]
        error = with_bounds(row["mse"], row["mse_low"], row["mse_high"], row.get("mse_run_std"))
        ssim = "-" if row.get("ssim") is None else f"{row['ssim']:.3f}"
        title = result.get("titles", {}).get(name, name)
        lines.append([prefix + title, KNOWS.get(row["freedom"], row["freedom"]), error, ssim])
    return lines


def evaluated(result: dict[str, Any], names: Iterable[str], more: list[list[str]]) -> list[str]:
    """A table of errors with what it rests on, and what it says."""
    unit = "I/F squared" if result["image_units"] == "iof" else "shares of the full DN range, squared"
    lines = [
        f"Model {result['model']}, {conclusions.basis(result)}, none of it seen in training. MSE in {unit}; +- is the standard deviation of "
        "training runs, in brackets 95 % intervals."
    ]
    rows = sorted(table_rows(result, names), key=lambda row: list(KNOWS.values()).index(row[1]))
    return (
        lines
        + table(["model", "what it may know", "MSE", "SSIM"], [*rows, *more])
        + bullets(conclusions.evaluation(result))
        + covered(result)
    )


def covered(result: dict[str, Any]) -> list[str]:
    """What the error bars hold."""
    found = result.get("coverage_percent")
    if not found:
        return []
    bands = [band["95"] for band in found.get("by_incidence", []) if band["pixels"]]
    spread = f"; by incidence those of 95 % hold {min(bands):.1f} to {max(bands):.1f} %" if bands else ""
    return [
        f"- Intervals that should hold 68 and 95 % of the pixels hold {found['68']:.1f} and {found['95']:.1f} %{spread}."
    ]


def brief(result: dict[str, Any]) -> list[str]:
    """The rows of a short table: the strongest baselines and the paper's among them."""
    wanted = {*BRIEF, *result.get("strongest_baseline", {}).values()}
    return [name for name in result["models"] if name in wanted]


def demo(root: Path) -> list[str]:
    result = read(root, "demo-full/evaluation.json", DEMO)
    return evaluated(result, brief(result), paper_row(root))


def paper_row(root: Path) -> list[list[str]]:
    """The paper's model and network, where they were trained on the same pairs."""
    try:
        other = read(root, "demo-full/m2.json", "make demo-paper")
    except Absent:
        return []
    runs = f"M2 with the paper's network ({conclusions.basis(other)}): "
    return table_rows(other, [name for name in other["models"] if name.startswith("learned")], runs)


def demo_rows(root: Path) -> list[str]:
    result = read(root, "demo-full/evaluation.json", DEMO)
    return evaluated(result, result["models"], paper_row(root))


def held_out(root: Path, name: str, command: str) -> list[str]:
    """Seen ground under unseen images."""
    result = read(root, name, command)
    rows = [
        [MAPS.get(name, name), with_bounds(row["mse"], row["mse_low"], row["mse_high"]),
         "-" if row.get("ssim") is None else f"{row['ssim']:.3f}"]
        for name, row in result["models"].items()
    ]  # fmt: skip
    unit = "" if result.get("image_units") == "iof" else " MSE in DN squared."
    lines = [f"Claim: {result['claim']}; {conclusions.basis(result)}, {len(result['images'])} images.{unit}"]
    lines += table(["map", "MSE", "SSIM"], rows) + bullets(conclusions.held_out_images(result))
    return lines + covered(result)


def matched(root: Path, name: str, command: str) -> list[str]:
    """Shares of matches within 1 px."""
    result = read(root, name, command)
    rows = []
    for matcher, renderings in result["matchers"].items():
        for name, row in renderings.items():
            share, low, high = (row[f"within_1_px_percent{end}"] for end in ("", "_low", "_high"))
            text = "-" if share is None else f"{share:.1f} %" + ("" if low is None else f" ({low:.1f} .. {high:.1f})")
            rows.append([matcher, name.replace("_", " "), str(row["matches"]), text])
    lines = [f"{result['crops']} crops on {result['tiles']} ground tiles, one training run, 95 % intervals over tiles."]
    return lines + table(["matcher", "rendering", "matches", "within 1 px"], rows)[:-1]


def diagnosed(root: Path, folder: str, command: str) -> list[str]:
    return bullets(diagnosis_sentences(read(root, f"{folder}/diagnosis.json", command)))


def apollo15(root: Path) -> list[str]:
    result = read(root, "results/apollo15/evaluation.json", APOLLO)
    return evaluated(result, brief(result), [])


def models(root: Path) -> list[str]:
    """The paper's comparison of reflectance models."""
    result = read(root, "results/models.json", PAPER)
    rows = []
    for name, row in result["models"].items():
        error = with_bounds(row["mse"], row["mse_low"], row["mse_high"], row["mse_seed_std"])
        paper = "-" if row.get("paper_mse_crop_sum") is None else f"{row['paper_mse_crop_sum']:.2f}"
        rows.append([name, error, f"{row['mse_crop_sum']:.4f}", paper])
    lines = [
        f"{result['crops']} validation crops on {result['tiles']} ground tiles, {result['seeds']} training runs each; +- is the standard "
        "deviation of runs, in brackets 95 % intervals over tiles and runs. The paper's figures are of its own pairs."
    ]
    lines += table(["model", "MSE", "MSE summed over a crop", "the paper's"], rows)
    known = [p for p in result["differences"] if p["larger_than_noise"]]
    text = "; ".join(f"{p['better']} below {p['worse']} by {p['difference_percent']:.1f} %" for p in known)
    return [*lines, f"Differences larger than their noise: {text or 'none'}."]


def commands(_: Path) -> list[str]:
    """What `make demo` runs, as make itself lists it, from within demo/."""
    listed = subprocess.run(
        ["make", "-nB", "D=demo", "demo/report.html"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    found = re.findall(r"^\.venv/bin/(lunargr (?:.*\\\n)*.*)$", listed, re.M)
    lines = "\n".join(found).replace(" --overwrite", "").replace(" --resume", "").replace("demo/", "")
    return [f"    {re.sub(r'(?<=[^ ]) +', ' ', re.sub(r'^ +', '    ', line))}".rstrip() for line in lines.splitlines()]


def benchmark(root: Path, name: str) -> list[str]:
    """What a benchmark printed, word for word."""
    try:
        printed = (root / f"results/bench/{name}.txt").read_text().rstrip()
    except FileNotFoundError:
        raise Absent(f"results/bench/{name}.txt", f"make bench ONLY={name.removeprefix('bench_')}") from None
    return ["```text", *printed.splitlines(), "```"]


SIZES = (
    ("scene.h5", "Mpx of the working grid", "scene.h5:elevation"),
    ("crops.h5", "pair", "crops.h5:elevation"),
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
    for name, unit, counted in SIZES:
        try:
            size = (root / "demo-full" / name).stat().st_size
            per = "-"
            if counted:
                file, variable = counted.split(":")
                with h5py.File(root / "demo-full" / file) as opened:
                    shape = opened[variable].shape
                number = shape[0] if len(shape) == 3 else shape[0] * shape[1] / 1e6
                per = (
                    f"{size / number / 1e3:,.0f} kB a {unit}"
                    if len(shape) == 3
                    else f"{size / number / 1e6:.1f} MB a {unit}"
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
    ("infer", 342.0, 4180.0),
    ("render", 342.0, 4180.0),
    ("evaluate", 8.337, None),
)


def campaigns(root: Path) -> list[str]:
    """Processor time of large work, from the rates that bench_scaling measured and wrote into the page."""
    try:
        text = (root / "docs" / "scaling.md").read_text()
    except FileNotFoundError:
        raise Absent("docs/scaling.md", "python tests/benchmarks/bench_scaling.py --docs docs/scaling.md") from None
    rates = {m[1]: (m[2], float(m[3]), m[4]) for m in RATE.finditer(text)}
    rows = []
    for stage, *works in CAMPAIGNS:
        if stage not in rates:
            raise Absent(f"the rate of {stage}", "python tests/benchmarks/bench_scaling.py --docs docs/scaling.md")
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


RATE = re.compile(r"^\| `([a-z -]+)` \| [^|]*\| ([^|]*?) \|.*\| ([0-9.]+) s per ([^|]*?) \|$", re.M)


def duration(seconds: float) -> str:
    return f"{seconds / 60:.1f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h"


BLOCKS: dict[str, Callable[[Path], list[str]]] = {
    "demo-commands": commands,
    "demo": demo,
    "demo-rows": demo_rows,
    "demo-held-out": lambda root: held_out(root, "demo-full/held_out.json", DEMO),
    "demo-albedo": lambda root: held_out(root, "demo-full/held_out_all.json", ALBEDO),
    "demo-albedo-match": lambda root: matched(root, "demo-full/match_albedo.json", ALBEDO),
    "demo-match": lambda root: matched(root, "demo-full/match.json", DEMO),
    "demo-diagnosis": lambda root: diagnosed(root, "demo-full", DEMO),
    "apollo15": apollo15,
    "apollo15-held-out": lambda root: held_out(root, "results/apollo15/held_out.json", APOLLO),
    "apollo15-match": lambda root: matched(root, "results/apollo15/match.json", APOLLO),
    "apollo15-diagnosis": lambda root: diagnosed(root, "results/apollo15", APOLLO),
    "models": models,
    "demo-sizes": sizes,
    "campaigns": campaigns,
    "bench-training": lambda root: benchmark(root, "bench_training"),
    "bench-layer": lambda root: benchmark(root, "bench_layer"),
    "bench-inference": lambda root: benchmark(root, "bench_inference"),
    "bench-view": lambda root: benchmark(root, "bench_view"),
}


def block(name: str, root: Path) -> str:
    """What stands between the markers. Raises KeyError for a block that nobody writes."""
    try:
        lines = BLOCKS[name](root)
    except Absent as absent:
        file, command = absent.args
        lines = [f"*No figures yet: `{command}` makes `{file}`, then `make figures` writes them here.*"]
    return "\n" + "\n".join(lines).strip("\n") + "\n\n"


def rewrite(text: str, root: Path) -> str:
    """A page with all its blocks as the files of ``root`` have them."""
    return BLOCK.sub(lambda found: found[1] + block(found[2], root) + found[3], text)


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
