"""Parameters as other programs write them, converted to ours and back.

A convention is named SYSTEM:MODEL, as in ``isis:HapkeHen``. It belongs to one model here and says for each of its own
quantities the name and the unit. Parameters that it has no place for (roughness in ASP's Hapke, an albedo in ISIS'
Lunar-Lambert) are listed with the value that its formula implies; other values of them would be lost, so that such a
conversion is refused unless an approximate one is asked for.

Systems: ``lunargr`` (this package), ``isis`` (USGS ISIS photometric models), ``asp`` (Ames Stereo Pipeline ``sfs``),
``sato`` (Hapke parameter maps of Sato et al. 2014), ``g2r`` (.brdf textures of the Lunar-G2R reference implementation).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from schemas.errors import ConfigError, RegistryError
from stages.physics.photometry.base import get_model, model_names
from stages.physics.photometry.quantities import from_bidirectional_reflectance, to_bidirectional_reflectance

Maps = Mapping[str, np.ndarray]
Converter = Callable[[Maps], dict[str, np.ndarray]]
SLOPE = 0.01  # of the LeakyReLU in the .brdf materials


@dataclass(frozen=True)
class Convention:
    """One program's way to write the parameters of one model.

    quantities : (name, unit) in the program's own order
    model : name of the model here
    returns : what the program's formula gives
    to_ours, from_ours : maps by name -> maps by name
    implied : our parameters that the convention has no place for, with the value that it implies
    same_as : another model here to which this one's parameters may be passed, and what then changes
    """

    name: str
    quantities: tuple[tuple[str, str], ...]
    model: str
    returns: str
    reference: str
    to_ours: Converter
    from_ours: Converter
    implied: dict[str, float] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.quantities]


# Models that share their parameters and differ in the named approximation only.
RELATED = {
    frozenset(("hapke", "hapke_h1981")): "the H function (2002 or 1981)",
    frozenset(("hapke_legendre", "hapke_legendre_h1981")): "the H function (2002 or 1981)",
}


def _rename(pairs: Mapping[str, str]) -> tuple[Converter, Converter]:
    """Converters for quantities that differ in their names only: theirs -> ours."""
    return (
        lambda theirs: {ours: theirs[name] for name, ours in pairs.items()},
        lambda ours: {name: ours[key] for name, key in pairs.items()},
    )


def _theta_in_degrees(theirs: str, rest: tuple[Converter, Converter]) -> tuple[Converter, Converter]:
    """The converters ``rest``, and the roughness, which another program keeps in degrees under the name ``theirs``."""
    to_ours, from_ours = rest
    return (
        lambda t: {**to_ours(t), "theta": np.radians(t[theirs])},
        lambda o: {**from_ours(o), theirs: np.degrees(o["theta"])},
    )


def _hapke_to(theirs: Maps, w: str, b: str, c: str, amplitude: str, width: str) -> dict[str, np.ndarray]:
    """The older notation: the backward lobe has weight c in 0..1, and b < 0 swaps the lobes."""
    asymmetry, weight = theirs[b], theirs[c]
    backward = np.where(asymmetry >= 0, weight, 1 - weight)
    return {
        "w": theirs[w],
        "b": np.abs(asymmetry),
        "c": 2 * backward - 1,
        "Bs0": theirs[amplitude],
        "hs": theirs[width],
    }


def _hapke_from(ours: Maps, w: str, b: str, c: str, amplitude: str, width: str) -> dict[str, np.ndarray]:
    return {w: ours["w"], b: ours["b"], c: (1 + ours["c"]) / 2, amplitude: ours["Bs0"], width: ours["hs"]}


def _charon_to(theirs: Maps) -> dict[str, np.ndarray]:
    """f A mu0/(mu0+mu) + (1-A) mu0 as albedo [2 L mu0/(mu0+mu) + (1-L) mu0]."""
    lunar = theirs["A"] * theirs["f_alpha"] / 2
    albedo = lunar + 1 - theirs["A"]
    return {"albedo": albedo, "L": lunar / albedo}


def _charon_from(ours: Maps) -> dict[str, np.ndarray]:
    weight = 1 - ours["albedo"] * (1 - ours["L"])
    return {"A": weight, "f_alpha": 2 * ours["albedo"] * ours["L"] / weight}


def _texture(channels: Mapping[str, str], zero: tuple[str, ...] = ()) -> tuple[Converter, Converter]:
    """Channels of a .brdf texture -> coefficients of I/F: LeakyReLU first, and times pi since they give r."""

    def to_ours(theirs: Maps) -> dict[str, np.ndarray]:
        active = {
            ours: from_bidirectional_reflectance(np.where(theirs[name] >= 0, theirs[name], SLOPE * theirs[name]))
            for name, ours in channels.items()
        }
        like = next(iter(active.values()))
        return {**active, **{name: np.zeros_like(like) for name in zero}}

    def from_ours(ours: Maps) -> dict[str, np.ndarray]:
        raw = {name: to_bidirectional_reflectance(ours[key]) for name, key in channels.items()}
        return {name: np.where(value >= 0, value, value / SLOPE) for name, value in raw.items()}

    return to_ours, from_ours


_NO_BACKSCATTER = {"Bc0": 0.0, "phi": 0.0}
_conventions: list[Convention] = []


def _add(name: str, quantities: str, model: str, returns: str, reference: str, both, **more) -> None:
    """``quantities`` is 'name unit, name unit, ...'."""
    pairs = tuple((q.split()[0], q.split()[1]) for q in quantities.split(","))
    _conventions.append(Convention(name, pairs, model, returns, reference, *both, **more))


_HEN = {"w": "Wh", "b": "Hg1", "c": "Hg2", "amplitude": "B0", "width": "Hh"}
_ASP = {"w": "omega", "b": "b", "c": "c", "amplitude": "B0", "width": "h"}

_add(
    "isis:HapkeHen",
    "Wh 1, Hg1 1, Hg2 1, Hh 1, B0 1, Theta degree",
    "hapke_h1981",
    "I/F",
    "ISIS photomet, HapkeHen: Hg2 = weight of the backward lobe, 0..1",
    _theta_in_degrees("Theta", (lambda t: _hapke_to(t, **_HEN), lambda o: _hapke_from(o, **_HEN))),
    implied=_NO_BACKSCATTER,
)
_add(
    "isis:HapkeLeg",
    "Wh 1, Bh 1, Ch 1, Hh 1, B0 1, Theta degree",
    "hapke_legendre_h1981",
    "I/F",
    "ISIS photomet, HapkeLeg",
    _theta_in_degrees("Theta", _rename({"Wh": "w", "Bh": "b", "Ch": "c", "Hh": "hs", "B0": "Bs0"})),
    implied=_NO_BACKSCATTER,
)
_add(
    "isis:LunarLambert",
    "L 1",
    "lunar_lambert_fixed",
    "I/F at albedo 1",
    "ISIS photomet, LunarLambert",
    _rename({"L": "L"}),
    implied={"albedo": 1.0},
)
_add(
    "isis:Minnaert",
    "K 1",
    "minnaert",
    "I/F at albedo 1",
    "ISIS photomet, Minnaert",
    _rename({"K": "k"}),
    implied={"albedo": 1.0},
)
_add(
    "asp:Hapke",
    "omega 1, b 1, c 1, B0 1, h 1",
    "hapke_h1981",
    "r = I/F / pi",
    "ASP sfs, Hapke without roughness: c = (1 + Sato's c)/2",
    (lambda t: _hapke_to(t, **_ASP), lambda o: _hapke_from(o, **_ASP)),
    implied={**_NO_BACKSCATTER, "theta": 0.0},
)
_add(
    "asp:LunarLambert",
    "O 1, A 1/degree, B 1/degree^2, C 1/degree^3, phaseC1 1/rad, phaseC2 1",
    "lunar_lambert_empirical",
    "I/F at albedo 1",
    "ASP sfs, Lunar-Lambert; the factor exp(-phaseC1 g) + phaseC2 is 1 with both 0",
    _rename({"O": "O", "A": "A", "B": "B", "C": "C", "phaseC1": "C1", "phaseC2": "C2"}),
    implied={"albedo": 1.0},
)
_add(
    "asp:Charon",
    "A 1, f_alpha 1",
    "lunar_lambert_fixed",
    "I/F at albedo 1",
    "ASP sfs, Charon: f A mu0/(mu0 + mu) + (1 - A) mu0",
    (_charon_to, _charon_from),
)
_add(
    "sato:Hapke",
    "w 1, b 1, c 1, Bc0 1, hc 1, Bs0 1, hs 1, theta degree, phi 1",
    "hapke",
    "I/F",
    "Sato et al. (2014), LROC WAC_HAPKEPARAMMAP and ISIS lrowacphomap: c = backward minus forward share, -1..1",
    _theta_in_degrees("theta", _rename({name: name for name in ("w", "b", "c", "Bc0", "hc", "Bs0", "hs", "phi")})),
)
_G2R = "Lunar-G2R code, {}.brdf: channels before LeakyReLU(0.01)"
for _name, _model, _channels, _zero in (
    ("polynomial_2p", "M1", {"x": "b", "y": "a"}, ()),
    ("polynomial_3p_cst", "M2", {"x": "b", "y": "a", "z": "c"}, ()),
    ("polynomial_4p_cos2g_cos2i", "M3", {"x": "b", "y": "a", "z": "c", "w": "d"}, ()),
    ("polynomial_4p_cos2i", "M4", {"x": "b", "y": "a", "z": "c", "w": "d"}, ()),
    ("polynomial_3p_cos2i", "M4", {"x": "b", "y": "a", "z": "c"}, ("d",)),
    ("polynomial_4p_cos2g", "M5", {"x": "b", "y": "a", "z": "c", "w": "d"}, ()),
    ("polynomial_3p_cos2g", "M5", {"x": "b", "y": "a", "z": "c"}, ("d",)),
):
    _add(
        f"g2r:{_name}",
        ", ".join(f"{c} 1" for c in _channels),
        _model,
        "r = I/F / pi",
        _G2R.format(_name),
        _texture(_channels, _zero),
        implied=dict.fromkeys(_zero, 0.0),
    )
_add(
    "g2r:hapke_diff",
    "x 1, y 1, z 1",
    "hapke_g2r",
    "r = I/F / pi",
    "Lunar-G2R code, hapke_diff.brdf: h, sqrt(1 - w), B0",
    _rename({"x": "h", "y": "gamma", "z": "B0"}),
)


def _own(model_name: str) -> Convention:
    """This package's own parameters as a convention, so that both ends of a conversion look alike."""
    model = get_model(model_name)
    pairs = tuple((p.name, p.unit) for p in model.parameters)
    same = _rename({name: name for name, _ in pairs})
    return Convention(f"lunargr:{model.name}", pairs, model.name, "I/F", model.reference, *same)


