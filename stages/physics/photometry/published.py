"""Published parameter sets for the Moon, by name, with their source.

evaluate(get_set("sato2014_643nm").model, get_set("sato2014_643nm").values, incidence, emission, phase)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from schemas.errors import RegistryError
from stages.physics.photometry.base import ReflectanceModel, get_model, model_names


@dataclass(frozen=True)
class ParameterSet:
    """Values of one model's parameters (radians where the parameter is in radians) and where they come from.

    wavelength_nm : that they hold for, None where none is told
    """

    name: str
    model: str
    values: dict[str, float]
    description: str
    reference: str
    wavelength_nm: float | None = None


_SATO = "Sato, H. et al. (2014), J. Geophys. Res. Planets 119, 1775, doi:10.1002/2013JE004580"
_SATO_ROUGHNESS = math.radians(23.6566)

# (w, b, c, Bs0, hs) by wavelength in nm: mean over the Moon, weighted with cos(latitude), of the published parameter
# map (1 deg cells, 70 S to 70 N) as reduced to 32 deg cells in the test data of ISIS lrowacphomap.
_SATO_MEAN = {
    321: (0.15952, 0.23032, 0.40262, 2.43743, 0.06658),
    360: (0.19285, 0.23479, 0.35759, 2.33284, 0.06255),
    415: (0.22768, 0.23767, 0.32796, 2.08978, 0.06577),
    566: (0.32637, 0.23552, 0.35033, 1.77183, 0.06334),
    604: (0.35465, 0.23181, 0.38975, 1.73981, 0.05751),
    643: (0.38138, 0.23066, 0.40267, 1.70638, 0.05431),
    689: (0.41010, 0.23686, 0.33660, 1.65842, 0.06022),
}


def _sato(values: tuple[float, float, float, float, float]) -> dict[str, float]:
    """Sato et al. fit w, b, c, Bs0 and hs; roughness is fixed, coherent backscatter and porosity are off."""
    fitted = dict(zip(("w", "b", "c", "Bs0", "hs"), values, strict=True))
    return {**fitted, "Bc0": 0.0, "hc": 1.0, "theta": _SATO_ROUGHNESS, "phi": 0.0}


def _sets() -> list[ParameterSet]:
    sets = [
        ParameterSet(
            f"sato2014_{band}nm",
            "hapke",
            _sato(values),
            f"whole Moon, LROC WAC {band} nm, 32 deg cells averaged",
            _SATO,
            float(band),
        )
        for band, values in _SATO_MEAN.items()
    ]
    sets += [
        ParameterSet(
            "sato2014_643nm_mare",
            "hapke",
            _sato((0.254484, 0.262982, 0.081127, 1.994042, 0.048495)),
            "mare: Oceanus Procellarum, map cell about 22 N 304 E, LROC WAC 643 nm",
            _SATO,
            643.0,
        ),
        ParameterSet(
            "sato2014_643nm_highland",
            "hapke",
            _sato((0.450915, 0.231281, 0.390314, 1.647419, 0.067423)),
            "highland: far side, map cell about 22 N 208 E, LROC WAC 643 nm",
            _SATO,
            643.0,
        ),
        ParameterSet(
            "helfenstein1987",
            "hapke_legendre_h1981",
            {
                "w": 0.21,
                "b": 0.29,
                "c": 0.39,
                "Bs0": 0.71 / (0.21 * 1.68),
                "hs": 0.07,
                "Bc0": 0.0,
                "hc": 1.0,
                "theta": math.radians(20),
                "phi": 0.0,
            },
            "whole disk of the Moon, V band; Bs0 from S(0) = 0.71 as S(0) / (w p(0))",
            "Helfenstein, P. and Veverka, J. (1987), Icarus 72, 342, table II",
            550.0,
        ),
        ParameterSet(
            "mcewen1996",
            "lunar_lambert_empirical",
            {"albedo": 1.0, "O": 1.0, "A": -0.019, "B": 2.42e-4, "C": -1.46e-6, "C1": 0.0, "C2": 0.0},
            "the Moon, relative (albedo 1), phase below 100 deg; default of ISIS LunarLambertMcEwen and of ASP sfs",
            "McEwen, A. S. (1996), Lunar Planet. Sci. XXVII, 841",
        ),
        ParameterSet(
            "lroc_nac_2014",
            "lroc_empirical_2014",
            {"A0": -2.9811422, "A1": -0.0112862, "A2": -0.8084603, "A3": 1.3248888},
            "LROC NAC broadband, 600 nm",
            "ISIS lronacpho, NAC_PHO_LROC_Empirical.0002",
            600.0,
        ),
        ParameterSet(
            "lroc_nac_2019",
            "lroc_empirical_2019",
            {
                "B0": -1.479654495,
                "B1": -0.000083528,
                "B2": 0.012964707,
                "B3": -0.237774774,
                "B4": 0.556075496,
                "B5": 0.663671460,
                "B6": -0.439918609,
            },
            "LROC NAC broadband, 600 nm",
            "ISIS lronacpho, NAC_PHO_LROC_Empirical.0003",
            600.0,
        ),
    ]
    return sets


_SETS = {s.name: s for s in _sets()}


def published_sets() -> list[ParameterSet]:
    """All published sets."""
    return list(_SETS.values())


def get_set(name: str) -> ParameterSet:
    """The published set called ``name``. Raises RegistryError with the choices."""
    try:
        return _SETS[name]
    except KeyError:
        raise RegistryError.unknown("parameter set", name, _SETS) from None


def hapke_set(wavelength_nm: float, name: str | None = None) -> ParameterSet:
    """Hapke's parameters of the whole Moon at the wavelength nearest to one, 643 nm where that is NaN; or a set of Hapke's by name.

    Raises RegistryError with the choices.
    """
    known = {s.name: s for s in _SETS.values() if s.model.startswith("hapke")}
    if name is not None:
        if name not in known:
            raise RegistryError.unknown("set of Hapke's parameters", name, known)
        return known[name]
    wanted = 643.0 if math.isnan(wavelength_nm) else wavelength_nm
    return known[f"sato2014_{min(_SATO_MEAN, key=lambda band: abs(band - wanted))}nm"]


def sets_by_wavelength(family: str) -> dict[float, ParameterSet]:
    """Sets of one publication by wavelength in nm, such as those of 'sato2014'; empty where it has none."""
    known = {s.name: (s.wavelength_nm, s) for s in _SETS.values() if s.wavelength_nm is not None}
    return {nm: s for name, (nm, s) in known.items() if name == f"{family.lower()}_{nm:g}nm"}


def find_reflectance(name: str) -> tuple[ReflectanceModel, dict[str, float]]:
    """A model and its default values by its name, or a published set's by the name of the set.

    Raises RegistryError with the choices.
    """
    if name.lower() in _SETS:
        chosen = _SETS[name.lower()]
        model = get_model(chosen.model)
        return model, model.defaults() | chosen.values
    if name.lower() not in (known.lower() for known in model_names()):
        raise RegistryError.unknown("reflectance model or parameter set", name, [*model_names(), *_SETS])
    model = get_model(name)
    return model, model.defaults()
