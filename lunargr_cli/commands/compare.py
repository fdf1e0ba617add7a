"""`lunargr compare PAIRS`: train several reflectance models from several seeds and say which differences are real."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lunargr_cli.options import MOST, Device, Json, Overwrite, Quiet, Resume
from lunargr_cli.paths import Writes

NAME, ORDER = "compare", 72
ENDS = ("checkpoint.h5", "checkpoint.resume.h5")  # and the evaluation's


def command(
    pairs: Annotated[Path, typer.Argument(help="Pairs from 'lunargr project'.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for checkpoints, evaluations and the table."),
        Writes.FOLDER,
    ],
    models: Annotated[
        str, typer.Option("--models", help="Reflectance models, separated by commas.")
    ] = "M1,M2,M3,M4,M5,M6,kernels,hapke",
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, max=1000, help="Training runs of every model, from seeds 0, 1, ...")
    ] = 3,
    epochs: Annotated[int, typer.Option("--epochs", min=1, max=100_000, help="Passes over the training pairs.")] = 20,
    batch: Annotated[int, typer.Option("--batch", min=1, max=MOST, help="Pairs per training step.")] = 32,
    lr: Annotated[float, typer.Option("--lr", help="Adam's learning rate.")] = 3e-3,
    schedule: Annotated[
        str, typer.Option("--schedule", help="Learning rate over the steps: constant or cosine.")
    ] = "cosine",
    widths: Annotated[str, typer.Option("--widths", help="Channels of each stage of the U-Net.")] = "8-16-32",
    precision: Annotated[
        str, typer.Option("--precision", help="fp32, bf16, or auto: bf16 where a probe finds it faster.")
    ] = "auto",
    split: Annotated[
        str, typer.Option("--split", help="Where models are compared: validation (as in the paper) or test.")
    ] = "validation",
    device: Device = "auto",
    json_file: Json = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Train every model from several seeds on the same pairs and compare them, with the noise of seeds and ground.

    With --resume, runs that the folder already holds are kept and an interrupted one goes on where it stopped.
    """
    from lunargr_cli.console import Console
    from lunargr_cli.options import read_numbers
    from schemas import SPLITS, ConfigError
    from schemas.files.outputs import Output, Target, check_outputs
    from stages import compare, evaluate, train
    from stages.physics.photometry import get_model

    console = Console(quiet)
    names = list(dict.fromkeys(get_model(name.strip()).name for name in models.split(",") if name.strip()))
    if len(names) < 2:
        raise ConfigError(f"--models: expected at least two models, found '{models}'.")
    channels = read_numbers("--widths", widths, int)
    settings: dict[str, Any] = {"epochs": epochs, "batch": batch, "lr": lr, "schedule": schedule, "widths": channels}
    settings["precision"] = precision
    train.check(train.Config(device=device, **settings))
    if split not in dict(SPLITS):
        raise ConfigError(f"--split: expected one of {', '.join(dict(SPLITS))}, found '{split}'.")
    table, curves = output / compare.TABLE, output / compare.CURVES
    check_outputs([Target(table), Target(curves)], [pairs], overwrite or resume)
    made = [output / f"{name}_seed{k}.{end}" for name in names for k in range(seeds) for end in ENDS]
    made += [output / f"{name}.{split}.{end}" for name in names for end in ("h5", "json")]
    check_outputs(map(Target, made), [pairs], overwrite or resume)
    files: list[tuple[Path, list[Path]]] = []
    for number, name in enumerate(names):
        evaluation = output / f"{name}.{split}.h5"
        checkpoints = [output / f"{name}_seed{seed}.checkpoint.h5" for seed in range(seeds)]
        for seed, checkpoint in enumerate(checkpoints):
            config = train.Config(model=name, seed=seed, device=device, **settings)
            if not (resume and checkpoint.exists() and _same(checkpoint, config, pairs)):
                console.say(f"training {name}, seed {seed} ({number * seeds + seed + 1} of {seeds * len(names)})")
                train.run(pairs, Output(checkpoint, overwrite or resume, resume), config, console.say, console.progress)
        if not (resume and evaluation.exists() and _made_from(evaluation, [pairs, *checkpoints])):
            scoring = evaluate.Config(split=split, renderings=False, device=device, only=("learned",))
            evaluate.run(pairs, checkpoints, Output(evaluation, overwrite=True), scoring, console.say, console.progress)
        files.append((evaluation, checkpoints))
    result = compare.run(files, Output(output, overwrite=True, json=json_file))
    console.table(
        f"{len(names)} models x {seeds} seeds on {result['crops']} {split} crops, {result['tiles']} ground tiles",
        *compare.result_lines(result),
    )
    console.table("which differences are larger than their noise", *compare.difference_lines(result))
    console.say(f"written: {table}, {curves}")


def _same(checkpoint: Path, config: Any, pairs: Path) -> bool:
    """Whether a finished checkpoint came from these options and these pairs."""
    import json
    from dataclasses import asdict

    from schemas import CHECKPOINT, open_artefact, read_config
    from schemas.provenance import sha256

    with open_artefact(checkpoint, CHECKPOINT) as file:
        found, inputs = read_config(file), json.loads(str(file.attrs["inputs"]))
    wanted = json.loads(json.dumps(asdict(config)))
    return all(found.get(k) == wanted[k] for k in wanted if k != "device") and inputs[0]["sha256"] == sha256(pairs)


def _made_from(evaluation: Path, inputs: list[Path]) -> bool:
    """Whether a finished evaluation is one of these very files."""
    import json

    from schemas import EVALUATION, open_artefact
    from schemas.provenance import sha256

    with open_artefact(evaluation, EVALUATION) as file:
        found = json.loads(str(file.attrs["inputs"]))
    return [entry["sha256"] for entry in found] == [sha256(path) for path in inputs]
