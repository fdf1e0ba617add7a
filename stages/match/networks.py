"""Learned features and LightGlue through OpenCV's DNN module; the networks' files are the user's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from schemas.errors import ConfigError, InputError
from stages.match.base import Matcher, Matches, Models, mutual_nearest


def load_network(factory: str, path: Path, *arguments: Any) -> Any:
    """An OpenCV object from an ONNX file, made by cv2.``factory``. Raises ConfigError (OpenCV too old), InputError (unusable file)."""
    if not hasattr(cv2, factory):
        raise ConfigError(
            f"matcher: expected an OpenCV with {factory}, found {cv2.__version__}; install opencv-contrib-python-headless 5."
        )
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the ONNX file of the network.")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # its remarks on targets are none of the user's
    try:
        return getattr(cv2, factory)(str(path), *arguments)
    except cv2.error as error:
        raise InputError(f"{path}: expected an ONNX network for {factory}, {_reason(error)}.") from None


def _reason(error: cv2.error) -> str:
    return "OpenCV says: " + " ".join(str(error.err if hasattr(error, "err") else error).split())[:160]


class NetworkMatcher(Matcher):
    """Features from one network, matched by LightGlue where its file is given, else by reciprocal nearest neighbours."""

    needs_models = True
    factory: str  # OpenCV's name of what makes the detector

    def __init__(self, models: Models) -> None:
        super().__init__(models)
        if models.features is None:
            raise ConfigError(
                f"`matchers` {self.name}: expected `features_model` FILE.onnx, found none; give its path."
            )
        self.files = models
        self.detector = load_network(self.factory, models.features)
        self.lightglue = self._load_lightglue(models.lightglue) if models.lightglue is not None else None

    def _load_lightglue(self, path: Path) -> Any:
        return load_network("LightGlueMatcher_create", path)

    def match(self, measured: np.ndarray, rendered: np.ndarray) -> Matches:
        (points, descriptors), (other_points, other_descriptors) = self._detect(measured), self._detect(rendered)
        if self.lightglue is None:
            here, there = mutual_nearest(descriptors, other_descriptors)
        else:
            sizes = [(p.shape[1], p.shape[0]) for p in (measured, rendered)]
            try:
                self.lightglue.setPairInfo(points, other_points, *sizes)
                pairs = self.lightglue.match(descriptors, other_descriptors)
            except cv2.error as error:
                raise InputError(
                    f"{self.files.lightglue}: expected a LightGlue network for {self.name} features, {_reason(error)}."
                ) from None
            here = np.array([p.queryIdx for p in pairs], int)
            there = np.array([p.trainIdx for p in pairs], int)
        return Matches(points[here].astype(float), other_points[there].astype(float))

    def _detect(self, picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 2) float32 and descriptors (N, D) of a grey picture."""
        try:
            points, descriptors = self.detector.detectAndCompute(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR), None)
        except cv2.error as error:
            raise InputError(
                f"{self.files.features}: expected a {self.name} network as OpenCV's {self.factory} uses it, {_reason(error)}."
            ) from None
        places = np.array([k.pt for k in points], np.float32).reshape(-1, 2)
        return places, np.empty((0, 1), np.float32) if descriptors is None else descriptors.astype(np.float32)
