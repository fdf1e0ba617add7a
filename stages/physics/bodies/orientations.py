"""Orientation of the bodies: north poles, prime meridians and their motion, as the IAU publishes them.

Values: report of the IAU Working Group on Cartographic Coordinates and Rotational Elements 2015 (Archinal et al. 2018,
Celest. Mech. Dyn. Astr. 130:22), with Phobos as corrected in 2019 (131:61), as in NAIF's pck00011.tpc. Bennu is not in
the report: OSIRIS-REx's own (bennu_v17.tpc). Earth's is the report's low-precision pole, good to 0.01 deg since 1990.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CENTURY = 36525.0  # days


@dataclass(frozen=True)
class Orientation:
    """A body's pole and prime meridian: right ascension, declination, W in degrees.

    Each of ``pole_ra`` and ``pole_dec`` is (constant, per century), ``meridian`` (constant, per day, per day^2).
    Each term is (phase, rate, d_ra, d_dec, d_w): ra += d_ra sin(a), dec += d_dec cos(a), w += d_w sin(a)
    with a = phase + rate * time, time in days, or in centuries where ``terms_per_century``.
    """

    pole_ra: tuple[float, float]
    pole_dec: tuple[float, float]
    meridian: tuple[float, float, float]
    terms: tuple[tuple[float, float, float, float, float], ...] = ()
    terms_per_century: bool = False

    def rotation(self, days: float) -> NDArray[np.float64]:
        """(3, 3), takes ICRF vectors to body-fixed ones; ``days`` of TDB since J2000."""
        centuries = days / CENTURY
        ra = self.pole_ra[0] + self.pole_ra[1] * centuries
        dec = self.pole_dec[0] + self.pole_dec[1] * centuries
        w = self.meridian[0] + (self.meridian[1] * days) % 360.0 + self.meridian[2] * days * days
        for phase, rate, d_ra, d_dec, d_w in self.terms:
            angle = math.radians((phase + rate * (centuries if self.terms_per_century else days)) % 360.0)
            ra += d_ra * math.sin(angle)
            dec += d_dec * math.cos(angle)
            w += d_w * math.sin(angle)
        return about_z(w) @ about_x(90.0 - dec) @ about_z(90.0 + ra)


def about_z(angle_deg: float) -> NDArray[np.float64]:
    """(3, 3), from one set of axes to another that is turned about their common z axis."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def about_x(angle_deg: float) -> NDArray[np.float64]:
    """(3, 3), from one set of axes to another that is turned about their common x axis."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])


ORIENTATIONS = {
    "moon": Orientation(
        (269.9949, 0.0031),
        (66.5392, 0.0130),
        (38.3213, 13.17635815, -1.4e-12),
        (
            (125.045, -0.0529921, -3.8787, 1.5419, 3.5610),
            (250.089, -0.1059842, -0.1204, 0.0239, 0.1208),
            (260.008, 13.0120009, 0.0700, -0.0278, -0.0642),
            (176.625, 13.3407154, -0.0172, 0.0068, 0.0158),
            (357.529, 0.9856003, 0.0, 0.0, 0.0252),
            (311.589, 26.4057084, 0.0072, -0.0029, -0.0066),
            (134.963, 13.0649930, 0.0, 0.0009, -0.0047),
            (276.617, 0.3287146, 0.0, 0.0, -0.0046),
            (34.226, 1.7484877, 0.0, 0.0, 0.0028),
            (15.134, -0.1589763, -0.0052, 0.0008, 0.0052),
            (119.743, 0.0036096, 0.0, 0.0, 0.0040),
            (239.961, 0.1643573, 0.0, 0.0, 0.0019),
            (25.053, 12.9590088, 0.0043, -0.0009, -0.0044),
        ),
    ),
    "mercury": Orientation(
        (281.0103, -0.0328),
        (61.4155, -0.0049),
        (329.5988, 6.1385108, 0.0),
        (
            (174.7910857, 4.092335, 0.0, 0.0, 0.01067257),
            (349.5821714, 8.184670, 0.0, 0.0, -0.00112309),
            (164.3732571, 12.277005, 0.0, 0.0, -0.00011040),
            (339.1643429, 16.369340, 0.0, 0.0, -0.00002539),
            (153.9554286, 20.461675, 0.0, 0.0, -0.00000571),
        ),
    ),
    "venus": Orientation((272.76, 0.0), (67.16, 0.0), (160.20, -1.4813688, 0.0)),
    "mars": Orientation(
        (317.269202, -0.10927547),
        (54.432516, -0.05827105),
        (176.049863, 350.891982443297, 0.0),
        (
            (198.991226, 19139.4819985, 0.000068, 0.0, 0.0),
            (226.292679, 38280.8511281, 0.000238, 0.0, 0.0),
            (249.663391, 57420.7251593, 0.000052, 0.0, 0.0),
            (266.183510, 76560.6367950, 0.000009, 0.0, 0.0),
            (79.398797, 0.5042615, 0.419057, 0.0, 0.0),
            (122.433576, 19139.9407476, 0.0, 0.000051, 0.0),
            (43.058401, 38280.8753272, 0.0, 0.000141, 0.0),
            (57.663379, 57420.7517205, 0.0, 0.000031, 0.0),
            (79.476401, 76560.6495004, 0.0, 0.000005, 0.0),
            (166.325722, 0.5042615, 0.0, 1.591274, 0.0),
            (129.071773, 19140.0328244, 0.0, 0.0, 0.000145),
            (36.352167, 38281.0473591, 0.0, 0.0, 0.000157),
            (56.668646, 57420.9295360, 0.0, 0.0, 0.000040),
            (67.364003, 76560.2552215, 0.0, 0.0, 0.000001),
            (104.792680, 95700.4387578, 0.0, 0.0, 0.000001),
            (95.391654, 0.5042615, 0.0, 0.0, 0.584542),
        ),
        terms_per_century=True,
    ),
}

_JUPITER = ((73.32, 91472.9), (24.62, 45137.2), (283.90, 4850.7), (355.80, 1191.3), (119.90, 262.1), (229.80, 64.3),
            (352.25, 2382.6), (113.35, 6070.0))  # J1..J8  # fmt: skip
_SATURN = ((353.32, 75706.7), (28.72, 75706.7), (177.40, -36505.5), (300.00, -7225.9), (316.45, 506.2),
           (345.20, -1016.3))  # S1..S6  # fmt: skip
_MARS = ((190.72646643, 15917.10818695), (21.46892470, 31834.27934054), (332.86082793, 19139.89694742),
         (394.93256437, 38280.79631835), (189.63271560, 41215158.18420050), (121.46893664, 660.22803474),
         (231.05028581, 660.99123540), (251.37314025, 1320.50145245), (217.98635955, 38279.96125550),
         (196.19729402, 19139.83628608))  # M1..M10  # fmt: skip
_NEPTUNE = ((177.85, 52.316), (355.70, 104.632), (533.55, 156.948), (711.40, 209.264), (889.25, 261.580),
            (1067.10, 313.896), (1244.95, 366.212), (1422.80, 418.528), (1600.65, 470.844))  # N7, 2 N7 .. 9 N7  # fmt: skip


def _satellite(
    ra: tuple[float, float],
    dec: tuple[float, float],
    meridian: tuple[float, float, float],
    angles: Sequence[tuple[float, float]] = (),
    d_ra: Sequence[float] = (),
    d_dec: Sequence[float] = (),
    d_w: Sequence[float] = (),
) -> Orientation:
    """An orientation whose terms count from the first of its planet's ``angles``; sums that end early end in zeros."""
    most = max(len(d_ra), len(d_dec), len(d_w))
    padded = [tuple(d) + (0.0,) * (most - len(d)) for d in (d_ra, d_dec, d_w)]
    terms = tuple((*angle, a, d, w) for angle, a, d, w in zip(angles, *padded, strict=False))
    return Orientation(ra, dec, meridian, terms, terms_per_century=True)


