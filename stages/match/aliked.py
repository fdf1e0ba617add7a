"""ALIKED features, with LightGlue where the user gives its network."""

from __future__ import annotations

from stages.match.base import register
from stages.match.networks import NetworkMatcher


@register
class Aliked(NetworkMatcher):
    name = "aliked"
    title = "ALIKED (+ LightGlue)"
    reference = "Zhao et al. (2023), IEEE Trans. Instrum. Meas. 72; Lindenberger et al. (2023), LightGlue"
    factory = "ALIKED_create"
