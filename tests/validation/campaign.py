"""`make campaign`: plant every effect in hidden scenes, name it blindly, and write what came out into docs.

    python tests/validation/campaign.py --seed 7 --scenes 10 --nulls 40 --jobs 2 --output results/campaign

Writes OUTPUT.json (every case, as it comes), OUTPUT.md (tables) and OUTPUT.png (planted against named); cases that OUTPUT.json
holds already are not done again. Seeds of a final campaign are drawn once, after the code is frozen; development uses others.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from hidden.drawn import drawn
from hidden.laws import LAWS
from hidden.scene import Layout, Scene, Truth, write_pairs
from hidden.size import strength
from hidden.worlds import WORLDS
from sure_names import doubtful

# effect -> parameters at full strength; weaker plants multiply the first one
PLANTS: dict[str, dict] = {
    "misregistration": {"rms_px": 1.0},
    "dem_smoothing": {"sigma2_px2": 1.5},
    "dem_scale": {"relative": 0.12},
    "line_jitter": {"rms_px": 0.5},
    "sun_elevation": {"error_deg": 1.5},
    "sun_azimuth": {"error_deg": 3.0},
    "penumbra": {"radius_deg": 2.0},
    "distant_shadow": {"height_m": 120.0, "side": "west", "distance_m": 300.0},  # in a campaign: by the crop's size
    "interreflection": {"strength": 1.0},
    "earthshine": {"irradiance": 0.002, "elevation_deg": 50.0, "azimuth_deg": 120.0},
    "opposition_surge": {"B0": 0.3, "h": 0.06},
    "phase_slope": {"per_radian": 0.08},
    "limb_darkening": {"share": 0.15},
    "macroscopic_roughness": {"theta_bar_deg": 18.0},
    "slope_albedo": {"per_std": 0.05},
    "elevation_albedo": {"per_std": 0.06},
    "curvature_albedo": {"per_std": 0.04},
    "albedo_map": {"per_std": 0.10},
    "azimuthal_anisotropy": {"east": 0.02, "north": 0.01},
    "image_gain": {"rms": 0.02},
    "dark_bias": {"iof": 0.001},
    "nonlinearity": {"quadratic": 1.0},
    "psf_blur": {"sigma2_px2": 0.8},
    "column_pattern": {"rms": 0.03},
    "echo": {"fraction": 0.05, "lag_px": 6},
    "saturation": {"iof": 0.085},
}
PAIRED = ("phase_slope", "limb_darkening", "column_pattern", "image_gain", "line_jitter", "echo")
LOOSE = {"opposition_surge": 0.3, "interreflection": 0.3}  # bars on parameters other than 10 %
UNKNOWN = {  # effects that the catalogue has not
    "banding": {"amplitude": 0.01, "period": 7.0},
    "ghost": {"share": 0.03},
    "hot_columns": {"share": 0.02, "every": 8},
    "motion": {"px": 3},
    "stray_light": {"share": 0.1, "px": 12.0},
    "blooming": {"above": 1.3, "share": 0.5, "px": 9},
    "compression": {"step": 0.03},
}


def random_world(rng: np.random.Generator) -> dict:
    """Imperfections that every data set has."""
    return {
        "texture": float(rng.uniform(0.015, 0.04)),
        "texture_power": float(rng.uniform(2.0, 3.0)),
        "dem_noise_deg": float(rng.uniform(0.2, 1.0)),
        "dem_smoothing": float(rng.uniform(0.0, 0.45)),
        "seam": float(rng.uniform(0, 0.2)),
        "misregistration": float(rng.uniform(0.1, 0.3)),
        "snr": float(rng.uniform(50, 100)),
    }


def diagnose(path: Path) -> dict:
    """The JSON that a user would get."""
    from stages import diagnose as stage

    return stage.run(path).answer.to_json()


def make(scene: Scene, effect: dict, seed: int, path: Path, law: str = "linear", kind: str = "usual") -> dict:
    """Write a case's pairs file; return its truth."""
    rng = np.random.default_rng((seed, 99))
    world = random_world(rng) | {"law": law} | WORLDS[kind][1]
    data = scene.make(Truth(effect=effect, **world), seed)
    write_pairs(path, data, scene.layout)
    fid, possible = 0.0, None
    if effect:
        fid, possible = strength(data, scene.make(Truth(**world), seed), scene.layout.gsd)
    return {
        "seed": seed,
        "scene": scene.layout.seed,
        "law": law,
        "world": kind,
        "planted": effect,
        "drawn": drawn(scene, Truth(effect=effect, **world), seed),
        "fid": fid,
        "possible_gain_percent": possible,
    }


