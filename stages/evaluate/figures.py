"""Pictures of an evaluation: training curves, errors with intervals, and the best, median and worst crops."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from schemas import CHECKPOINT, atomic_path, open_artefact
from stages.evaluate.renderers import Batch, read_batch
from stages.evaluate.rows import TITLES, Row
from stages.evaluate.scores import Scores
from stages.evaluate.task import Task

DPI = 130
COLOURS = {
    "learned": "#1b6ca8",
    "global": "#4f9d69",
    "kernels": "#7a5ba6",
    "lunar_lambert": "#c08a2e",
    "hapke": "#a8434b",
}
DRAWN = (
    "learned", "learned_gain_offset", "learned_extended", "global", "kernels", "hapke_fitted", "hapke_minmax",
    "hapke_gain_offset",
)  # fmt: skip


def write_figures(
    folder: Path, task: Task, rows: list[Row], scores: Scores, scale: float, result: dict[str, Any], checkpoint: Path
) -> None:
    """Write all figures as PNG into ``folder``. rows, scores : one for each name; scale : full range of DN"""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    def save(figure: Any, name: str) -> None:
        with atomic_path(folder / name) as partial:
            figure.savefig(partial, dpi=DPI, bbox_inches="tight", facecolor="white")
        plt.close(figure)

    save(training_curves(checkpoint), "training_curves.png")
    save(error_chart(result), "errors.png")
    units = "I/F" if result["image_units"] == "iof" else "share of the DN range"
    for label, position in exemplary_crops(scores).items():
        batch = read_batch(task.reader, task.wanted[position : position + 1], scale)
        save(crop_figure(batch, rows, scores, position, label, units), f"crop_{label}.png")


def exemplary_crops(scores: Scores) -> dict[str, int]:
    """Positions of the first model's (the learned one's) best, median and worst crop by MSE."""
    mse = scores.mse[0]
    order = np.argsort(np.where(np.isfinite(mse), mse, np.inf))[: int(np.isfinite(mse).sum())]
    return {"best": int(order[0]), "median": int(order[len(order) // 2]), "worst": int(order[-1])}


def training_curves(checkpoint: Path) -> Any:
    """Training and validation loss against epoch."""
    import matplotlib.pyplot as plt

    with open_artefact(checkpoint, CHECKPOINT) as file:
        train, validation = file["train_loss"][...], file["validation_loss"][...]
        best, model = int(file.attrs["best_epoch"]), file.attrs["model"]
    epochs = np.arange(1, len(train) + 1)
    figure, axes = plt.subplots(figsize=(6, 3.6))
    axes.plot(epochs, train, color="#8a8f98", label="training")
    axes.plot(epochs, validation, color=COLOURS["learned"], label="validation")
    axes.axvline(best, color="#c08a2e", linewidth=1, linestyle=":", label=f"kept: epoch {best}")
    if np.all(np.concatenate([train, validation]) > 0):
        axes.set_yscale("log")
    axes.locator_params(axis="x", integer=True)
    axes.set(xlabel="epoch", ylabel="mean squared error", title=f"Training of {model}")
    axes.grid(alpha=0.25, which="both", linewidth=0.5)
    axes.legend(frameon=False)
    return figure


def error_chart(result: dict[str, Any]) -> Any:
    """Root mean squared error of every model with its 95 % interval."""
    import matplotlib.pyplot as plt

    names = list(result["models"])
    figure, axes = plt.subplots(figsize=(7.5, 0.42 * len(names) + 1.1))
    for k, name in enumerate(names):
        row = result["models"][name]
        colour = next(c for key, c in COLOURS.items() if name.startswith(key))
        if row["mse_low"] is not None and row["mse_high"] is not None:
            axes.plot(np.sqrt([row["mse_low"], row["mse_high"]]), [k, k], color=colour, linewidth=2.5, alpha=0.55)
        axes.plot(row["rmse"], k, "o", color=colour, markersize=6)
    axes.set_yticks(range(len(names)), [TITLES.get(n, n) for n in names], fontsize=8)
    axes.invert_yaxis()
    unit = "I/F" if result["image_units"] == "iof" else "share of the DN range"
    axes.set(xlabel=f"root mean squared error, {unit}", title=f"Split '{result['split']}', {result['pairs']} crops")
    errors = [row["rmse"] for row in result["models"].values() if row["rmse"]]
    if errors and max(errors) > 8 * min(errors):
        axes.set_xscale("log")
    axes.grid(axis="x", which="both", alpha=0.25, linewidth=0.5)
    return figure


def crop_figure(batch: Batch, rows: list[Row], scores: Scores, position: int, label: str, units: str) -> Any:
    """One crop: measured and the main models above, residuals (measured - rendered) below, on shared scales."""
    import matplotlib.pyplot as plt

    usable = batch.usable[0].numpy()
    measured = np.where(usable, batch.image[0].numpy(), np.nan)
    low, high = np.nanpercentile(measured, (0.5, 99.5))
    learned = np.where(usable, measured - rows[0].renderer.image(batch, rows[0].matching)[0].numpy(), np.nan)
    spread = float(np.nanpercentile(np.abs(learned), 99)) or 1e-6
    drawn = [k for k, row in enumerate(rows) if k == 0 or row.name in DRAWN]
    columns = len(drawn) + 1
    figure, axes = plt.subplots(2, columns, figsize=(1.75 * columns + 0.6, 4.4), layout="constrained")
    greys, differences = (plt.get_cmap(name).with_extremes(bad="#d9c9a3") for name in ("gray", "RdBu_r"))
    picture = axes[0, 0].imshow(measured, cmap=greys, vmin=low, vmax=high)
    axes[0, 0].set_title("measured", fontsize=8)
    axes[1, 0].imshow(np.where(usable, batch.observation.elevation[0].numpy(), np.nan), cmap="cividis")
    axes[1, 0].set_title("elevation", fontsize=8)
    for column, k in enumerate(drawn, start=1):
        row = rows[k]
        rendered = np.where(usable, row.renderer.image(batch, row.matching)[0].numpy(), np.nan)
        axes[0, column].imshow(rendered, cmap=greys, vmin=low, vmax=high)
        axes[0, column].set_title(row.name.replace("_", " "), fontsize=8, wrap=True)
        residual = axes[1, column].imshow(measured - rendered, cmap=differences, vmin=-spread, vmax=spread)
        axes[1, column].set_title(f"rms {np.sqrt(scores.mse[k, position]):.4f}", fontsize=8)
    for axis in axes.flat:
        axis.set_axis_off()
    figure.colorbar(picture, ax=axes[0], fraction=0.02, pad=0.01, label=units)
    figure.colorbar(residual, ax=axes[1], fraction=0.02, pad=0.01, label="measured - rendered")
    figure.suptitle(f"The {label} crop of '{rows[0].name}'", fontsize=10)
    return figure
