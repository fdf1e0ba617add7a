"""Reference spheres of the bodies that lunargr knows by name; any other radius is given in metres."""

from __future__ import annotations

from dataclasses import dataclass

from schemas.errors import GeometryError

# IAU WGCCRE mean radii (Archinal et al. 2018), metres; the Moon's is the LRO/LOLA reference sphere.
RADII = {
    "moon": 1737400.0,
    "mercury": 2439400.0,
    "venus": 6051800.0,
    "earth": 6371008.4,
    "mars": 3389500.0,
    "phobos": 11080.0,
    "deimos": 6200.0,
    "ceres": 470000.0,
    "vesta": 255000.0,
    "io": 1821490.0,
    "europa": 1560800.0,
    "ganymede": 2631200.0,
    "callisto": 2410300.0,
    "mimas": 198200.0,
    "enceladus": 252100.0,
    "tethys": 531000.0,
    "dione": 561400.0,
    "rhea": 763500.0,
    "titan": 2574730.0,
    "iapetus": 734300.0,
    "triton": 1352600.0,
    "pluto": 1188300.0,
    "charon": 606000.0,
    "eros": 8450.0,
    "bennu": 244.61,  # Barnouin et al. 2019
    "ryugu": 448.4,  # Watanabe et al. 2019
}


@dataclass(frozen=True)
class Body:
    """A reference sphere; ``radius`` in metres."""

    name: str
    radius: float


def find_body(text: str) -> Body:
    """The body called ``text``, or the sphere of that many metres. Raises GeometryError."""
    name = text.strip().lower()
    if name in RADII:
        return Body(name, RADII[name])
    try:
        radius = float(name)
    except ValueError:
        raise GeometryError(
            f"`body`: expected a radius in metres or one of {', '.join(RADII)}; found '{text}'."
        ) from None
    if not 100.0 <= radius <= 1e8:
        raise GeometryError(
            f"`body`: expected a radius in metres between 100 and 1e8, found {radius:g}; is it in kilometres?"
        )
    return Body(f"sphere of {radius:g} m", radius)
