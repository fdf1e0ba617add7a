"""`lunargr diagnose` on hidden data that Mitsuba traced: names, silence, structure, blindness, bad input."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
import torch
from campaign import PLANTS, UNKNOWN, random_world
from hidden.scene import Layout, Scene, Truth, write_pairs
from typer.testing import CliRunner

from schemas import ArtefactError
from stages import diagnose
from stages.diagnose.images import _agreement, _Fold
from stages.diagnose.selection import _faint
from stages.effects import get_effect, load_extension

# What two sites of 64 px in ten images can show, with the first parameter's relative error where it is recovered.
SHOWN = {
    "misregistration": None,  # the campaign plants a mean size; the drawn shifts are compared below
    "dem_smoothing": 0.15,
    "dem_scale": 0.15,
    "line_jitter": 0.1,
    "sun_elevation": 0.15,
    "sun_azimuth": 0.1,
    "penumbra": 0.4,
    "distant_shadow": 0.3,
    "earthshine": 0.2,
    "opposition_surge": 0.1,
    "phase_slope": 0.1,
    "limb_darkening": 0.1,
    "macroscopic_roughness": 0.1,
    "slope_albedo": 0.25,
    "elevation_albedo": 0.25,
    "curvature_albedo": 0.25,
    "albedo_map": 0.25,
    "azimuthal_anisotropy": 0.1,
    "image_gain": 0.35,
    "dark_bias": 0.1,
    "nonlinearity": 0.1,
    "psf_blur": 0.1,
    "column_pattern": None,  # its rms is over the columns that these crops happen to show
    "echo": 0.15,
    "saturation": 0.05,
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(Layout())


def _pairs(scene, folder, effect, seed=11, **changes):
    world = random_world(np.random.default_rng((seed, 99))) | changes
    units = world.pop("units", "iof")
    data = scene.make(Truth(effect=effect, units=units, **world), seed)
    return write_pairs(folder / "pairs.h5", data, scene.layout, units=units)


@pytest.mark.parametrize("effect", SHOWN)
def test_planted_cause_is_named(scene, tmp_path, effect):
    """... and every kind of cause can be written, reported, and read back as an extension of the model."""
    files = [tmp_path / name for name in ("d.h5", "d.json", "d.html")]
    diagnose.run(_pairs(scene, tmp_path, {effect: PLANTS[effect]}), None, diagnose.Config(), *files)
    answer = json.loads(files[1].read_text())
    extended = [e.name for e in load_extension(files[0])]
    assert extended == [c["effect"] for c in answer["causes"] if get_effect(c["effect"]).scope != "site"]
    assert answer["verdict"] == "named"
    first = answer["causes"][0]
    assert effect in first["group"]
    assert first["effect"] == effect
    if SHOWN[effect] is not None:
        name = next(iter(PLANTS[effect]))
        found = first["parameters"][name]
        assert found["value"] == pytest.approx(PLANTS[effect][name], rel=SHOWN[effect])
        assert found["unit"]


@pytest.mark.slow
def test_what_smooth_ground_hides_is_said(scene, tmp_path):
    """Slopes of 9 degrees hardly light each other, least of all beside a DEM's errors: what cannot be shown is not denied."""
    answer = diagnose.run(_pairs(scene, tmp_path, {"interreflection": {"strength": 1.0}})).answer
    assert answer.verdict == "cannot_tell" and "interreflection" in answer.blind


def test_rugged_ground_lights_itself(tmp_path):
    """Slopes of 20 degrees show the light that real terrain scatters: Mitsuba's two bounces, at their true strength."""
    assert set(SHOWN) == set(PLANTS) - {"interreflection"}
    rugged = Scene(Layout(seed=5, sites=4, images=12, slope_deg=20.0, sun_elevations=(10.0, 60.0)))
    world = {"dem_noise_deg": 0.4, "dem_smoothing": 0.2, "misregistration": 0.2}
    answer = diagnose.run(_pairs(rugged, tmp_path, {"interreflection": {"strength": 1.0}}, 3, **world)).answer
    assert [c.effect.name for c in answer.causes] == ["interreflection"]
    assert answer.causes[0].effect.values["strength"] == pytest.approx(1.0, rel=0.3)
    assert answer.held_out.gain > 0