def case(scene: Scene, effect: dict, seed: int, folder: Path, law: str = "linear", kind: str = "usual") -> dict:
    """Make a case's file and diagnose it."""
    path = folder / "pairs.h5"
    truth = make(scene, effect, seed, path, law, kind)
    started = time.perf_counter()
    answer = diagnose(path)
    return truth | {"seconds": time.perf_counter() - started, "answer": answer}


def summarise(cases: list[dict]) -> str:
    """Markdown tables, every share with its counts."""
    lines = [
        "# Campaign of `lunargr diagnose`",
        "",
        "Written by `tests/validation/campaign.py`; every share is a count.",
        "",
    ]
    nulls = [c for c in cases if not c["planted"]]
    named = [c for c in nulls if c["answer"]["causes"]]
    lines += ["| | |", "|---|---|", f"| any cause named when nothing is hidden | {_share(len(named), len(nulls))} |"]
    lines.append(f"| verdicts on nulls | {dict(Counter(c['answer']['verdict'] for c in nulls))} |")
    lines.append(f"| what was named on nulls | {dict(Counter(c['answer']['causes'][0]['effect'] for c in named))} |")
    single = [c for c in cases if len(c["planted"]) == 1 and next(iter(c["planted"])) in PLANTS]
    first = [c for c in single if _first(c) == next(iter(c["planted"]))]
    group = [c for c in single if next(iter(c["planted"])) in _group(c)]
    lines.append(f"| planted cause named first | {_share(len(first), len(single))} |")
    lines.append(f"| planted cause within the group | {_share(len(group), len(single))} |")
    wrong = [c for c in single if _first(c) not in ("", next(iter(c["planted"])))]
    lines.append(f"| another cause named first | {_share(len(wrong), len(single))} |")
    for low in (0.03, 0.06):
        strong = [c for c in single if c["fid"] >= low]
        hits = [c for c in strong if _first(c) == next(iter(c["planted"]))]
        lines.append(f"| ... where it is at least {low} of the noise: named first | {_share(len(hits), len(strong))} |")
        near = [c for c in strong if next(iter(c["planted"])) in _group(c)]
        lines.append(
            f"| ... where it is at least {low} of the noise: within the group | {_share(len(near), len(strong))} |"
        )
    missed = [c for c in single if c["fid"] >= 0.03 and not c["answer"]["causes"]]
    said = [
        c for c in missed if c["answer"]["verdict"] == "cannot_tell" and set(c["planted"]) <= set(c["answer"]["blind"])
    ]
    lines.append(
        f"| ... at least 0.03, nothing named: `cannot_tell` with the cause in `blind` | {_share(len(said), len(missed))} |"
    )
    weak = [c for c in single if c["fid"] < 0.03]
    silent = [c for c in weak if c["answer"]["verdict"] == "nothing_significant"]
    lines.append(f"| weaker than 0.03: `nothing_significant` | {_share(len(silent), len(weak))} |")
    worth = [
        c["answer"]["held_out"]["gain_percent"] / c["possible_gain_percent"]
        for c in first
        if c["possible_gain_percent"] > 3 and c["answer"]["held_out"]["gain_percent"] is not None
    ]
    if worth:
        lines.append(
            f"| held-out gain over that of the world without the effect, median of {len(worth)} | {np.median(worth):.2f} |"
        )
    sizes = [(e, r) for c in first if c["fid"] >= 0.1 for e in c["planted"] for r in _ratios(e, [c])]
    close = [r for e, r in sizes if abs(r - 1) <= LOOSE.get(e, 0.1)]
    lines.append(
        "| first parameter within 10 % (opposition, interreflection 30 %), where at least 0.1 of the noise "
        f"| {_share(len(close), len(sizes))} |"
    )
    near = [r for c in first if c["fid"] >= 0.1 for r in _errors_off(next(iter(c["planted"])), c)]
    lines.append(f"| ... or within three of its errors | {_share(sum(r <= 3 for r in near), len(near))} |")
    double = [c for c in cases if len(c["planted"]) == 2]
    both = [c for c in double if set(c["planted"]) <= {x["effect"] for x in c["answer"]["causes"]}]
    third = [c for c in double if {x["effect"] for x in c["answer"]["causes"]} - set(c["planted"])]
    lines.append(f"| two planted: both named | {_share(len(both), len(double))} |")
    lines.append(f"| two planted: a spurious further cause | {_share(len(third), len(double))} |")
    strange = [c for c in cases if set(c["planted"]) & set(UNKNOWN)]
    said = [c for c in strange if c["answer"]["verdict"] == "unexplained"]
    wrong = [c for c in strange if c["answer"]["causes"]]
    lines.append(f"| outside the catalogue: `unexplained` | {_share(len(said), len(strange))} |")
    lines.append(f"| outside the catalogue: a name | {_share(len(wrong), len(strange))} |")
    lines += [f"| ... {_of_unknown(name, strange)}" for name in UNKNOWN if any(name in c["planted"] for c in strange)]
    lines += doubtful([c["answer"] for c in cases])
    seconds = [c["seconds"] for c in cases]
    lines.append(f"| seconds per diagnosis, median / largest | {np.median(seconds):.1f} / {max(seconds):.1f} |")
    lines += [
        "",
        "| planted | strength | over noise | named first | blind | verdicts | parameter, found / planted |",
        "|---|---|---|---|---|---|---|",
    ]
    for effect in PLANTS:
        for size in sorted({_strength(c) for c in single if effect in c["planted"]}):
            mine = [c for c in single if effect in c["planted"] and _strength(c) == size]
            hit = [c for c in mine if _first(c) == effect]
            blind = sum(effect in c["answer"]["blind"] for c in mine)
            verdicts = ", ".join(f"{k} {v}" for k, v in Counter(c["answer"]["verdict"] for c in mine).items())
            fid = " ".join(f"{c['fid']:.2f}" for c in mine)
            lines.append(
                f"| `{effect}` | {size:.3g} | {fid} | {len(hit)} of {len(mine)} | {blind} | {verdicts} | {_ratio(effect, hit)} |"
            )
    return "\n".join([*lines, *_by_world(cases)]) + "\n"


