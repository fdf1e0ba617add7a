"""What images have of their own: broad patterns of a frame are told from errors of relief, which have finer waves as well."""

from __future__ import annotations

import math
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
from hidden.terrain import red_noise

from stages.diagnose.result.answer import Answer, Named
from stages.diagnose.result.files import write_diagnosis
from stages.diagnose.sources import frames, ground
from stages.effects import Survey, get_effect

SIZE, IMAGES = 64, 5
FIELD = get_effect("frame_field")


def test_broad_power_that_grows_with_finer_power_is_taken_off():
    """A line in relative errors: what relief has goes with its finer waves, and a constant remains."""
    rng = np.random.default_rng(4)
    frame = np.arange(40) % 10
    finer = 1e-4 * (1 + 50 * rng.uniform(0, 1, 40) ** 4)  # noise, and what relief adds where shading is strong
    for constant in (0.0, 6e-4):
        power = (0.4 * (finer - 1e-4) + constant) * rng.lognormal(0, 0.2, 40)
        size, error, freedom, share = frames.without_finer(power, finer, frame)
        assert size == pytest.approx(constant, abs=max(3 * error, 3e-5)) and freedom == 9
        assert share[finer.argmax()] == pytest.approx(
            constant / (constant + 0.4 * (finer.max() - finer.min())), abs=0.1
        )
    assert (
        frames.without_finer(power, finer, frame % 3)[2] == 15
    )  # of three frames the images are asked, not the frames


def _chain(number: int, field: float, relief: float, rng):
    """Level ground of one site; every image has a broad wave of its own, and errors as white as those of a DEM's slopes."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    images = []
    for k in range(IMAGES):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        wave = field * math.sqrt(2) * np.cos(6 * (x * np.cos(angle) + y * np.sin(angle)) + phase)
        errors = relief * (1 + k) * (rng.standard_normal((SIZE, SIZE)) + 4 * red_noise(rng, SIZE, 1.0))
        images.append(
            0.05 * (1 + wave - wave.mean() + errors + 0.03 * red_noise(np.random.default_rng(number), SIZE, 2.5))
        )
    image = torch.from_numpy(np.array(images)).float()
    plain = torch.full_like(image, 0.05)
    numbers = np.arange(IMAGES) + (number % 2) * IMAGES

    def render(effect=None):
        state = SimpleNamespace(
            elevation=plain, image=plain, observation=SimpleNamespace(frame=torch.from_numpy(numbers), site=torch.full((IMAGES,), number))
        )  # fmt: skip
        if effect is not None:
            effect.apply(state)
        return state.image

    site = SimpleNamespace(count=IMAGES, number=number, image=image, frames=numbers)
    return SimpleNamespace(site=site, predict=lambda: plain, render=render)


@pytest.mark.parametrize(("field", "relief"), [(0.03, 0.0003), (0.03, 0.001), (0.0, 0.003), (0.0, 0.001)])
def test_a_field_of_every_frame_is_named_and_relief_is_not(monkeypatch, field, relief):
    rng = np.random.default_rng(11)
    lit = torch.ones(IMAGES, SIZE, SIZE, dtype=torch.bool)
    monkeypatch.setattr(ground, "judged", lambda chain: (lit, ~lit))
    chains = [_chain(k, field, relief, rng) for k in (0, 2, 3, 5)]
    state = SimpleNamespace(chains=lambda: chains, data=Survey(units="dn"), has=frozenset())
    (claim,) = frames.by_images(state)
    assert (claim.decide() is None) == bool(field) and claim.name == "frame_field" and claim.would_show()
    if field:
        value, error, _ = claim.named.parameters["rms"]
        assert abs(value - field) < 3 * error and error < 0.01 and claim.named.percent[1] > 0
    # a calibrated image has no response of its own: what is left is light, and has no name in the catalogue
    state.data = Survey(units="iof")
    assert [(c.decide() is None, c.named.effect.listed) for c in frames.by_images(state)] == [(bool(field), False)]


def test_values_per_image_of_a_site_are_written_and_act_on_that_crop_alone(tmp_path):
    values = {p.name: torch.zeros(2, 4) for p in FIELD.coordinates}
    values["f10"][1, 3] = 0.1
    effect = FIELD(values, Survey(units="dn"))
    image = torch.ones(3, 8, 8)
    seen = SimpleNamespace(frame=torch.tensor([1, 1, 5]), site=torch.tensor([3, 2, 3]))
    state = SimpleNamespace(elevation=image, image=image, observation=seen)
    effect.apply(state)
    assert float(state.image[0, 0, 0]) == pytest.approx(1 + 0.1 * math.sqrt(2) * math.cos(math.pi / 16), abs=1e-6)
    assert torch.equal(state.image[1:], image[1:])  # another site, and an image that was not looked at
    cause = Named(effect, {"rms": (0.1, 0.01, "1")}, 0.01, 9.0, 1.0, 1.0, 0.9, (10.0, 5.0, 15.0), ["frame_field"])
    albedo = get_effect("albedo_map")({p.name: torch.ones(6) for p in get_effect("albedo_map").coordinates})
    other = Named(albedo, {"per_std": (0.1, 0.01, "1")}, 0.01, 9.0, 1.0, 1.0, 0.9, (10.0, 5.0, 15.0), ["albedo_map"])
    path = tmp_path / "diagnosis.h5"
    answer = Answer("named", config={})
    answer.causes = [cause, other]
    write_diagnosis(path, answer, ["A", "B", "C"], [])
    with h5py.File(path) as file:
        table = file["frame_field"][()]
        assert table.shape == (3, 6, len(FIELD.coordinates)) and table.sum() == pytest.approx(0.1)
        assert file["site_albedo"].shape[0] == 6