def test_shifts_come_back(scene, tmp_path):
    """Shift by shift: the mean shift of all images is the DEM's own to give, so differences are compared."""
    world = random_world(np.random.default_rng((11, 99)))
    truth = Truth(effect={"misregistration": PLANTS["misregistration"]}, **world)
    rng = np.random.default_rng((11, 5))
    for site in range(scene.layout.sites):
        scene.given_dem(site, truth, rng)
    planted = np.array([scene._frame(rng, truth)[0].error for _ in range(scene.layout.images)])
    cause = diagnose.run(_pairs(scene, tmp_path, truth.effect)).answer.causes[0]
    found = np.stack([cause.effect.values[k].numpy() for k in ("south_px", "east_px")], 1)
    high = np.array([sun[2] for sun in scene.suns]) > np.sin(np.radians(20))  # a low Sun leaves hardly a lit pixel
    difference = (found - found[high].mean(0)) - (planted - planted[high].mean(0))
    assert np.abs(difference[high]).max() < 0.12
    assert np.sqrt((difference[high] ** 2).mean()) < 0.06


@pytest.mark.parametrize("seed", [21, 22, 23, 24])
def test_nothing_hidden_names_nothing(scene, tmp_path, seed):
    answer = diagnose.run(_pairs(scene, tmp_path, {}, seed)).answer
    assert not answer.causes
    assert answer.verdict in ("nothing_significant", "cannot_tell")


@pytest.mark.parametrize("what", UNKNOWN)
def test_outside_the_catalogue_is_unexplained(scene, tmp_path, what):
    answer = diagnose.run(_pairs(scene, tmp_path, {what: UNKNOWN[what]})).answer
    assert answer.verdict == "unexplained" and not answer.causes


@pytest.mark.parametrize(
    "both", [("phase_slope", "line_jitter"), ("limb_darkening", "phase_slope"), ("column_pattern", "echo")]
)
def test_two_planted(scene, tmp_path, both):
    planted = {k: PLANTS[k] for k in both}
    answer = diagnose.run(_pairs(scene, tmp_path, planted)).answer
    assert {c.effect.name for c in answer.causes} == set(planted)


def test_what_a_cause_explains_is_not_tried_again(scene, tmp_path):
    """A flat field looks like a wrong Sun, a phase slope and a bent response until it is known."""
    result = diagnose.run(_pairs(scene, tmp_path, {"column_pattern": PLANTS["column_pattern"]}))
    assert [c.effect.name for c in result.answer.causes] == ["column_pattern"]
    assert not result.search.refused
    assert max(e.gain for e in result.round.best.values()) < 0.05 * result.answer.causes[0].gain


def test_what_the_data_cannot_show_is_said(scene, tmp_path):
    """Gains of images in dn are free: a planted one leaves no trace."""
    answer = diagnose.run(_pairs(scene, tmp_path, {"image_gain": {"rms": 0.02}}, units="dn")).answer
    assert answer.verdict == "cannot_tell"
    assert "image_gain" in answer.blind


def test_outputs(scene, tmp_path):
    from lunargr_cli.main import app

    pairs = _pairs(scene, tmp_path, {"phase_slope": PLANTS["phase_slope"], "line_jitter": PLANTS["line_jitter"]})
    names = [str(tmp_path / n) for n in ("d.h5", "d.json", "d.html")]
    out = CliRunner().invoke(
        app, ["diagnose", str(pairs), "-o", names[0], "--json", names[1], "--report", names[2], "-q"]
    )
    assert out.exit_code == 0, out.output
    answer = json.loads((tmp_path / "d.json").read_text())
    keys = {"verdict", "causes", "unexplained_fraction", "blind", "held_out", "data", "config"}
    assert keys <= set(answer)
    cause = answer["causes"][0]
    assert {"effect", "parameters", "p_family_wise", "gain_nats", "gain_error", "group", "to_separate"} <= set(cause)
    assert answer["held_out"]["gain_percent_low"] > 0
    page = (tmp_path / "d.html").read_text()
    assert "data:image/png;base64" in page and "http" not in page.split("</style>")[1].replace("https://", "")
    effects = {e.name: e for e in load_extension(tmp_path / "d.h5", ["image-003", "never-seen"])}
    assert float(effects["phase_slope"].values["per_radian"]) == pytest.approx(0.08, rel=0.1)
    shifts = effects["line_jitter"].values["east1_px"]
    assert shifts.shape == (2,) and float(shifts[1]) == 0.0


