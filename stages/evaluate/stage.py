"""From files to files: pairs and checkpoint in, table, JSON, evaluation artefact and figures out."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from schemas import EVALUATION, ArtefactWriter, write_json
from schemas.files.outputs import Output
from stages.common.progress import Progress
from stages.common.runner.job import Job
from stages.evaluate.checks import check, check_runs, limitations, read_seed, select
from stages.evaluate.config import Config, report_files
from stages.evaluate.parts import Kept, first_runs, score_in_parts
from stages.evaluate.rows import Row
from stages.evaluate.scores import Scores
from stages.evaluate.task import Task, make_task, score_here, summarise
from stages.pairs.ground import leave_out_learned
from stages.pairs.reader import PairReader

RENDERINGS_LIMIT = 512 * 2**20  # bytes of rendered crops that are kept without being asked for

# How the crops are scored: rows of the table, their scores, the full range of DN
Score = Callable[[Task, Kept], tuple[list[Row], Scores, float]]


@dataclass(frozen=True)
class Files:
    """What is read and written."""

    pairs: Path
    checkpoints: Sequence[Path]
    extend: str | None
    output: Output

    @property
    def inputs(self) -> list[Path]:
        """What no output may replace."""
        return [self.pairs, *self.checkpoints, *([Path(self.extend)] if self.extend else [])]


def work(
    pairs: Path, checkpoints: Sequence[Path], output: Output, config: Config, progress: Progress
) -> dict[str, Any]:
    """See :func:`stages.evaluate.run`."""
    return _work(pairs, checkpoints, output, config, lambda task, kept: score_here(task, kept.put, progress))


def in_parts(job: Job, pairs: Path, checkpoints: Path | Sequence[Path], config: Config) -> dict[str, Any]:
    """The evaluation with the crops scored in parts."""
    several = [checkpoints] if isinstance(checkpoints, Path) else list(checkpoints)

    def score(task: Task, kept: Kept) -> tuple[list[Row], Scores, float]:
        return score_in_parts(task, pairs, several, job.fan, kept)

    return _work(pairs, several, job.output, config, score)


def _work(pairs: Path, checkpoints: Sequence[Path], output: Output, config: Config, score: Score) -> dict[str, Any]:
    files = Files(pairs, checkpoints, config.extend, output)
    check(config)
    with PairReader(pairs) as reader:
        wanted, notes = select(reader, config.split), []
        for checkpoint in checkpoints:
            wanted, more = leave_out_learned(reader, wanted, checkpoint, config.split)
            notes += more
        task = make_task(reader, checkpoints, wanted, config)
        check_runs(checkpoints, task)
        rows, scores, scale, result = _write(task, files, limitations(checkpoints[0], task) + notes, score)
        if output.figures is not None:
            from stages.evaluate.figures import write_figures

            first = [rows[k] for k in first_runs(rows)]
            write_figures(output.figures, task, first, scores.mean_over_runs(), scale, result, checkpoints[0])
    return result


def _write(
    task: Task, files: Files, warnings: list[str], score: Score
) -> tuple[list[Row], Scores, float, dict[str, Any]]:
    """Score, and write the artefact and the JSON. warnings : what the result holds beside its own"""
    config, count = task.config, len(task.wanted)
    height, width = task.reader.size
    first = first_runs(task.rows())
    size = len(first) * count * height * width * 4
    renderings = size <= RENDERINGS_LIMIT if config.renderings is None else config.renderings
    sizes = {"model": len(first), "run": len(files.checkpoints), "pair": count, "y": height, "x": width}
    settings = asdict(config) | {"renderings": renderings}
    with ArtefactWriter(
        files.output.file,
        EVALUATION,
        sizes,
        config=settings,
        inputs=files.inputs,
        seed=config.seed,
    ) as artefact:
        kept = Kept(artefact.dataset("measured"), artefact.dataset("rendered") if renderings else None, first)
        rows, scores, scale = score(task, kept)
        result = summarise(task, scores, scale)
        names = [path.name for path in files.checkpoints]
        seeds = [read_seed(path) for path in files.checkpoints]
        result |= {"pairs_file": files.pairs.name, "checkpoint": names[0], "checkpoints": names, "seeds": seeds}
        result |= {"config": settings, "warnings": warnings + result["warnings"]}
        _write_scores(artefact, task, scores, seeds)
        artefact.file.attrs["split"] = config.split
        artefact.file.attrs["metrics"] = json.dumps(result)
        for report in report_files(files.output):
            write_json(report, result)
    return rows, scores, scale, result


def _write_scores(artefact: ArtefactWriter, task: Task, scores: Scores, seeds: list[int]) -> None:
    table = scores.mean_over_runs()
    artefact.write("model_name", table.names)
    artefact.write("pair_index", task.wanted)
    artefact.write("tile", task.reader.tile[task.wanted])
    artefact.write("valid_pixels", table.pixels)
    artefact.write("mse", table.mse)
    artefact.write("ssim", table.ssim)
    artefact.write("run_seed", seeds)
    if "learned" in table.names:
        artefact.write("run_mse", scores.runs("learned", "mse"))
