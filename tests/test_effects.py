"""Effects: each does nothing at its null value, something elsewhere, has a gradient, and says what it is."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from schemas import ConfigError, RegistryError
from stages.diagnose.result.answer import Answer, Named
from stages.diagnose.result.files import write_diagnosis
from stages.effects import Effect, Survey, effect_names, fields, get_effect, load_extension, register
from stages.effects.azimuthal_anisotropy import sun_cotangent
from stages.effects.filters import gaussian
from stages.physics.formation.chain import Observation, State, form
from stages.physics.formation.resampling import displace, displace_anywhere
from stages.physics.photometry import get_model

CATALOGUE, EVERY = effect_names(), effect_names(unlisted=True)


def _scene() -> Observation:
    rng = np.random.default_rng(4)
    size = 32
    spectrum = np.fft.rfft2(rng.normal(size=(size, size)))
    k = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size))
    z = np.fft.irfft2(spectrum / (k + 0.03) ** 2, s=(size, size))
    z = torch.tensor(z / np.abs(np.gradient(z)).mean() * 0.7, dtype=torch.float32)
    suns = [[0.5, 0.4, 0.7], [-0.8, 0.3, 0.35]]
    sun = torch.nn.functional.normalize(torch.tensor(suns, dtype=torch.float32), dim=1)
    horizon = torch.atan(torch.rand(2, size, size, generator=torch.Generator().manual_seed(1)) * 0.5)
    camera = torch.tensor([[2e4, 1e4, 1e5], [0.0, -3e4, 1e5]])
    return Observation(
        z.expand(2, -1, -1).clone(), sun, camera, 5.0, 1737400.0, horizon, frame=torch.tensor([0, 1]),
        site=torch.tensor([0, 0]),
    )  # fmt: skip


SCENE, M2 = _scene(), get_model("M2")
COEFFICIENTS = torch.tensor([0.08, 0.02, 0.01])[None, :, None, None]
SURVEY = Survey(crop_px=32, gsd=5.0, brightness=0.06, brightness_quantiles=(0.07, 0.075, 0.08, 0.09), slope=(0.2, 0.1))


def _values(cls, trial, factor: float = 1.0) -> dict:
    values = dict(trial.fixed)
    for column in trial.columns:
        values |= {k: cls.null()[k] + factor * (v - cls.null()[k]) for k, v in column.items()}
    if cls.scope != "scene":
        values = {k: torch.full((2, 2) if cls.scope == "pair" else (2,), float(v)) for k, v in values.items()}
    return values


def test_the_catalogue_has_what_the_documents_name():
    wanted = "misregistration dem_smoothing dem_scale line_jitter sun_elevation sun_azimuth penumbra distant_shadow interreflection earthshine opposition_surge phase_slope limb_darkening macroscopic_roughness slope_albedo elevation_albedo curvature_albedo albedo_map azimuthal_anisotropy image_gain dark_bias nonlinearity psf_blur column_pattern echo saturation relief_displacement frame_field"
    assert set(wanted.split()) <= set(CATALOGUE)


def test_unknown_names_list_the_choices():
    with pytest.raises(RegistryError, match="phase_slope"):
        get_effect("phase")


@pytest.mark.parametrize("name", EVERY)
def test_effect(name):
    cls = get_effect(name)
    plain = form(SCENE, M2, COEFFICIENTS)
    null = form(SCENE, M2, COEFFICIENTS, [cls(None, SURVEY)])
    torch.testing.assert_close(null, plain, atol=2e-6, rtol=1e-5)
    trials = list(cls.trials(SURVEY))
    changed = [
        float((form(SCENE, M2, COEFFICIENTS, [cls(_values(cls, t), SURVEY)]) - plain).abs().max()) for t in trials
    ]
    assert max(changed) > 1e-5
    assert all(math.isfinite(c) for c in changed)
    for p in (*cls.parameters, *cls.fitted()):
        assert p.lower <= p.default <= p.upper and p.unit, p
    assert {p.name for p in cls.fitted()} >= set(cls.strong), "a size worth knowing of what is not fitted"
    assert cls.mechanism and cls.reference and cls.separate and cls.confused_with, name
    assert set(cls.confused_with) <= set(CATALOGUE), name
    assert cls.listed == (name in CATALOGUE)


@pytest.mark.parametrize("name", [n for n in EVERY if n != "distant_shadow"])
def test_effect_has_a_gradient(name):
    cls = get_effect(name)
    trial = cls.trials(SURVEY)[-1]
    values = _values(cls, trial)
    key = next(iter(trial.columns[0]))
    leaf = torch.as_tensor(values[key], dtype=torch.float32).clone().requires_grad_()
    image = form(SCENE, M2, COEFFICIENTS, [cls({**values, key: leaf}, SURVEY)])
    image.square().sum().backward()
    assert torch.isfinite(leaf.grad).all() and float(leaf.grad.abs().sum()) > 0


def test_values_per_image_go_with_the_frame():
    gain = get_effect("image_gain")({"gain": torch.tensor([0.1, 0.0])})
    ratio = form(SCENE, M2, COEFFICIENTS, [gain]).sum((1, 2)) / form(SCENE, M2, COEFFICIENTS).sum((1, 2))
    torch.testing.assert_close(ratio, torch.tensor([1.1, 1.0]))


def test_closed_forms():
    plain = form(SCENE, M2, COEFFICIENTS)
    biased = form(SCENE, M2, COEFFICIENTS, [get_effect("dark_bias")({"iof": 0.003})])
    torch.testing.assert_close(biased - plain, torch.full_like(plain, 0.003), atol=1e-7, rtol=0)
    cut = form(SCENE, M2, COEFFICIENTS, [get_effect("saturation")({"iof": 0.05})])
    assert float(cut.max()) == pytest.approx(0.05, rel=1e-6)
    impulse = torch.zeros(1, 41, 41)
    impulse[0, 20, 20] = 1
    spread = gaussian(impulse, 1.5)[0]
    x = torch.arange(41.0) - 20
    assert float((spread.sum(0) * x * x).sum()) == pytest.approx(1.5, rel=1e-3)
    moved = displace(impulse, torch.tensor(2.0), torch.tensor(-3.0))
    assert divmod(int(moved.argmax()), 41) == (23, 18)


def _detector(turn_deg: float, scale: float = 1.0) -> Observation:
    """Both images of the scene, on a detector that lies turned against the crop and has smaller pixels."""
    row, column = torch.meshgrid(torch.arange(32.0), torch.arange(32.0), indexing="ij")
    c, s = scale * math.cos(math.radians(turn_deg)), scale * math.sin(math.radians(turn_deg))
    sample, line = c * column - s * row, s * column + c * row
    return dataclasses.replace(
        SCENE, detector_sample=sample.expand(2, -1, -1).clone(), detector_line=line.expand(2, -1, -1).clone()
    )


def _exposed(observation: Observation) -> State:
    return State(observation, SCENE.elevation, SCENE.sun_direction, SCENE.camera_position, SCENE.sun_horizon)


@pytest.mark.parametrize(("turn_deg", "axis", "sign"), [(0.0, -2, 1), (0.0, -1, -1), (90.0, -1, 1), (180.0, -2, 1)])
def test_motion_blurs_along_lines_what_it_sharpens_along_samples(turn_deg, axis, sign):
    """A wave along either axis of the detector is damped by exp(-v k^2 / 2), or grows by it; k in its pixels, two thirds of the crop's."""
    state = _exposed(_detector(turn_deg, 1.5))
    wave = 2 * math.pi / 8
    phase = wave * torch.arange(32.0)
    state.image = 1 + 0.1 * torch.cos(phase[:, None] if axis == -2 else phase).expand(2, 32, 32)
    get_effect("motion_blur")({"sigma2_px2": 0.3}).apply(state)
    inner = state.image[:, 12:20, 12:20] - 1
    kept = float(inner.amax()) / 0.1
    assert kept == pytest.approx(math.exp(-sign * 0.3 * (wave / 1.5) ** 2 / 2), rel=0.01)