def test_list_explains_every_effect():
    from lunargr_cli.main import app

    out = CliRunner().invoke(app, ["diagnose", "--list"])
    assert out.exit_code == 0
    assert all(effect in out.output for effect in PLANTS)


def test_without_horizon_a_clear_line(scene, tmp_path):
    path = _pairs(scene, tmp_path, {})
    with h5py.File(path, "a") as file:
        del file["sun_horizon_deg"]
    with pytest.raises(ArtefactError, match="sun_horizon_deg"):
        diagnose.run(path)


def test_too_few_pixels_cannot_tell(scene, tmp_path):
    path = _pairs(scene, tmp_path, {"phase_slope": PLANTS["phase_slope"]})
    with h5py.File(path, "a") as file:
        file["valid"][:, 10:] = 0
    answer = diagnose.run(path).answer
    assert answer.verdict == "cannot_tell" and not answer.causes and "too few" in answer.sentence()


def test_a_low_sun_over_rugged_ground_cannot_tell(tmp_path):
    """Three of four such worlds with nothing hidden had a name: the DEM's errors choose which slopes seem to face the Sun."""
    low = Scene(Layout(seed=9, sites=3, images=8, size=96, slope_deg=14.0, sun_elevations=(3.0, 25.0)))
    answer = diagnose.run(_pairs(low, tmp_path, {"phase_slope": PLANTS["phase_slope"]})).answer
    assert answer.verdict == "cannot_tell" and not answer.causes and "Sun is too low" in answer.sentence()
    assert "phase_slope" in answer.blind


def test_a_site_that_shows_nothing_of_an_effect_changes_no_agreement():
    gram, score = torch.diag(torch.tensor([4.0, 9.0]).double()), torch.tensor([4.0, 18.0]).double()
    alike = [(torch.arange(2), _Fold(gram, score)) for _ in range(3)]
    blank = (torch.arange(2), _Fold(torch.zeros_like(gram), torch.zeros_like(score)))
    values = torch.tensor([1.0, 2.0]).double()
    # each site alone gains (4 + 36) / 2 nats, of which chance has half a nat for every value but the two in common
    assert _agreement(values, alike) == pytest.approx(60 / (60 - 2), rel=1e-5)
    assert _agreement(values, [*alike, blank]) == pytest.approx(60 / (60 - 3), rel=1e-5)


def test_sites_may_have_unequal_numbers_of_images(scene, tmp_path):
    """Stacks from a real archive: maps of slope errors come from the sites with enough images alone."""
    data = scene.make(Truth(effect={"dem_smoothing": {"sigma2_px2": 1.5}}), 11)
    first = np.flatnonzero(data["site"] == data["site"].min())
    keep = np.setdiff1d(np.arange(len(data["site"])), first[3:])
    fewer = {name: np.asarray(values)[keep] for name, values in data.items()}
    answer = diagnose.run(write_pairs(tmp_path / "pairs.h5", fewer, scene.layout)).answer
    assert answer.pairs == int((fewer["split"] == 0).sum())
    assert [c.effect.name for c in answer.causes] == ["dem_smoothing"]


