"""The cameras of ISIS cubes: what a cube's label and SPICE tables say, put as an ISD.

Instruments differ by where their kernels keep the detector's centre, the focal length and the distortion: a framing camera is
one entry of FRAMING. Facts are those of ISIS's camera models (github.com/DOI-USGS/ISIS3, isis/src/*/objs).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from schemas.errors import InputError
from stages.physics.cameras.isis_cube import ISIS_SHIFT, Cube
from stages.physics.images.labels import find_value
from stages.physics.maps.grid import CSM_CENTRE

NAC_CODES = {"nacl": -85600, "nacr": -85610}


def cube_document(path: Path) -> dict[str, Any]:
    """The ISD of a cube, cropped, reduced or whole. Raises InputError for unknown instruments and without SPICE tables."""
    return document_of(Cube.open(path))


def document_of(cube: Cube) -> dict[str, Any]:
    """The ISD of what a cube's label and tables say. Raises InputError."""
    instrument = str(find_value(cube.label, "InstrumentId") or "none")
    name = "".join(instrument.lower().split())
    if name in NAC_CODES:
        return _nac(cube, NAC_CODES[name])
    if name not in FRAMING:
        known = ", ".join(sorted(n.upper() for n in (*NAC_CODES, *FRAMING)))
        raise InputError(
            f"{cube.where}: expected a cube of {known} to take the camera from, found instrument '{instrument}'; make an ISD "
            "with ALE (isd_generate CUBE, see docs/from_pds_to_pairs.md, step 3) and name it as the camera."
        )
    return _framing(cube, FRAMING[name])


# --- line scanners --------------------------------------------------------------------------------------------------


def _nac(cube: Cube, code: int) -> dict[str, Any]:
    """LROC NAC: the clock's count, corrected as the instrument kernel says, starts the lines."""

    def kernel(name: str) -> float:
        return float(cube.kernel(name, code=code)[0])

    extent = cube.extent()
    exposure = float(cube.value("LineExposureDuration")) / 1000.0
    rate = exposure * (1 + kernel("MULTIPLI_LINE_ERROR")) + kernel("ADDITIVE_LINE_ERROR") / 1000.0
    first_time = cube.clock_time() + kernel("CONSTANT_TIME_OFFSET") + kernel("ADDITIONAL_PREROLL") * rate
    start = first_time + extent.corner[0] * rate
    rate *= extent.scale[0]
    centre = start + extent.lines * rate / 2
    summing = float(cube.value("SpatialSumming"))
    first_sample = float(find_value(cube.label, "SampleFirstPixel") or 0)
    return cube.common(extent) | {
        "name_model": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL",
        "center_ephemeris_time": centre,
        "starting_ephemeris_time": start,
        "line_scan_rate": [[CSM_CENTRE, start - centre, rate]],
        "detector_line_summing": summing * extent.scale[0],
        "detector_sample_summing": summing * extent.scale[1],
        "focal_length_model": {"focal_length": kernel("FOCAL_LENGTH")},
        "focal2pixel_lines": cube.kernel("ITRANSL", 3, code),
        "focal2pixel_samples": cube.kernel("ITRANSS", 3, code),
        "detector_center": {"line": kernel("BORESIGHT_LINE"), "sample": kernel("BORESIGHT_SAMPLE") - ISIS_SHIFT},
        "starting_detector_line": 0,
        "starting_detector_sample": first_sample + extent.corner[1] * summing,
        "optical_distortion": {"lrolrocnac": {"coefficients": [kernel("OD_K")]}},
    }


# --- framing cameras ------------------------------------------------------------------------------------------------

NO_DISTORTION = {"radial": {"coefficients": [0.0, 0.0, 0.0]}}