@pytest.mark.parametrize(("turn_deg", "axis"), [(0.0, -2), (90.0, -1), (180.0, -2)])
def test_a_column_of_a_frame_adds_its_own_mean(turn_deg, axis):
    state = _exposed(_detector(turn_deg))
    state.image = torch.rand(2, 32, 32, generator=torch.Generator().manual_seed(3))
    mean = state.image.mean(axis, keepdim=True).expand(2, 32, 32)
    plain = state.image
    get_effect("charge_smear")({"share": 0.1}).apply(state)
    torch.testing.assert_close(state.image, plain + 0.1 * mean)
    state.image = plain  # what it has to gain more than: light of lines, which nothing adds up
    smear = get_effect("charge_smear")({"share": 0.1, "axis": -1.0})
    smear.apply(state)
    torch.testing.assert_close(state.image, plain + 0.1 * plain.mean(-3 - axis, keepdim=True).expand(2, 32, 32))
    assert not smear.plausible({"share": 0.1, "axis": -1.0}, smear.survey)


@pytest.mark.parametrize(
    ("turn_deg", "mirror", "flipped"), [(30.0, 0, (-2, -1)), (0.0, 1, (-1,)), (90.0, 1, (-2,)), (0.0, 2, (-2,))]
)
def test_a_ghost_is_the_image_mirrored_and_out_of_focus(turn_deg, mirror, flipped):
    state = _exposed(_detector(turn_deg))
    state.image = plain = torch.rand(2, 32, 32, generator=torch.Generator().manual_seed(3))
    effect = get_effect("ghost")({"share": 0.1, "mirror": float(mirror)})
    effect.apply(state)
    torch.testing.assert_close(state.image, plain + 0.1 * gaussian(plain.flip(flipped), 4.0), atol=2e-4, rtol=0)
    assert effect.plausible({"share": 0.1}, effect.survey) and not effect.plausible({"share": -0.1}, effect.survey)


