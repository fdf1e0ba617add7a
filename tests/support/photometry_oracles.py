"""Outside tables of reflectance beside what this package computes for the same geometry.

Shared by the tests and by examples/photometry_page.py. The only knowledge here is how each table's author writes his
parameters and what his function returns; the parameters go through ``stages.physics.photometry.conventions`` wherever
that knows the program.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from stages.physics.formation import geometry
from stages.physics.photometry import evaluate
from stages.physics.photometry.conventions import convert_maps, get_convention


@dataclass
class Comparison:
    """Expected and computed values of one model and parameter set in one table.

    digits : significant digits that the table prints, None for full precision
    wrong : why rows of the table are not to be met, and which
    """

    table: str
    case: str
    model: str
    expected: np.ndarray
    computed: np.ndarray
    digits: int | None = None
    wrong: str = ""

    def __post_init__(self) -> None:
        self.expected = np.atleast_1d(np.asarray(self.expected, float))
        self.computed = np.atleast_1d(np.asarray(self.computed, float))

    @property
    def relative_error(self) -> np.ndarray:
        """|computed - expected| / |expected|; what lies within half of the last printed digit counts as 0."""
        difference = np.abs(self.computed - self.expected)
        if self.digits is not None:
            magnitude = np.floor(np.log10(np.maximum(np.abs(self.expected), 1e-300)))
            half = 0.5 * 10 ** (magnitude - self.digits + 1)
            difference = np.where(difference <= half * (1 + 1e-9), 0.0, difference)
        return np.where(difference == 0, 0.0, difference / np.maximum(np.abs(self.expected), 1e-300))

    @property
    def worst(self) -> float:
        return float(self.relative_error.max())


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as stream:
        return list(csv.DictReader(stream))


def columns(rows: list[dict[str, str]], *names: str) -> tuple[np.ndarray, ...]:
    return tuple(np.array([float(r[n]) for r in rows]) for n in names)


def angles(rows: list[dict[str, str]]) -> tuple[np.ndarray, ...]:
    """Incidence, emission, phase in radians."""
    return tuple(np.radians(c) for c in columns(rows, "incidence_deg", "emission_deg", "phase_deg"))


def groups(rows: list[dict[str, str]], *keys: str) -> dict[tuple[str, ...], list[dict[str, str]]]:
    found: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for row in rows:
        found.setdefault(tuple(row[k] for k in keys), []).append(row)
    return found


def ours(convention: str, values: dict[str, float]) -> tuple[str, dict[str, np.ndarray]]:
    """Model and parameters here for values written in a convention."""
    model = get_convention(convention).model
    converted, _ = convert_maps(values, convention, f"lunargr:{model}")
    return model, converted


def isis_hapke_grid(oracles: Path) -> Iterator[Comparison]:
    """2,160 values from compiled ISIS: HapkeHen and HapkeLeg (H of 1981) and HapkeLROC (Hapke 2012, H of 2002)."""
    conventions = {"HapkeHen": "isis:HapkeHen", "HapkeLeg": "isis:HapkeLeg", "HapkeLROC": "sato:Hapke"}
    table = "isis_hapke_dense_grid.csv"
    for (name, text), rows in groups(read(oracles / table), "model", "params_json").items():
        model, values = ours(conventions[name], json.loads(text))
        yield Comparison(
            table, f"{name} {_short(text)}", model, columns(rows, "expected")[0], evaluate(model, values, *angles(rows))
        )


def lroc_empirical_grid(oracles: Path) -> Iterator[Comparison]:
    table = "lroc_empirical_dense_grid.csv"
    rows = read(oracles / table)
    for year in (2014, 2019):
        model = f"lroc_empirical_{year}"
        yield Comparison(table, str(year), model, columns(rows, f"iof_{year}")[0], evaluate(model, {}, *angles(rows)))


def asp_grid(oracles: Path) -> Iterator[Comparison]:
    """1,200 values from compiled Ames Stereo Pipeline. Its Hapke returns r, so I/F / pi; the others I/F at albedo 1."""
    table = "asp_sfs_reflectance_dense_grid.csv"
    for (name, text), rows in groups(read(oracles / table), "model", "params_json").items():
        values = json.loads(text)
        kind = name.removeprefix("asp_")
        scale = 1.0
        if kind == "Lambertian":
            model, parameters = "lambert", {"albedo": 1.0}
        elif kind == "Hapke":
            (model, parameters), scale = ours("asp:Hapke", values), 1 / np.pi
        elif kind == "LunarLambert":
            model, parameters = ours("asp:LunarLambert", values)
        else:
            model, parameters = ours("asp:Charon", values)
        computed = scale * evaluate(model, parameters, *angles(rows))
        yield Comparison(table, f"{kind} {_short(text)}", model, columns(rows, "expected")[0], computed)


def giant_parameters(name: str, albedo: float, phase_deg: np.ndarray) -> tuple[str, dict] | None:
    """NASA GIANT's models as ours: its albedo stands before mu0/(mu0+mu), and its L falls as exp(-g/60 deg)."""
    weight = np.exp(-phase_deg / 60)
    if name == "LambertianIllumination":
        return "lambert", {"albedo": albedo}
    if name == "LommelSeeligerIllumination":
        return "lommel_seeliger", {"albedo": albedo / 2}
    if name == "McEwenIllumination":
        return "lunar_lambert_fixed", {"albedo": albedo, "L": weight}
    if name == "GaskellIllumination":  # (1 - b) mu0 + b mu0/(mu0+mu), without McEwen's factor 2
        return "lunar_lambert_fixed", {"albedo": albedo * (1 - weight / 2), "L": weight / 2 / (1 - weight / 2)}
    return None


