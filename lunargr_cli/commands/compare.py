"""`lunargr compare PAIRS`: train several reflectance models from several seeds and say which differences are real."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lunargr_cli.options import MOST, Device, Json, Overwrite, Quiet, Resume

NAME, ORDER = "compare", 72


def command(
    pairs: Annotated[Path, typer.Argument(help="Pairs from 'lunargr project'.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for checkpoints, evaluations and the table.")],
    models: Annotated[
        str, typer.Option("--models", help="Reflectance models, separated by commas.")
    ] = "M1,M2,M3,M4,M5,M6",
    seeds: Annotated[
        int, typer.Option("--seeds", min=1, max=1000, help="Training runs of every model, from seeds 0, 1, ...")
    ] = 3,
    epochs: Annotated[int, typer.Option("--epochs", min=1, max=100_000, help="Passes over the training pairs.")] = 20,
    batch: Annotated[int, typer.Option("--batch", min=1, max=MOST, help="Pairs per training step.")] = 64,
    lr: Annotated[float, typer.Option("--lr", help="Adam's learning rate.")] = 1e-4,
    schedule: Annotated[
        str, typer.Option("--schedule", help="Learning rate over the epochs: constant or cosine.")
    ] = "constant",
    widths: Annotated[str, typer.Option("--widths", help="Channels of each stage of the U-Net.")] = "16-32-64-128-256",
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
    from schemas import SPLITS, ConfigError
    from stages import compare, evaluate, train
    from stages.physics.photometry import get_model

    console = Console(quiet)
    names = list(dict.fromkeys(get_model(name.strip()).name for name in models.split(",") if name.strip()))
    if len(names) < 2:
        raise ConfigError(f"--models: expected at least two models, found '{models}'.")
    if output.exists() and not output.is_dir():
        raise ConfigError(f"{output}: expected a folder, found a file; choose another --output.")
    table = output / "comparison.json"
    for report in (table, *([json_file] if json_file else [])):
        if report.exists() and not (overwrite or resume):
            raise ConfigError(f"{report}: exists already; add --overwrite or --resume, or choose another --output.")
    try:
        channels = tuple(int(w) for w in widths.split("-"))
    except ValueError:
        raise ConfigError(f"--widths: expected numbers like 16-32-64-128-256, found '{widths}'.") from None
    settings: dict[str, Any] = {"epochs": epochs, "batch": batch, "lr": lr, "schedule": schedule, "widths": channels}
    train.check(train.Config(device=device, **settings))
    if split not in dict(SPLITS):
        raise ConfigError(f"--split: expected one of {', '.join(dict(SPLITS))}, found '{split}'.")
    files: list[tuple[Path, Path]] = []
    for seed in range(seeds):
        for name in names:
            checkpoint = output / f"{name}_seed{seed}.checkpoint.h5"
            evaluation = output / f"{name}_seed{seed}.{split}.h5"
            config = train.Config(model=name, seed=seed, device=device, **settings)
            if not (resume and checkpoint.exists() and _same(checkpoint, config, pairs)):
                console.say(f"training {name}, seed {seed} ({len(files) + 1} of {seeds * len(names)})")
                train.run(pairs, checkpoint, config, overwrite or resume, resume, console.say, console.progress)
                evaluation.unlink(missing_ok=True)
            if not (resume and evaluation.exists()):
                scoring = evaluate.Config(split=split, renderings=False, device=device, only=("learned",))
                evaluate.run(pairs, checkpoint, evaluation, scoring, overwrite=True, progress=console.progress)
            files.append((evaluation, checkpoint))
    result = compare.run(files, table, output / "validation_curves.png")
    if json_file is not None:
        from schemas import atomic_path

        with atomic_path(json_file) as partial:
            partial.write_text(table.read_text())
    console.table(
        f"{len(names)} models x {seeds} seeds on {result['crops']} {split} crops, {result['tiles']} ground tiles",
        *compare.result_lines(result),
    )
    console.table("which differences are larger than their noise", *compare.difference_lines(result))
    console.say(f"written: {table}, {output / 'validation_curves.png'}")


def _same(checkpoint: Path, config: Any, pairs: Path) -> bool:
    """Whether a finished checkpoint came from these options and these pairs."""
    import json
    from dataclasses import asdict

    from schemas import CHECKPOINT, open_artefact, read_config
    from schemas.provenance import sha256

    with open_artefact(checkpoint, CHECKPOINT) as file:
        found, inputs = read_config(file), json.loads(str(file.attrs["inputs"]))
    wanted = json.loads(json.dumps(asdict(config)))
    keys = ("model", "seed", "epochs", "batch", "lr", "schedule", "widths")
    return all(found.get(k) == wanted[k] for k in keys) and inputs[0]["sha256"] == sha256(pairs)
