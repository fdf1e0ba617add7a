"""Seen ground under unseen images: a section of its own, because it is another claim than unseen ground."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from stages.common import page
from stages.common.page.diagnosis import formatted as cell
from stages.common.page.sentences import basis, bounds, verdict

TITLES = {
    "terrain": "map from terrain",
    "albedo": "with albedo from the other photographs",
    "refined": "with refined elevations and albedo",
    "terrain_gain_offset": "map from terrain, gain + offset per crop",
    "albedo_gain_offset": "with albedo, gain + offset per crop",
    "refined_gain_offset": "with refined elevations and albedo, gain + offset per crop",
}


def held_out_images(result: dict[str, Any]) -> page.Section:
    """Maps without and with albedo on photographs that had no part in it."""
    section = page.Section("Albedo, judged by unseen images")
    unit = "I/F" if result["image_units"] == "iof" else "DN"
    rows = []
    for name, row in result["models"].items():
        interval = "-" if row["mse_low"] is None else f"{row['mse_low']:.2e} .. {cell(row['mse_high'], '.2e')}"
        gain = next(iter(result["gains"].get(name, {}).values()), None)
        lowered = "-"
        if gain and gain["gain_percent"] is not None:
            lowered = f"{gain['gain_percent']:+.1f} ({bounds(gain)}): {verdict(gain)}"
        rows.append([TITLES.get(name, name), f"{row['mse']:.3e}", interval, cell(row.get("ssim"), ".3f"), lowered])
    section.add(
        page.paragraph(
            f"Claim: {result['claim']}. Other photographs of the same ground made the albedo; no scored image had a part in "
            f"it. {basis(result)}; errors in {unit}. Not to be read beside the table of unseen ground."
        ),
        page.table("The same pairs, each map", ["map", "MSE", "95 % interval", "SSIM", "MSE lowered by, %"], rows),
    )
    coverage = result.get("coverage_percent")
    if coverage:
        section.add(_coverage(coverage))
    images = [
        [
            image["image_id"], str(image["crops"]), f"{image['nearest_used_sun_deg']:.1f}",
            f"{image['mse_terrain']:.3e}", f"{image['mse_albedo']:.3e}",
        ]
        for image in result.get("images", [])
    ]  # fmt: skip
    if images:
        header = ["unseen image", "crops", "nearest Sun used, deg", "MSE from terrain", "MSE with albedo"]
        section.add(page.table("By image", header, images))
    return section


def _coverage(coverage: dict[str, Any]) -> Markup:
    """How many pixels the error bars hold, in all and by incidence where that was counted."""
    rows = [["all", cell(coverage.get("68"), ".1f"), cell(coverage.get("95"), ".1f")]]
    for band in coverage.get("by_incidence", []):
        name = f"{band['incidence_low_deg']:g} to {band['incidence_high_deg']:g}"
        rows.append([name, cell(band["68"], ".1f"), cell(band["95"], ".1f")])
    columns = ["incidence, deg", "within the 68 % interval, %", "within the 95 % interval, %"]
    return page.table("Error bars: share of the pixels of unseen images", columns, rows)