def giant_grid(oracles: Path) -> Iterator[Comparison]:
    table = "giant_illumination_dense_grid.csv"
    for (name, text), rows in groups(read(oracles / table), "model", "params_json").items():
        values = json.loads(text)
        albedo = values["global_albedo"] * values["albedo"]
        found = giant_parameters(name, albedo, columns(rows, "phase_deg")[0])
        if found is not None:
            model, parameters = found
            computed = evaluate(model, parameters, *angles(rows))
            yield Comparison(table, name, model, columns(rows, "expected")[0], computed)


def lunar_g2r_grid(oracles: Path) -> Iterator[Comparison]:
    """The reference implementation's materials, which return r = I/F / pi; negative values are the formula's."""
    table = "lunar_g2r_material_grid.csv"
    for key, rows in groups(read(oracles / table), "material", "p_x", "p_y", "p_z", "p_w").items():
        wrong = ""
        if key[0] == "hapke_diff":
            # At 90 deg of phase tan(g) is 1.6e16: 1 - exp(-h/tan g) rounds to 0 there and leaves the full surge B0,
            # where the formula's limit is none. That row says nothing about the model.
            lost = [r for r in rows if abs(np.cos(np.radians(float(r["phase_deg"])))) < 1e-15]
            rows = [r for r in rows if r not in lost]
            wrong = f"{len(lost)} row at 90 deg of phase left out: the table lost its opposition term to rounding"
        channels = {c: float(v) for c, v in zip("xyzw", key[1:], strict=True) if v}
        convention = f"g2r:{key[0]}"
        model, parameters = ours(convention, {n: channels[n] for n in get_convention(convention).names})
        computed = evaluate(model, parameters, *angles(rows)) / np.pi
        yield Comparison(
            table, f"{key[0]} {', '.join(key[1:])}", model, columns(rows, "value")[0], computed, wrong=wrong
        )


def isis_truth(oracles: Path) -> Iterator[Comparison]:
    """Rows of ISIS' own truth files, one comparison each; six printed digits. The 9 rows with an atmosphere are left out."""
    table = "isis_photometry_truth.csv"
    for number, row in enumerate(read(oracles / table), start=2):
        if "Atm" in row["model"]:
            continue
        model, computed, wrong = _TRUTH[row["model"]](json.loads(row["params_json"]), row, *angles([row]))
        expected = float(row["expected"])
        if expected == -1.79769e308:  # ISIS' special pixel Null: no albedo without light
            expected = np.inf
        if wrong:
            expected, wrong = 0.0, f"line {number}: table says {expected:g}: {wrong}"
        case = f"line {number} {row['model']} i={row['incidence_deg']} e={row['emission_deg']} g={row['phase_deg']}"
        infinite = np.isinf(expected) and np.isinf(computed).all()
        yield Comparison(
            table,
            case,
            model,
            0.0 if infinite else expected,
            0.0 if infinite else computed,
            int(row["printed_sig_digits"]),
            wrong,
        )


Truth = tuple[str, np.ndarray, str]


def _converted(convention: str) -> Callable[..., Truth]:
    def compute(values: dict, row: dict, i: np.ndarray, e: np.ndarray, g: np.ndarray) -> Truth:
        model, parameters = ours(convention, {k: v for k, v in values.items() if k in get_convention(convention).names})
        return model, evaluate(model, parameters, i, e, g), ""

    return compute


