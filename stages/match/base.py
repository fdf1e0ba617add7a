"""What a matcher is: a name and one function from two pictures of the same place to corresponding points."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from schemas.errors import ConfigError, RegistryError
from stages.common.registry import import_all


@dataclass(frozen=True)
class Matches:
    """Corresponding points, (N, 2) each as (x, y) in pixels; pixel centres are whole numbers."""

    measured: np.ndarray
    rendered: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """(N,) px: how far each match is from the truth, for pictures that agree pixel for pixel."""
        return np.linalg.norm(self.measured - self.rendered, axis=1)


@dataclass(frozen=True)
class Models:
    """Network files of the user: ``features`` detects and describes, ``lightglue`` matches."""

    features: Path | None = None
    lightglue: Path | None = None


class Matcher(ABC):
    """Base of every matcher. One file in this folder per matcher; it decorates itself with @register."""

    name: ClassVar[str]
    title: ClassVar[str]
    reference: ClassVar[str]
    needs_models: ClassVar[bool] = False

    def __init__(self, models: Models) -> None:
        if models.features is not None and not self.needs_models:
            raise ConfigError(
                f"`features_model`: the matcher '{self.name}' takes no network; choose one that does: {', '.join(n for n, c in sorted(_MATCHERS.items()) if c.needs_models)}."
            )

    @abstractmethod
    def match(self, measured: np.ndarray, rendered: np.ndarray) -> Matches:
        """Corresponding points of two (H, W) uint8 pictures."""


_MATCHERS: dict[str, type[Matcher]] = {}


def register(cls: type[Matcher]) -> type[Matcher]:
    """Class decorator: make a matcher known under its name. Raises ConfigError in one line for one that is not whole."""
    for attribute in ("name", "title", "reference"):
        if not hasattr(cls, attribute):
            raise ConfigError(f"matcher {cls.__name__}: expected `{attribute}` in {cls.__module__}, found none.")
    _MATCHERS[cls.name] = cls
    return cls


def _load_all() -> None:
    import stages.match as package

    import_all("stages.match", package.__path__)


def matchers() -> list[type[Matcher]]:
    """The registered matchers, by name."""
    _load_all()
    return [_MATCHERS[name] for name in sorted(_MATCHERS)]


def get_matcher(name: str, models: Models = Models()) -> Matcher:
    """The matcher called ``name``, ready to use. Raises RegistryError with the choices, ConfigError."""
    _load_all()
    try:
        cls = _MATCHERS[name.lower()]
    except KeyError:
        raise RegistryError.unknown("matcher", name, _MATCHERS) from None
    return cls(models)


def mutual_nearest(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of reciprocal nearest neighbours between descriptors (N, D) and (M, D), by Euclidean distance."""
    if not len(first) or not len(second):
        return np.empty(0, int), np.empty(0, int)
    import cv2

    pairs = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(first, second)
    return np.array([p.queryIdx for p in pairs], int), np.array([p.trainIdx for p in pairs], int)
