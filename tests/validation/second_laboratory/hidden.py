"""What a case hides: one effect or one fault with its parameters, or nothing."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Hidden:
    """An effect or a fault by name, its parameters, and the seed of what else is random in it."""

    name: str | None = None
    values: dict[str, float] = field(default_factory=dict)
    seed: int = 0

    def get(self, name: str, parameter: str, default: float) -> float:
        """The parameter's value if this is what is hidden, else the default."""
        return self.values.get(parameter, default) if self.name == name else default


NOTHING = Hidden()

# These change where surfaces, shadows and rays lie, so that nothing of a cached geometry holds.
GEOMETRY = {"dem_scale", "dem_smoothing", "sun_azimuth", "sun_elevation", "distant_shadow", "penumbra"}
GROUND = GEOMETRY | {
    "earthshine", "interreflection", "albedo_map", "azimuthal_anisotropy", "curvature_albedo", "elevation_albedo",
    "slope_albedo", "limb_darkening", "macroscopic_roughness", "opposition_surge", "phase_slope",
}  # fmt: skip
OPTICS = {"psf_blur"}
