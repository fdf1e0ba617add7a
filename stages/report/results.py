"""Evaluation, matching, model comparison and diagnosis: one function per result, from numbers to a section."""

from __future__ import annotations

import math
from typing import Any

import h5py
import numpy as np
from markupsafe import Markup

from stages.common import page
from stages.common.page import pictures
from stages.common.page.diagnosis import chapters, conclusions, words
from stages.common.page.diagnosis import formatted as cell
from stages.common.page.sentences import basis, bounds, verdict

COLOURS = {
    "learned": "#3b8ecb",
    "global": "#4f9d69",
    "kernels": "#8d6cc0",
    "lunar_lambert": "#c08a2e",
    "hapke": "#c25b63",
}
UNITS = {"tile": "ground tiles", "site": "the sites of one ground tile"}
EXAMPLES = (
    "learned", "learned_gain_offset", "learned_extended", "global", "kernels", "hapke_fitted", "lunar_lambert",
    "hapke_minmax", "hapke_gain_offset",
)  # fmt: skip


def evaluation(result: dict[str, Any], file: h5py.File | None) -> page.Section:
    """The table of models, what the learned one gains, and example crops where the file kept renderings."""
    section = page.Section("Evaluation on unseen ground")
    models, titles = result["models"], result.get("titles", {})
    unit = "I/F" if result["image_units"] == "iof" else f"shares of the full range of {result['dn_full_range']:.0f} DN"
    rows = [
        [
            titles.get(name, name), f"{m['mse']:.3e}",
            "-" if m["mse_low"] is None else f"{m['mse_low']:.2e} .. {cell(m['mse_high'], '.2e')}",
            cell(m.get("mse_run_std"), ".1e"), cell(m["mse_crop_sum"], ".3f"), cell(m["psnr"], ".2f"), cell(m["psnr_crop_range"], ".2f"),
            cell(m["ssim"], ".3f"), cell(m["lpips"], ".3f"),
        ]
        for name, m in models.items()
    ]  # fmt: skip
    best = int(np.argmin([m["mse"] for m in models.values()]))
    header = [
        "model", "MSE", "95 % interval", "+- training runs", "MSE per crop", "PSNR, dB", "PSNR of crop range, dB",
        "SSIM", "LPIPS",
    ]  # fmt: skip
    section.add(
        page.paragraph(
            f"Split '{result['split']}': {basis(result)}; errors in {unit}. Intervals take "
            f"{UNITS.get(result.get('interval_unit', 'tile'))} for independent (delete-one jackknife, Student's t)"
            + (" and hold the spread of training runs." if result.get("training_runs", 1) > 1 else ".")
        ),
        page.table("Lowest MSE in bold", header, rows, best),
        page.chart(_errors(result), "Root mean squared error with 95 % intervals"),
    )
    rows = [
        [
            words(ours), words(other), cell(gain["gain_percent"], "+.1f"), bounds(gain),
            verdict(gain).replace(" ", "\u00a0"),
        ]
        for ours, others in result["gains"].items()
        for other, gain in others.items()
        if _like_for_like(models, ours, other)
    ]  # fmt: skip
    if rows:
        header = ["model", "against", "MSE lowered by, %", "interval", "verdict"]
        section.add(page.table(f"What the learned reflectance gains: {basis(result)}", header, rows))
    for note in result.get("warnings", []):
        section.add(page.paragraph(f"Note: {note}.", "soft"))
    if result.get("lpips_unavailable"):
        section.add(page.paragraph(f"LPIPS is not available: {result['lpips_unavailable']}.", "soft"))
    if file is not None and "rendered" in file:
        section.add(*_examples(file, list(models), unit))
    return section


