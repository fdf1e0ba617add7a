"""The formation chain is differentiable in elevation, Sun and camera: against finite differences."""

from __future__ import annotations

import torch

from stages.physics.formation import Observation, form
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
