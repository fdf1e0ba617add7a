"""DISK features, with LightGlue where the user gives its network and OpenCV knows DISK's variant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2

from schemas.errors import ConfigError
from stages.match.base import register
from stages.match.networks import NetworkMatcher, load_network


@register
class Disk(NetworkMatcher):
    name = "disk"
    title = "DISK (+ LightGlue)"
    reference = "Tyszkiewicz, Fua & Trulls (2020), DISK; Lindenberger et al. (2023), LightGlue"
    factory = "DISK_create"

    def _load_lightglue(self, path: Path) -> Any:
        # LightGlue's network for DISK has other inputs and outputs than ALIKED's; OpenCV 5.0 drives only the latter.
        if not hasattr(cv2, "LG_DISK"):
            raise ConfigError(
                f"`lightglue_model`: OpenCV {cv2.__version__} drives LightGlue for ALIKED only; leave it out "
                "(DISK then matches by reciprocal nearest neighbours) or choose `matchers` aliked."
            )
        return load_network("LightGlueMatcher_create", path, 0.0, 0, 0, cv2.LG_DISK)