def _direct(model: str) -> Callable[..., Truth]:
    return lambda values, row, i, e, g: (model, evaluate(model, {"albedo": 1.0}, i, e, g), "")


def _mcewen(values: dict, row: dict, i: np.ndarray, e: np.ndarray, g: np.ndarray) -> Truth:
    """ISIS' McEwen gives the factor that brings I/F to 30 deg incidence and phase; 0 where there is no light."""
    standard = evaluate("lunar_lambert", {"albedo": 1.0}, np.radians(30), 0.0, np.radians(30))
    here = evaluate("lunar_lambert", {"albedo": 1.0}, i, e, g)
    return "lunar_lambert", np.where(here > 0, standard / np.maximum(here, 1e-300), 0.0), ""


def _tabulated(model: str, key: str, name: str) -> Callable[..., Truth]:
    """ISIS' empirical models: phase tables of the exponent and of the brightness, by natural cubic splines."""

    def compute(values: dict, row: dict, i: np.ndarray, e: np.ndarray, g: np.ndarray) -> Truth:
        from scipy.interpolate import CubicSpline

        spline = [CubicSpline(values["PhaseList"], values[k], bc_type="natural") for k in (key, "PhaseCurveList")]
        shape, brightness = (s(np.degrees(g)) for s in spline)
        # Its test goes on at 90 deg, whose cosine is 6e-17 in binary and so "lit", with tables extrapolated to 180 deg.
        wrong = "light at incidence and emission 90 deg" if float(row["expected"]) > 9 else ""
        return model, evaluate(model, {"albedo": brightness, name: shape}, i, e, g), wrong

    return compute


def tilt_derivative(i: np.ndarray, g: np.ndarray) -> np.ndarray:
    """|d I/F / d tilt| of a Lambert surface, by differentiating the chain from slopes to I/F."""
    slopes = torch.zeros(2, 1, 1, 1, dtype=torch.float64, requires_grad=True)
    sun = torch.tensor([[float(np.sin(i[0])), 0.0, float(np.cos(i[0]))]], dtype=torch.float64)
    up = (torch.zeros(1, 1, 1).double(), torch.zeros(1, 1, 1).double(), torch.ones(1, 1, 1).double())
    lit = geometry.photometric_angles(slopes[0], slopes[1], sun, up)
    evaluated = evaluate("lambert", {"albedo": 1.0}, lit.incidence, lit.emission, lit.phase)
    (gradient,) = torch.autograd.grad(evaluated.sum(), slopes)
    return np.atleast_1d(float(gradient.norm()))


def _normalised(kind: str) -> Callable[..., Truth]:
    """ISIS' normalisation modes around Lambert: what they do with the reflectance, not a reflectance of their own."""

    def lambert(i: float | np.ndarray) -> np.ndarray:
        return np.asarray(evaluate("lambert", {"albedo": 1.0}, i, 0.0, i))

    def compute(values: dict, row: dict, i: np.ndarray, e: np.ndarray, g: np.ndarray) -> Truth:
        dn, rho, shading = float(row["dn_in"]), values.get("Albedo", 1.0), lambert(i)
        with np.errstate(divide="ignore"):
            if kind == "Albedo":
                result = dn / shading
            elif kind == "Shade":
                result = rho * shading
            elif kind == "Topo":
                reference = np.radians([values["Incref"]])
                gain = shading * tilt_derivative(reference, reference) / tilt_derivative(i, g)
                result = rho * (dn * gain + lambert(reference) - gain)
            else:  # Mixed
                match = np.radians([values["Incmat"]])
                gain = 1 / np.hypot(shading, lambert(match) * tilt_derivative(i, g) / tilt_derivative(match, match))
                result = dn * gain + rho * (1 - gain * shading)
        return "lambert", result, ""

    return compute


def _moon_albedo(values: dict, row: dict, i: np.ndarray, e: np.ndarray, g: np.ndarray) -> Truth:
    """Buratti's phase normalisation (ISIS MoonAlbedo) of what McEwen's law leaves; D = 0, so nothing to iterate."""

    def phase_curve(phase: np.ndarray | float) -> np.ndarray:
        def lobe(asymmetry: float) -> np.ndarray:
            return (1 - asymmetry**2) / (1 + asymmetry**2 + 2 * asymmetry * np.cos(phase)) ** 1.5

        surge = 1 + values["Bsh1"] / (1 + np.tan(np.asarray(phase) / 2) / values["H"])
        return ((1 - values["F"]) * lobe(values["E"]) + values["F"] * lobe(values["G2"])) * surge

    _, factor, _ = _mcewen(values, row, i, e, g)
    return "lunar_lambert", float(row["dn_in"]) * factor * phase_curve(np.radians(30)) / phase_curve(g), ""


