"""Peak memory and time of every stage against the size of its input: memory should stay flat, and time grow in proportion.

    python tests/validation/benchmarks/bench_scaling.py [--stages ingest,infer] [--largest] [--sizes infer=4000,8000,16000]
                                             [--folder SCRATCH] [--json FILE] [--docs docs/resources.md]

Every figure is of the actual `lunargr` command in a process of its own: its peak resident memory as the kernel counts
it (VmHWM), processor time (user + system, of all threads) and wall time. The largest sizes need 60 GB of disk and hours.

- memory: peak at the largest size over the peak at the smallest.
- line: how far processor time at a size in the middle is from the straight line between the smallest and the largest.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
import scaling_inputs as make

MAP_GSD, CROP = 5.0, 128
MARKS = ("<!-- scaling: begin -->", "<!-- scaling: end -->")


@dataclass
class Run:
    """One command. size : in the stage's unit; work : what time is in proportion to."""

    size: int
    work: float
    peak_mb: float
    cpu_s: float
    wall_s: float
    output_mb: float


@dataclass
class Curve:
    stage: str
    what: str
    unit: str
    runs: list[Run] = field(default_factory=list)

    @property
    def memory(self) -> float:
        return self.runs[-1].peak_mb / self.runs[0].peak_mb

    @property
    def line(self) -> float:
        """Largest relative distance from the straight line, in processor time; with its sign."""
        first, last = self.runs[0], self.runs[-1]
        found = 0.0
        for run in self.runs[1:-1]:
            share = (run.work - first.work) / (last.work - first.work)
            expected = first.cpu_s + share * (last.cpu_s - first.cpu_s)
            found = max(found, run.cpu_s / expected - 1, key=abs)
        return found

    @property
    def rate(self) -> float:
        first, last = self.runs[0], self.runs[-1]
        return (last.cpu_s - first.cpu_s) / (last.work - first.work)


def measure(command: list[object], output: Path) -> tuple[float, float, float, float]:
    """(peak MB, processor seconds, wall seconds, MB written) of a `lunargr` command."""
    words = [*make.LUNARGR, *map(str, command), "-o", str(output), "--overwrite", "--quiet"]
    began = time.monotonic()
    pid = os.posix_spawn(words[0], words, os.environ)
    peak = 0
    while True:
        try:  # the kernel keeps the maximum; it is only gone when the process is
            with open(f"/proc/{pid}/status") as status:
                peak = max([peak, *(int(line.split()[1]) for line in status if line.startswith("VmHWM"))])
        except OSError:
            pass
        ended, code, usage = os.wait4(pid, os.WNOHANG)
        if ended:
            break
        time.sleep(0.01)
    wall = time.monotonic() - began
    if code:
        raise SystemExit(f"{' '.join(words)}: ended with {os.waitstatus_to_exitcode(code)}")
    written = sum(p.stat().st_size for p in output.parent.glob(f"{output.stem}.*")) / 1e6
    return peak / 1024, usage.ru_utime + usage.ru_stime, wall, written


