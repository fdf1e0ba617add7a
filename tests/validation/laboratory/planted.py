"""Every effect of the catalogue, as this laboratory understands it from `lunargr diagnose --list`."""

from __future__ import annotations

from . import planted_geometry, planted_ground, planted_light, planted_sensor
from .plant import Plant

_MODULES = (planted_geometry, planted_light, planted_ground, planted_sensor)
_ORDER = (  # the dealer draws by position
    "sun_azimuth", "dem_scale", "dem_smoothing", "echo", "psf_blur", "misregistration", "image_gain", "column_pattern",
    "dark_bias", "nonlinearity", "line_jitter", "saturation", "slope_albedo", "elevation_albedo", "curvature_albedo",
    "albedo_map", "azimuthal_anisotropy", "interreflection", "earthshine", "penumbra", "relief_displacement",
    "sun_elevation", "phase_slope", "limb_darkening", "macroscopic_roughness", "opposition_surge", "distant_shadow",
)  # fmt: skip
_BY_NAME: dict[str, type[Plant]] = {effect.name: effect for module in _MODULES for effect in module.EFFECTS}

PLANTED: dict[str, type[Plant]] = {name: _BY_NAME[name] for name in _ORDER}
