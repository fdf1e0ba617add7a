"""compare: which of several trained models predicts best, and which differences are larger than their noise.

Two sources of noise count: training (the same model from several seeds) and the ground (which tiles were held out).
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
    write_json,
)

# Validation MSE summed over a crop of 128 x 128 px, where the Lunar-G2R paper's text gives it.
PAPER = {"M1": 4.51, "M2": 4.06, "M6": 5.34}
RESAMPLES = 2000
LEVEL = 0.05


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


def read_run(evaluation: Path, checkpoint: Path) -> Trained:
    """One run from what evaluate and train wrote."""
    with open_artefact(checkpoint, CHECKPOINT) as file:
        model, seed = str(file.attrs["model"]), int(file.attrs["seed"])
        best, history = int(file.attrs["best_epoch"]), file["validation_loss"][...]
    with open_artefact(evaluation, EVALUATION) as file:
        names = read_strings(file, "model_name")
        if "learned" not in names:
            raise ArtefactError(f"{evaluation}: expected the row 'learned', found {', '.join(names)}; evaluate again.")
        pixels = file["valid_pixels"][...].astype(float)
        error = np.nan_to_num(file["mse"][names.index("learned")]) * pixels
        return Trained(model, seed, error, pixels, file["tile"][...], best, history)


def compare(runs: Sequence[Trained], seed: int = 0) -> dict[str, Any]:
    """The table of models, best first, and every pair of them with the noise of their difference.

    A difference d of mean MSE has the variance s_a^2 / n_a + s_b^2 / n_b over seeds plus that of a paired bootstrap over
    ground tiles; its p value takes Student's t with Welch's degrees of freedom, adjusted by Holm over all pairs.
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
    spread = {m: float(np.std([r.mse for r in g], ddof=1)) if len(g) > 1 else None for m, g in groups.items()}
    draws = _tile_draws(groups, seed)
    order = sorted(models, key=mean.__getitem__)
    table = {}
    for m in order:
        g = groups[m]
        low, high = np.quantile(draws[m], (0.025, 0.975)) if draws[m].size else (math.nan, math.nan)
        table[m] = {
            "mse": mean[m],
            "mse_seed_std": spread[m],
            "mse_low": _number(low),
            "mse_high": _number(high),
            "mse_crop_sum": float(np.mean([r.mse_crop_sum for r in g])),
            "mse_crop_sum_seed_std": float(np.std([r.mse_crop_sum for r in g], ddof=1)) if len(g) > 1 else None,
            "paper_mse_crop_sum": PAPER.get(m),
            "best_epoch": [r.best_epoch + 1 for r in g],
            "seeds": [r.seed for r in g],
        }
    pairs = []
    for a, b in combinations(order, 2):
        difference = mean[b] - mean[a]
        tile_variance = float(np.var(draws[b] - draws[a])) if draws[a].size else math.nan
        p = None
        of_a, of_b = spread[a], spread[b]
        if of_a is not None and of_b is not None and math.isfinite(tile_variance):
            va, vb = of_a**2 / len(groups[a]), of_b**2 / len(groups[b])
            noise = math.sqrt(va + vb + tile_variance)
            p = two_sided_p(difference / noise, _welch(va, vb, len(groups[a]), len(groups[b]))) if noise > 0 else 0.0
            seeds_noise, tiles_noise = math.sqrt(va + vb), math.sqrt(tile_variance)
        pairs.append(
            {
                "better": a,
                "worse": b,
                "difference": difference,
                "difference_percent": 100 * difference / mean[b] if mean[b] else 0.0,
                "noise_of_seeds": None if p is None else seeds_noise,
                "noise_of_tiles": None if p is None else tiles_noise,
                "p": p,
            }
        )
    _holm(pairs)
    return {"models": table, "differences": pairs, "crops": len(runs[0].tile), "tiles": len(np.unique(runs[0].tile))}


def _tile_draws(groups: dict[str, list[Trained]], seed: int) -> dict[str, np.ndarray]:
    """Resampled seed-mean MSE of every model, with the same tiles for all; empty where there is one tile."""
    first = next(iter(groups.values()))[0]
    names, index = np.unique(first.tile, return_inverse=True)
    if len(names) < 2:
        return {m: np.empty(0) for m in groups}
    weights = np.random.default_rng(seed).multinomial(len(names), np.full(len(names), 1 / len(names)), size=RESAMPLES)
    draws = {}
    for m, g in groups.items():
        errors = np.mean([np.bincount(index, r.squared_error) for r in g], axis=0)
        pixels = np.bincount(index, g[0].pixels)
        with np.errstate(invalid="ignore", divide="ignore"):
            draws[m] = (weights @ errors) / (weights @ pixels)
    return draws


def _welch(va: float, vb: float, na: int, nb: int) -> float:
    """Welch-Satterthwaite degrees of freedom of a difference of means with variances va and vb."""
    bottom = va**2 / (na - 1) + vb**2 / (nb - 1)
    return (va + vb) ** 2 / bottom if bottom > 0 else float(na + nb - 2)


def two_sided_p(t: float, freedom: float) -> float:
    """Probability that |Student's t| exceeds |t|, by Simpson's rule on the angle atan(t / sqrt(freedom))."""
    # With t = sqrt(v) tan(a) the density becomes cos(a)^(v - 1) up to a constant, smooth on a finite interval.
    angle = np.linspace(math.atan(abs(t) / math.sqrt(freedom)), math.pi / 2, 2001)
    density = np.cos(angle) ** (freedom - 1)
    step = angle[1] - angle[0]
    area = step / 3 * (density[0] + density[-1] + 4 * density[1:-1:2].sum() + 2 * density[2:-1:2].sum())
    constant = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(math.pi)
    return float(min(1.0, 2 * constant * area))


def _holm(pairs: list[dict[str, Any]]) -> None:
    """Add Holm's adjusted p and the verdict to every pair."""
    known = sorted((p for p in pairs if p["p"] is not None), key=lambda p: p["p"])
    running = 0.0
    for rank, pair in enumerate(known):
        running = max(running, min(1.0, pair["p"] * (len(known) - rank)))
        pair["p_adjusted"] = running
    for pair in pairs:
        pair.setdefault("p_adjusted", None)
        pair["larger_than_noise"] = None if pair["p"] is None else pair["p_adjusted"] < LEVEL


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def run(
    files: Sequence[tuple[Path, Path]], json_file: Path | None = None, figures: Path | None = None
) -> dict[str, Any]:
    """Compare the runs behind (evaluation, checkpoint) files; writes JSON and the curves where asked."""
    runs = [read_run(evaluation, checkpoint) for evaluation, checkpoint in files]
    result = compare(runs)
    if json_file is not None:
        write_json(json_file, result)
    if figures is not None:
        write_curves(runs, figures)
    return result


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
        interval = "-" if row["mse_low"] is None else f"{row['mse_low']:.3e} .. {row['mse_high']:.3e}"
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
    return ["model", "MSE/crop", "+- seeds", "MSE", "95 % over tiles", "best epochs", "paper's MSE/crop"], cells


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