def _by_world(cases: list[dict]) -> list[str]:
    """A table of worlds, where there is more than the usual one."""
    worlds = list(dict.fromkeys(c["world"] for c in cases))
    if worlds == ["usual"]:
        return []
    lines = [
        "",
        "| world | nothing hidden: named | planted: named first | another first | a further cause | neither named nor blind |",
    ]
    lines.append("|---|---|---|---|---|---|")
    for world in worlds:
        nulls = [c for c in cases if c["world"] == world and not c["planted"]]
        single = [c for c in cases if c["world"] == world and len(c["planted"]) == 1 and c["fid"] >= 0.03]
        right = [c for c in single if _first(c) in c["planted"]]
        wrong = [c for c in single if _first(c) not in ("", *c["planted"])]
        more = [c for c in right if len(c["answer"]["causes"]) > 1]
        denied = [c for c in single if not _first(c) and not set(c["planted"]) <= set(c["answer"]["blind"])]
        shares = [_share(sum(bool(c["answer"]["causes"]) for c in nulls), len(nulls))]
        shares += [_share(len(part), len(single)) for part in (right, wrong, more, denied)]
        lines.append(f"| {world} | {' | '.join(shares)} |")
    return lines


def _of_unknown(name: str, strange: list[dict]) -> str:
    mine = [c for c in strange if name in c["planted"]]
    named = Counter(x["effect"] for c in mine for x in c["answer"]["causes"])
    said = sum(c["answer"]["verdict"] == "unexplained" for c in mine)
    fid = " ".join(f"{c['fid']:.2f}" for c in mine)
    return f"`{name}`, {fid} of the noise: `unexplained`; names | {said} of {len(mine)}; {dict(named)} |"


def _strength(c: dict) -> float:
    return float(next(iter(next(iter(c["planted"].values())).values())))


def _first(c: dict) -> str:
    return next((cause["effect"] for cause in c["answer"]["causes"]), "")


