"""Laws of reflectance of the lunar surface."""

from dataclasses import dataclass

import numpy as np

Field = np.ndarray


@dataclass(frozen=True)
class Law:
    """A law and its parameters; reflectance is relative to incidence 30, emission 0 and phase 30 deg."""

    name: str
    parameters: dict[str, float]

    def reflectance(self, mu0: Field, mu: Field, phase: Field, twist: Field | float) -> Field:
        """Radiance factor over that of the standard geometry.

        mu0, mu: cosines of incidence and emission; phase: radian; twist: relative local change of the parameters.
        """
        standard = np.array([np.cos(np.pi / 6)]), np.array([1.0]), np.array([np.pi / 6])
        shape = FORMS[self.name]
        return shape(self.parameters, mu0, mu, phase, twist) / shape(self.parameters, *standard, 0.0)


def draw_law(rng: np.random.Generator, given: bool) -> Law:
    """Lunar-Lambert in half of all draws, else Hapke, Minnaert or Akimov, with parameters of published spread.

    given: the polynomial that `diagnose` is given as the law instead.
    """
    name = str(rng.choice(["lunar-Lambert", "Hapke", "Minnaert", "Akimov"], p=[0.5, 0.2, 0.15, 0.15]))
    drawn = {
        "slope": rng.uniform(0.4, 0.8),
        "surge": rng.uniform(0.1, 0.5),
        "surge_width": rng.uniform(0.04, 0.1),
        "limb_scale": rng.uniform(0.85, 1.15),
        "minnaert": rng.uniform(0.5, 0.6),
        "minnaert_per_radian": rng.uniform(0.1, 0.2),
        "single_albedo": rng.uniform(0.18, 0.4),
        "lobe_width": rng.uniform(0.2, 0.3),
        "lobe_share": rng.uniform(0.2, 0.7),
    }
    if given:
        name = "polynomial"
        drawn = {"cos_phase": rng.uniform(0.2, 0.5), "constant": rng.uniform(0.1, 0.25)}
    return Law(name, {key: float(value) for key, value in drawn.items()})


def phase_function(p: dict[str, float], phase: Field, twist: Field | float) -> Field:
    """Exponential with an opposition surge."""
    return np.exp(-p["slope"] * (1 + twist) * phase) * (1 + p["surge"] / (1 + np.tan(phase / 2) / p["surge_width"]))


def lunar_lambert(p: dict[str, float], mu0: Field, mu: Field, phase: Field, twist: Field | float) -> Field:
    """McEwen (1991): Lommel-Seeliger and Lambert, with a share that falls with the phase angle."""
    g = np.degrees(phase)
    share = 1 - p["limb_scale"] * (0.019 * g - 0.242e-3 * g**2 + 1.46e-6 * g**3) + twist / 2
    return phase_function(p, phase, twist) * mu0 * (2 * share / (mu0 + mu) + 1 - share)


def minnaert(p: dict[str, float], mu0: Field, mu: Field, phase: Field, twist: Field | float) -> Field:
    """Minnaert's law with an exponent that grows with the phase angle."""
    k = (p["minnaert"] + p["minnaert_per_radian"] * phase) * (1 + twist)
    return phase_function(p, phase, twist) * np.maximum(mu0, 1e-4) ** k * mu ** (k - 1)


def akimov(p: dict[str, float], mu0: Field, mu: Field, phase: Field, twist: Field | float) -> Field:
    """Akimov's disk function without parameters, as given by Shkuratov et al. (2011)."""
    g = np.maximum(phase, 0.01)
    longitude = np.arctan((mu0 / mu - np.cos(g)) / np.sin(g))
    cos_latitude = np.clip(mu / np.cos(longitude), 1e-3, 1)
    disk = np.cos(g / 2) * np.maximum(np.cos(np.pi / (np.pi - g) * (longitude - g / 2)), 0)
    disk = disk * cos_latitude ** (g / (np.pi - g)) / np.cos(longitude)
    return phase_function(p, phase, twist) * np.where(mu0 > 0, disk, 0)


def hapke(p: dict[str, float], mu0: Field, mu: Field, phase: Field, twist: Field | float) -> Field:
    """Hapke (1986) with two Henyey-Greenstein lobes and H functions in Hapke's first form, smooth surface."""
    w, b, c = p["single_albedo"] * (1 + twist), p["lobe_width"], p["lobe_share"] * (1 + twist)
    cos_g = np.cos(phase)
    back = (1 - b * b) / (1 - 2 * b * cos_g + b * b) ** 1.5
    forward = (1 - b * b) / (1 + 2 * b * cos_g + b * b) ** 1.5
    particle = (1 + c) / 2 * back + (1 - c) / 2 * forward
    surge = 1 + 1.8 / (1 + np.tan(phase / 2) / p["surge_width"])
    root = np.sqrt(1 - w)
    multiple = (1 + 2 * mu0) / (1 + 2 * mu0 * root) * (1 + 2 * mu) / (1 + 2 * mu * root) - 1
    return w * mu0 / (mu0 + mu) * (surge * particle + multiple)


def polynomial(p: dict[str, float], mu0: Field, mu: Field, phase: Field, twist: Field | float) -> Field:
    """Linear in the cosines of incidence and of the phase angle."""
    return np.maximum(mu0 + p["cos_phase"] * (1 + twist) * np.cos(phase) + p["constant"], 0)


FORMS = {
    "polynomial": polynomial,
    "lunar-Lambert": lunar_lambert,
    "Minnaert": minnaert,
    "Akimov": akimov,
    "Hapke": hapke,
}
