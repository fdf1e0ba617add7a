"""compare: which of several trained models predicts best, and which differences are larger than their noise.

The noise has two sources: training (several seeds of the same model), and the choice of ground (of the tiles held out).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from schemas import (
    CHECKPOINT,
    EVALUATION,
    ArtefactError,
    ConfigError,
    atomic_path,
    open_artefact,
    read_strings,
)
from stages.common.intervals import ERROR, LOG, ground_variance, join, ratio_interval, run_variance, two_sided_p

# Validation MSE summed over a crop of 128 x 128 px, where the Lunar-G2R paper's text gives it.
PAPER = {"M1": 4.51, "M2": 4.06, "M6": 5.34}


@dataclass
class Trained:
    """One training run on the compared split: errors of its crops, (N,) each, and its history."""

    model: str
    seed: int
    squared_error: np.ndarray
    pixels: np.ndarray
    tile: np.ndarray
    best_epoch: int
    validation_loss: np.ndarray

    @property
    def mse(self) -> float:
        """Per pixel."""
        return float(self.squared_error.sum() / self.pixels.sum())

    @property
    def mse_crop_sum(self) -> float:
        """Mean over crops of the sum over pixels."""
        return float(self.squared_error.sum() / (self.pixels > 0).sum())


def read_runs(evaluation: Path, checkpoints: Sequence[Path]) -> list[Trained]:
    """The training runs of one model from what train wrote and evaluate wrote of them all."""
    with open_artefact(evaluation, EVALUATION) as file:
        names = read_strings(file, "model_name")
        if "run_mse" not in file or "run_seed" not in file:
            raise ArtefactError(f"{evaluation}: expected the row 'learned', found {', '.join(names)}; evaluate again.")
        seeds = file["run_seed"][...].tolist()
        pixels = file["valid_pixels"][...].astype(float)
        errors = np.nan_to_num(file["run_mse"][...]) * pixels
        tile = file["tile"][...]
    runs = []
    for checkpoint in checkpoints:
        with open_artefact(checkpoint, CHECKPOINT) as file:
            model, seed = str(file.attrs["model"]), int(file.attrs["seed"])
            best, history = int(file.attrs["best_epoch"]), file["validation_loss"][...]
        if seed not in seeds:
            raise ArtefactError(
                f"{evaluation}: expected seed {seed} of {checkpoint.name}, found {seeds}; evaluate again."
            )
        runs.append(Trained(model, seed, errors[seeds.index(seed)], pixels, tile, best, history))
    return runs


def compare(runs: Sequence[Trained], level: float = 0.05) -> dict[str, Any]:
    """The table of models, best first, and every pair of them with the noise of their difference.

    The logarithm of the ratio of two mean MSE has the variance of both means over seeds plus that of a paired jackknife
    over ground tiles; its p value takes Student's t with Satterthwaite's degrees of freedom, adjusted by Holm over all
    pairs of models. level : of significance, below which a difference is called larger than its noise
    """
    models = list(dict.fromkeys(r.model for r in runs))
    groups = {m: [r for r in runs if r.model == m] for m in models}
    if len(models) < 2:
        raise ConfigError(f"compare: expected at least two models, found {', '.join(models) or 'none'}.")
    if len({r.tile.tobytes() for r in runs}) > 1:
        raise ConfigError(
            "compare: expected runs on the same pairs, found different crops; evaluate on the same split."
        )
    mean = {m: float(np.mean([r.mse for r in g])) for m, g in groups.items()}
    order = sorted(models, key=mean.__getitem__)
    pairs = [_difference(groups[a], groups[b]) for a, b in combinations(order, 2)]
    _holm(pairs, level)
    tile = runs[0].tile
    return {
        "models": {m: _row(groups[m]) for m in order},
        "differences": pairs,
        "crops": len(tile),
        "tiles": len(np.unique(tile)),
        "seeds": max(len(g) for g in groups.values()),
    }


def _row(group: Sequence[Trained]) -> dict[str, Any]:
    """A model's line of the table; the interval holds the spread of ground and seeds."""
    first, several = group[0], len(group) > 1
    found = ratio_interval(np.stack([r.squared_error for r in group]), first.pixels, first.tile, ERROR)
    sums = [r.mse_crop_sum for r in group]
    return {
        "mse": found.value,
        "mse_seed_std": float(np.std([r.mse for r in group], ddof=1)) if several else None,
        "mse_low": _number(found.low),
        "mse_high": _number(found.high),
        "mse_crop_sum": float(np.mean(sums)),
        "mse_crop_sum_seed_std": float(np.std(sums, ddof=1)) if several else None,
        "paper_mse_crop_sum": PAPER.get(first.model),
        "best_epoch": [r.best_epoch for r in group],
        "seeds": [r.seed for r in group],
    }