def _group(c: dict) -> list[str]:
    return next((cause["group"] for cause in c["answer"]["causes"]), [])


def _share(part: int, whole: int) -> str:
    return f"{part} of {whole} ({100 * part / whole:.0f} %)" if whole else "not run"


def _ratios(effect: str, hits: list[dict]) -> list[float]:
    """First parameter found over planted."""
    name = next(iter(PLANTS[effect]))
    return [
        c["answer"]["causes"][0]["parameters"][name]["value"] / c["drawn"].get(effect, c["planted"][effect][name])
        for c in hits
        if name in c["answer"]["causes"][0]["parameters"]
    ]


def _errors_off(effect: str, c: dict) -> list[float]:
    """How many of its errors the first parameter is away from what was planted."""
    name = next(iter(PLANTS[effect]))
    found = c["answer"]["causes"][0]["parameters"].get(name)
    if found is None or not found["error"]:
        return []
    return [abs(found["value"] - c["drawn"].get(effect, c["planted"][effect][name])) / found["error"]]


def _ratio(effect: str, hits: list[dict]) -> str:
    found = _ratios(effect, hits)
    return f"{np.median(found):.2f} ({min(found):.2f} .. {max(found):.2f})" if found else "-"


def picture(cases: list[dict], path: Path) -> None:
    """Planted (rows) against named first (columns)."""
    from matplotlib.figure import Figure

    names = list(PLANTS)
    rows, columns = [*names, "nothing", *UNKNOWN], [*names, "no name", "unexplained"]
    table = np.zeros((len(rows), len(columns)))
    for c in cases:
        if len(c["planted"]) > 1:
            continue
        row = next(iter(c["planted"]), "nothing")
        first = _first(c)
        column = first or ("unexplained" if c["answer"]["verdict"] == "unexplained" else "no name")
        table[rows.index(row), columns.index(column)] += 1
    share = table / np.maximum(table.sum(1, keepdims=True), 1)
    figure = Figure(figsize=(11, 11), layout="constrained")
    axis = figure.subplots()
    axis.imshow(share, cmap="Blues", vmin=0, vmax=1)
    axis.set_xticks(range(len(columns)), columns, rotation=90)
    axis.set_yticks(range(len(rows)), rows)
    axis.set_xlabel("named first")
    axis.set_ylabel("planted")
    for r, c in zip(*np.nonzero(table), strict=True):
        axis.text(c, r, int(table[r, c]), ha="center", va="center", color="white" if share[r, c] > 0.5 else "black")
    figure.savefig(path, dpi=110)


def draw_layout(rng: np.random.Generator, options: argparse.Namespace, kind: str = "usual") -> Layout:
    """A scene: from smooth mare to rugged highland, of any scale."""
    usual = Layout(
        seed=int(rng.integers(2**31)), sites=options.sites, images=options.images, size=options.size,
        slope_deg=float(np.exp(rng.uniform(np.log(5), np.log(16)))), gsd=float(rng.choice([2.0, 5.0, 20.0])),
        sun_elevations=(float(rng.uniform(6, 14)), float(rng.uniform(55, 75))),
    )  # fmt: skip
    return replace(usual, **WORLDS[kind][0])


def draw_jobs(rng: np.random.Generator, layout: Layout, options: argparse.Namespace) -> list[tuple[int, dict]]:
    """(seed, what is hidden) of every case of a scene."""
    jobs: list[dict] = [{} for _ in range(options.nulls)]
    crop = layout.size * layout.gsd
    wall = {"height_m": 0.19 * crop, "side": "west", "distance_m": 0.45 * crop}
    effects = list(PLANTS) if options.only is None else options.only
    if options.draw:
        effects = rng.choice(effects, options.draw, replace=False).tolist()
    for effect, values in (PLANTS | {"distant_shadow": wall}).items():
        if effect not in effects:
            continue
        key = next(iter(values))
        strengths = [1.0] if effect == "saturation" else options.strengths  # a level, not a size
        jobs += [{effect: {**values, key: values[key] * s}} for s in strengths for _ in range(options.plants)]
    unknown = list(UNKNOWN)
    if options.draw or options.only is not None:
        unknown = rng.choice(unknown, options.unknown, replace=False).tolist() if options.unknown else []
    jobs += [{k: UNKNOWN[k]} for k in unknown for _ in range(options.plants)]
    if options.only is None and not options.draw:
        for _ in range(options.doubles):
            jobs.append({str(k): PLANTS[str(k)] for k in rng.choice(PAIRED, 2, replace=False)})
    return [(int(rng.integers(2**31)), job) for job in jobs]


