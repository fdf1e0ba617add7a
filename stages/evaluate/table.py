"""From per-crop scores to the table: pooled errors, intervals over ground and training runs, gains, conclusions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stages.common.intervals import ERROR, Interval, gain_interval, ratio_interval
from stages.common.page.sentences import basis, compared, verdict
from stages.evaluate.metrics import psnr
from stages.evaluate.rows import TITLES, freedom
from stages.evaluate.scores import Scores

PAIRED = ("learned", "learned_gain_offset", "learned_extended", "learned_extended_gain_offset")
# Rows that are compared like for like: they know nothing of the scored crops, or two numbers of each.
CLASSES = {
    "none": "Knowing nothing of the scored crops",
    "gain_offset": "With a least-squares gain and offset for each scored crop",
}


def metric_table(scores: Scores, unit: np.ndarray) -> dict[str, dict[str, Any]]:
    """The metrics of every row by name; a number that does not exist (or is infinite) is None.

    scores : of every training run; unit : (N,) labels of independent ground
    mse, rmse, psnr : over all valid pixels; mse_crop_sum : mean over crops of the sum over the crop's pixels;
    psnr_crop_mean, psnr_crop_range, ssim, lpips : means over crops. All are means over training runs. ``_low`` and
    ``_high`` bound 95 %; ``mse_runs`` holds each run's, ``mse_run_std`` their standard deviation.
    """
    pixels = scores.pixels.astype(float)
    crops = (pixels > 0).astype(float)
    table = {}
    for name in dict.fromkeys(scores.names):
        totals = scores.runs(name)
        mse = ratio_interval(totals, pixels, unit, ERROR)
        runs = totals.sum(axis=1) / pixels.sum()
        row: dict[str, Any] = {
            "mse": mse.value,
            "mse_low": max(0.0, mse.low) if math.isfinite(mse.low) else mse.low,
            "mse_high": mse.high,
            "mse_run_std": float(np.std(runs, ddof=1)) if len(runs) > 1 else math.nan,
            "mse_crop_sum": float(totals.mean(axis=0).sum() / crops.sum()),
            "rmse": math.sqrt(mse.value),
            "psnr": float(psnr(mse.value)),
            "psnr_low": float(psnr(mse.high)),
            "psnr_high": float(psnr(mse.low)),
            "psnr_crop_mean": _mean(np.asarray(psnr(scores.runs(name, "mse")))),
        }
        for metric in ("psnr_crop_range", "ssim", "ssim_range_1", "lpips"):
            values = scores.runs(name, metric)
            row[metric] = _mean(values)
            if metric != "ssim_range_1":
                interval = ratio_interval(values, crops, unit)
                row[f"{metric}_low"], row[f"{metric}_high"] = interval.low, interval.high
        numbers: dict[str, Any] = {key: finite(value) for key, value in row.items()}
        table[name] = numbers | {"freedom": freedom(name), "mse_runs": runs.tolist()}
    return table


def gain_table(scores: Scores, unit: np.ndarray) -> dict[str, dict[str, dict[str, float | None]]]:
    """By how much each learned row lowers the MSE of every other row, in percent, with paired intervals."""
    names = list(dict.fromkeys(scores.names))
    table: dict[str, dict[str, dict[str, float | None]]] = {}
    for ours in (n for n in PAIRED if n in names):
        table[ours] = {}
        for other in (n for n in names if n != ours):
            table[ours][other] = gain_entry(gain_interval(scores.runs(ours), scores.runs(other), unit))
    return table


def gain_entry(gain: Interval) -> dict[str, float | None]:
    """A gain as the JSON holds it."""
    return {
        "gain_percent": finite(gain.value),
        "gain_percent_low": finite(gain.low),
        "gain_percent_high": finite(gain.high),
    }


def strongest_baselines(models: dict[str, dict[str, Any]]) -> dict[str, str]:
    """Of each class of freedom the row without a network that has the lowest MSE."""
    found = {}
    for kind in CLASSES:
        rivals = [n for n, row in models.items() if row["freedom"] == kind and not n.startswith("learned")]
        if rivals:
            found[kind] = min(rivals, key=lambda n: models[n]["mse"])
    return found


def conclude(result: dict[str, Any]) -> list[str]:
    """What the table says of each learned row against the strongest baseline of the same freedom, one sentence each."""
    sentences = []
    for kind, words in CLASSES.items():
        rival = result["strongest_baseline"].get(kind)
        for ours in (n for n in result["gains"] if rival and result["models"][n]["freedom"] == kind):
            gain = result["gains"][ours][rival]
            if gain["gain_percent"] is None:
                continue
            name = "the learned reflectance" + (" with the diagnosed effects" if "extended" in ours else "")
            other = f"the strongest baseline, {rival} ({TITLES[rival]})"
            sentences.append(compared(f"{words}, {name}", other, gain, basis(result))[0])
    return sentences


def _mean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def finite(value: float) -> float | None:
    """A number as JSON can hold it: None for NaN and infinity."""
    return value if math.isfinite(value) else None


def result_lines(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and cells of the table on the terminal."""
    columns = ["model", "MSE", "95 % interval", "+- runs", "MSE/crop", "RMSE", "PSNR", "PSNR crop", "SSIM", "LPIPS"]
    cells = []
    for name, row in result["models"].items():
        cells.append(
            [
                name,
                f"{row['mse']:.3e}",
                _bounds_text(row),
                "-" if row["mse_run_std"] is None else f"{row['mse_run_std']:.1e}",
                f"{row['mse_crop_sum']:.3f}",
                f"{row['rmse']:.5f}",
                *(
                    "-" if row[key] is None else f"{row[key]:.{digits}f}"
                    for key, digits in (("psnr", 2), ("psnr_crop_range", 2), ("ssim", 3), ("lpips", 3))
                ),
            ]
        )
    return columns, cells


def _bounds_text(row: dict[str, Any]) -> str:
    """The interval of a row's MSE; so few tiles may scatter so much that nothing bounds it from above."""
    if row["mse_low"] is None:
        return "-"
    return f"{row['mse_low']:.3e} .. " + ("unbounded" if row["mse_high"] is None else f"{row['mse_high']:.3e}")


def gain_lines(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and cells of the table of what the learned model gains over each baseline of the same freedom; an interval that holds 0 is no difference."""
    columns = ["model", "against", "lower MSE by", "95 % interval", "verdict"]
    cells = []
    for ours, others in result["gains"].items():
        for other, gain in others.items():
            if not _comparable(result, ours, other):
                continue
            if gain["gain_percent"] is None:
                cells.append([ours, other, "-", "-", "-"])
                continue
            low, high = gain["gain_percent_low"], gain["gain_percent_high"]
            bounds = "-" if low is None or high is None else f"{low:+.1f} .. {high:+.1f} %"
            cells.append([ours, other, f"{gain['gain_percent']:+.1f} %", bounds, verdict(gain)])
    return columns, cells


def _comparable(result: dict[str, Any], ours: str, other: str) -> bool:
    """Rows of the same freedom, and the paper's comparison: free against matched by range. Not a network with itself."""
    if other.startswith("learned"):
        return ours.startswith("learned_extended") and other == ours.replace("_extended", "")
    freedoms = [result["models"][name]["freedom"] for name in (ours, other)]
    return freedoms[0] == freedoms[1] or freedoms == ["none", "minmax"]
