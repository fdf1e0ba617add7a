"""The hidden data, which judge `diagnose`, share no code with it and hold what they say."""

from __future__ import annotations

import ast
import inspect

import laboratory_campaign
import numpy as np
import pytest
from campaign import UNKNOWN
from conftest import ROOT
from hidden import departures, laws, sensor
from hidden.faults import FAULTS
from laboratory import cases as laboratory_cases
from laboratory import laws as laboratory_laws
from laboratory.faults import FAULTS as LABORATORY_FAULTS
from laboratory.layout import Needs
from laboratory.plant import Plant
from laboratory.planted import PLANTED
from scipy.ndimage import gaussian_filter
from second_laboratory import cases as second_cases
from second_laboratory import laws as second_laws
from second_laboratory import light as second_light
from second_laboratory.effects import EFFECTS as SECOND_EFFECTS
from second_laboratory.faults import FAULTS as SECOND_FAULTS
from second_laboratory.faults import Place

from stages.effects import effect_names, get_effect

SIMULATORS = ("hidden", "laboratory", "second_laboratory")


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_hidden_data_import_nothing_of_the_program(simulator):
    others = {*SIMULATORS} - {simulator}
    paths = sorted((ROOT / "tests/validation" / simulator).glob("*.py"))
    assert len(paths) > 5
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            for name in names:
                known = {"stages", "schemas", "lunargr_cli", *others}
                assert name.split(".")[0] not in known, f"{path.name} imports {name}"


@pytest.mark.parametrize("kind", [*PLANTED.values(), *LABORATORY_FAULTS.values()], ids=lambda kind: kind.name)
def test_every_plant_of_the_other_laboratory_says_what_it_does(kind):
    assert not inspect.isabstract(kind)
    own = {name for k in kind.__mro__[:-2] if k is not Plant for name in vars(k)}
    assert own & {"iof", "departure", "image", "given_sun", "given_dem"}


@pytest.mark.parametrize(
    ("laboratory", "layouts"),
    [(laboratory_cases, {*"abcd"}), (second_cases, {"4x12", "6x8", "12x4", "40x1"})],
    ids=["first", "second"],
)
def test_a_hand_of_another_laboratory_is_dealt_as_its_seed_says(laboratory, layouts):
    hand = laboratory.deal(5, 44)
    assert hand == laboratory.deal(5, 44) != laboratory.deal(6, 44)
    assert sum(d.effect is None and d.fault is None for d in hand) == 14 and sum(d.fault is not None for d in hand) == 8
    assert {d.effect for d in hand if d.effect} <= set(effect_names())
    assert {d.layout for d in hand if d.fault} == layouts


def test_the_law_that_diagnose_is_given_is_what_both_laboratories_draw_then():
    """I/F = a cos(i) + b cos(g) + c (Lunar-G2R, M2), over that at the standard geometry."""
    mu0, mu, phase = 0.4, 0.9, 1.1
    first = laboratory_laws.draw_law(np.random.default_rng(2), Needs(), given=True)
    b, c = first.parameters[5:7]
    expected = (mu0 + b * np.cos(phase) + c) / ((1 + b) * np.cos(np.pi / 6) + c)
    found = laboratory_laws.reflectance(mu0, mu, phase, first.code, first.parameters)
    assert found / first.at_30_degrees() == pytest.approx(expected)
    second = second_laws.draw_law(np.random.default_rng(2), given=True)
    b, c = second.parameters["cos_phase"], second.parameters["constant"]
    expected = (mu0 + b * np.cos(phase) + c) / ((1 + b) * np.cos(np.pi / 6) + c)
    assert second.reflectance(np.array(mu0), np.array(mu), np.array(phase), 0.0) == pytest.approx(expected)


def test_the_second_laboratory_plants_every_effect():
    own = {
        n for n in effect_names() if get_effect(n).__module__.startswith("stages.effects.")
    }  # examples register more
    assert set(SECOND_EFFECTS) == own


