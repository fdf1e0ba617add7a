"""The interface of every camera: from pixels to rays, and from points on the ground to pixels.

Image coordinates here are CSM's: (line, sample), the first pixel's centre at (0.5, 0.5), its outer corner at (0, 0).
``grid.CSM_CENTRE`` converts to array indices. Body-fixed (``mcmf``) vectors are in metres.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.errors import GeometryError, InputError, RegistryError
from schemas.files.user_files import read_json
from stages.common.arrays import Floats


class Camera(ABC):
    """Base of every camera. ``lines`` x ``samples`` pixels; ``semi_axes`` of the body (equatorial, polar), m."""

    kind: ClassVar[str]
    # values of a document's "type" (ours) or "name_model" (CSM) that this class reads
    answers_to: ClassVar[tuple[str, ...]]

    lines: int
    samples: int
    semi_axes: tuple[float, float]

    @property
    def notes(self) -> tuple[str, ...]:
        """What was taken otherwise than the camera's file says, one line each."""
        return ()

    @classmethod
    @abstractmethod
    def from_document(cls, document: Mapping[str, Any], where: str) -> Camera:
        """The camera that a JSON document describes. Raises InputError or GeometryError, naming ``where``."""

    @abstractmethod
    def rays(self, line: ArrayLike, sample: ArrayLike) -> tuple[Floats, Floats]:
        """Origins and unit directions (out of the camera), each (..., 3), body-fixed."""

    @abstractmethod
    def ground_to_image(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """(line, sample) of body-fixed points (..., 3), m; NaN where no line of the image looks that way.

        Points that fall beside the detector get coordinates outside it: see :meth:`inside`.
        """

    def sun_position(self, line: ArrayLike) -> Floats | None:
        """(..., 3) body-fixed place of the Sun while each line was taken, m; None where the model holds none."""
        return None

    def ephemeris_time(self, line: ArrayLike) -> Floats | None:
        """When each line was taken, s of TDB since J2000; None where the model holds no time.

        line : (...,) px; returns the same shape
        """
        return None

    def position(self, line: ArrayLike, sample: ArrayLike | None = None) -> Floats:
        """(..., 3) body-fixed place of the camera while each line was taken, m."""
        line = np.asarray(line, float)
        return self.rays(line, np.full(line.shape, self.samples / 2) if sample is None else sample)[0]

    def framelet(self, line: ArrayLike) -> NDArray[np.int64] | None:
        """Number of the framelet that holds each line, None for a camera whose image is one exposure or one strip.

        Framelets overlap on the ground, so that neighbouring lines of two framelets need not be neighbours there.

        line : (...,) px; returns the same shape
        """
        return None

    def ground_to_framelet(self, points: ArrayLike, framelet: ArrayLike) -> tuple[Floats, Floats]:
        """As :meth:`ground_to_image`, but within given framelets: lines are clipped to the framelet's own pixel centres, so
        that interpolation does not reach into the next one.

        points : (..., 3); framelet : numbers that broadcast with them
        """
        return self.ground_to_image(points)

    def edge_lines(self, count: int) -> Floats:
        """(n,) image lines, ``count`` or more from first to last, whose ground outlines that of the image."""
        return np.linspace(0.0, self.lines, count)

    def inside(self, line: ArrayLike, sample: ArrayLike) -> NDArray[np.bool_]:
        """Whether image coordinates lie on the detector.

        line, sample : (...,) px, broadcast against each other
        """
        line, sample = np.asarray(line, float), np.asarray(sample, float)
        return (line >= 0) & (line <= self.lines) & (sample >= 0) & (sample <= self.samples)

    def image_to_ground(
        self, line: ArrayLike, sample: ArrayLike, height: ArrayLike = 0.0, missing: str = "nan"
    ) -> Floats:
        """(..., 3) body-fixed points where the pixels' rays meet the body's ellipsoid raised by ``height`` metres.

        line, sample, height : broadcastable
        missing : what a ray that misses the body gives: ``nan``, ``nearest`` (the ray's point closest to the
            body, as CSM cameras answer) or ``error`` (GeometryError)
        """
        origin, direction = self.rays(line, sample)
        equatorial, polar = self.semi_axes
        points, hit = meet_ellipsoid(origin, direction, equatorial + np.asarray(height), polar + np.asarray(height))
        if missing == "error" and not hit.all():
            first = np.argwhere(~hit)[0] if hit.ndim else ()
            at = np.broadcast_arrays(np.asarray(line, float), np.asarray(sample, float))
            raise GeometryError(
                f"{self.kind} camera: {int((~hit).sum())} of {hit.size} pixels look past the body, the first at line "
                f"{at[0][tuple(first)]:g}, sample {at[1][tuple(first)]:g}; check its pointing and `body`."
            )
        if missing != "nearest":
            points = np.where(hit[..., None], points, np.nan)
        return points


def meet_ellipsoid(
    origin: Floats, direction: Floats, equatorial: ArrayLike, polar: ArrayLike
) -> tuple[Floats, NDArray[np.bool_]]:
    """Where rays first meet an ellipsoid of revolution, (..., 3), and whether each does so ahead of the camera, (...,).

    origin, direction : (..., 3); equatorial, polar : semi-axes; no ray meets an ellipsoid without extent. A ray that
    misses gives its point closest to the ellipsoid.
    """
    equatorial, polar = np.asarray(equatorial, float), np.asarray(polar, float)
    exists = (equatorial > 0) & (polar > 0)
    equatorial, polar = np.where(exists, equatorial, 1.0), np.where(exists, polar, 1.0)
    stretch = (equatorial / polar) ** 2
    weight = np.stack(np.broadcast_arrays(np.ones_like(stretch), np.ones_like(stretch), stretch), axis=-1)
    a = (weight * direction * direction).sum(-1)
    half_b = (weight * direction * origin).sum(-1)
    # c as a difference of lengths keeps its digits where the camera is close to the ground
    size = np.sqrt((weight * origin * origin).sum(-1))
    c = (size - equatorial) * (size + equatorial)
    discriminant = half_b * half_b - a * c
    root = np.sqrt(np.maximum(discriminant, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(half_b < 0, c / (root - half_b), (-half_b - root) / a)
        closest = -half_b / a
    distance = np.where(discriminant < 0, closest, distance)
    hit = exists & (discriminant >= 0) & (distance >= 0)
    return origin + distance[..., None] * direction, hit


_CAMERAS: dict[str, type[Camera]] = {}


def register(cls: type[Camera]) -> type[Camera]:
    """Class decorator: register a camera under its kind and its ``answers_to``."""
    for name in {cls.kind, *cls.answers_to}:
        _CAMERAS[name.lower()] = cls
    return cls


def cameras() -> list[type[Camera]]:
    """The registered cameras, by kind."""
    return sorted(set(_CAMERAS.values()), key=lambda cls: cls.kind)


def camera_from_document(document: Mapping[str, Any], where: str) -> Camera:
    """The camera of a JSON document, ours (key ``type``) or an ISD (key ``name_model``). Raises LunargrError."""
    name = document.get("type", document.get("name_model"))
    if name is None:
        raise InputError(
            f"{where}: expected a camera with the key 'type' or 'name_model' (an ALE/CSM ISD), found neither; is it the right file?"
        )
    cls = _CAMERAS.get(str(name).lower())
    if cls is None:
        raise RegistryError(f"{where}: {RegistryError.unknown('camera', str(name), _CAMERAS)}")
    return cls.from_document(document, where)


def read_document(path: Path) -> Mapping[str, Any]:
    """A camera's JSON document. Raises InputError."""
    document = read_json(path, "a camera model in JSON")
    if not isinstance(document, Mapping):
        raise InputError(
            f"{path}: expected a JSON object that describes a camera, found a {type(document).__name__}; is it the right file?"
        )
    return document