def test_wings_of_optics_fall_with_the_cube_of_the_distance():
    """A point's light, all but the 3 % beyond the crop; where a law is fitted to lit ground the dark alone tells."""
    size, core = 256, 4.0
    point = torch.zeros(1, size, size)
    point[0, size // 2, size // 2] = 1.0
    state = SimpleNamespace(image=point, elevation=point, sun_visibility=None, law_fitted=False)
    get_effect("stray_light")({"share": 0.1}).apply(state)
    wings = state.image[0, size // 2] - point[0, size // 2]
    away = torch.arange(8, 48)
    expected = 0.1 * core / (2 * math.pi * (away**2 + core**2) ** 1.5)
    torch.testing.assert_close(wings[size // 2 + away], expected.float(), rtol=0.05, atol=2e-8)
    assert 0.097 < float(state.image.sum()) - 1 < 0.1
    lit = SimpleNamespace(image=point, elevation=point, sun_visibility=torch.ones_like(point), law_fitted=True)
    get_effect("stray_light")({"share": 0.1}).apply(lit)
    torch.testing.assert_close(lit.image, point)


def test_slots_fix_the_order():
    a, b = get_effect("dark_bias")({"iof": 0.01}), get_effect("image_gain")({"gain": torch.tensor([0.5, 0.5])})
    torch.testing.assert_close(form(SCENE, M2, COEFFICIENTS, [a, b]), form(SCENE, M2, COEFFICIENTS, [b, a]))


@pytest.mark.parametrize("slope_deg", [20.0, 45.0])
def test_light_from_a_slope_is_its_view_factor(slope_deg):
    """Flat ground before a long, evenly bright slope that rises to an angle b gets (1 - cos b) / 2 of it."""
    from stages.effects.interreflection import gather

    size, cell = 96, 10.0
    x = torch.arange(size) - 47.5
    height = (x.clamp(min=0) * cell * math.tan(math.radians(slope_deg))).expand(size, -1).contiguous()
    bright = (x > 0).float().expand(size, -1)
    light = gather(height, bright[None], cell)[0]
    foot = light[40:56, 45].mean()
    top = math.atan(47.5 * math.tan(math.radians(slope_deg)) / (95 - 45))  # the slope ends with the crop
    assert float(foot) == pytest.approx((1 - math.cos(top)) / 2, rel=0.08)
    assert float(light[:, :20].max()) < float(foot)
    flat = gather(torch.zeros(size, size), torch.ones(1, size, size), cell)
    assert float(flat.abs().max()) == 0.0


def _paraboloid(bend: float, size: int = 96, gsd: float = 5.0) -> torch.Tensor:
    """(1, size, size) m: z = bend (x^2 + y^2) / 2, a hollow where bend is above 0."""
    x = (torch.arange(size, dtype=torch.float64) - (size - 1) / 2) * gsd
    return (bend / 2 * (x[:, None] ** 2 + x**2))[None]


@pytest.mark.parametrize("bend", [0.004, -0.004])
def test_curvature_of_a_paraboloid(bend):
    """Its Laplacian is twice its bend everywhere: above 0 in hollows, below 0 on hills; a blur changes nothing of it."""
    found = fields.curvature(_paraboloid(bend), 5.0)[:, 36:-36, 36:-36]
    torch.testing.assert_close(found, torch.full_like(found, 2 * bend), rtol=1e-3, atol=0)


def test_albedo_that_follows_curvature_is_high_in_hollows_where_its_strength_is_above_0():
    cls, level = get_effect("curvature_albedo"), slice(36, -36)
    survey = Survey(crop_px=96, gsd=5.0, curvature=(0.001, 0.005))
    for bend in (0.004, -0.004):
        z = _paraboloid(bend).float()
        overhead = torch.tensor([[0.0, 0.0, 1.0]])
        scene = Observation(
            z, overhead, overhead * 1e6, 5.0, 1e9, None, frame=torch.tensor([0]), site=torch.tensor([0])
        )
        followed = form(scene, M2, COEFFICIENTS, [cls({"per_std": 0.1}, survey)])
        ratio = (followed / form(scene, M2, COEFFICIENTS))[:, level, level]
        expected = 1 + 0.1 * (2 * bend - 0.001) / 0.005
        torch.testing.assert_close(ratio, torch.full_like(ratio, expected), rtol=2e-3, atol=0)


@pytest.mark.parametrize("alike", [True, False])
def test_a_ramp_is_displaced_by_what_is_asked_for(alike):
    """The cubic of torch's grid_sample moves it by 0.14 px where 0.1 is asked for."""
    ramp = torch.arange(24.0).expand(2, 16, 24) + 3 * torch.arange(16.0)[:, None]
    east, south = torch.full((2, 1, 1), 0.1), torch.full((2, 1, 1), -0.3)
    moved = displace(ramp, east if alike else east.expand_as(ramp), south)
    assert torch.allclose((moved - ramp)[:, 4:-4, 4:-4], torch.tensor(0.1 - 0.9), atol=1e-4)


def test_the_compiled_displacement_is_the_plain_one(rng):
    image, east, south = (torch.from_numpy(rng.normal(size=(3, 20, 31))).float() for _ in range(3))
    assert torch.allclose(
        displace(image, 9 * east, 9 * south), displace_anywhere(image, 9 * east, 9 * south), atol=2e-5
    )
    shift = torch.tensor([0.3, -7.6, 40.0])[:, None, None]
    far = shift.expand_as(image)
    assert torch.allclose(displace(image, shift, 2 * shift), displace_anywhere(image, far, 2 * far), atol=2e-5)
    moved = torch.full((3, 1, 1), 0.3, requires_grad=True)
    displace(image, moved.expand_as(image), moved).square().sum().backward()
    slope = moved.grad.clone()
    moved.grad = None
    displace(image, moved, moved).square().sum().backward()
    assert torch.allclose(slope, moved.grad, rtol=1e-4)


def test_gradients_of_a_wave_that_is_hardly_resolved():
    from stages.effects.filters import gradients

    x = torch.arange(64.0)
    east, south = gradients(torch.sin(0.9 * x).expand(1, 32, 64))
    assert torch.allclose(east[0, 10, 8:-8], 0.9 * torch.cos(0.9 * x)[8:-8], atol=0.03)
    assert float(south.abs().max()) == 0.0


@pytest.mark.parametrize("variable", [("image_gain", None), None])
def test_values_per_image_come_back_whether_or_not_they_have_a_variable_of_their_own(tmp_path, monkeypatch, variable):
    """As an effect of somebody else's has them, which no schema knows; images that were not diagnosed have the null value."""
    cls = get_effect("image_gain")
    monkeypatch.setattr(cls, "table", variable)
    effect = cls({"gain": torch.tensor([0.1, 0.0, -0.2])}, SURVEY)
    cause = Named(effect, {"rms": (0.1, 0.01, "1")}, 0.01, 9.0, 1.0, 0.1, 0.09, (5.0, 4.0, 6.0), ["image_gain"])
    write_diagnosis(tmp_path / "d.h5", Answer("named", causes=[cause]), ["a", "b", "c"], [])
    [found] = load_extension(tmp_path / "d.h5", ["c", "x", "a"])
    torch.testing.assert_close(found.values["gain"], torch.tensor([-0.2, 0.0, 0.1]))


@pytest.mark.parametrize(("attribute", "value"), [("scope", "frame"), ("slot", "lens"), ("title", None)])
def test_an_effect_that_is_not_whole_is_refused_in_one_line(attribute, value):
    body = {k: getattr(get_effect("dark_bias"), k) for k in ("slot", "title", "mechanism", "reference", "parameters")}
    body |= {"name": "mine", attribute: value, "apply": lambda self, state: None}
    cls = type("Mine", (Effect,), {k: v for k, v in body.items() if v is not None})
    with pytest.raises(ConfigError, match=f"effect mine: expected .*{attribute}"):
        register(cls)
    assert "mine" not in effect_names()


@pytest.mark.parametrize("mistake", ["import nothing_like_this", "def f(:", "1 / 0"])
def test_a_file_that_is_not_right_is_named(tmp_path, monkeypatch, mistake):
    """Whoever adds one reads which file it is, not what else could not be loaded."""
    from stages.common.registry import import_all

    folder = tmp_path / f"added_{abs(hash(mistake))}"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "haze.py").write_text(mistake)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match=rf"{folder.name}\.haze: expected a module that can be imported, found "):
        import_all(folder.name, [str(folder)])


def test_anisotropy_is_as_large_as_it_says_at_the_mean_cotangent_of_the_sun():
    """cot(elevation) of 1 and 3, lit from the east: relative changes of 0.04 and 0.12 over a mean cotangent of 2, 0.08 on average."""
    sun = torch.tensor([[1.0, 0.0, 1.0], [3.0, 0.0, 1.0]])
    sun = sun / sun.norm(dim=1, keepdim=True)
    effect = get_effect("azimuthal_anisotropy")(
        {"east": 0.08, "north": 0.0, "shading": 1.0}, Survey(sun_cotangent=float(sun_cotangent(sun).mean()))
    )
    state = SimpleNamespace(sun_direction=sun, elevation=torch.zeros(2, 3, 3), reflectance=torch.ones(2, 3, 3))
    effect.apply(state)
    assert (state.reflectance[:, 0, 0] - 1).tolist() == pytest.approx([0.04, 0.12], rel=1e-5)
