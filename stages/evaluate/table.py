"""From per-crop scores to the table: pooled errors, intervals over ground tiles, gains of the learned model."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stages.evaluate.bootstrap import TileBootstrap
from stages.evaluate.core import Scores
from stages.evaluate.metrics import psnr

PAIRED = ("learned", "learned_gain_offset", "learned_extended", "learned_extended_gain_offset")


def metric_table(scores: Scores, bootstrap: TileBootstrap) -> dict[str, dict[str, float | None]]:
    """The metrics of every row by name; a number that does not exist (or is infinite) is None.

    mse, rmse, psnr : over all valid pixels; mse_crop_sum : mean over crops of the sum over the crop's pixels;
    psnr_crop_mean, psnr_crop_range, ssim, lpips : means over crops. ``_low`` and ``_high`` bound 95 %.
    """
    pixels = scores.pixels.astype(float)
    crops = (pixels > 0).astype(float)
    table = {}
    for k, name in enumerate(scores.names):
        total = scores.squared_error[k]
        mse = float(total.sum() / pixels.sum())
        low, high = bootstrap.interval(bootstrap.draws(total, pixels))
        row: dict[str, float] = {
            "mse": mse,
            "mse_low": low,
            "mse_high": high,
            "mse_crop_sum": float(total.sum() / crops.sum()),
            "rmse": math.sqrt(mse),
            "psnr": float(psnr(mse)),
            "psnr_low": float(psnr(high)),
            "psnr_high": float(psnr(low)),
            "psnr_crop_mean": _mean(np.asarray(psnr(scores.mse[k]))),
        }
        for metric, values in (
            ("psnr_crop_range", scores.psnr_crop_range[k]),
            ("ssim", scores.ssim[k]),
            ("ssim_range_1", scores.ssim_range_1[k]),
            ("lpips", scores.lpips[k]),
        ):
            row[metric] = _mean(values)
            if metric != "ssim_range_1":
                row[f"{metric}_low"], row[f"{metric}_high"] = bootstrap.interval(bootstrap.draws(values, crops))
        table[name] = {key: _number(value) for key, value in row.items()}
    return table


def gain_table(scores: Scores, bootstrap: TileBootstrap) -> dict[str, dict[str, dict[str, float | None]]]:
    """By how much each learned row lowers the MSE of every other row, in percent, with paired intervals."""
    pixels = scores.pixels.astype(float)
    pooled = scores.squared_error.sum(axis=1)
    draws = {n: bootstrap.draws(scores.squared_error[k], pixels) for k, n in enumerate(scores.names)}
    table: dict[str, dict[str, dict[str, float | None]]] = {}
    for ours in (n for n in PAIRED if n in scores.names):
        table[ours] = {}
        for k, other in enumerate(scores.names):
            if other == ours:
                continue
            with np.errstate(invalid="ignore", divide="ignore"):
                gain = 100 * (1 - pooled[scores.names.index(ours)] / pooled[k])
                low, high = bootstrap.interval(100 * (1 - draws[ours] / draws[other]))
            table[ours][other] = {
                "gain_percent": _number(float(gain)),
                "gain_percent_low": _number(low),
                "gain_percent_high": _number(high),
            }
    return table


def verdict(low: float | None, high: float | None) -> str:
    """What a paired interval says in one word or two."""
    if low is None or high is None:
        return "unknown"
    return "better" if low > 0 else "worse" if high < 0 else "no difference"


def _mean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def result_lines(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and cells of the table on the terminal."""
    columns = ["model", "MSE", "95 % interval", "MSE/crop", "RMSE", "PSNR", "PSNR crop", "SSIM", "LPIPS"]
    cells = []
    for name, row in result["models"].items():
        bounds = "-" if row["mse_low"] is None else f"{row['mse_low']:.3e} .. {row['mse_high']:.3e}"
        cells.append(
            [
                name,
                f"{row['mse']:.3e}",
                bounds,
                f"{row['mse_crop_sum']:.3f}",
                f"{row['rmse']:.4f}",
                *(
                    "-" if row[key] is None else f"{row[key]:.{digits}f}"
                    for key, digits in (("psnr", 2), ("psnr_crop_range", 2), ("ssim", 3), ("lpips", 3))
                ),
            ]
        )
    return columns, cells


def gain_lines(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """What the learned model gains over each baseline; a gain whose interval holds 0 is no difference."""
    columns = ["model", "against", "lower MSE by", "95 % interval", "verdict"]
    cells = []
    for ours, others in result["gains"].items():
        for other, gain in others.items():
            if other.startswith("learned") and not ours.startswith("learned_extended"):
                continue
            if gain["gain_percent"] is None:
                cells.append([ours, other, "-", "-", "-"])
                continue
            low, high = gain["gain_percent_low"], gain["gain_percent_high"]
            known = low is not None and high is not None
            cells.append(
                [
                    ours,
                    other,
                    f"{gain['gain_percent']:+.1f} %",
                    f"{low:+.1f} .. {high:+.1f} %" if known else "-",
                    verdict(low, high),
                ]
            )
    return columns, cells
