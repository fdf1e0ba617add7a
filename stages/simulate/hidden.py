"""Hidden effects: planted in the images, the image table or the DEM, and recorded in truth.h5 only.

They are defined physically here, on the fine grid and in the sensor's own terms, apart from the templates of
``stages/effects``: a diagnosis that names them has not been given its own formula. Names and signs follow the catalogue
of ``diagnose`` (an error is truth minus what is given).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

from schemas.errors import ConfigError, RegistryError

# effect -> parameter -> (default, lowest, highest, unit, description)
CHOICES: dict[str, dict[str, tuple[float, float, float, str, str]]] = {
    "dark_bias": {"iof": (0.004, -0.05, 0.05, "1", "stray light or dark current left in every pixel, I/F")},
    "nonlinearity": {"quadratic": (-0.6, -3.0, 3.0, "1", "I -> I (1 + q I): a full well that fills up")},
    "opposition_surge": {
        "B0": (0.6, 0.0, 3.0, "1", "extra amplitude: I (1 + B0 / (1 + tan(g/2) / h))"),
        "h": (0.06, 0.005, 0.3, "1", "its angular width"),
    },
    "phase_slope": {"per_radian": (0.3, -2.0, 2.0, "rad-1", "I exp(-beta g)")},
    "psf_blur": {"sigma2_px2": (0.8, 0.0, 9.0, "px2", "variance of a defocus, image pixels")},
    "sun_azimuth": {"error_deg": (2.0, -20.0, 20.0, "degree", "true minus tabulated azimuth of the Sun")},
    "sun_elevation": {"error_deg": (0.8, -5.0, 5.0, "degree", "true minus tabulated elevation of the Sun")},
    "penumbra": {"radius_deg": (1.2, 0.01, 5.0, "degree", "effective angular radius of the Sun")},
    "earthshine": {
        "irradiance": (0.004, 0.0, 0.1, "1", "I/F of a facet that faces it"),
        "elevation_deg": (50.0, 1.0, 90.0, "degree", "elevation of the source"),
        "azimuth_deg": (120.0, -360.0, 360.0, "degree", "azimuth of the source"),
    },
    "echo": {
        "fraction": (0.04, 0.0, 0.5, "1", "share of the signal that a later pixel of the line repeats"),
        "lag_px": (3.0, 1.0, 64.0, "px", "distance along the line, image pixels"),
    },
    "column_pattern": {"rms": (0.03, 0.0, 0.5, "1", "smooth response error over the detector's columns")},
    "image_gain": {"rms": (0.04, 0.0, 0.5, "1", "calibration error of each image")},
    "saturation": {"iof": (0.12, 0.01, 1.0, "1", "I/F beyond which the detector reads the same")},
    "misregistration": {"rms_px": (0.8, 0.0, 20.0, "px", "planted shift of each image, image pixels")},
    "line_jitter": {"rms_px": (0.6, 0.0, 20.0, "px", "shift that drifts along the lines, image pixels")},
    "dem_scale": {"relative": (0.06, -0.5, 0.5, "1", "true heights / given heights - 1")},
    "dem_smoothing": {"sigma2_px2": (2.0, 0.0, 30.0, "px2", "variance by which the given DEM is smoother, DEM pixels")},
}


Hidden = dict[str, dict[str, float]]  # planted effects in the recipe's order, with all their parameters


def parse_hidden(entries: Iterable[Mapping[str, Any]]) -> Hidden:
    """Check recipe entries such as {"effect": "dark_bias", "iof": 0.004}. Raises ConfigError or RegistryError."""
    hidden: Hidden = {}
    for entry in entries:
        if not isinstance(entry, Mapping) or "effect" not in entry:
            raise ConfigError(
                f'recipe: \'hidden\': expected entries like {{"effect": "dark_bias", "iof": 0.004}}, found {json.dumps(entry)}; mend it.'
            )
        effect = str(entry["effect"])
        if effect not in CHOICES:
            raise RegistryError.unknown("hidden effect", effect, [*CHOICES, "none"])
        known = CHOICES[effect]
        parameters = {name: default for name, (default, *_) in known.items()}
        for name, value in entry.items():
            if name == "effect":
                continue
            if name not in known:
                raise RegistryError.unknown(f"parameter of the hidden effect {effect}", name, known)
            low, high = known[name][1:3]
            try:
                number = float(value)
            except (TypeError, ValueError):
                number = math.nan
            if not low <= number <= high:
                raise ConfigError(f"`hidden` {effect}: expected {name} in {low:g}..{high:g}, found {value}.")
            parameters[name] = number
        if effect in hidden:
            raise ConfigError(f"`hidden`: expected each effect once, found '{effect}' twice.")
        hidden[effect] = parameters
    return hidden


def hidden_from_option(text: str) -> list[dict[str, Any]]:
    """'none', 'dark_bias', 'dark_bias:iof=0.003', or several joined by '+'. Raises ConfigError."""
    if text.strip().lower() in ("", "none"):
        return []
    entries = []
    for part in text.split("+"):
        name, _, rest = part.strip().partition(":")
        entry: dict[str, Any] = {"effect": name}
        for pair in rest.split(",") if ":" in part else ():
            key, equals, value = pair.partition("=")
            if not equals or key.strip() in entry:
                raise ConfigError(f"`hidden`: expected EFFECT:NAME=VALUE,... with each name once, found '{part}'.")
            entry[key.strip()] = value
        entries.append(entry)
    parse_hidden(entries)
    return entries
