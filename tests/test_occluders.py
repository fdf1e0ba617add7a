"""Where the shadow at a pixel comes from, against ridges whose distance is plane geometry."""

import math

import pytest
import torch

from stages.diagnose.occluders import occluder_distance
from stages.physics.formation.chain import Observation

SIZE, RIDGE = 96, 60


def observe(azimuth_deg: float, horizon: torch.Tensor | None = None) -> Observation:
    """Level ground with a ridge of 20 m along column RIDGE, pixels of 5 m."""
    elevation = torch.zeros(1, SIZE, SIZE)
    elevation[..., RIDGE] = 20.0
    azimuth = math.radians(azimuth_deg)
    sun = torch.tensor([[math.sin(azimuth), math.cos(azimuth), 0.2]])
    camera = torch.tensor([[0.0, 0.0, 1e6]])
    return Observation(elevation, sun / sun.norm(), camera, 5.0, 1737400.0, sun_horizon=horizon)


@pytest.mark.parametrize("azimuth", [90.0, 70.0, 45.0, 115.0])
def test_a_ridge_is_found_at_its_distance(azimuth):
    along = abs(math.sin(math.radians(azimuth)))
    found = occluder_distance(observe(azimuth))[0, SIZE // 2]
    for away in (1, 2, 3, 5, 8, 14, 20):
        expected = away / along
        assert float(found[RIDGE - away]) == pytest.approx(expected, abs=max(0.5, expected / 12))


def test_what_stands_outside_is_at_least_as_far_as_the_border():
    horizon = torch.full((1, SIZE, SIZE), math.radians(30.0))
    found = occluder_distance(observe(90.0, horizon))[0, SIZE // 2]
    assert float(found[80]) == pytest.approx(SIZE - 1 - 80)
    assert float(found[RIDGE - 1]) == pytest.approx(1.0)  # the ridge itself rises by more
