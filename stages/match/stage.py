"""From files to files: measured and rendered pictures in, shares of consistent matches and coloured pictures out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from schemas import ConfigError, atomic_path, write_json
from schemas.files.outputs import Output
from stages.common.progress import Progress, Say
from stages.match.base import Matches, Models, get_matcher
from stages.match.comparisons import comparisons
from stages.match.config import FIGURES, Config, figure_name
from stages.match.consistency import summarise
from stages.match.pictures import HEIGHT, WIDTH, drop_unknown, match_figure, stretch_limits, to_grey


def work(files: list[Path], output: Output, config: Config, say: Say, progress: Progress) -> dict[str, Any]:
    """See :func:`stages.match.run`."""
    json_file, figures = output.json or output.path, output.figures
    if config.count < 1:
        raise ConfigError(f"`count`: expected at least 1, found {config.count}.")
    models = Models(config.features_model, config.lightglue_model)
    matchers = [get_matcher(name, models) for name in config.matchers]
    notes: list[str] = []
    total, source = comparisons(files, config, notes.append)
    for note in notes:
        say(f"note: {note}.")
    collected: dict[str, dict[str, list[Matches]]] = {m.name: {} for m in matchers}
    ground: list[int] = []
    progress(0, total, "match")
    for number, comparison in enumerate(source):
        ground.append(comparison.ground)
        limits = stretch_limits(comparison.measured)
        measured, known = to_grey(comparison.measured, limits)
        pictures = {}
        for name, image in comparison.rendered.items():
            pictures[name], also_known = to_grey(image, limits if comparison.common_scale else stretch_limits(image))
            known = known & also_known
        for matcher in matchers:
            found = {name: drop_unknown(matcher.match(measured, picture), known) for name, picture in pictures.items()}
            for name, matches in found.items():
                collected[matcher.name].setdefault(name, []).append(matches)
            if figures is not None and number < FIGURES:
                _save(
                    match_figure(measured, pictures, found, f"{comparison.label}, {matcher.title}"),
                    figures / figure_name(matcher.name, number),
                )
        progress(number + 1, total, "match")
    result = {
        "size_px": [WIDTH, HEIGHT],
        "crops": total,
        "tiles": len(set(ground)),
        "files": [f.name for f in files],
        "warnings": notes,
        "matchers": {
            m.name: {name: summarise(found, ground) for name, found in collected[m.name].items()} for m in matchers
        },
    }
    if json_file is not None:
        write_json(json_file, result)
    return result


def _save(figure: Any, path: Path) -> None:
    import matplotlib.pyplot as plt

    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=110, facecolor="white")
    plt.close(figure)


def result_lines(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and cells of the table on the terminal."""

    def share(row: dict[str, Any], threshold: int) -> str:
        key = f"within_{threshold}_px_percent"
        if row[key] is None:
            return "-"
        low, high = row[f"{key}_low"], row[f"{key}_high"]
        return f"{row[key]:.1f}" + ("" if low is None else f" ({low:.1f} .. {high:.1f})")

    def shift(row: dict[str, Any]) -> str:
        right, down = row["median_shift_right_px"], row["median_shift_down_px"]
        return "-" if right is None else f"{right:+.1f}, {down:+.1f}"

    cells = [
        [matcher, name, str(row["matches"]), *(share(row, t) for t in (1, 3, 5))]
        + ["-" if row[k] is None else f"{row[k]:.2f}" for k in ("mean_error_px", "median_error_px")]
        + [shift(row)]
        for matcher, rows in result["matchers"].items()
        for name, row in rows.items()
    ]
    shares = ["< 1 px, %", "< 3 px, %", "< 5 px, %"]
    return ["matcher", "rendering", "matches", *shares, "mean, px", "median, px", "shift, px"], cells