def test_what_comes_out_within_its_errors_is_blind(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("stages.diagnose.selection._faint", lambda cause: cause.effect.name == "dem_smoothing")
    path = _pairs(scene, tmp_path, {"dem_smoothing": PLANTS["dem_smoothing"]})
    answer = diagnose.run(path).answer.to_json()
    assert answer["verdict"] == "cannot_tell"
    assert "dem_smoothing" in answer["blind"]


def test_an_error_that_only_lowers_is_no_doubt_of_presence(scene, tmp_path):
    """A DEM's noise makes its smoothing look smaller than it is: 0.8 +- 0.4 px^2 of which 0.35 are that is not nothing."""
    answer = diagnose.run(_pairs(scene, tmp_path, {"dem_smoothing": PLANTS["dem_smoothing"]}, dem_noise_deg=1.0)).answer
    (cause,) = answer.causes
    error = cause.errors["sigma2_px2"]
    assert 0 < cause.lowered["sigma2_px2"] < error
    cause.errors["sigma2_px2"] = float(cause.effect.values["sigma2_px2"]) / 2
    cause.lowered["sigma2_px2"] = 0.95 * cause.errors["sigma2_px2"]
    assert not _faint(cause)
    cause.lowered["sigma2_px2"] = 0.0
    assert _faint(cause)


def test_what_is_sure_and_too_small_for_a_name_is_blind(scene, tmp_path, monkeypatch):
    path = _pairs(scene, tmp_path, {"dark_bias": {"iof": 0.0005}})
    monkeypatch.setattr("stages.diagnose.naming.floor_fid", lambda slope: 10.0)
    answer = diagnose.run(path).answer.to_json()
    assert answer["verdict"] == "cannot_tell"
    assert "dark_bias" in answer["blind"]


def test_a_fit_that_lost_to_a_simpler_one_is_in_its_group(scene, tmp_path, monkeypatch):
    """A second source of light has three coordinates, and a bias, which looks like it, one."""
    monkeypatch.setattr("stages.diagnose.contest.SLIGHT", 1.0)
    monkeypatch.setattr("stages.diagnose.contest.SIMPLER", 0.5)
    path = _pairs(scene, tmp_path, {"earthshine": PLANTS["earthshine"]})
    (first,) = diagnose.run(path, None, diagnose.Config(most_causes=1)).answer.to_json()["causes"]
    assert first["effect"] == "dark_bias"
    assert first["group"][:2] == ["dark_bias", "earthshine"]


def test_six_images_a_site_are_enough(tmp_path):
    """Albedo and two slopes take half of what they show: little of a phase function is left in the other half."""
    layout = Layout(seed=1177726415, sites=8, images=6, size=96, gsd=20.0, slope_deg=5.4, sun_elevations=(11.4, 64.5))
    few = Scene(layout)
    answer = diagnose.run(_pairs(few, tmp_path, {"phase_slope": {"per_radian": 0.056}}, seed=3104)).answer.to_json()
    assert answer["nominal"] is None
    assert [c["effect"] for c in answer["causes"]] == ["phase_slope"]
    assert answer["causes"][0]["parameters"]["per_radian"]["value"] == pytest.approx(0.056, rel=0.1)


def test_a_model_that_does_not_fit_names_nothing(scene, tmp_path):
    path = _pairs(scene, tmp_path, {})
    with h5py.File(path, "a") as file:
        file["image"][...] = np.random.default_rng(1).exponential(0.05, file["image"].shape)
    answer = diagnose.run(path).answer
    assert answer.verdict == "unexplained" and not answer.causes


@pytest.mark.parametrize("effect", ["phase_slope", "nonlinearity"])
def test_a_wrong_form_of_the_nominal_model_is_no_cause(scene, tmp_path, effect):
    """Ground that follows M2: Hapke's model would need other causes to look like it."""
    pairs = _pairs(scene, tmp_path, {effect: PLANTS[effect]})
    answer = diagnose.run(pairs, None, diagnose.Config(model="hapke")).answer
    assert answer.form in ("M2", "kernels")  # the second takes either effect for its own
    assert {c.effect.name for c in answer.causes} <= {effect}
    if answer.form == "M2":
        assert answer.causes
    assert answer.to_json()["nominal"] == answer.form and "hapke" in answer.sentence()


@pytest.mark.parametrize("law", ["hapke", pytest.param("lunar_lambert", marks=pytest.mark.slow), "akimov"])
def test_ground_that_follows_another_law_is_no_cause(scene, tmp_path, law):
    """M2, the default, leaves a sixth of such ground's brightness: nothing but its form is wrong."""
    answer = diagnose.run(_pairs(scene, tmp_path, {}, law=law)).answer
    assert not answer.causes
    assert answer.form in ("kernels", "hapke")
    assert {"phase_slope", "opposition_surge", "image_gain"} & set(answer.blind) or answer.verdict == "unexplained"


@pytest.mark.parametrize(
    "law",
    [pytest.param("hapke", marks=pytest.mark.slow), "lunar_lambert", pytest.param("akimov", marks=pytest.mark.slow)],
)
def test_a_cause_is_found_on_ground_that_follows_another_law(scene, tmp_path, law):
    answer = diagnose.run(_pairs(scene, tmp_path, {"psf_blur": PLANTS["psf_blur"]}, law=law)).answer
    assert [c.effect.name for c in answer.causes] == ["psf_blur"]
    assert float(answer.causes[0].effect.values["sigma2_px2"]) == pytest.approx(0.8, rel=0.2)


def test_f_tail_against_scipy():
    from scipy.stats import f

    from stages.diagnose.numbers import f_tail

    for x, a, b in ((1.3, 1, 7), (40.0, 2, 9.5), (3.0, 8, 20), (0.2, 1, 1)):
        assert f_tail(x, a, b) == pytest.approx(f.sf(x, a, b), rel=1e-6)


def _fitted(scene, folder):
    """A site with nothing hidden, and the nominal model of it."""
    from stages.diagnose.data import group_pairs, load_site
    from stages.diagnose.nominal import fit, load_nominal
    from stages.pairs.reader import PairReader

    with PairReader(_pairs(scene, folder, {})) as reader:
        site = load_site(reader, group_pairs(reader, np.arange(reader.count), 16)[0])
    nominal = load_nominal(None, "M2", "iof")
    fit(nominal, [site], [], "iof", [site.image])
    return site, nominal.chain(site, [])


def test_projection_leaves_no_texture_and_no_slope_error(scene, tmp_path):
    """Residuals made of a static albedo and a static slope error alone leave the dynamic rows empty."""
    from stages.diagnose.projection import Projector

    site, chain = _fitted(scene, tmp_path)
    east, north = chain.slope_tangents()
    torch.manual_seed(0)
    error = 0.05 * torch.randn(64, 64) * chain.textured + 0.02 * torch.randn(64, 64) * east
    error = error + 0.02 * torch.randn(64, 64) * north
    projector = Projector(chain, site.valid.float())
    weighted = (error * projector.weight)[None]
    dynamic = projector.project_(weighted, projector.coefficients(weighted))
    assert float(dynamic.square().sum()) < 1e-6 * float(error.square().sum())


def test_an_image_that_shows_next_to_nothing_moves_next_to_nothing(scene, tmp_path):
    """Three stray pixels of an image otherwise masked must not be explained by a shift of many pixels."""
    from stages.diagnose.columns import nuisance_columns
    from stages.diagnose.projection import Local, Projector

    site, chain = _fitted(scene, tmp_path)
    weight = site.valid / (0.02 * chain.textured.mean())
    first = torch.zeros_like(weight[0])
    first[10, 10] = first[30, 40] = first[50, 20] = 1e-3 * weight[0].max()
    weight[0] = first
    residual = torch.zeros_like(weight)
    residual[0] = 30.0 * (first > 0)
    columns = residual[None].clone()
    projector = Projector(chain, weight)
    on_basis = projector.coefficients(columns)
    Local(projector, nuisance_columns(chain, False)).remove_(columns, on_basis)
    assert float((columns - residual).abs().max()) < 1.0


@pytest.mark.parametrize("planted", [0.0, 0.07])
def test_a_broad_pattern_stands_out_from_red_texture_alone(planted):
    """Albedo of a pure power law, down to the longest waves, is no pattern; seven percent of slow waves on top of it are."""
    from types import SimpleNamespace

    from stages.diagnose.naming import GATE, STANDS_OUT
    from stages.diagnose.pattern import ORDERS, SHORTEST, weigh_pattern
    from stages.effects.fields import cosine_field

    rng, size = np.random.default_rng(5), 48
    waves = [(m, n) for m in range(SHORTEST + 1) for n in range(SHORTEST + 1) if m + n > 0]
    fields = torch.stack([cosine_field(o, size, size) for o in waves]).flatten(1)
    slow = np.array([o in ORDERS for o in waves])
    named = 0
    for exponent in np.tile([2.0, 2.5, 3.0], 6):
        power = np.hypot(*np.array(waves).T) ** -exponent
        amount = rng.normal(size=(4, len(waves))) * 0.03 * np.sqrt(power / power.sum())
        amount[:, slow] += planted / np.sqrt(slow.sum()) * rng.normal(size=(4, slow.sum()))
        albedo = (torch.tensor(amount, dtype=torch.float32) @ fields).view(4, size, size)
        sites = [SimpleNamespace(site=SimpleNamespace(count=9, number=k), albedo=a) for k, a in enumerate(albedo)]
        e = weigh_pattern(sites)
        named += (
            e.p * 26 < GATE and np.hypot(e.rms, e.texture) > STANDS_OUT * e.texture and e.rms > 0.03 + 2 * e.rms_error
        )
        if planted:
            assert e.rms == pytest.approx(planted, rel=0.35)
    assert named == (18 if planted else 0)
