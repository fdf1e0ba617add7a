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
}

__all__ = ["WORLDS"]