ORIENTATIONS |= {
    "earth": Orientation((0.0, -0.641), (90.0, -0.557), (190.147, 360.9856235, 0.0)),
    "phobos": _satellite(
        (317.67071657, -0.10844326), (52.88627266, -0.06134706), (35.18774440, 1128.84475928, 9.536137031212154e-09),
        _MARS, (-1.78428399, 0.02212824, -0.01028251, -0.00475595), (-1.07516537, 0.00668626, -0.00648740, 0.00281576),
        (1.42421769, -0.02273783, 0.00410711, 0.00631964, -1.143),
    ),
    "deimos": _satellite(
        (316.65705808, -0.10518014), (53.50992033, -0.05979094), (79.39932954, 285.16188899, 0.0), _MARS[5:],
        (3.09217726, 0.22980637, 0.06418655, 0.02533537, 0.00778695),
        (1.83936004, 0.14325320, 0.01911409, -0.01482590, 0.00192430),
        (-2.73954829, -0.39968606, -0.06563259, -0.02912940, 0.01699160),
    ),
    "io": _satellite(
        (268.05, -0.009), (64.50, 0.003), (200.39, 203.4889538, 0.0), _JUPITER[2:], (0.094, 0.024), (0.040, 0.011),
        (-0.085, -0.022),
    ),
    "europa": _satellite(
        (268.08, -0.009), (64.51, 0.003), (36.022, 101.3747235, 0.0), _JUPITER[3:], (1.086, 0.060, 0.015, 0.009),
        (0.468, 0.026, 0.007, 0.002), (-0.980, -0.054, -0.014, -0.008),
    ),
    "ganymede": _satellite(
        (268.20, -0.009), (64.57, 0.003), (44.064, 50.3176081, 0.0), _JUPITER[3:], (-0.037, 0.431, 0.091),
        (-0.016, 0.186, 0.039), (0.033, -0.389, -0.082),
    ),
    "callisto": _satellite(
        (268.72, -0.009), (64.83, 0.003), (259.51, 21.5710715, 0.0), _JUPITER[4:], (-0.068, 0.590, 0.0, 0.010),
        (-0.029, 0.254, 0.0, -0.004), (0.061, -0.533, 0.0, -0.009),
    ),
    "mimas": _satellite(
        (40.66, -0.036), (83.52, -0.004), (333.46, 381.9945550, 0.0), _SATURN[2:], (13.56,), (-1.53,),
        (-13.48, 0.0, -44.85),
    ),
    "enceladus": Orientation((40.66, -0.036), (83.52, -0.004), (6.32, 262.7318996, 0.0)),
    "tethys": _satellite(
        (40.66, -0.036), (83.52, -0.004), (8.95, 190.6979085, 0.0), _SATURN[3:], (9.66,), (-1.09,), (-9.60, 2.23)
    ),
    "dione": Orientation((40.66, -0.036), (83.52, -0.004), (357.6, 131.5349316, 0.0)),
    "rhea": _satellite(
        (40.38, -0.036), (83.55, -0.004), (235.16, 79.6900478, 0.0), _SATURN[5:], (3.10,), (-0.35,), (-3.08,)
    ),
    "titan": Orientation((39.4827, 0.0), (83.4279, 0.0), (186.5855, 22.5769768, 0.0)),
    "iapetus": Orientation((318.16, -3.949), (75.03, -1.143), (355.2, 4.5379572, 0.0)),
    "triton": _satellite(
        (299.36, 0.0), (41.17, 0.0), (296.53, -61.2572637, 0.0), _NEPTUNE,
        (-32.35, -6.28, -2.08, -0.74, -0.28, -0.11, -0.07, -0.02, -0.01), (22.55, 2.10, 0.55, 0.16, 0.05, 0.02, 0.01),
        (22.25, 6.73, 2.05, 0.74, 0.28, 0.11, 0.05, 0.02, 0.01),
    ),
    "pluto": Orientation((132.993, 0.0), (-6.163, 0.0), (302.695, 56.3625225, 0.0)),
    "charon": Orientation((132.993, 0.0), (-6.163, 0.0), (122.695, 56.3625225, 0.0)),
    "ceres": Orientation((291.418, 0.0), (66.764, 0.0), (170.650, 952.1532, 0.0)),
    "vesta": Orientation((309.031, 0.0), (42.235, 0.0), (285.39, 1617.3329428, 0.0)),
    "eros": Orientation((11.35, 0.0), (17.22, 0.0), (326.07, 1639.38864745, 0.0)),
    "bennu": Orientation((85.46097, 0.0), (-60.3586, 0.0), (140.68835, 2011.145755336826, 1.815e-6)),
}  # fmt: skip
