"""Times and sub-solar points against values that SPICE gave."""

from __future__ import annotations

import json
import math
import os
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest

from schemas.errors import ConfigError, GeometryError, InputError
from stages.physics.bodies import ephemeris
from stages.physics.bodies.ephemeris import et_to_utc, parse_utc, subsolar_point, utc_to_et
from stages.physics.bodies.spheres import find_body
from stages.physics.cameras import open_camera


def degrees_apart(a, b):
    def unit(longitude, latitude):
        lon, lat = math.radians(longitude), math.radians(latitude)
        return np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])

    return math.degrees(2 * math.asin(np.linalg.norm(unit(*a) - unit(*b)) / 2))


@pytest.mark.parametrize(
    "name",
    [
        "oracles/ale_lrolroc_M103595705LE.isd.json",
        "oracles/usgscsm_toughLroNacLineScan.isd.json",
        "data/formats/M143947267L.cal.echo.crop.cub",
    ],
)
def test_subsolar_point_agrees_with_spice(shared, name):
    camera = open_camera(shared / name)
    for line in (0.5, camera.lines - 0.5):
        sun = camera.sun_position(line)
        distance = np.linalg.norm(sun)
        truth = math.degrees(math.atan2(sun[1], sun[0])), math.degrees(math.asin(sun[2] / distance))
        found = subsolar_point(et_to_utc(float(camera.ephemeris_time(line))))
        assert degrees_apart(found[:2], truth) < 0.01
        assert found.distance_au == pytest.approx(distance / ephemeris.AU, abs=1e-6)