@pytest.mark.parametrize(("azimuth", "elevation"), [(90.0, 20.0), (270.0, 14.0), (0.0, 30.0), (180.0, 15.0)])
def test_shadow_of_a_wall_of_the_second_laboratory_is_as_long_as_it_should_be(azimuth, elevation):
    """Height over the tangent of the Sun's elevation, to half a cell and a step of the ray, which is 2 % of its length."""
    ground = np.zeros((300, 300), np.float32)
    ground[:, 150:170] = 10.0
    if azimuth in (0.0, 180.0):
        ground = np.ascontiguousarray(ground.T)
    window = second_light.Window(40, 40, 220, 220)
    tangent = second_light.horizon_tangent(ground, window, 0.5, azimuth)
    light = second_light.visible_disc(elevation, tangent, second_light.SUN_RADIUS_DEG)
    line = light[110] if azimuth in (90.0, 270.0) else light[:, 110]
    beside = line[:110] if azimuth in (90.0, 180.0) else line[130:]  # rows run to the south: what lies behind the wall
    assert 0.5 * (1 - beside).sum() == pytest.approx(10 / np.tan(np.radians(elevation)), rel=0.02, abs=0.25)


@pytest.mark.parametrize("name", [n for n in SECOND_FAULTS if n != "nearest_resampling"])  # done where images are laid
def test_faults_of_the_second_laboratory_change_images(name):
    fault, rng = SECOND_FAULTS[name], np.random.default_rng(3)
    image = 0.05 * (1 + 0.2 * gaussian_filter(rng.normal(size=(120, 128)), 2) / 0.14)
    at = Place(np.arange(120) + 40, np.arange(128) + 700, (400.0, 600.0), 500.0)
    changed = fault.act(image, at, max(fault.first, 0.02), np.random.default_rng(1), np.random.default_rng(2))
    assert changed.shape == image.shape and np.isfinite(changed).all()
    assert 1e-6 < np.abs(changed / image - 1).mean() < 0.2


def test_an_answer_is_right_if_the_first_name_is_what_was_planted():
    def answered(*names, blind=()):
        causes = [{"effect": name, "parameters": {}} for name in names]
        return laboratory_campaign.judged({"planted": {"echo": {}}, "answer": {"causes": causes, "blind": [*blind]}})

    found = [answered("echo", "psf_blur"), answered("psf_blur", "echo"), answered(blind=["echo"]), answered()]
    assert found == ["right", "another first", "no name, in `blind`", "no name, not in `blind`"]


def test_roughness_of_a_smooth_surface_is_one():
    mu0, mu = np.linspace(0.2, 0.9, 5), np.linspace(0.9, 0.3, 5)
    assert laws.roughness(mu0, mu, 0.5 * (mu0 + mu), 1e-3) == pytest.approx(np.ones(5), abs=1e-9)


def test_surge_is_half_as_high_where_hapkes_is():
    h = 0.06
    half = 2 * np.arctan(h)
    assert departures.surge(np.cos(half), 0.4, h) == pytest.approx(1.2)


@pytest.mark.parametrize("slope", [-0.1, 0.08, 0.3])
def test_phase_curve_falls_by_as_much_as_planted(slope):
    ends = departures.steeper(np.cos([0.3, 1.5]), slope)
    assert np.log(ends[0] / ends[1]) / 1.2 == pytest.approx(slope)


@pytest.mark.parametrize("snr", [30.0, 140.0])
def test_noise_is_as_large_as_asked_for(snr):
    camera = sensor.Detector(snr=snr, uneven=0.0)
    image = sensor.expose(np.random.default_rng(1), np.full((200, 200), 0.05), sensor.Pose(), camera)
    assert 0.05 / image.std() == pytest.approx(snr, rel=0.05)


def test_veil_is_broad_and_its_own_in_every_image():
    rng = np.random.default_rng(2)
    camera = sensor.Detector(snr=1e4, read=0.0, uneven=0.0, bits=20, veil=0.02, veil_px=10.0)
    first, second = (sensor.expose(rng, np.full((160, 160), 0.05), sensor.Pose(), camera) / 0.05 - 1 for _ in range(2))
    assert first.std() == pytest.approx(0.02, rel=0.02)
    assert np.abs(np.diff(first)).mean() < 0.15 * first.std()
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.3


@pytest.mark.parametrize("name", FAULTS)
def test_faults_that_the_catalogue_has_not_keep_the_light(name):
    """They change images by as much as planted and leave their mean alone but for what is read twice."""
    rng = np.random.default_rng(4)
    signal = 0.05 * (1 + 0.2 * gaussian_filter(rng.normal(size=(97, 97)), 2, mode="wrap") / 0.14)
    changed = FAULTS[name](signal.copy(), np.arange(97) + 2500.0, np.arange(97) + 10.0, **UNKNOWN[name])
    assert changed.shape == signal.shape and not np.array_equal(changed, signal)
    assert 0.001 < np.abs(changed / signal - 1).mean() < 0.1
    assert changed.mean() == pytest.approx(signal.mean(), rel=0.005)