def _difference(better: Sequence[Trained], worse: Sequence[Trained]) -> dict[str, Any]:
    """Two models: what their difference is, and its noise on the scale of the worse one's MSE."""
    a, b = (float(np.mean([r.mse for r in group])) for group in (better, worse))
    found: dict[str, Any] = {
        "better": better[0].model,
        "worse": worse[0].model,
        "difference": b - a,
        "difference_percent": 100 * (b - a) / b if b else 0.0,
        "noise_of_seeds": None,
        "noise_of_tiles": None,
        "p": None,
    }
    if not a > 0:
        return found
    ours, other = (np.stack([r.squared_error for r in group]).mean(axis=0)[None] for group in (better, worse))
    tiles = ground_variance(ours, other, better[0].tile, LOG)
    seeds = [run_variance([r.mse / m for r in group]) for group, m in ((better, a), (worse, b))]
    whole = join([tiles, *seeds])
    if whole.freedom > 0 and whole.value > 0:
        found["noise_of_seeds"] = b * math.sqrt(join(seeds).value)
        found["noise_of_tiles"] = b * math.sqrt(tiles.value)
        found["p"] = two_sided_p(math.log(b / a) / math.sqrt(whole.value), whole.freedom)
    return found


def _holm(pairs: list[dict[str, Any]], level: float) -> None:
    """Add Holm's adjusted p and the verdict to every pair."""
    known = sorted((p for p in pairs if p["p"] is not None), key=lambda p: p["p"])
    running = 0.0
    for rank, pair in enumerate(known):
        running = max(running, min(1.0, pair["p"] * (len(known) - rank)))
        pair["p_adjusted"] = running
    for pair in pairs:
        pair.setdefault("p_adjusted", None)
        pair["larger_than_noise"] = None if pair["p"] is None else pair["p_adjusted"] < level


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def write_curves(runs: Sequence[Trained], path: Path) -> None:
    """Validation loss of every model against epoch: the mean over seeds and their range, as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for k, m in enumerate(dict.fromkeys(r.model for r in runs)):
        curves = [r.validation_loss for r in runs if r.model == m]
        length = min(map(len, curves))
        stack = np.stack([c[:length] for c in curves])
        epochs = np.arange(1, length + 1)
        axes.plot(epochs, stack.mean(axis=0), color=f"C{k}", label=m)
        axes.fill_between(epochs, stack.min(axis=0), stack.max(axis=0), color=f"C{k}", alpha=0.15, linewidth=0)
    axes.set(xlabel="epoch", ylabel="validation mean squared error", yscale="log")
    axes.set_title("mean over seeds; the band is their range", fontsize=9)
    axes.locator_params(axis="x", integer=True)
    axes.grid(alpha=0.25, which="both", linewidth=0.5)
    axes.legend(frameon=False, ncols=2)
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=130, facecolor="white")
    plt.close(figure)


def result_lines(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and cells of the table of models, best first."""
    cells = []
    for name, row in result["models"].items():
        deviation = row["mse_crop_sum_seed_std"]
        interval = (
            "-" if None in (row["mse_low"], row["mse_high"]) else f"{row['mse_low']:.3e} .. {row['mse_high']:.3e}"
        )
        cells.append(
            [
                name,
                f"{row['mse_crop_sum']:.4f}",
                "-" if deviation is None else f"{deviation:.4f}",
                f"{row['mse']:.4e}",
                interval,
                ", ".join(map(str, row["best_epoch"])),
                "-" if row["paper_mse_crop_sum"] is None else f"{row['paper_mse_crop_sum']:.2f}",
            ]
        )
    return [
        "model",
        "MSE/crop",
        "+- seeds",
        "MSE",
        "95 % over tiles and seeds",
        "best epochs",
        "paper's MSE/crop",
    ], cells


def difference_lines(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and cells of the pairs of models."""
    cells = []
    for pair in result["differences"]:
        known = pair["p"] is not None
        cells.append(
            [
                f"{pair['better']} < {pair['worse']}",
                f"{pair['difference']:.2e} ({pair['difference_percent']:.1f} %)",
                f"{pair['noise_of_seeds']:.1e}" if known else "-",
                f"{pair['noise_of_tiles']:.1e}" if known else "-",
                f"{pair['p_adjusted']:.3f}" if known else "-",
                ("yes" if pair["larger_than_noise"] else "no") if known else "needs two seeds and two tiles",
            ]
        )
    return ["pair", "difference of MSE", "noise: seeds", "noise: tiles", "p (Holm)", "larger than its noise"], cells
