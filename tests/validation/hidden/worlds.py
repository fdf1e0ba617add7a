"""Worlds other than the usual one: what a diagnosis should not depend on, and what no threshold of it was set on."""

from __future__ import annotations

from typing import Any

# name -> changes of Layout, changes of Truth
WORLDS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "usual": ({}, {}),
    "nadir": ({"emissions": (0.0, 3.0), "opposition": 0}, {}),  # as a narrow-angle camera looks
    "oblique": ({"emissions": (20.0, 60.0)}, {}),
    "low_sun": ({"sun_elevations": (3.0, 25.0), "opposition": 1}, {}),
    "high_sun": ({"sun_elevations": (40.0, 80.0)}, {}),
    "measured_relief": ({"relief": "dem/kepler_lola.tif"}, {}),
    "fine_noise": ({}, {"dem_noise_px": 0.7}),
    "broad_noise": ({}, {"dem_noise_px": 4.0}),
    "patches": ({}, {"texture_kind": "patches"}),
    "units": ({}, {"texture_kind": "units"}),
    # what real photographs have and the first campaigns had not, each alone
    "veil_fine": ({}, {"veil": 0.005, "veil_px": 4.0}),
    "veil": ({}, {"veil": 0.005, "veil_px": 12.0}),
    "veil_strong": ({}, {"veil": 0.02, "veil_px": 12.0}),
    "veil_broad": ({}, {"veil": 0.01, "veil_px": 40.0}),
    "drift": ({}, {"drift": 0.04}),
    "quiet": ({}, {"snr": 150.0}),
    "noisy": ({}, {"snr": 30.0}),
    "aligned": ({"rotation_deg": 0.0}, {}),
    "turned": ({"rotation_deg": 60.0, "border": 40, "margin": 56}, {}),
    "dem_samples": ({}, {"dem_samples": True, "dem_smoothing": 0.0}),
    "one_image": ({"sites": 36, "images": 12, "per_site": 1}, {}),
    "two_images": ({"sites": 18, "images": 12, "per_site": 2}, {}),
    "four_images": ({"sites": 10, "images": 12, "per_site": 4}, {}),
    "photograph": ({}, {"veil": 0.006, "veil_px": 12.0, "drift": 0.03, "snr": 60.0}),
}

__all__ = ["WORLDS"]