@dataclass(frozen=True)
class Framing:
    """Where a framing camera's cubes keep what differs between instruments.

    centre : (line, sample) of the detector's origin as ISIS counts, the first pixel's centre at 1
    distortion : an ISD's ``optical_distortion``; focal_length : mm; code : whose keywords of the kernel hold
    binning : detector px to one of the whole image, and the (line, sample) of its first pixel on the detector, from 0
    notes : what is left out
    """

    centre: Callable[[Cube], tuple[float, float]]
    distortion: Callable[[Cube, int], dict[str, Any]] = lambda cube, code: NO_DISTORTION
    focal_length: Callable[[Cube, int], float] = lambda cube, code: float(cube.kernel("FOCAL_LENGTH", 1, code)[0])
    code: Callable[[Cube], int] = lambda cube: cube.code
    binning: Callable[[Cube], tuple[float, float, float]] = lambda cube: (1.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()


def _framing(cube: Cube, instrument: Framing) -> dict[str, Any]:
    extent, code = cube.extent(), instrument.code(cube)
    times = np.asarray(cube.spice["instrument_pointing"]["ephemeris_times"], float)
    line, sample = instrument.centre(cube)
    binning, first_line, first_sample = instrument.binning(cube)
    return cube.common(extent) | {
        "name_model": "USGS_ASTRO_FRAME_SENSOR_MODEL",
        "center_ephemeris_time": float(times[0] + times[-1]) / 2,  # spiceinit keeps the middle of the exposure alone
        "focal_length_model": {"focal_length": instrument.focal_length(cube, code)},
        "focal2pixel_lines": cube.kernel("ITRANSL", 3, code),
        "focal2pixel_samples": cube.kernel("ITRANSS", 3, code),
        "detector_center": {"line": line - ISIS_SHIFT, "sample": sample - ISIS_SHIFT},
        "detector_line_summing": binning * extent.scale[0],
        "detector_sample_summing": binning * extent.scale[1],
        "starting_detector_line": first_line + binning * extent.corner[0],
        "starting_detector_sample": first_sample + binning * extent.corner[1],
        "optical_distortion": instrument.distortion(cube, code),
        "lunargr_notes": [f"{cube.where}: {note}" for note in instrument.notes],
    }


def _boresight(cube: Cube) -> tuple[float, float]:
    return float(cube.kernel("BORESIGHT_LINE")[0]), float(cube.kernel("BORESIGHT_SAMPLE")[0])


def _ccd_centre(cube: Cube) -> tuple[float, float]:
    sample, line = cube.kernel("CCD_CENTER", 2)  # this keyword counts pixels from 0
    return float(line) + 1.0, float(sample) + 1.0


def _half_of_the_image(cube: Cube) -> tuple[float, float]:
    lines, samples = cube.extent().whole
    return lines / 2, samples / 2


def _label_boresight(cube: Cube) -> tuple[float, float]:
    """Lunar Orbiter: the label's boresight; with fiducials their affine map, which spiceinit keeps, counts from 0."""
    if find_value(cube.label, "FiducialSamples") is not None:
        return 0.0, 0.0
    return float(cube.value("BoresightLine")), float(cube.value("BoresightSample"))


def _metric(cube: Cube, code: int) -> dict[str, Any]:
    numbers = [cube.kernel("PP", 2, code), cube.kernel("OD_K", 3, code), cube.kernel("DECENTER", 3, code)]
    return {"metric": {"coefficients": np.concatenate(numbers)}}


def _uvvis(cube: Cube, code: int) -> dict[str, Any]:
    numbers = [cube.kernel("PP", 2, code), cube.kernel("OD_K", 3, code), cube.kernel("DECENTER", 2, code)]
    return {"uvvis": {"coefficients": np.concatenate(numbers)}}


def _taylor(cube: Cube, code: int) -> dict[str, Any]:
    return {"transverse": {"x": cube.kernel("OD_T_X", 10, code), "y": cube.kernel("OD_T_Y", 10, code)}}


def _dawn(cube: Cube, code: int) -> dict[str, Any]:
    return {"dawnfc": {"coefficients": cube.kernel("RAD_DIST_COEFF", 1, code)}}


def _msi(cube: Cube, code: int) -> dict[str, Any]:
    return {"radial": {"coefficients": -cube.kernel("K1", 1, code)}}


def _lunar_orbiter_medium(cube: Cube, code: int) -> dict[str, Any]:
    """The kernel's polynomial is in 5,000 pixels, about a point given in pixels from the boresight."""
    reference, pitch = 5000.0, float(cube.kernel("PIXEL_PITCH", 1, code)[0])
    powers = np.array([1.0, (pitch * reference) ** -2, (pitch * reference) ** -4]) / reference
    centre = cube.kernel("POINT_OF_SYMMETRY", 2, code) * pitch
    return {"centred": {"coefficients": np.concatenate([centre, cube.kernel("OD_K", 3, code) * powers])}}


def _lunar_orbiter_high(cube: Cube, code: int) -> dict[str, Any]:
    px, py = cube.kernel("PERSPECTIVE_FACTORS", 2, code)
    x, y = cube.kernel("POINT_OF_SYMMETRY", 2, code)
    radial = cube.kernel("OD_K", 2, code)
    names = ("perspective_x", "perspective_y", "center_point_x", "center_point_y")
    return {"lunarorbiter": dict(zip(names, (px, py, x, y), strict=True)) | {"coefficients": radial}}


def _mdis_filter(cube: Cube) -> int:
    """The wide-angle camera's kernel has keywords for each of its filters."""
    wide = str(cube.value("InstrumentId")).upper() == "MDIS-WAC"
    return cube.code - int(cube.value("Number")) if wide else cube.code


def _mdis_focal_length(cube: Cube, code: int) -> float:
    """At the detector's temperature, where the kernel knows it."""
    found = find_value(cube.keywords, "TempDependentFocalLength")
    return float(cube.kernel("FOCAL_LENGTH", 1, code)[0] if found is None else found)


def _mdis_binning(cube: Cube) -> tuple[float, float, float]:
    binning = float(cube.value("PixelBinningMode")) or 1.0
    if not int(cube.value("FpuBinningMode")):
        return binning, 0.0, 0.0
    line, sample = (float(cube.kernel(f"FPUBIN_START_{axis}")[0]) - 1.0 for axis in ("LINE", "SAMPLE"))
    return 2.0 * binning, line, sample


# mm, of Viking Orbiter 1 A and B, 2 A and B
VIKING_FOCAL_LENGTHS = {("1", "A"): 474.398, ("1", "B"): 474.448, ("2", "A"): 474.610, ("2", "B"): 474.101}


def _viking_focal_length(cube: Cube, code: int) -> float:
    spacecraft, camera = str(cube.value("SpacecraftName"))[-1:], str(cube.value("InstrumentId"))[-1:]
    if (spacecraft, camera) not in VIKING_FOCAL_LENGTHS:
        raise InputError(f"{cube.where}: expected a camera of Viking Orbiter 1 or 2, found '{spacecraft}', '{camera}'.")
    return VIKING_FOCAL_LENGTHS[spacecraft, camera]


_MDIS = Framing(_boresight, _taylor, _mdis_focal_length, _mdis_filter, _mdis_binning)
_DAWN = Framing(_ccd_centre, _dawn)
_VIKING = Framing(
    lambda cube: (528.0, 602.0),
    focal_length=_viking_focal_length,
    notes=("the vidicon's distortion between its reseau marks, up to some pixels, is not removed",),
)
# InstrumentId without spaces, in lower case
FRAMING = {
    "metric": Framing(_half_of_the_image, _metric),
    "mdis-nac": _MDIS,
    "mdis-wac": _MDIS,
    "fc1": _DAWN,
    "fc2": _DAWN,
    "uvvis": Framing(_boresight, _uvvis),
    "nir": Framing(_boresight),
    "hires": Framing(_boresight),
    "highresolutioncamera": Framing(_label_boresight, _lunar_orbiter_high),
    "mediumresolutioncamera": Framing(_label_boresight, _lunar_orbiter_medium),
    "visual_imaging_subsystem_camera_a": _VIKING,
    "visual_imaging_subsystem_camera_b": _VIKING,
    "msi": Framing(_boresight, _msi),
}
