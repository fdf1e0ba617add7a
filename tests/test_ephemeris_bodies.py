"""The Sun over other bodies, with a time alone, against what SPICE gave and what the literature says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from schemas.errors import InputError
from stages.physics.bodies.ephemeris import AU, KERNELS_VARIABLE, SATELLITES, et_to_utc, subsolar_point
from stages.physics.bodies.orientations import ORIENTATIONS
from stages.physics.bodies.small_bodies import ELEMENTS, Elements, small_body_state
from stages.physics.bodies.spheres import RADII, find_body
from stages.physics.cameras.document import quaternion_matrix

# Ephemeris time, body rotation (J2000 to body-fixed, w x y z) and the Sun (J2000, km) that SPICE gave in ALE's test ISDs
# (github.com/DOI-USGS/ale, tests/pytests/data/isds: dawnfc, cassiniiss, galileossi, newhorizons, osirisrex, msi, hayabusa2).
SPICE = {
    "ceres": (
        488002614.62294483,
        [-0.7323907260895571, 0.1890116253358707, -0.06950386369161242, 0.6504211272382237],
        [-184987783.06715, 343341745.2043138, 199532284.61700404],
    ),
    "enceladus": (
        376938208.24072826,
        [-0.49726210411698374, 0.01884225276113552, 0.0532896313700967, 0.8657572318545625],
        [1342712164.7010403, 521645736.9735198, 157522069.3546536],
    ),
    "io, Galileo": (
        -90341490.50077514,
        [-0.05535025592416614, 0.01988347883852856, 0.22000702873027086, -0.9737237307099407],
        [-408911151.05250275, 591769599.3362305, 263605502.90189648],
    ),
    "io, New Horizons": (
        225940527.51631695,
        [-0.57817095054415, 0.13699803004374, 0.1729987472005, -0.78550704973162],
        [311036228.79889, 679984041.50957, 283865335.82619],
    ),
    "bennu": (
        604882849.4327942,
        [-0.24468662154888665, -0.8995476917306681, 0.3540944064834505, 0.07456244922312974],
        [94633635.43566033, -98012563.34059505, -55786970.073704116],
    ),
    "eros": (
        4750816.53996159,
        [-0.21742791831046224, -0.5915927720196109, 0.04469058688780722, -0.7750779598704606],
        [122682357.26743293, 156146522.97922137, 110874367.26208726],
    ),
    "earth": (
        502404366.34876287,
        [-0.1979938370409085, -0.0007582477662989689, 0.00015456662316054356, -0.9802029594238645],
        [-48916727.046504386, -127647230.31032252, -55336271.675298646],
    ),
}


@pytest.fixture(autouse=True)
def no_kernels(monkeypatch):
    monkeypatch.delenv(KERNELS_VARIABLE, raising=False)


def degrees_between(a, b):
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return math.degrees(2 * math.asin(np.linalg.norm(a - b) / 2))


@pytest.mark.parametrize("name", SPICE)
def test_subsolar_points_agree_with_spice(name):
    et, quaternion, sun = SPICE[name]
    expected = quaternion_matrix(np.array(quaternion)) @ np.array(sun)
    found = subsolar_point(et_to_utc(et), name.split(",")[0])
    lon, lat = math.radians(found.longitude_deg), math.radians(found.latitude_deg)
    direction = [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)]
    far = name.split(",")[0] in SATELLITES
    assert degrees_between(np.array(direction), expected) < (0.03 if far else 0.001)
    assert found.distance_au == pytest.approx(np.linalg.norm(expected) * 1e3 / AU, rel=1e-4 if far else 1e-6)


# Minor Planet Center, MPCORB: (Julian date of the epoch, M, perihelion, node, inclination, e, n) at other epochs than ours
MPCORB = [
    ("ceres", 2455400.5, 113.41048, 72.58976, 80.39321, 10.58682, 0.0791382, 0.21432817),  # K107N
    ("ceres", 2455800.5, 199.31747, 72.44742, 80.37910, 10.58595, 0.0785634, 0.21418897),  # K118R
    ("ceres", 2456600.5, 10.55761, 72.29213, 80.32762, 10.59398, 0.0757973, 0.21415869),  # K13B4
    ("ceres", 2458200.5, 352.23052, 73.11528, 80.30992, 10.59351, 0.0755347, 0.21413094),  # K183N
    ("ceres", 2461000.5, 231.53974, 73.29974, 80.24964, 10.58789, 0.0795764, 0.21429712),  # K25BL
    ("vesta", 2455400.5, 307.80111, 149.83731, 103.90970, 7.13407, 0.0886225, 0.27152411),  # K107N
    ("vesta", 2461000.5, 26.80969, 151.53711, 103.70232, 7.14406, 0.0901676, 0.27158812),  # K25BL
    ("eros", 2461000.5, 310.55432, 178.92978, 304.27008, 10.82847, 0.2228360, 0.55977529),  # K25BL
]


@pytest.mark.parametrize(("name", "epoch", "elements"), [(r[0], r[1], r[2:]) for r in MPCORB])
def test_asteroids_agree_with_the_elements_of_other_epochs(name, epoch, elements):
    expected = Elements(epoch, *elements, "MPCORB").state()[:3]
    assert degrees_between(small_body_state(name, epoch)[0], expected) < 3e-4
    if abs(epoch - ELEMENTS[name].epoch) < 1000:
        return
    # without the planets' pull it would be off by far more
    ours, other = ELEMENTS[name], Elements(epoch, *elements, "MPCORB")
    unperturbed = Elements(
        ours.epoch, ours.mean_anomaly + ours.motion * (epoch - ours.epoch), ours.perihelion, ours.node,
        ours.inclination, ours.eccentricity, ours.motion, "",
    ).state()[:3]  # fmt: skip
    assert degrees_between(unperturbed, other.state()[:3]) > 0.01


def test_seasons_that_missions_met():
    """Vesta: late southern summer, 27 deg south, as Dawn arrived; northward equinox 2012-08-20 (Dawn Journal, 2012).
    Saturn: equinox 2009-08-11, northern solstice 2017-05-24, ring plane 26.7 deg (Cassini). Pluto: New Horizons found the
    Sun 51.6 deg north on 2015-07-14 (Moore et al. 2016, Science 351:1284)."""
    assert subsolar_point("2011-08-11T00:00:00", "vesta").latitude_deg == pytest.approx(-27.2, abs=0.2)
    assert subsolar_point("2012-08-18T00:00:00", "vesta").latitude_deg < 0
    assert subsolar_point("2012-08-22T00:00:00", "vesta").latitude_deg > 0
    for moon in ("enceladus", "dione"):  # upright on the ring plane within 0.03 deg
        assert abs(subsolar_point("2009-08-11T00:00:00", moon).latitude_deg) < 0.1
        assert subsolar_point("2017-05-24T00:00:00", moon).latitude_deg == pytest.approx(26.73, abs=0.05)
    assert subsolar_point("2015-07-14T11:50:00", "pluto").latitude_deg == pytest.approx(51.6, abs=0.1)


@pytest.mark.parametrize("moon", SATELLITES)
def test_satellites_turn_with_their_orbits(moon):
    """Over a tenth of a day the Sun moves west by the turn of the body; Phobos swings by 1.1 deg about its own."""
    rate = ORIENTATIONS[moon].meridian[1]
    assert abs(rate) > 4
    start = 5.0e8
    first, later = (subsolar_point(et_to_utc(start + k * 86400 * 0.1), moon) for k in (0, 1))
    turned = (first.longitude_deg - later.longitude_deg + 180) % 360 - 180
    assert turned == pytest.approx((rate * 0.1 + 180) % 360 - 180, abs=2.5 if moon == "phobos" else 0.6)
    assert abs(first.latitude_deg) < 65


def test_every_body_by_name_has_a_sun_or_says_what_to_give():
    for name in RADII:
        if name in ORIENTATIONS:
            point = subsolar_point("2012-06-01T00:00:00", find_body(name.title()))
            assert -90 <= point.latitude_deg <= 90 and 0.3 < point.distance_au < 35
            rotation = ORIENTATIONS[name].rotation(12.4 * 365.25)
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert set(RADII) - set(ORIENTATIONS) == {"ryugu"}


def test_mars_and_enceladus_orientation_as_evaluated_elsewhere():
    """2020-06-15T12:00 TDB from pck00011 by another project (duncaneddy/brahe): pole and prime meridian, degrees."""
    days = 645494400.0 / 86400
    for name, (ra, dec, w) in {
        "mars": (317.6591428449708, 52.87386598710687, 170.63252998981625),
        "enceladus": (40.65263638603696, 83.51918182067077, 156.34191160020418),
    }.items():
        rotation = ORIENTATIONS[name].rotation(days)
        pole = [math.cos(math.radians(dec)) * f(math.radians(ra)) for f in (math.cos, math.sin)]
        np.testing.assert_allclose(rotation[2], [*pole, math.sin(math.radians(dec))], atol=1e-11)
        node = np.array([-math.sin(math.radians(ra)), math.cos(math.radians(ra)), 0.0])
        assert (
            degrees_between(rotation @ node, np.array([math.cos(math.radians(w)), -math.sin(math.radians(w)), 0]))
            < 1e-8
        )


def test_times_too_far_from_the_elements_are_refused():
    with pytest.raises(InputError, match=r"body 'ceres': expected a time within 110 years"):
        small_body_state("ceres", 2378861.5)  # 1801-01-01, when it was found
