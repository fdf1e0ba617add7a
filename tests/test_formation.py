"""The formation chain: its gradients against finite differences, and the one pass that takes its place in training."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from stages.physics.formation.chain import Observation, facets, form
from stages.physics.formation.cosine_sums import cosine_sum
from stages.physics.light.sun_disc import SUN_RADIUS, sun_visibility
from stages.physics.photometry import get_model, model_names


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


def by_the_chain(observation: Observation, model, coefficients: torch.Tensor) -> torch.Tensor:
    """As ``form`` goes about it where the ground has gradients."""
    return form(replace(observation, elevation=observation.elevation.clone().requires_grad_()), model, coefficients)


@pytest.mark.parametrize("name", model_names())
@pytest.mark.parametrize("shadows", [True, False])
def test_one_pass_gives_what_the_chain_gives(name, shadows):
    """Images to rounding, and gradients, whichever way the coefficients lie in memory."""
    model, observation = get_model(name), crops()
    if not shadows:
        observation = replace(observation, sun_horizon=None)
    defaults = torch.tensor(list(model.defaults().values())).view(1, -1, 1, 1)
    generator = torch.Generator().manual_seed(2)
    maps = defaults * (1 + 0.1 * torch.rand(3, len(model.parameters), 24, 40, generator=generator))
    weight = torch.rand(3, 24, 40, generator=generator)
    tolerance = 1e-3 if name == "M6" else 3e-5  # its azimuths turn fast where the half vector meets the normal
    for given in (maps, maps.contiguous(memory_format=torch.channels_last), defaults):
        given = given.clone().requires_grad_()
        expected, found = by_the_chain(observation, model, given), form(observation, model, given)
        torch.testing.assert_close(found, expected, rtol=tolerance, atol=2e-6)
        assert (found == 0).float().mean() > 0.05
        gradients = [torch.autograd.grad(image, given, weight)[0] for image in (expected, found)]
        scale = gradients[0].abs().max()
        torch.testing.assert_close(gradients[1] / scale, gradients[0] / scale, rtol=tolerance, atol=1e-5)


def test_one_pass_is_exact_in_the_half_shadow():
    observation = crops()
    _, light = facets.angles_and_light(
        observation.elevation, observation.sun_direction, observation.camera_position, observation.sun_horizon, 5.0, 1737400.0
    )  # fmt: skip
    expected = sun_visibility(torch.asin(observation.sun_direction[:, 2])[:, None, None], observation.sun_horizon)
    seen = light > 0
    assert ((expected > 0.01) & (expected < 0.99) & seen).float().mean() > 0.1
    torch.testing.assert_close(light[seen], expected[seen], rtol=2e-5, atol=2e-6)


def test_the_chain_is_taken_where_one_pass_will_not_do():
    observation, model = crops(), get_model("M2")
    coefficients = torch.full((1, 3, 1, 1), 0.1)
    many = form(replace(observation, elevation=observation.elevation.double()), model, coefficients.double())
    assert many.dtype == torch.float64
    one = Observation(
        observation.elevation[:1], observation.sun_direction[:1], observation.camera_position[:1], 5.0, 1e6
    )
    assert form(one, model, coefficients.expand(4, -1, -1, -1)).shape == (4, 24, 40)
    for name in ("elevation", "sun_direction", "camera_position", "sun_horizon"):
        wanted = getattr(observation, name).clone().requires_grad_()
        image = form(replace(observation, **{name: wanted}), model, coefficients)
        assert torch.autograd.grad(image.sum(), wanted)[0].abs().max() > 0


def test_unknown_horizons_are_not_taken_for_sunlight():
    observation = crops()
    observation.sun_horizon[0, 3, 4] = torch.nan
    image = form(observation, get_model("M2"), torch.full((1, 3, 1, 1), 0.1))
    assert torch.isnan(image).sum() <= 1
    assert not image[0, 3, 4] > 0


@pytest.mark.parametrize("powers", [((1, 0), (0, 1), (0, 0)), ((2, 0), (1, 1), (0, 2))])
def test_cosine_sums_have_the_gradient_of_their_value(powers):
    generator = torch.Generator().manual_seed(1)
    mu0, phase, light = torch.rand(3, 2, 4, 5, generator=generator, dtype=torch.float64)
    coefficients = torch.rand(2, 3, 4, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c: cosine_sum(c, mu0, phase, light, powers), coefficients)
    plain = sum(c * mu0**p * phase**q for c, (p, q) in zip(coefficients.unbind(1), powers, strict=True))
    torch.testing.assert_close(cosine_sum(coefficients, mu0, phase, light, powers), plain * light)


def test_the_gradient_of_cosine_sums_lies_in_memory_as_the_coefficients_do():
    light = torch.rand(2, 4, 5)
    coefficients = torch.rand(2, 3, 4, 5).contiguous(memory_format=torch.channels_last).requires_grad_()
    image = cosine_sum(coefficients, light, light, light, ((1, 0), (0, 1), (0, 0)))
    assert torch.autograd.grad(image.sum(), coefficients)[0].stride() == coefficients.stride()
