"""`lunargr infer`: scene.h5 or a DEM, and checkpoint.h5 -> svbrdf.h5 and a GeoTIFF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunargr_cli.options import (
    MOST,
    BodyOption,
    Device,
    OutputFile,
    Overwrite,
    Parts,
    Quiet,
    ResumeParts,
    Scheduler,
    Shard,
    in_parts,
    parse_shard,
)
from lunargr_cli.paths import Writes

NAME, ORDER = "infer", 60


def command(
    terrain: Annotated[Path, typer.Argument(metavar="SCENE|DEM", help="scene.h5, or a DEM that GDAL reads.")],
    checkpoint: Annotated[Path, typer.Argument(help="checkpoint.h5 from 'lunargr train'.")],
    window: Annotated[
        int | None,
        typer.Option(
            "--window", min=16, max=MOST, help="Window size, px; context around it is added (default: what is fast)."
        ),
    ] = None,
    stride: Annotated[
        int | None, typer.Option("--stride", min=1, max=MOST, help="Step between windows, px (default: a window).")
    ] = None,
    window_offset: Annotated[
        int, typer.Option("--window-offset", min=-MOST, max=MOST, metavar="PX", help="Shift the grid of windows.")
    ] = 0,
    precision: Annotated[
        str,
        typer.Option("--precision", help="fp32, bf16, or auto: bf16 where the processor has it and it does no harm."),
    ] = "auto",
    any_gsd: Annotated[bool, typer.Option("--any-gsd", help="Allow a DEM at another GSD than the training's.")] = False,
    geotiff: Annotated[
        Path | None,
        typer.Option("--geotiff", help="GeoTIFF to write (default: the output's name with .tif)."),
        Writes.FILE,
    ] = None,
    no_geotiff: Annotated[
        bool, typer.Option("--no-geotiff", help="Write svbrdf.h5 only: on large maps a quarter of the time less.")
    ] = False,
    body: BodyOption = None,
    device: Device = "auto",
    shard: Shard = None,
    output: OutputFile = Path("svbrdf.h5"),
    scheduler: Scheduler = None,
    resume: ResumeParts = False,
    parts: Parts = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Predict georeferenced maps of reflectance coefficients for a DEM of any size."""
    import contextlib
    from dataclasses import replace

    from lunargr_cli.console import Console
    from schemas import ConfigError
    from schemas.files.locks import scratch_path
    from schemas.files.outputs import Output
    from stages import infer

    if precision not in ("auto", "fp32", "bf16"):
        raise ConfigError(f"--precision: expected auto, fp32 or bf16, found '{precision}'.")
    if geotiff and no_geotiff:
        raise ConfigError(f"--geotiff {geotiff} and --no-geotiff: expected one of them, found both.")
    console = Console(quiet)
    to = Output(output, overwrite, geotiff=geotiff)
    config = infer.Config(
        window=window,
        stride=stride,
        offset=window_offset,
        device=device,
        precision=precision,
        any_gsd=any_gsd,
        shard=parse_shard(shard),
        geotiff=not no_geotiff,
    )
    interrupted = scheduler is not None or resume  # may have got as far as the GeoTIFF: its parts tell
    infer.check_files([terrain, checkpoint], replace(to, resume=interrupted), config)
    gridding = None
    if infer.open_terrain(terrain):
        infer.check_body(terrain, body)
    else:
        from stages import ingest
        from stages.network.predictor import load_predictor

        gridding = ingest.Config(
            gsd=None if any_gsd else load_predictor(checkpoint).gsd, body="moon" if body is None else body
        )
    if in_parts(scheduler, resume, parts, shard):
        from lunargr_cli.fanout.job import Work
        from lunargr_cli.fanout.stages import run_infer

        found = run_infer(
            terrain, checkpoint, to, config, gridding, Work(scheduler, parts, console.say, console.progress)
        )
    else:
        scene = terrain
        with contextlib.ExitStack() as stack:
            if gridding is not None:
                scene = stack.enter_context(scratch_path(output, "grid"))
                ingest.run(terrain, None, scene, gridding, progress=console.progress)
            found = infer.run(scene, checkpoint, to, config, console.say, console.progress)
    console.say(
        f"{output}: {found.grid.height} x {found.grid.width} px at {found.grid.gsd:g} m, {found.valid_share:.1%} valid"
    )
    rows = [(name, *(f"{v:.5f}" for v in values)) for name, values in found.coefficients.items()]
    console.table(f"coefficients of {found.model}", ("name", "mean", "std", "1 %", "99 %"), rows)