def draw_law(seed: int, laws: list[str]) -> str:
    return laws[int(np.random.default_rng((seed, 98)).integers(len(laws)))]


def _go_with_the_parent(parent: int) -> None:
    """A worker whose campaign was killed would go on with the queue."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def work(layout: Layout, cache: Path, seed: int, job: dict, law: str, kind: str) -> dict:
    """One case in a process of its own, on one thread."""
    import torch

    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        scene = scene_of(layout, cache)
        return case(scene, aimed(job, scene), seed, Path(name), law, kind)


@lru_cache(maxsize=4)
def scene_of(layout: Layout, cache: Path) -> Scene:
    """A scene stays for the cases after it."""
    return Scene(layout, cache)


def aimed(job: dict, scene: Scene) -> dict:
    """A far wall stands on the side of the lowest Sun: where none reaches an image there is nothing to find."""
    if "distant_shadow" not in job:
        return job
    lowest = min(scene.suns, key=lambda sun: sun[2])
    side = ("north", "east", "south", "west")[round(np.degrees(np.arctan2(lowest[0], lowest[1])) / 90) % 4]
    return {**job, "distant_shadow": {**job["distant_shadow"], "side": side}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--scenes", type=int, default=2)
    parser.add_argument("--nulls", type=int, default=20, help="per scene")
    parser.add_argument("--plants", type=int, default=1, help="per effect, strength and scene")
    parser.add_argument("--strengths", type=float, nargs="+", default=[1.0])
    parser.add_argument("--doubles", type=int, default=4, help="per scene")
    parser.add_argument("--sites", type=int, default=5, help="the last one is the test split")
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--only", nargs="*", default=None, help="effects; none for nulls alone")
    parser.add_argument("--draw", type=int, default=0, help="effects per scene, drawn from these; 0 for all")
    parser.add_argument("--unknown", type=int, default=0, help="beside --draw or --only: so many that no catalogue has")
    parser.add_argument(
        "--laws",
        nargs="+",
        choices=tuple(LAWS),
        default=[law for law in LAWS if law != "linear"],
        help="of reflectance, one drawn per case; by default all but `linear`, which is a form of the program's",
    )
    parser.add_argument(
        "--worlds", nargs="+", choices=tuple(WORLDS), default=["usual"], help="one for each scene, in turn"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    record = options.output.with_suffix(".json")
    record.parent.mkdir(parents=True, exist_ok=True)
    cases: list[dict] = json.loads(record.read_text()) if record.exists() else []
    known = {(c["scene"], c["seed"]) for c in cases}
    with (
        tempfile.TemporaryDirectory() as cache,
        ProcessPoolExecutor(options.jobs, get_context("spawn"), _go_with_the_parent, (os.getpid(),)) as pool,
    ):
        for number in range(options.scenes):
            kind = options.worlds[number % len(options.worlds)]
            layout = draw_layout(rng, options, kind)
            todo = [(s, j) for s, j in draw_jobs(rng, layout, options) if (layout.seed, s) not in known]
            for future in as_completed(
                [pool.submit(work, layout, Path(cache), s, j, draw_law(s, options.laws), kind) for s, j in todo]
            ):
                done = future.result()
                cases.append(done)
                print(_line(done), flush=True)
                record.write_text(json.dumps(cases, indent=1))
            options.output.with_suffix(".md").write_text(summarise(cases))
            picture(cases, options.output.with_suffix(".png"))
    print(summarise(cases))


def _line(done: dict) -> str:
    answer = done["answer"]
    named = [(c["effect"], {k: p["value"] for k, p in c["parameters"].items()}) for c in answer["causes"]]
    return (
        f"{done['world']:15s} {done['law']:13s} {','.join(done['planted']) or 'nothing':24s} -> {answer['verdict']:20s} {named} "
        f"blind {answer['blind']} fid {done['fid']:.3f} {done['seconds']:.1f} s"
    )


if __name__ == "__main__":
    main()