def test_subsolar_point_agrees_with_the_sun_to_ground_tables(shared):
    table = np.genfromtxt(shared / "oracles/usgscsm_lro_nac_tough_image_ground.csv", delimiter=",", names=True)
    centre = json.loads((shared / "oracles/usgscsm_toughLroNacLineScan.isd.json").read_text())["center_ephemeris_time"]
    for row in table[:: len(table) // 5]:
        found = subsolar_point(et_to_utc(centre + row["time_s"]))
        sun = (
            ephemeris.AU
            * found.distance_au
            * np.array(
                [
                    math.cos(math.radians(found.latitude_deg)) * math.cos(math.radians(found.longitude_deg)),
                    math.cos(math.radians(found.latitude_deg)) * math.sin(math.radians(found.longitude_deg)),
                    math.sin(math.radians(found.latitude_deg)),
                ]
            )
        )
        direction = np.array([row["X_m"], row["Y_m"], row["Z_m"]]) - sun
        direction /= np.linalg.norm(direction)
        truth = np.array([row["sun_to_ground_x"], row["sun_to_ground_y"], row["sun_to_ground_z"]])
        assert math.degrees(np.linalg.norm(direction - truth)) < 0.01


def test_ephemeris_time_of_a_nac_exposure(shared):
    """The cube's own clock conversion by SPICE, and its UTC start time, are the same moment."""
    expected = json.loads((shared / "oracles/nac_M143947267LE_crop_geometry_and_expected.json").read_text())
    preroll = expected["naif"]["CLOCK_ET_preroll_s"]
    line_time = expected["label"]["LineExposureDuration_ms"] * 1e-3 * (1 + expected["naif"]["MULTIPLI_LINE_ERROR"])
    start = preroll + expected["naif"]["ADDITIONAL_PREROLL"] * line_time
    assert utc_to_et(expected["label"]["StartTime"]) == pytest.approx(start, abs=2e-3)


def test_utc_comes_back():
    assert et_to_utc(utc_to_et("2016-12-31T23:59:60.500")) == "2016-12-31T23:59:60.500Z"  # a leap second
    assert et_to_utc(utc_to_et("1971-07-31T01:00:00Z")) == "1971-07-31T01:00:00.000Z"


@pytest.mark.parametrize(
    "text",
    [
        "2010-11-09T13:06:40.356Z",
        "2010-11-09 13:06:40.356",
        "2010-313T13:06:40.356",
        "2010-11-09T13:06:40.356 UTC",
        datetime(2010, 11, 9, 13, 6, 40, 356000, tzinfo=UTC),
        datetime(2010, 11, 9, 15, 6, 40, 356000, tzinfo=timezone(timedelta(hours=2))),
    ],
)
def test_the_spellings_of_a_time(text):
    assert abs((parse_utc(text) - parse_utc("2010-11-09T13:06:40.356")).sec) < 1e-6


@pytest.mark.parametrize(
    "text",
    [
        "",
        "yesterday",
        "2010-13-01T00:00:00",
        "2010-02-30",
        "2010-11-09T25:00:00",
        "09/11/2010",
        "1700-01-01",
        "2100-01-01",
        datetime(1959, 12, 31),
    ],
)
def test_what_is_no_time(text):
    with pytest.raises(InputError, match="table: image 3: expected a UTC time"):
        parse_utc(text, "table: image 3")


def test_mars_agrees_with_the_worked_example_of_mars24():
    """Allison & McEwen (2000, Planet. Space Sci. 48:215), as Mars24 works it: 174.726 W, declination -24.98 (ocentric)."""
    found = subsolar_point("2000-01-06T00:00:00", "mars")
    assert found.longitude_deg == pytest.approx(-174.726, abs=0.01)
    assert found.latitude_deg == pytest.approx(
        math.degrees(math.asin(0.42565 * math.sin(math.radians(277.18677)))), abs=0.02
    )


def test_seasons_of_mars():
    """Northern solstices and the equinox that opened Mars year 26 (Piqueux et al. 2015, Icarus 251:332)."""
    assert abs(subsolar_point("2002-04-18T12:00:00", "mars").latitude_deg) < 0.15
    for solstice in ("2002-10-31T00:00:00", "2004-09-20T00:00:00"):
        assert subsolar_point(solstice, find_body("Mars")).latitude_deg == pytest.approx(25.19, abs=0.05)


@pytest.mark.parametrize("body", ["mercury", "venus"])
def test_the_pole_leans_no_further_than_it_does(body):
    """Mercury stands upright within 0.04 deg, Venus (retrograde) within 2.7 deg of its orbit's normal."""
    latitudes = [subsolar_point(f"2015-{month:02d}-15", body).latitude_deg for month in range(1, 13)]
    assert max(map(abs, latitudes)) < {"mercury": 0.05, "venus": 2.7}[body]
    assert np.ptp(latitudes) > 1e-3


def test_unknown_bodies_are_told_what_helps():
    with pytest.raises(GeometryError, match=r"'ryugu'.*sub-solar point, or SPICE kernels") as caught:
        subsolar_point("2018-07-01", find_body("Ryugu"))
    assert "\n" not in str(caught.value)


def test_spice_kernels_without_spiceypy_or_files(monkeypatch, tmp_path):
    monkeypatch.setenv(ephemeris.KERNELS_VARIABLE, str(tmp_path / "none.tm"))
    with pytest.raises((ConfigError, InputError), match=ephemeris.KERNELS_VARIABLE):
        subsolar_point("2015-01-01")


def test_spice_kernels_are_used_where_there_are_any(tmp_path, monkeypatch):
    """Kernels written here with the built-in Sun and Moon, and a Moon whose prime meridian is turned by 90 deg."""
    spiceypy = pytest.importorskip("spiceypy", reason="spiceypy is the extra 'spice'")
    from astropy.coordinates import get_body_barycentric_posvel

    times = [f"2015-03-{day:02d}T00:00:00" for day in range(1, 12)]
    epochs = np.array([utc_to_et(t) for t in times])
    handle = spiceypy.spkopn(str(tmp_path / "sun_moon.bsp"), "test", 0)
    for name, code in (("sun", 10), ("moon", 301)):
        states = []
        for t in times:
            position, velocity = get_body_barycentric_posvel(name, parse_utc(t).tdb, ephemeris="builtin")
            states.append([*position.xyz.to_value("km"), *velocity.xyz.to_value("km/s")])
        spiceypy.spkw13(handle, code, 0, "J2000", epochs[0], epochs[-1], name, 7, len(states), states, epochs)
    spiceypy.spkcls(handle)
    moon = ephemeris.ORIENTATIONS["moon"]
    (tmp_path / "moon.tpc").write_text(
        "\\begindata\n"
        f"BODY301_POLE_RA = ( {moon.pole_ra[0]} {moon.pole_ra[1]} 0 )\nBODY301_POLE_DEC = ( {moon.pole_dec[0]} {moon.pole_dec[1]} 0 )\n"
        f"BODY301_PM = ( {moon.meridian[0] + 90} {moon.meridian[1]} {moon.meridian[2]} )\nBODY3_NUT_PREC_ANGLES = ( "
        + "\n".join(f"{t[0]} {t[1] * 36525}" for t in moon.terms)  # a line holds at most 132 characters
        + " )\n"
        + "".join(
            f"BODY301_NUT_PREC_{axis} = ( " + "\n".join(str(t[k]) for t in moon.terms) + " )\n"
            for axis, k in (("RA", 2), ("DEC", 3), ("PM", 4))
        )
        + "\\begintext\n"
    )
    built_in = subsolar_point("2015-03-05T06:00:00")
    try:
        monkeypatch.setenv(
            ephemeris.KERNELS_VARIABLE, os.pathsep.join(str(tmp_path / name) for name in ("sun_moon.bsp", "moon.tpc"))
        )
        found = subsolar_point("2015-03-05T06:00:00")
        assert (found.longitude_deg - built_in.longitude_deg + 90 + 180) % 360 - 180 == pytest.approx(0, abs=1e-3)
        assert found.latitude_deg == pytest.approx(built_in.latitude_deg, abs=1e-3)
        assert found.distance_au == pytest.approx(built_in.distance_au, abs=1e-7)
        with pytest.raises(InputError, match="no place of the Sun seen from 'ceres'"):
            subsolar_point("2015-03-05T06:00:00", "ceres")
    finally:
        spiceypy.kclear()