class Bench:
    """Inputs, each made when first asked for, in a scratch folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def file(self, name: str, write: Callable[[Path], object]) -> Path:
        path = self.folder / name
        if not path.exists():
            print(f"  ({name})", file=sys.stderr, flush=True)
            write(path)
        return path

    def dem(self, edge: int, gsd: float) -> Path:
        return self.file(
            f"dem-{edge}-{gsd:g}.tif",
            lambda p: make.write_raster(p, make.relief(gsd), edge, edge, gsd, tiled=True),
        )

    def image(self, lines: int, gsd: float = 1.0) -> Path:
        tile = make.brightness(make.relief(gsd), gsd)
        return self.file(f"image-{lines}.tif", lambda p: make.write_raster(p, tile, lines, 5000, gsd, tiled=False))

    def table(self, lines: int, images: int = 1) -> Path:
        image = self.image(lines)
        return self.file(f"images-{lines}-{images}.csv", lambda p: make.write_table(p, [image] * images))

    def ground(self, edge: int) -> Path:
        """A scene without images at the working GSD."""

        def write(path: Path) -> None:
            dem = self.dem(edge, MAP_GSD)
            make.lunargr("ingest", dem, "-o", path, "--quiet")
            dem.unlink()

        return self.file(f"ground-{edge}.h5", write)

    def scene(self, images: int = 4, lines: int = 25000) -> Path:
        """A strip of ground under a few long images, or under many shorter ones."""
        table = self.table(lines, images)
        name = "scene.h5" if images == 4 else f"scene-{images}.h5"
        return self.file(
            name, lambda p: make.lunargr("ingest", self.ground(6000), "--images", table, "-o", p, "--quiet")
        )

    def crops(self, count: int, images: int = 4, lines: int = 25000) -> Path:
        scene = self.scene(images, lines)
        options = ["--crop", CROP, "--count", count, "--tile-m", 2000, "--quiet"]
        name = f"crops-{count}.h5" if images == 4 else f"crops-{count}-{images}.h5"
        return self.file(name, lambda p: make.lunargr("sample", scene, *options, "-o", p))

    def some_pairs(self) -> Path:
        return self.file("pairs.h5", lambda p: make.lunargr("project", self.crops(256), "-o", p, "--quiet"))

    def pairs(self, count: int) -> Path:
        return self.file(f"pairs-{count}.h5", lambda p: make.repeat_pairs(self.some_pairs(), count, p))

    def stack(self, count: int) -> Path:
        """Pairs for diagnose: places that many images show, from the embedded scene."""

        def few(path: Path) -> None:
            home = self.folder / "embedded"
            make.lunargr("simulate", "-o", home, "--size-px", 768, "--images", 12, "--quiet", "--overwrite")
            scene, crops = home / "scene.h5", home / "crops.h5"
            make.lunargr("ingest", home / "dem.tif", "--images", home / "images.csv", "--gsd", 5, "-o", scene, "-q")
            make.lunargr("sample", scene, "--stack", "--count", 4, "--tile-m", 640, "-o", crops, "--quiet")
            make.lunargr("project", crops, "-o", path, "--quiet")

        stack = self.file("stack.h5", few)
        return self.file(f"stack-{count}.h5", lambda p: make.repeat_pairs(stack, count, p, places=True))

    def checkpoint(self) -> Path:
        options = ["--epochs", 1, "--model", "M2", "--device", "cpu", "--quiet"]
        return self.file("checkpoint.h5", lambda p: make.lunargr("train", self.some_pairs(), *options, "-o", p))

    def map(self, edge: int) -> Path:
        return self.file(f"map-{edge}.h5", lambda p: make.write_map(self.ground(edge), p))

    def strips(self, edge: int) -> Path:
        """The scene of a map under tilted strips."""

        def write(path: Path) -> None:
            table = make.write_table(path.with_suffix(".csv"), make.write_strips(self.folder, edge, MAP_GSD))
            options = ["--skip-outside", "--crop", CROP, "--quiet"]
            make.lunargr("ingest", self.ground(edge), "--images", table, *options, "-o", path)

        return self.file(f"strips-{edge}.h5", write)


@dataclass(frozen=True)
class Stage:
    """sizes : tried by default, and with --largest; command(bench, size) -> arguments; work(size) in ``unit``."""

    what: str
    unit: str
    sizes: tuple[int, ...]
    largest: tuple[int, ...]
    command: Callable[[Bench, int], list[object]]
    work: Callable[[int], float]
    suffix: str = ".h5"


def mpx(edge: int) -> float:
    return edge * edge / 1e6


def one(size: int) -> float:
    return size / 1e3


STAGES = {
    "ingest": Stage(
        "DEM at 1 m to 5 m, edge in px", "Mpx", (6000, 12000, 18000), (10000, 20000, 40000),
        lambda b, n: ["ingest", b.dem(n, 1.0), "--gsd", 5], mpx,
    ),
    "ingest --images": Stage(
        "image of 5,000 px by lines", "Mpx", (6000, 12500, 25000), (12500, 25000, 50000),
        lambda b, n: ["ingest", b.ground(12000), "--images", b.table(n)], lambda n: 5e-3 * n,
    ),
    "sample": Stage(
        "crops", "thousand crops", (2000, 6000, 12000), (10000, 40000, 100000),
        lambda b, n: ["sample", b.scene(), "--count", n, "--crop", CROP, "--tile-m", 2000], one,
    ),
    "project": Stage(
        "pairs", "thousand pairs", (250, 500, 1000), (1000, 4000, 20000),
        lambda b, n: ["project", b.crops(n)], one,
    ),
    "project images": Stage(
        "images of 6,000 lines, 100 pairs of each", "images", (8, 16, 32), (16, 64, 256),
        lambda b, n: ["project", b.crops(100 * n, n, 6000)], float,
    ),
    "train": Stage(
        "pairs, one epoch of a small network", "thousand pairs", (1024, 2048, 4096), (10240, 40960, 102400),
        lambda b, n: ["train", b.pairs(n), "--epochs", 1, "--widths", "4-4", "--batch", 64, "--device", "cpu"], one,
    ),
    "infer": Stage(
        "map at 5 m, edge in px", "Mpx", (2000, 4000, 6000), (6000, 12000, 18000),
        lambda b, n: ["infer", b.ground(n), b.checkpoint(), "--device", "cpu"], mpx,
    ),
    "albedo": Stage(
        f"map at 5 m under {make.LOOKS} images, edge in px", "Mpx", (768, 1536, 3072), (1536, 3072, 6144),
        lambda b, n: ["albedo", b.map(n), b.strips(n)], mpx,
    ),
    "render": Stage(
        "map at 5 m, edge in px", "Mpx", (2000, 4000, 6000), (6000, 12000, 18000),
        lambda b, n: ["render", b.map(n), "--sun-azimuth", 100, "--sun-elevation", 20], mpx, ".exr",
    ),
    "evaluate": Stage(
        "pairs, all scored", "thousand pairs", (512, 1024, 2048), (10240, 40960, 102400),
        lambda b, n: ["evaluate", b.pairs(n), b.checkpoint(), "--split", "train", "--fit-pairs", 256, "--device", "cpu"],
        one,
    ),
    "merge": Stage(
        "pairs in parts of 256", "thousand pairs", (2048, 4096, 8192), (10240, 40960, 102400),
        lambda b, n: ["merge", *[b.some_pairs()] * (n // 256)], one,
    ),
    "diagnose": Stage(
        "pairs of the file, at most 384 looked at", "thousand pairs", (48, 96, 192), (384, 1920, 10240),
        lambda b, n: ["diagnose", b.stack(n), "--model", "M2"], one,
    ),
}  # fmt: skip


def run_stage(bench: Bench, name: str, sizes: tuple[int, ...]) -> Iterator[Run]:
    stage = STAGES[name]
    for size in sizes:
        command = stage.command(bench, size)
        with tempfile.TemporaryDirectory(dir=bench.folder) as folder:
            found = measure(command, Path(folder) / f"out{stage.suffix}")
        yield Run(size, stage.work(size), *found)


def table(curves: list[Curve]) -> str:
    """Markdown."""
    lines = [
        "| stage | sizes | peak memory, MB | largest / smallest | processor time, s | off the straight line | per unit |",
        "|---|---|---|---|---|---|---|",
    ]
    for curve in curves:
        sizes, peaks, times = (
            ", ".join(f"{v:,.0f}" for v in values)
            for values in zip(*((r.size, r.peak_mb, r.cpu_s) for r in curve.runs), strict=True)
        )
        lines.append(
            f"| `{curve.stage}` | {curve.what}: {sizes} | {peaks} | {curve.memory:.2f} | {times} | {100 * curve.line:+.0f} % "
            f"| {curve.rate:.3g} s per {curve.unit} |"
        )
    return "\n".join(lines)


def draw(curves: list[Curve], path: Path) -> None:
    """Time and memory against size, each as a share of the largest size tried."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image

    figure, (left, right) = plt.subplots(1, 2, figsize=(8.6, 3.6), constrained_layout=True)
    for k, curve in enumerate(curves):
        share = [r.work / curve.runs[-1].work for r in curve.runs]
        style = {"marker": "o", "markersize": 3.5, "linewidth": 1.2, "color": f"C{k}"}
        left.plot(share, [r.cpu_s / curve.runs[-1].cpu_s for r in curve.runs], **style)
        last = f"{curve.runs[-1].work:,.0f} {curve.unit}"
        right.plot(share, [r.peak_mb / 1024 for r in curve.runs], label=f"{curve.stage} (1 = {last})", **style)
    left.plot([0, 1], [0, 1], color="0.8", linewidth=3, zorder=0)
    left.set(
        xlabel="size / largest size", ylabel="processor time / that of the largest", xlim=(0, 1.05), ylim=(0, 1.05)
    )
    right.set(xlabel="size / largest size", ylabel="peak memory, GiB", xlim=(0, 1.05))
    right.set_ylim(bottom=0)
    figure.legend(loc="outside right center", fontsize=7, frameon=False)
    figure.savefig(path, dpi=100)
    plt.close(figure)
    with Image.open(path) as picture:  # few colours: a third of the bytes
        small = picture.convert("RGB").quantize(64)
    small.save(path, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", help=f"comma-separated, of: {', '.join(STAGES)}")
    parser.add_argument("--largest", action="store_true", help="sizes as large as Tycho: hours, and 60 GB of disk")
    parser.add_argument("--sizes", action="append", default=[], metavar="STAGE=A,B,C", help="sizes of one stage")
    parser.add_argument("--folder", type=Path, help="where inputs are made, and kept (default: a temporary one)")
    parser.add_argument("--json", type=Path, help="write the figures; those of other stages in it stay")
    parser.add_argument("--docs", type=Path, help="write the table into this page, and its picture beside it")
    options = parser.parse_args()
    chosen = {name: (s.largest if options.largest else s.sizes) for name, s in STAGES.items()}
    chosen |= {k: tuple(map(int, v.split(","))) for k, _, v in (text.partition("=") for text in options.sizes)}
    names = options.stages.split(",") if options.stages else list(STAGES)
    if unknown := [n for n in (*names, *chosen) if n not in STAGES]:
        parser.error(f"unknown stage {', '.join(unknown)}; known: {', '.join(STAGES)}")
    known: dict[str, Curve] = {}
    if options.json and options.json.exists():
        for entry in json.loads(options.json.read_text())["curves"]:
            known[entry["stage"]] = Curve(**(entry | {"runs": [Run(**r) for r in entry["runs"]]}))
    scratch = options.folder or Path(tempfile.mkdtemp(prefix="scaling-"))
    scratch.mkdir(parents=True, exist_ok=True)
    try:
        for name in names:
            curve = known[name] = Curve(name, STAGES[name].what, STAGES[name].unit)
            print(f"{name}: {STAGES[name].what} (load {os.getloadavg()[0]:.1f})", flush=True)
            for run in run_stage(Bench(scratch), name, chosen[name]):
                curve.runs.append(run)
                print(
                    f"  {run.size:>8,}: {run.peak_mb:7.0f} MB, {run.cpu_s:8.1f} s of processor time, {run.wall_s:8.1f} s, "
                    f"{run.output_mb:8.0f} MB written",
                    flush=True,
                )
            if options.json:
                entries = [asdict(known[n]) for n in STAGES if n in known]
                options.json.write_text(json.dumps({"curves": entries}, indent=1) + "\n")
    finally:
        if options.folder is None:
            shutil.rmtree(scratch, ignore_errors=True)
    curves = [known[n] for n in STAGES if n in known]
    print("\n" + table(curves))
    if options.docs:
        text = options.docs.read_text()
        before, after = text.partition(MARKS[0])[0], text.partition(MARKS[1])[2]
        options.docs.write_text(f"{before}{MARKS[0]}\n{table(curves)}\n{MARKS[1]}{after}")
        draw(curves, options.docs.parent / "images" / "scaling.png")


if __name__ == "__main__":
    main()