_TRUTH: dict[str, Callable[..., Truth]] = {
    "HapkeHen": _converted("isis:HapkeHen"),
    "HapkeLeg": _converted("isis:HapkeLeg"),
    "LunarLambert": lambda v, row, i, e, g: (
        "lunar_lambert_fixed", evaluate("lunar_lambert_fixed", {"albedo": 1.0, "L": v["L"]}, i, e, g), ""
    ),
    "Minnaert": lambda v, row, i, e, g: ("minnaert", evaluate("minnaert", {"albedo": 1.0, "k": v["K"]}, i, e, g), ""),
    "LommelSeeliger": _direct("lommel_seeliger"),
    "Lambert": _direct("lambert"),
    "LunarLambertMcEwen": _mcewen,
    "NoNormalization+LunarLambertMcEwen": _mcewen,
    "MoonAlbedo+LunarLambertMcEwen": _moon_albedo,
    "LunarLambertEmpirical": _tabulated("lunar_lambert_fixed", "LList", "L"),
    "MinnaertEmpirical": _tabulated("minnaert", "KList", "k"),
    "Albedo+Lambert": _normalised("Albedo"),
    "Shade+Lambert": _normalised("Shade"),
    "Topo+Lambert": _normalised("Topo"),
    "Mixed+Lambert": _normalised("Mixed"),
}  # fmt: skip


def lrowacphomap(oracles: Path) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """A WAC image normalised through Sato's map: (ISIS' statistics, ours as ISIS runs it, ours with the right band).

    The published numbers carry a fault that the table's README warns of: ISIS takes the numerator from the map's 321 nm
    and the denominator from its 689 nm for an image at 415 nm.
    """
    rows = read(oracles / "isis_lrowacphomap_pixels.csv")
    expected = json.loads((oracles / "isis_lrowacphomap_expected.json").read_text())
    cells = groups(read(oracles / "sato2014_hapke_map_isis_test_reduced.csv"), "band_nm", "cell_sample", "cell_line")

    def reflectance(band: str, *geometry: np.ndarray | float) -> np.ndarray:
        result = np.empty(np.broadcast(*geometry).shape)
        for (sample, line), members in groups(rows, "param_cell_sample", "param_cell_line").items():
            (cell,) = cells[band, sample, line]
            names = get_convention("sato:Hapke").names
            model, values = ours("sato:Hapke", {n: float(cell[n]) for n in names})
            here = np.array([(r["param_cell_sample"], r["param_cell_line"]) == (sample, line) for r in rows])
            assert here.sum() == len(members)
            result[here] = evaluate(model, values, *(np.broadcast_to(a, result.shape)[here] for a in geometry))
        return result

    dn = columns(rows, "dn_in_415nm")[0]
    i, e, g = angles(rows)
    reference = [
        np.full_like(i, np.radians(expected["reference_geometry"][k])) for k in ("incidence", "emission", "phase")
    ]

    def statistics(numerator: str, denominator: str) -> dict[str, float]:
        out = dn * reflectance(numerator, *reference) / reflectance(denominator, i, e, g)
        return {
            "average": out.mean(),
            "standard_deviation": out.std(ddof=1),
            "minimum": out.min(),
            "maximum": out.max(),
            "sum": out.sum(),
            "valid_pixels": float(np.isfinite(out).sum()),
        }

    return expected, statistics("321", "689"), statistics("415", "415")


TABLES: dict[str, Callable[[Path], Iterator[Comparison]]] = {
    "isis_photometry_truth.csv": isis_truth,
    "isis_hapke_dense_grid.csv": isis_hapke_grid,
    "lroc_empirical_dense_grid.csv": lroc_empirical_grid,
    "asp_sfs_reflectance_dense_grid.csv": asp_grid,
    "giant_illumination_dense_grid.csv": giant_grid,
    "lunar_g2r_material_grid.csv": lunar_g2r_grid,
}


def _short(text: str) -> str:
    """'{"w":0.3}' -> 'w=0.3'"""
    return ", ".join(f"{k}={v}" for k, v in json.loads(text).items())