def before_and_after(result: dict[str, Any], file: h5py.File | None) -> list[Markup]:
    """One test crop: the photograph, and a slider between the strongest model without a network and the learned one.

    It is the crop where the learned one gains what it gains on the median crop.
    """
    other = result.get("strongest_baseline", {}).get("none")
    if file is None or "rendered" not in file or not {"learned", other} <= set(result["models"]):
        return []
    names = list(result["models"])
    pair = [names.index(name) for name in (other, "learned")]
    before, after = (file["mse"][m] for m in pair)
    ratio = np.where(before > 0, after / np.where(before > 0, before, 1), np.nan)
    order = np.argsort(ratio)[: int(np.isfinite(ratio).sum())]
    if not len(order):
        return []
    k = int(order[len(order) // 2])
    measured = file["measured"][k]
    low, high = pictures.limits(measured)
    photograph, left, right = (
        pictures.photo_uri(pictures.coloured(image, low, high, "gray"))
        for image in (measured, *(file["rendered"][m, k] for m in pair))
    )
    titles = result.get("titles", {})
    percent = 100 * (1 - ratio[k])
    caption = (
        f"The same crop rendered without and with the network (pair {file['pair_index'][k]}): the squared error "
        f"changes by {-percent:+.0f} %, as on the median test crop."
    )
    return [
        page.picture(photograph, "A photograph of ground that training never saw"),
        page.slider(left, right, (titles.get(other, words(other)), titles.get("learned", "learned")), caption),
    ]


def _like_for_like(models: dict[str, Any], ours: str, other: str) -> bool:
    """Rows of the same freedom, and the paper's comparison with Hapke matched by range."""
    if other.startswith("learned"):
        return ours.startswith("learned_extended") and other == ours.replace("_extended", "")
    freedoms = [models[name].get("freedom") for name in (ours, other)]
    return freedoms[0] == freedoms[1] or freedoms == ["none", "minmax"]


def _errors(result: dict[str, Any]) -> str:
    names = list(result["models"])
    figure, axes = pictures.new_chart(7.2, 0.36 * len(names) + 0.8)
    for k, name in enumerate(names):
        row = result["models"][name]
        colour = next((c for key, c in COLOURS.items() if name.startswith(key)), "#888888")
        if row["mse_low"] is not None and row["mse_high"] is not None:
            axes.plot(np.sqrt([row["mse_low"], row["mse_high"]]), [k, k], color=colour, linewidth=3, alpha=0.5)
        axes.plot(row["rmse"], k, "o", color=colour, markersize=6)
    axes.set_yticks(range(len(names)), [words(n) for n in names], fontsize=8)
    axes.invert_yaxis()
    values = [m["rmse"] for m in result["models"].values() if m["rmse"] > 0]
    if values and max(values) > 8 * min(values):
        axes.set_xscale("log")
    axes.set_xlabel("root mean squared error")
    return pictures.chart_svg(figure, "errors")


def _examples(file: h5py.File, names: list[str], unit: str) -> list[Markup]:
    """Measured, rendered and residual for the first model's best, median and worst crop."""
    mse = file["mse"][0]
    order = np.argsort(mse)[: int(np.isfinite(mse).sum())]
    if not len(order):
        return []
    parts = [page.heading("Example crops: rendered above, measured - rendered below")]
    for label, k in (("best", order[0]), ("median", order[len(order) // 2]), ("worst", order[-1])):
        measured = file["measured"][k]
        low, high = pictures.limits(measured)
        shown = [m for m, name in enumerate(names) if m == 0 or name in EXAMPLES]
        rendered = {m: file["rendered"][m, k] for m in shown}
        spread = pictures.limits(np.abs(measured - rendered[0]), 1.0)[1]
        figures = [page.picture(pictures.data_uri(pictures.coloured(measured, low, high, "gray")), "measured")]
        for m in shown:
            above = pictures.data_uri(pictures.coloured(rendered[m], low, high, "gray"))
            below = pictures.data_uri(pictures.coloured(measured - rendered[m], -spread, spread, "RdBu_r"))
            text = words(names[m])
            caption = f"{text}: rms {math.sqrt(file['mse'][m, k]):.4f}"
            figures.append(page.picture_pair(above, below, f"residual of {text}", caption))
        bars = [
            (page.colour_bar(low, high, "gray", ""), f"brightness, {unit}"),
            (page.colour_bar(-spread, spread, "RdBu_r", ""), "measured - rendered"),
        ]
        title = f"The {label} crop of '{names[0]}' (pair {file['pair_index'][k]})"
        parts += [page.heading(title), page.crops(figures), page.named_bars(bars)]
    return parts


def matching(result: dict[str, Any]) -> page.Section:
    """Matching consistency."""
    section = page.Section("Feature matching")
    rows = []
    for matcher, renderings in result["matchers"].items():
        for name, m in renderings.items():
            shift = m.get("median_shift_right_px")
            rows.append(
                [matcher, words(name), str(m["matches"])]
                + [cell(m[f"within_{t}_px_percent"], ".1f") for t in (1, 3, 5)]
                + [cell(m["mean_error_px"], ".2f"), cell(m["median_error_px"], ".2f")]
                + ["-" if shift is None else f"{shift:+.1f}, {m['median_shift_down_px']:+.1f}"]
            )
    shares = ["within 1 px, %", "3 px, %", "5 px, %"]
    header = ["matcher", "rendering", "matches", *shares, "mean, px", "median, px", "shift, px"]
    width, height = result["size_px"]
    title = f"{result['crops']} pictures at {width} x {height} px on {result.get('tiles', 1)} ground tiles"
    section.add(
        page.paragraph(
            "Measured and rendered images show the same ground, so every match should end where it began. "
            "A median shift far from zero is misregistration, which no reflectance can mend."
        ),
        page.table(title, header, rows),
    )
    return section


def comparison(result: dict[str, Any]) -> page.Section:
    """Several models from several seeds."""
    section = page.Section("Comparison of reflectance models")
    rows = [
        [
            name, cell(m["mse_crop_sum"], ".4f"), cell(m["mse_crop_sum_seed_std"], ".4f"), cell(m["mse"], ".4e"),
            "-" if m["mse_low"] is None else f"{m['mse_low']:.3e} .. {cell(m['mse_high'], '.3e')}",
            ", ".join(map(str, m["best_epoch"])), cell(m["paper_mse_crop_sum"], ".2f"),
        ]
        for name, m in result["models"].items()
    ]  # fmt: skip
    header = ["model", "MSE per crop", "spread of seeds", "MSE", "95 % over tiles and seeds", "best epochs"]
    title = f"{result['crops']} crops, {result['tiles']} ground tiles, {result.get('seeds', 1)} training runs each"
    section.add(page.table(title, [*header, "paper's MSE per crop"], rows, 0))
    answers = {True: "yes", False: "no", None: "needs two seeds and two tiles"}
    rows = [
        [
            f"{p['better']} < {p['worse']}", f"{p['difference_percent']:.1f}", cell(p["noise_of_seeds"], ".1e"),
            cell(p["noise_of_tiles"], ".1e"), cell(p["p_adjusted"], ".3f"), answers[p["larger_than_noise"]],
        ]
        for p in result["differences"]
    ]  # fmt: skip
    header = ["pair", "difference, %", "noise of seeds", "noise of tiles", "p (Holm)", "larger than its noise"]
    section.add(page.table("Which differences are larger than their noise", header, rows))
    return section


def diagnosis(result: dict[str, Any]) -> page.Section:
    """What the simulation gets wrong: the chapters of the diagnosis's own page, without its pictures."""
    section = page.Section("Diagnosis")
    section.add(*(page.paragraph(text) for text, _ in conclusions(result)))
    for title, parts in chapters(result):
        section.add(page.heading(title), *parts)
    return section
