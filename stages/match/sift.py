"""SIFT key points with reciprocal nearest neighbours."""

from __future__ import annotations

import cv2
import numpy as np

from stages.match.base import Matcher, Matches, mutual_nearest, register


@register
class Sift(Matcher):
    """Key points are found in each picture by itself, so that their repeatability counts too."""

    name = "sift"
    title = "SIFT, reciprocal nearest neighbours"
    reference = "Lowe (2004), Int. J. Comput. Vis. 60, 91"

    def match(self, measured: np.ndarray, rendered: np.ndarray) -> Matches:
        detector = cv2.SIFT.create(contrastThreshold=0.01)
        points, descriptors = zip(*(detector.detectAndCompute(p, None) for p in (measured, rendered)), strict=True)
        if any(d is None for d in descriptors):
            return Matches(np.empty((0, 2)), np.empty((0, 2)))
        here, there = mutual_nearest(*descriptors)
        places = [np.array([k.pt for k in group], float).reshape(-1, 2) for group in points]
        return Matches(places[0][here], places[1][there])
