"""Reading checked values out of a camera's JSON document, an ISD or our own."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.errors import GeometryError, InputError
from schemas.files.user_files import check_keys
from stages.common.arrays import Floats
from stages.physics.bodies.spheres import find_body

LARGEST_IMAGE = 100_000_000  # lines, samples: longer than any strip from orbit
ROTATION_TOLERANCE = 1e-6
LOWEST_CAMERA = 0.5  # of the radius from the centre: small bodies are far from round
FARTHEST_CAMERA = 1e13  # m from the centre
QUATERNION_TOLERANCE = 1e-3  # of their length; tables keep 8 digits


def value(document: Mapping[str, Any], key: str, where: str) -> Any:
    """``document[key]``, where ``key`` may go down with dots. Raises InputError for a missing one."""
    here: Any = document
    for part in key.split("."):
        if not isinstance(here, Mapping) or part not in here:
            raise InputError(f"{where}: expected the key '{key}', found none; make the camera model again.")
        here = here[part]
    return here


def number(document: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    """A finite number. Raises InputError."""
    if default is not None and not has(document, key):
        return default
    found = value(document, key, where)
    try:
        result = float(found)
    except (TypeError, ValueError):
        raise InputError(
            f"{where}: expected a number in '{key}', found {_short(found)}; mend the camera model."
        ) from None
    if not math.isfinite(result):
        raise InputError(f"{where}: expected a finite number in '{key}', found {result}; mend the camera model.")
    return result


def array(document: Mapping[str, Any], key: str, where: str, shape: tuple[int, ...] | None = None) -> Floats:
    """Numbers of a fixed shape (-1: any length). Raises InputError."""
    found = value(document, key, where)
    try:
        result = np.array(found, dtype=float)
    except (TypeError, ValueError):
        raise InputError(
            f"{where}: expected numbers in '{key}', found {_short(found)}; mend the camera model."
        ) from None
    fits = shape is None or (
        result.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, result.shape, strict=True))
    )
    if not fits:
        wanted = " x ".join("n" if n == -1 else str(n) for n in shape or ())
        raise InputError(
            f"{where}: expected {wanted} numbers in '{key}', found shape {result.shape}; mend the camera model."
        )
    if not np.isfinite(result).all():
        raise InputError(f"{where}: expected finite numbers in '{key}', found NaN or infinity; mend the camera model.")
    return result


def has(document: Mapping[str, Any], key: str) -> bool:
    """Whether there is a value under ``key``, which may go down with dots."""
    try:
        value(document, key, "")
    except InputError:
        return False
    return True


def size(document: Mapping[str, Any], key: str, where: str) -> int:
    """A number of lines or samples. Raises InputError."""
    result = number(document, key, where)
    if not 1 <= result <= LARGEST_IMAGE or result != int(result):
        raise InputError(
            f"{where}: expected a whole number of pixels, 1 .. {LARGEST_IMAGE}, in '{key}', found {result:g}; mend the camera model."
        )
    return int(result)


def rotation(document: Mapping[str, Any], key: str, where: str) -> Floats:
    """(3, 3) rotation given as a matrix, as nine numbers by rows, or as a quaternion (x, y, z, w)."""
    numbers = array(document, key, where)
    if numbers.size == 9:
        matrix = numbers.reshape(3, 3)
    elif numbers.shape == (4,):
        return quaternion_matrix(check_quaternions(numbers, f"{where}: '{key}'")[[3, 0, 1, 2]])
    else:
        raise InputError(
            f"{where}: expected a rotation of 3 x 3 or 4 numbers in '{key}', found shape {numbers.shape}; mend the camera model."
        )
    off = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        kind = "a reflection" if off <= ROTATION_TOLERANCE else f"rows that are not orthonormal (by {off:.2g})"
        raise GeometryError(f"{where}: expected a rotation in '{key}', found {kind}; mend the camera model.")
    return matrix


def check_quaternions(quaternions: Floats, where: str) -> Floats:
    """Unit quaternions (..., 4), normalised. Raises GeometryError for those whose length is not near 1."""
    length = np.linalg.norm(quaternions, axis=-1)
    bad = np.abs(length - 1) > QUATERNION_TOLERANCE
    if bad.any():
        first = int(np.flatnonzero(np.ravel(bad))[0])
        raise GeometryError(
            f"{where}: expected unit quaternions, found one of length {np.ravel(length)[first]:.6g} (number {first + 1}); mend the camera model."
        )
    return quaternions / length[..., None]


def quaternion_matrix(quaternions: Floats) -> Floats:
    """(..., 3, 3) rotations of unit quaternions (..., 4), scalar first."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


FRAME_KEYS = ("type", "principal_point_px", "size_px", "position_mcmf", "rotation_camera_to_mcmf", "body")


def frame_camera(document: Mapping[str, Any], where: str, own: tuple[str, ...]) -> dict[str, Any]:
    """Arguments common to our own frame cameras: size, principal point, position, rotation and body.

    own : the other keys of this camera. Raises InputError, also for keys that are none of them, or GeometryError.
    """
    check_keys(document, (*FRAME_KEYS, *own), where)
    point = array(document, "principal_point_px", where, (2,))
    samples, lines = array(document, "size_px", where, (2,))
    extent = {"samples": samples, "lines": lines}
    centre, axes = array(document, "position_mcmf", where, (3,)), body_axes(document, where)
    if not LOWEST_CAMERA * axes[1] < np.linalg.norm(centre) < FARTHEST_CAMERA:
        raise GeometryError(
            f"{where}: expected a place above a body of {axes[0]:g} m radius in 'position_mcmf' (m), found one "
            f"{np.linalg.norm(centre):g} m from its middle; mend the camera model."
        )
    return {
        "lines": size(extent, "lines", f"{where}: 'size_px'"),
        "samples": size(extent, "samples", f"{where}: 'size_px'"),
        "principal_point_px": (float(point[0]), float(point[1])),
        "centre": centre,
        "rotation": rotation(document, "rotation_camera_to_mcmf", where),
        "semi_axes": axes,
    }


def one_or_two(document: Mapping[str, Any], key: str, where: str, what: str) -> tuple[float, float]:
    """Lengths above 0 along samples and lines, given as one or as two. Raises InputError or GeometryError."""
    found = np.atleast_1d(array(document, key, where))
    if found.size not in (1, 2) or (found <= 0).any():
        raise GeometryError(f"{where}: expected one or two {what} in '{key}', found {found}; mend the camera model.")
    return float(found[0]), float(found[-1])


def body_axes(document: Mapping[str, Any], where: str) -> tuple[float, float]:
    """Equatorial and polar semi-axis, m, of ``body`` (a name or a radius in metres; the Moon where absent)."""
    radius = find_body(str(document.get("body", "moon"))).radius
    return radius, radius


def _short(found: Any) -> str:
    text = repr(found)
    return text if len(text) < 60 else text[:57] + "..."
