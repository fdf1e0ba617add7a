"""What `lunargr evaluate --held-out-images` prints."""

from __future__ import annotations

from pathlib import Path

from lunargr_cli.console import Console
from schemas.files.outputs import Output


def show_held_out_images(
    console: Console, pairs: Path, maps: list[Path], output: Output, split: str, seed: int
) -> None:
    """Score maps with albedo on images that did not make it. Raises LunargrError."""
    from stages.evaluate.coverage import coverage_lines
    from stages.evaluate.held_out_images import Config, image_lines, result_lines, run

    result = run(pairs, maps, output, Config(split, seed), console.say, console.progress)
    suns = result["nearest_used_sun_deg"]
    columns, cells = result_lines(result)
    console.table(
        f"{result['claim']}: {result['pairs']} crops of split '{split}', {result['tiles']} ground tiles, "
        f"Suns {suns['least']:.1f} to {suns['most']:.1f} deg from the nearest one used",
        columns,
        cells,
    )
    console.table("by image", *image_lines(result))
    if result["coverage_percent"] is not None:
        console.table("pixels within the intervals, percent", *coverage_lines(result["coverage_percent"]))
    console.say(f"written: {output.file}, {output.file.with_suffix('.json')}")
