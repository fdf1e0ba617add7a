"""The options that commands share, each spelled and explained once."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from lunargr_cli.spelling import option_of
from schemas.errors import ConfigError
from schemas.files.outputs import Output
from schemas.later import without
from stages.train.config import SCHEDULES

Number = TypeVar("Number", int, float)

MOST = 2**31 - 1  # what counts pairs, pixels or crops
MOST_PARTS = 100_000  # of one stage: beyond it a part is less than its own overhead


def complete_model(incomplete: str) -> list[str]:
    """Names of reflectance models for the shell's completion ('lunargr --install-completion')."""
    with without("torch"):
        from stages.physics.photometry import model_names

        return [name for name in model_names() if name.startswith(incomplete)]


Config = TypeVar("Config")


def configure(config: type[Config], options: Mapping[str, Any], **converted: Any) -> Config:
    """A stage's Config from the options of a command that bear its fields' names.

    converted : fields by name whose options are written in another form
    """
    names = {field.name for field in dataclasses.fields(config)}  # type: ignore[arg-type]
    return config(**{name: value for name, value in options.items() if name in names} | converted)


OutputFile = Annotated[Path, typer.Option("--output", "-o", help="File to write.", show_default=True)]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")]
Shard = Annotated[
    str | None,
    typer.Option(
        "--shard", metavar="I/N", help="Do only part I of N, counted from 1; 'lunargr merge' joins the parts."
    ),
]
ResumeParts = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Keep finished parts after an interruption; the same command then does the rest.",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS|local:N",
        help="Run parts on Dask: N processes of this machine, or the workers of a scheduler. Keeps finished parts like --resume.",
    ),
]
Parts = Annotated[
    int | None,
    typer.Option(
        "--parts",
        metavar="N",
        min=1,
        max=MOST_PARTS,
        help="Number of parts with --scheduler or --resume (default: by size).",
    ),
]
Seed = Annotated[int, typer.Option("--seed", min=0, max=2**63 - 1, help="Seed of every random choice.")]
Device = Annotated[str, typer.Option("--device", help="cpu, cuda, cuda:1, ... or auto.")]
BodyOption = Annotated[
    str | None,
    typer.Option(
        "--body", metavar="NAME|METRES", help="Body by name, or its radius in metres (default: the Moon, 1737400)."
    ),
]
Json = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Also write the result as JSON.")]
GeoTiff = Annotated[
    Path | None,
    typer.Option("--geotiff", help="GeoTIFF to write (default: the output's name with .tif)."),
]
NoGeoTiff = Annotated[
    bool, typer.Option("--no-geotiff", help="Write only the HDF5 map; saves a seventh of the time on large maps.")
]
Register = Annotated[
    str | None,
    typer.Option(
        "--register",
        metavar="FORM",
        help="Align each image with its rendering: constant, affine or field, as in 'lunargr project'.",
    ),
]
# Of `train` and `compare`
Epochs = Annotated[int, typer.Option("--epochs", min=1, max=100_000, help="Passes over the training pairs.")]
Batch = Annotated[int, typer.Option("--batch", min=1, max=MOST, help="Pairs per step, over all processes.")]
LearningRate = Annotated[float, typer.Option("--lr", help="Adam's learning rate.")]
Schedule = Annotated[str, typer.Option("--schedule", help=f"Learning rate over the steps: {' or '.join(SCHEDULES)}.")]
Widths = Annotated[
    str, typer.Option("--widths", help="Channels of each stage of the U-Net; Lunar-G2R: 16-32-64-128-256.")
]
TrainingPrecision = Annotated[
    str, typer.Option("--precision", help="fp32, bf16, or auto: bf16 where the processor computes it faster.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")]


def check_numbers(command: Callable[..., None], options: Mapping[str, Any]) -> None:
    """No option of any command takes NaN or infinity. Raises ConfigError."""
    for name, value in options.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{option_of(command, name)}: expected a finite number, found {value}.")


def parse_shard(text: str | None) -> tuple[int, int]:
    """'2/8' -> (1, 8): zero-based index and count; None -> (0, 1). Raises ConfigError."""
    if text is None:
        return 0, 1
    first, _, last = text.partition("/")
    if all(part.isdecimal() and len(part) < 9 for part in (first, last)) and 1 <= int(first) <= int(last) <= MOST_PARTS:
        return int(first) - 1, int(last)
    raise ConfigError(f"--shard: expected I/N with 1 <= I <= N <= {MOST_PARTS}, found '{text}'.")


def read_numbers(option: str, text: str, kind: type[Number]) -> tuple[Number, ...]:
    """'16-32-64' -> (16, 32, 64). Raises ConfigError."""
    try:
        return tuple(kind(part) for part in text.split("-"))
    except ValueError:
        raise ConfigError(f"{option}: expected numbers like 8-16-32, found '{text}'.") from None


def join_numbers(numbers: Iterable[float]) -> str:
    """(16, 32, 64) -> '16-32-64', as :func:`read_numbers` reads it."""
    return "-".join(f"{number:g}" for number in numbers)


def read_names(option: str, text: str | None) -> tuple[str, ...]:
    """'w, b' -> ('w', 'b'); None -> (). Raises ConfigError for an empty name and one that comes twice."""
    if text is None:
        return ()
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise ConfigError(
            f"{option}: expected names separated by commas, found '{text}'; leave the option out for none."
        )
    return check_once(option, names)


def check_once(option: str, names: Iterable[str]) -> tuple[str, ...]:
    """The names of an option that lists them or may be repeated. Raises ConfigError where one comes twice."""
    found = tuple(names)
    for name in found:
        if found.count(name) > 1:
            raise ConfigError(f"{option}: expected each name once, found '{name}' twice; name it once.")
    return found


def make_map_output(options: Mapping[str, Any]) -> Output:
    """Where a map and its GeoTIFF go, from the options of a command. Raises ConfigError."""
    if (geotiff := options["geotiff"]) and options["no_geotiff"]:
        raise ConfigError(f"--geotiff {geotiff} and --no-geotiff: expected one of them, found both.")
    return make_output(options, geotiff=geotiff)


def read_list(option: str, text: str | None, counts: Sequence[int] = ()) -> tuple[float, ...] | None:
    """'3.6,25.8' -> (3.6, 25.8), as many numbers as one of ``counts``, or any; None -> None. Raises ConfigError."""
    if text is None:
        return None
    try:
        values = tuple(float(v) for v in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (counts or range(1, 1000)) or not all(math.isfinite(v) for v in values):
        wanted = f"{' or '.join(map(str, counts))} numbers" if counts else "numbers"
        raise ConfigError(f"{option}: expected {wanted} separated by commas, found '{text}'.")
    return values


def read_parameters(items: Iterable[str] | None) -> dict[str, float]:
    """['w=0.25,b=0.3'] -> {'w': 0.25, 'b': 0.3}. Raises ConfigError."""
    names, values = [], []
    for item in (part for text in items or () for part in text.split(",")):
        name, _, value = item.partition("=")
        try:
            values.append(float(value))
        except ValueError:
            raise ConfigError(f"--parameters: expected NAME=VALUE with a number, found '{item}'.") from None
        names.append(name.strip())
    return dict(zip(check_once("--parameters", names), values, strict=True))


def make_output(options: Mapping[str, Any], **others: Any) -> Output:
    """Where and how a stage writes, from the options of a command; others : fields with options of other names."""
    names = ("overwrite", "resume", "figures", "report", "scheduler", "parts")
    given = {name: options[name] for name in names if name in options}
    return Output(options.get("output"), json=options.get("json_file"), **given, **others)
