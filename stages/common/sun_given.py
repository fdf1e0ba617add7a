"""Which of its three descriptions gives the Sun; no import that takes time, so that a command can refuse at once."""

from __future__ import annotations

from schemas.errors import ConfigError


def sun_given(
    azimuth_deg: float | None,
    elevation_deg: float | None,
    subsolar_longitude_deg: float | None,
    subsolar_latitude_deg: float | None,
    time: str | None,
) -> str:
    """'angles', 'subsolar' or 'time'. Raises ConfigError unless one description is there, and whole."""
    parts = {
        "angles": (azimuth_deg, elevation_deg),
        "subsolar": (subsolar_longitude_deg, subsolar_latitude_deg),
        "time": (time,),
    }
    found = [name for name, values in parts.items() if any(value is not None for value in values)]
    if len(found) != 1:
        raise ConfigError(
            "the Sun: expected one of `sun_azimuth_deg` with `sun_elevation_deg`, `subsolar_longitude_deg` with `subsolar_latitude_deg`, "
            f"or `time`; found {'more than one' if found else 'none'}."
        )
    if any(value is None for value in parts[found[0]]):
        both = {
            "angles": "`sun_azimuth_deg` and `sun_elevation_deg`",
            "subsolar": "`subsolar_longitude_deg` and `subsolar_latitude_deg`",
        }
        raise ConfigError(f"the Sun: expected both {both[found[0]]}, found one; give both.")
    return found[0]
