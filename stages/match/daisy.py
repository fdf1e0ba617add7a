"""Dense DAISY descriptors with reciprocal nearest neighbours, as dense learned matchers are used."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from stages.match.base import Matcher, Matches, Models, register

RADIUS = 30  # px at 512 x 384, where a crop of 128 px is enlarged four times
GRID = 12  # px between the points that look for a partner
ROUNDS = 4
COARSE = 4  # px: descriptors this wide change slowly, so a search on every fourth pixel finds the right neighbourhood
CHUNK = 256


@register
class Daisy(Matcher):
    """Points on a grid of the measured picture look for their nearest descriptor at every pixel of the rendered one.

    From there back and forth, until a pair of pixels are each other's nearest (the fast reciprocal search of MASt3R).
    """

    name = "daisy"
    title = "dense DAISY, reciprocal nearest neighbours"
    reference = "Tola, Lepetit & Fua (2010), IEEE TPAMI 32, 815; search: Leroy et al. (2024), MASt3R"

    def __init__(self, models: Models) -> None:
        super().__init__(models)
        self._latest: tuple[np.ndarray, Field] | None = None

    def match(self, measured: np.ndarray, rendered: np.ndarray) -> Matches:
        height, width = measured.shape
        if self._latest is None or self._latest[0] is not measured:  # one measured picture meets several renderings
            self._latest = measured, Field(dense_descriptors(measured), width)
        first, second = self._latest[1], Field(dense_descriptors(rendered), width)
        rows, cols = np.meshgrid(np.arange(GRID // 2, height, GRID), np.arange(GRID // 2, width, GRID), indexing="ij")
        start = torch.from_numpy((rows * width + cols).reshape(-1))
        start = start[first.descriptors[start].abs().amax(dim=1) > 0]  # no structure, nothing to match
        here, there = reciprocal(first, second, start)
        return Matches(_points(here, width), _points(there, width))


class Field:
    """The descriptors of all pixels of a picture, (H W, D), searched from coarse to fine."""

    def __init__(self, descriptors: torch.Tensor, width: int) -> None:
        self.descriptors, self.width = descriptors, width
        self.height = len(descriptors) // width
        rows, cols = torch.arange(COARSE // 2, self.height, COARSE), torch.arange(COARSE // 2, width, COARSE)
        self.coarse = (rows[:, None] * width + cols).reshape(-1)
        self._coarse_descriptors = descriptors[self.coarse]

    def nearest(self, queries: torch.Tensor) -> torch.Tensor:
        """Pixel of the most similar descriptor for every query (N, D); (N,) int64."""
        best = [self._nearest(queries[k : k + CHUNK]) for k in range(0, len(queries), CHUNK)]
        return torch.cat(best) if best else torch.empty(0, dtype=torch.int64)

    def _nearest(self, queries: torch.Tensor) -> torch.Tensor:
        near = self.coarse[(queries @ self._coarse_descriptors.T).argmax(dim=1)]
        around = torch.arange(1 - COARSE, COARSE)
        y = (near[:, None, None] // self.width + around[:, None]).clamp(0, self.height - 1)
        x = (near[:, None, None] % self.width + around).clamp(0, self.width - 1)
        candidates = (y * self.width + x).flatten(1)
        similarity = (self.descriptors[candidates] * queries[:, None]).sum(dim=2)
        return candidates.gather(1, similarity.argmax(dim=1, keepdim=True))[:, 0]


def dense_descriptors(picture: np.ndarray) -> torch.Tensor:
    """(H W, D) float32 of unit length, one per pixel in row-major order; 0 where the picture is flat."""
    height, width = picture.shape
    daisy = cv2.xfeatures2d.DAISY.create(
        radius=RADIUS, q_radius=3, q_theta=4, q_hist=8, norm=cv2.xfeatures2d.DAISY_NRM_NONE
    )
    points = [cv2.KeyPoint(float(x), float(y), 1.0) for y in range(height) for x in range(width)]
    _, found = daisy.compute(picture, points)
    descriptors = torch.from_numpy(found)
    return torch.nn.functional.normalize(descriptors - descriptors.mean(dim=1, keepdim=True), dim=1)


def reciprocal(first: Field, second: Field, start: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Index pairs (first, second) that are each other's nearest, reached from the points ``start`` of ``first``."""
    found = [torch.empty(2, 0, dtype=torch.int64)]
    here = start
    for _ in range(ROUNDS):
        there = second.nearest(first.descriptors[here])
        back = first.nearest(second.descriptors[there])
        settled = back == here
        found.append(torch.stack([here[settled], there[settled]]))
        here = torch.unique(back[~settled])
        if not len(here):
            break
    pairs = torch.unique(torch.cat(found, dim=1), dim=1)
    return pairs[0], pairs[1]


def _points(index: torch.Tensor, width: int) -> np.ndarray:
    flat = index.numpy()
    return np.stack([flat % width, flat // width], axis=1).astype(np.float64)
