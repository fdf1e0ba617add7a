"""`lunargr evaluate PAIRS CHECKPOINT`: how well the learned reflectance predicts images it has not seen."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lunargr_cli.options import Device, Json, Output, Overwrite, Quiet, ResumeParts, Scheduler, Seed

NAME, ORDER = "evaluate", 70


def command(
    pairs: Annotated[Path, typer.Argument(help="Pairs from 'lunargr project'.")],
    checkpoint: Annotated[
        Path,
        typer.Argument(help="Checkpoint from 'lunargr train'; with --held-out-images a map from 'lunargr albedo'."),
    ],
    more_maps: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[MAPS]...", help="With --held-out-images: further maps, such as those of other folds."),
    ] = None,
    output: Output = Path("evaluation.h5"),
    held_out_images: Annotated[
        bool,
        typer.Option("--held-out-images", help="Score seen ground under images that did not make the map's albedo."),
    ] = False,
    split: Annotated[str, typer.Option("--split", help="train, validation or test.")] = "test",
    extend: Annotated[
        Path | None,
        typer.Option("--extend", metavar="FILE", help="Also score the extended model of 'lunargr diagnose'."),
    ] = None,
    figures: Annotated[
        Path | None, typer.Option("--figures", metavar="DIR", help="Write training curves and example crops as PNG.")
    ] = None,
    bootstrap: Annotated[
        int, typer.Option("--bootstrap", help="Resamples of the ground tiles for the intervals.")
    ] = 2000,
    fit_pairs: Annotated[
        int, typer.Option("--fit-pairs", help="Most train pairs that baselines are fitted on (0: all).")
    ] = 4096,
    renderings: Annotated[
        bool | None,
        typer.Option(
            "--renderings/--no-renderings", help="Keep every rendered crop in the output (default: below 512 MiB)."
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="ROW", help="Score only this row of the table; may be repeated."),
    ] = None,
    batch: Annotated[int, typer.Option("--batch", help="Crops in memory at a time.")] = 16,
    seed: Seed = 0,
    device: Device = "auto",
    json_file: Json = None,
    scheduler: Scheduler = None,
    resume: ResumeParts = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Score the learned model and its baselines on one split: MSE, PSNR, SSIM, LPIPS, with 95 % intervals.

    The result also goes to a JSON file beside the output. Images in DN get a gain and an offset per image, fitted on
    the train split in the same way for every model; their errors are shares of the full DN range.
    """
    from lunargr_cli.console import Console
    from schemas import ConfigError
    from stages import evaluate
    from stages.evaluate.table import gain_lines, result_lines

    console = Console(quiet)
    if held_out_images:
        from lunargr_cli.held_out import show_held_out_images

        maps = [checkpoint, *(more_maps or ())]
        show_held_out_images(console, pairs, maps, output, (split, bootstrap, seed), json_file, overwrite)
        return
    if more_maps:
        raise ConfigError(f"{more_maps[0]}: expected one checkpoint, found more files; maps need --held-out-images.")
    config = evaluate.Config(split, batch, bootstrap, fit_pairs, renderings, seed, device, tuple(only or ()))
    more: dict[str, Any] = {"extend": extend, "json_file": json_file, "figures": figures, "overwrite": overwrite}
    more["progress"] = console.progress
    if scheduler is not None or resume:
        from lunargr_cli.fanout.stages import run_evaluate

        result = run_evaluate(pairs, checkpoint, output, config, scheduler=scheduler, say=console.say, **more)
    else:
        result = evaluate.run(pairs, checkpoint, output, config, **more)
    columns, cells = result_lines(result)
    unit = "I/F" if result["image_units"] == "iof" else f"shares of {result['dn_full_range']:.0f} DN"
    console.table(
        f"{result['pairs']} crops of split '{split}', {result['tiles']} ground tiles, errors in {unit}", columns, cells
    )
    columns, cells = gain_lines(result)
    if cells:
        console.table("what the learned reflectance gains (paired over ground tiles)", columns, cells)
    for warning in result["warnings"]:
        console.say(f"note: {warning}.")
    if result["lpips_unavailable"]:
        console.say(f"LPIPS is not available: {result['lpips_unavailable']}.")
    console.say(f"written: {output}, {output.with_suffix('.json')}" + (f", {figures}/" if figures else ""))
