"""The camera of an LROC NAC cube that went through ISIS ``spiceinit``: its label and attached tables make an ISD."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from stages.physics.images.labels import Block, find_block, find_value, isis_table, read_label
from stages.physics.maps.grid import CSM_CENTRE, ISIS_CENTRE

ISIS_SHIFT = ISIS_CENTRE - CSM_CENTRE


def is_cube(path: Path) -> bool:
    """Whether a file is an ISIS cube."""
    with path.open("rb") as file:
        return file.read(32).lstrip().startswith(b"Object = IsisCube")


def cube_document(path: Path) -> dict[str, Any]:
    """The ISD of a NAC cube, cropped or whole. Raises InputError for other instruments and without SPICE tables."""
    where = str(path)
    label = read_label(path)
    if label is None:
        raise InputError(f"{where}: expected an ISIS label, found none.")
    instrument = str(find_value(label, "InstrumentId") or "none")
    if instrument not in ("NACL", "NACR"):
        raise InputError(
            f"{where}: expected a cube of the LROC NAC to take the camera from, found instrument '{instrument}'; make an ISD "
            "with ALE (isd_generate CUBE, see docs/from_pds_to_pairs.md, step 3) and name that."
        )
    keywords = find_block(label, "NaifKeywords")
    if keywords is None:
        raise InputError(f"{where}: expected SPICE data attached to the cube, found none; run spiceinit on it first.")
    number = -85600 if instrument == "NACL" else -85610
    kernel = {name: _required(keywords, f"INS{number}_{name}", where) for name in _KERNEL}
    preroll = _preroll(keywords, where)
    exposure = float(_required(label, "LineExposureDuration", where)) / 1000.0
    rate = exposure * (1 + kernel["MULTIPLI_LINE_ERROR"]) + kernel["ADDITIVE_LINE_ERROR"] / 1000.0
    first_time = preroll + kernel["CONSTANT_TIME_OFFSET"] + kernel["ADDITIONAL_PREROLL"] * rate
    first_line, first_sample, lines, samples = _crop(label, where)
    summing = float(_required(label, "SpatialSumming", where))
    start = first_time + first_line * rate
    centre = start + lines * rate / 2
    radii = next((v for k, v in keywords.items() if k.startswith("BODY") and k.endswith("_RADII")), None)
    if radii is None:
        raise InputError(
            f"{where}: expected the body's radii among its NAIF keywords, found none; run spiceinit again."
        )
    return {
        "name_model": "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL",
        "image_lines": lines,
        "image_samples": samples,
        "center_ephemeris_time": centre,
        "starting_ephemeris_time": start,
        "line_scan_rate": [[CSM_CENTRE, start - centre, rate]],
        "detector_line_summing": summing,
        "detector_sample_summing": summing,
        "focal_length_model": {"focal_length": kernel["FOCAL_LENGTH"]},
        "focal2pixel_lines": kernel["ITRANSL"],
        "focal2pixel_samples": kernel["ITRANSS"],
        "detector_center": {
            "line": kernel["BORESIGHT_LINE"],
            "sample": kernel["BORESIGHT_SAMPLE"] - ISIS_SHIFT,
        },
        "starting_detector_line": 0,
        "starting_detector_sample": float(find_value(label, "SampleFirstPixel") or 0) + first_sample * summing,
        "optical_distortion": {"lrolrocnac": {"coefficients": [kernel["OD_K"]]}},
        "radii": {"semimajor": radii[0], "semiminor": radii[2], "unit": "km"},
        "instrument_position": _states(path, label, "InstrumentPosition"),
        "sun_position": _states(path, label, "SunPosition"),
        "instrument_pointing": _rotations(path, label, "InstrumentPointing"),
        "body_rotation": _rotations(path, label, "BodyRotation"),
    }


_KERNEL = (
    "FOCAL_LENGTH",
    "ITRANSL",
    "ITRANSS",
    "BORESIGHT_LINE",
    "BORESIGHT_SAMPLE",
    "OD_K",
    "MULTIPLI_LINE_ERROR",
    "ADDITIVE_LINE_ERROR",
    "ADDITIONAL_PREROLL",
    "CONSTANT_TIME_OFFSET",
)


def _required(block: Block, key: str, where: str) -> Any:
    value = find_value(block, key)
    if value is None:
        raise InputError(f"{where}: expected '{key}' in the cube's label, found none; run spiceinit on it again.")
    return value


def _preroll(keywords: Block, where: str) -> float:
    """Ephemeris time of the clock count before the exposure, which spiceinit keeps as the bytes of a double."""
    for key, value in keywords.items():
        if key.startswith("CLOCK_ET_") and key.endswith("_COMPUTED"):
            digits = f"{value:016d}" if isinstance(value, int) else str(value)  # bytes may happen to be all digits
            try:
                return float(struct.unpack("<d", bytes.fromhex(digits))[0])
            except (ValueError, struct.error):
                break
    raise InputError(
        f"{where}: expected the clock's computed time among its NAIF keywords, found none; run spiceinit again."
    )


def _crop(label: Block, where: str) -> tuple[float, float, int, int]:
    """(line, sample) of the cube's corner in the whole image, and its lines and samples."""
    size = find_block(label, "Dimensions")
    if size is None:
        raise InputError(f"{where}: expected the cube's Dimensions, found none.")
    lines, samples = int(size["Lines"]), int(size["Samples"])
    alpha = find_block(label, "AlphaCube")
    if alpha is None:
        return 0.0, 0.0, lines, samples
    if (alpha.get("BetaLines"), alpha.get("BetaSamples")) != (
        alpha["AlphaEndingLine"] - alpha["AlphaStartingLine"],
        alpha["AlphaEndingSample"] - alpha["AlphaStartingSample"],
    ):
        raise InputError(
            f"{where}: expected a cube at its image's full scale, found one reduced or enlarged; crop only."
        )
    # ISIS puts the outer corner at 0.5
    first_line, first_sample = (float(alpha[f"AlphaStarting{axis}"]) - ISIS_SHIFT for axis in ("Line", "Sample"))
    return first_line, first_sample, lines, samples


def _table(path: Path, label: Block, name: str, fields: tuple[int, int]) -> NDArray[np.float64]:
    """(records, fields) of a table with one or the other number of fields. Raises InputError."""
    table = isis_table(path, label, name)
    if table.shape[1] not in fields:
        raise InputError(
            f"{path}: expected {fields[0]} or {fields[1]} fields in table '{name}', found {table.shape[1]}; run spiceinit again."
        )
    return table


def _states(path: Path, label: Block, name: str) -> dict[str, Any]:
    table = _table(path, label, name, (4, 7))
    states: dict[str, Any] = {"positions": table[:, :3], "ephemeris_times": table[:, -1], "unit": "km"}
    if table.shape[1] == 7:
        states["velocities"] = table[:, 3:6]
    return states


def _rotations(path: Path, label: Block, name: str) -> dict[str, Any]:
    table = _table(path, label, name, (5, 8))
    rotations: dict[str, Any] = {"quaternions": table[:, :4], "ephemeris_times": table[:, -1]}
    constant = (find_block(label, "Table", name) or {}).get("ConstantRotation")
    if constant is not None:
        rotations["constant_rotation"] = constant
    return rotations
