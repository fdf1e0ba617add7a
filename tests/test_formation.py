"""The formation chain: its gradients against finite differences, and its angles against products of vectors."""

from __future__ import annotations

import numpy as np
import torch

from stages.physics.formation.chain import Observation, form, illuminate
from stages.physics.light.sun_disc import SUN_RADIUS
from stages.physics.photometry import get_model


def test_gradients_in_elevation_sun_and_camera():
    """Penumbra included: the horizon lies across the Sun's disc."""
    generator = torch.Generator().manual_seed(0)
    z = torch.rand(1, 6, 6, generator=generator, dtype=torch.float64).mul(4).requires_grad_()
    sun = torch.tensor([[0.6, 0.2, 0.7745966692]], dtype=torch.float64, requires_grad=True)
    camera = torch.tensor([[200.0, -300.0, 900.0]], dtype=torch.float64, requires_grad=True)
    horizon = torch.full((1, 6, 6), float(torch.asin(sun.detach()[0, 2])) - 0.001, dtype=torch.float64)
    coefficients = torch.tensor([0.6, 0.2, 0.1], dtype=torch.float64).view(1, 3, 1, 1)

    def image(elevation, direction, position):
        return form(
            Observation(elevation, direction, position, 5.0, 1737400.0, sun_horizon=horizon),
            get_model("M2"),
            coefficients,
        )

    assert torch.autograd.gradcheck(image, (z, sun, camera), eps=1e-6, atol=1e-5)


def crops(seed: int = 5, count: int = 3, height: int = 24, width: int = 40) -> Observation:
    """Rough float32 ground under a low Sun whose disc the horizon cuts in places; some facets face away from it."""
    generator = torch.Generator().manual_seed(seed)
    z = torch.randn(count, height, width, generator=generator).cumsum(1).cumsum(2) * 0.6
    sun = torch.tensor([[0.9, 0.1, 0.3], [-0.5, 0.7, 0.25], [0.0, -1.0, 0.12]])
    sun /= sun.norm(dim=1, keepdim=True)
    camera = torch.tensor([[0.0, 0.0, 8e4], [5e4, 2e4, 6e4], [-300.0, 200.0, 900.0]])
    offset = 3 * SUN_RADIUS * (torch.rand(z.shape, generator=generator) * 2 - 1)
    horizon = torch.asin(sun[:, 2])[:, None, None] + offset
    return Observation(z, sun[:count], camera[:count], 5.0, 1737400.0, sun_horizon=horizon[:count])


def test_the_angles_of_a_plane_on_a_sphere():
    """By products of unit vectors: the plane falls away from the crop's middle with the sphere under it."""
    east_slope, north_slope, gsd, radius = 0.3, -0.2, 5.0, 2000.0
    x = (np.arange(30) - 14.5)[None] * gsd
    y = (9.5 - np.arange(20))[:, None] * gsd
    z = east_slope * x + north_slope * y
    sun, camera = np.array([0.6, 0.3, 0.74]), np.array([300.0, -200.0, 900.0])
    sun /= np.linalg.norm(sun)
    observation = Observation(
        torch.from_numpy(z)[None], torch.from_numpy(sun)[None], torch.from_numpy(camera)[None], gsd, radius
    )
    normal = np.stack([x / radius - east_slope + 0 * y, y / radius - north_slope + 0 * x, np.ones_like(z)])
    view = camera[:, None, None] - np.stack([x + 0 * y, y + 0 * x, z])
    normal, view = (v / np.linalg.norm(v, axis=0) for v in (normal, view))
    angles = illuminate(observation).angles
    for found, expected in (
        (angles.cos_incidence, np.tensordot(sun, normal, 1)),
        (angles.cos_emission, (normal * view).sum(axis=0)),
        (angles.cos_phase, np.tensordot(sun, view, 1)),
    ):
        np.testing.assert_allclose(found[0].numpy(), expected, rtol=1e-6)


def test_unknown_horizons_are_not_taken_for_sunlight():
    observation = crops()
    observation.sun_horizon[0, 3, 4] = torch.nan
    image = form(observation, get_model("M2"), torch.full((1, 3, 1, 1), 0.1))
    assert torch.isnan(image).sum() <= 1
    assert not image[0, 3, 4] > 0