def conventions() -> list[Convention]:
    """All conventions, this package's own models first."""
    return [_own(name) for name in model_names()] + _conventions


def get_convention(name: str) -> Convention:
    """The convention called ``name`` (case does not matter). Raises RegistryError with the choices."""
    known = {c.name.lower(): c for c in conventions()}
    try:
        return known[name.lower()]
    except KeyError:
        raise RegistryError.unknown("convention", name, [c.name for c in known.values()]) from None


def convert_maps(
    maps: Maps, source: str, target: str, approximate: bool = False
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Parameters written in one convention, in another.

    maps : name -> array or number, one for each quantity of ``source``; NaN stays NaN
    returns the arrays by name in the order of ``target``, and what was lost: subject -> words (empty unless
    ``approximate``)
    Raises ConfigError where the two describe different models, or where ``target`` cannot hold a value.
    """
    start, end = get_convention(source), get_convention(target)
    losses = model_difference(start, end)
    arrays = {name: np.asarray(maps[name], dtype=float) for name in start.names}
    with np.errstate(invalid="ignore", divide="ignore"):
        ours = start.to_ours(arrays)
        like = next(iter(ours.values()))
        ours = {**{k: np.full_like(like, v) for k, v in start.implied.items()}, **ours}
        ours = {p.name: ours.get(p.name, np.full_like(like, p.default)) for p in get_model(end.model).parameters}
        for name, value in end.implied.items():
            wrong = np.isfinite(ours[name]) & ~np.isclose(ours[name], value, rtol=1e-6, atol=1e-9)
            if wrong.any():
                losses[name] = f"{name} = {float(ours[name][wrong].flat[0]):g} becomes {value:g}"
        if losses and not approximate:
            raise ConfigError(
                f"{start.name} -> {end.name}: the target cannot hold all of the source: {'; '.join(losses.values())}; "
                "give `approximate` to convert all the same."
            )
        result = end.from_ours(ours)
    return {name: result[name] for name in end.names}, losses


def model_difference(start: Convention, end: Convention) -> dict[str, str]:
    """Differences between two conventions' models: subject -> words. Raises ConfigError where no conversion is possible."""
    if start.model == end.model:
        return {}
    pair = frozenset((start.model, end.model))
    if pair in RELATED:
        return {"model": f"{RELATED[pair]} changes from {start.model} to {end.model}"}
    reachable = [
        c.name for c in conventions() if c.model == start.model or frozenset((c.model, start.model)) in RELATED
    ]
    raise ConfigError(
        f"{start.name} -> {end.name}: different models ({start.model} and {end.model}) have no conversion; "
        f"{start.name} converts to: {', '.join(n for n in reachable if n != start.name)}."
    )
