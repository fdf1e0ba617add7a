"""A new matcher in one file: ORB's binary descriptors, as flight computers use them.

Put a file like this into ``stages/match/`` and `lunargr match --matcher orb` knows it; here it is only registered for
this run. Run it to see a picture matched with itself, moved by two pixels:

    python examples/new_matcher.py
"""

from __future__ import annotations

import cv2
import numpy as np

from stages.match.base import Matcher, Matches, Models, get_matcher, register


@register
class Orb(Matcher):
    name = "orb"
    title = "ORB, reciprocal nearest neighbours by Hamming distance"
    reference = "Rublee et al. (2011), Proc. ICCV, 2564"

    def match(self, measured: np.ndarray, rendered: np.ndarray) -> Matches:
        detector = cv2.ORB.create(nfeatures=2000)
        points, descriptors = zip(*(detector.detectAndCompute(p, None) for p in (measured, rendered)), strict=True)
        if any(d is None for d in descriptors):
            return Matches(np.empty((0, 2)), np.empty((0, 2)))
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(*descriptors)
        here = [points[0][p.queryIdx].pt for p in pairs]
        there = [points[1][p.trainIdx].pt for p in pairs]
        return Matches(np.array(here, float).reshape(-1, 2), np.array(there, float).reshape(-1, 2))


if __name__ == "__main__":
    rng = np.random.default_rng(1)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (256, 256)), (0, 0), 2)
    picture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    found = get_matcher("orb", Models()).match(picture, np.roll(picture, 2, axis=1))
    moved = np.median(found.rendered - found.measured, axis=0)
    print(f"orb: {len(found.measured)} matches, moved by {moved[0]:.1f}, {moved[1]:.1f} px (truth 2, 0)")
