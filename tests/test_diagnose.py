"""`lunargr diagnose` on hidden data that Mitsuba traced, and on semi-real scenes: names, silence, blindness, bad input."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
from campaign import PLANTS, UNKNOWN, random_world
from hidden.drawn import drawn
from hidden.scene import Layout, Scene, Truth, write_pairs
from laboratory.cases import Deal, make_case
from planted import semi_real
from typer.testing import CliRunner

from schemas import ArtefactError
from stages import diagnose
from stages.effects import Survey, effect_names, get_effect, load_extension

# What two sites of 64 px in ten images can show, with the first parameter's relative error where it is recovered;
# a wrong Sun stands in test_diagnose_leaks.py.
SHOWN = {
    "misregistration": None,  # the campaign plants a mean size, which the frames' own draws differ from
    "psf_blur": 0.15,
    "dem_smoothing": None,  # noise of the DEM and relief within a pixel take it to two thirds
    "phase_slope": 0.1,
}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(Layout())


def _truth(effect, seed=11, **changes):
    world = {"units": "iof"} | random_world(np.random.default_rng((seed, 99))) | changes
    return Truth(effect=effect, **world)


def _pairs(scene, folder, effect, seed=11, **changes):
    truth = _truth(effect, seed, **changes)
    return write_pairs(folder / "pairs.h5", scene.make(truth, seed), scene.layout, units=truth.units)


@pytest.fixture(scope="module")
def diagnosed(scene, tmp_path_factory):
    """(effect, seed) -> the folder of d.h5, d.json and d.html that the command writes; made when first asked for. Effect "": nothing is planted."""
    from lunargr_cli.main import app

    made = {}

    def make(effect, seed=11):
        if (effect, seed) not in made:
            folder = tmp_path_factory.mktemp(effect or "nothing")
            pairs = _pairs(scene, folder, {effect: PLANTS[effect]} if effect else {}, seed)
            names = [str(folder / n) for n in ("d.h5", "d.json", "d.html")]
            command = ["diagnose", str(pairs), "-o", names[0], "--json", names[1], "--report", names[2], "-q"]
            out = CliRunner().invoke(app, command)
            assert out.exit_code == 0, out.output
            made[effect, seed] = folder
        return made[effect, seed]

    return make


@pytest.mark.slow  # the one of the fast tests is in test_diagnose_leaks.py
@pytest.mark.parametrize("effect", SHOWN)
def test_planted_cause_is_named(scene, diagnosed, effect):
    """... and every kind of cause can be written, reported, and read back as an extension of the model."""
    answer = json.loads((diagnosed(effect) / "d.json").read_text())
    assert [e.name for e in load_extension(diagnosed(effect) / "d.h5")] == [c["effect"] for c in answer["causes"]]
    assert answer["verdict"] == "named"
    first = answer["causes"][0]
    assert first["effect"] == effect
    assert effect in first["group"]
    if SHOWN[effect] is not None:
        name = next(iter(PLANTS[effect]))
        found = first["parameters"][name]
        # departures are planted in forms of their own: this is the size of theirs in the catalogue's form
        planted = drawn(scene, _truth({effect: PLANTS[effect]}), 11).get(effect, PLANTS[effect][name])
        assert found["value"] == pytest.approx(planted, rel=SHOWN[effect])
        assert found["unit"]


@pytest.mark.slow
def test_an_echo_may_lag_by_what_was_not_tried(scene, tmp_path):
    """Lags of 6 and 8 px are tried; between them the lag is fitted, with an error."""
    tried = {abs(t.fixed["lag_px"]) for t in get_effect("echo").trials(Survey())}
    assert 7.0 not in tried
    answer = diagnose.run(_pairs(scene, tmp_path, {"echo": {"fraction": 0.05, "lag_px": 7}})).answer
    assert [c.effect.name for c in answer.causes] == ["echo"]
    lag, error, unit = answer.causes[0].parameters["lag_px"]
    assert 0 < error < 0.5 and abs(abs(lag) - 7) < 3 * error and unit == "px"


@pytest.mark.slow
def test_large_gains_of_images_are_one_cause(scene, tmp_path):
    """What a first estimate leaves of them is no second cause, nor a curve of the detector."""
    answer = diagnose.run(_pairs(scene, tmp_path, {"image_gain": {"rms": 0.2}})).answer
    assert [c.effect.name for c in answer.causes] == ["image_gain"]


@pytest.mark.parametrize("seed", [21, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (22, 23, 24))])
def test_nothing_hidden_names_nothing(diagnosed, seed):
    answer = json.loads((diagnosed("", seed) / "d.json").read_text())
    assert answer["causes"] == [] == load_extension(diagnosed("", seed) / "d.h5")
    assert answer["verdict"] in ("nothing_significant", "cannot_tell")


@pytest.mark.slow
def test_an_ordinary_blur_is_rendered_so_that_others_are_judged_beside_it_and_is_no_cause(scene, tmp_path):
    result = diagnose.run(_pairs(scene, tmp_path, {"psf_blur": {"sigma2_px2": 0.45}}))
    assert not result.answer.causes
    assert result.answer.verdict in ("nothing_significant", "cannot_tell")
    (ordinary,) = result.answer.ordinary
    assert ordinary.effect.name == "psf_blur" not in result.answer.blind
    assert ordinary.parameters["sigma2_px2"][0] == pytest.approx(0.45, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "words"), [("banding", "lines"), ("motion", "motion")])
def test_a_fault_outside_the_catalogue_is_unexplained(scene, tmp_path, fault, words):
    answer = diagnose.run(_pairs(scene, tmp_path, {fault: UNKNOWN[fault]})).answer
    assert answer.unexplained_fraction > 0
    assert answer.verdict == "unexplained" and not answer.causes
    assert any(words in what for what in answer.structure)


@pytest.mark.slow
def test_another_renderer_with_broad_noise_and_drifting_reflectance(tmp_path):
    """Semi-real: a wrong Sun is found within three errors, though each image has noise of its own, 4 to 16 px wide."""
    said = diagnose.run(semi_real(tmp_path / "p.h5", 1, truth={"sun_azimuth_deg": 4.0})).answer.to_json()
    found = {c["effect"]: c["parameters"] for c in said["causes"]}
    error = found["sun_azimuth"]["error_deg"]
    assert abs(error["value"] - 4.0) < 3 * error["error"]


@pytest.mark.slow
def test_errors_of_a_dem_whose_relief_runs_one_way_are_no_wrong_sun(tmp_path):
    """Under Suns in the east and west they look like an azimuth of half a degree, on all ground and in the test pairs alike."""
    make_case(4, Deal("d"), 2802199605, tmp_path / "pairs.h5")
    assert not diagnose.run(tmp_path / "pairs.h5").answer.causes


@pytest.mark.slow
def test_a_high_wall_close_to_the_border_is_named(tmp_path):
    """It stood beyond the highest that was tried so near, and nothing was said of shadows on half of some images."""
    truth = make_case(7, Deal("b", "distant_shadow"), 1836542769, tmp_path / "pairs.h5")["planted"]["distant_shadow"]
    (cause,) = diagnose.run(tmp_path / "pairs.h5").answer.causes
    height, error, _ = cause.parameters["height_m"]
    assert cause.effect.name == "distant_shadow" and abs(height - truth["height_m"]) < 3 * error


def test_no_effect_is_named_in_the_method():
    """Whatever is special about an effect stands in its own file."""
    folder = Path(diagnose.__file__).parent
    for path in folder.rglob("*.py"):
        strings = re.findall(r"""["']([a-z_]+)["']""", path.read_text())
        assert not set(strings) & set(effect_names()), path


def test_a_shift_of_five_pixels_is_captured():
    from stages.diagnose.registration.capture import correlations, peak
    from stages.effects.filters import gaussian

    torch.manual_seed(1)
    ground = gaussian(torch.randn(2, 80, 80), 4.0)
    rendered, image = ground[:, 8:72, 8:72], ground[:, 8 - 3 : 72 - 3, 8 + 5 : 72 + 5] * 2 + 1
    valid = torch.ones(2, 64, 64)
    valid[:, 20:30, 10:40] = 0
    shift, highest = peak(correlations(image, valid, rendered, torch.ones(2, 64, 64), 8, 6.0))
    assert torch.allclose(shift, torch.tensor([[5.0, -3.0]]).expand(2, 2), atol=0.1)
    assert float(highest.min()) > 0.9


@pytest.mark.parametrize(("share", "found"), [(0.5, 5.0), (0.1, 0.0)])
def test_an_image_without_the_rendered_contrast_tells_nothing_of_where_it_lies(monkeypatch, share, found):
    """Of two images that show a share of what is rendered, 5 px away and beside a texture of their own, the fainter match is one of the law."""
    from stages.diagnose.registration import start
    from stages.effects.filters import gaussian

    torch.manual_seed(1)
    ground = gaussian(torch.randn(1, 144, 144), 4.0)
    rendered, shifted = ground[:, 8:136, 8:136], ground[:, 8:136, 13:141]
    own = gaussian(torch.randn(1, 128, 128), 4.0) * 0.2
    valid = torch.ones(1, 128, 128, dtype=torch.bool)
    site = SimpleNamespace(
        read=2 * (share * shifted + own + 1), read_valid=valid, gain=torch.tensor([2.0]), frames=np.array([0])
    )
    chain = SimpleNamespace(site=site, predict=lambda: rendered)
    monkeypatch.setattr(start, "_lit", lambda chain: valid)
    shift, _ = start._frame_shifts([chain], 1)
    assert torch.allclose(shift, torch.tensor([[found, 0.0]]), atol=0.2)
    (alone,) = start.captured([chain])
    assert torch.allclose(alone, torch.tensor([[found, 0.0]]), atol=0.2)


def test_relief_displacement_lies_along_the_view():
    """A camera in the east at 45 deg: ground 100 m high is seen 100 m too far west, so the pixel shows ground to the east."""
    from stages.effects.relief_displacement import lean
    from stages.physics.formation.chain import Observation

    z = torch.full((1, 8, 8), 100.0)
    camera = torch.tensor([[1e7, 0.0, 1e7]])
    east, south = lean(Observation(z, torch.tensor([[0.0, 0.0, 1.0]]), camera, 10.0, 1737400.0), 0.0)
    assert torch.allclose(east, torch.full_like(z, 10.0), rtol=1e-3)
    assert float(south.abs().max()) < 1e-3


def test_ground_that_several_crops_show_counts_once():
    from stages.diagnose.data.sites import overlap

    first, *others = np.array([(0.0, 0.0), (100.0, 0.0), (40.0, 40.0), (90.0, 44.0), (-44.0, 10.0)])
    assert [overlap(first, o[None], (48, 48)) for o in others] == [False, True, False, False]
    assert overlap(first, np.array(others), (48, 48)) and not overlap(first, np.zeros((0, 2)), (48, 48))


def test_of_crops_that_overlap_one_is_diagnosed(tmp_path):
    """As 'lunargr sample' draws them, most crops share ground: merged into one piece, they would leave none to judge on."""
    import h5py

    from stages.diagnose import Config
    from stages.diagnose.stage import load
    from stages.pairs.reader import PairReader

    path = semi_real(tmp_path / "pairs.h5", 4713, sites=4, images=2)
    row = np.array([0, 30, 64, 64, 500])
    column = np.array([0, 30, 0, 64, 0])
    with h5py.File(path, "a") as file:
        file["row"], file["col"] = row[file["site"][...]], column[file["site"][...]]
    with PairReader(path) as reader:
        sites = load(reader, np.arange(reader.count), Config())
    assert [s.number for s in sites] == [0, 2, 3, 4]


def test_of_many_crops_those_that_are_diagnosed_lie_all_over_the_scene():
    from stages.diagnose.data.sites import all_over

    crops = [np.array([k]) for k in range(1000)]
    several = np.array([1000, 1001])
    taken = all_over([several, *crops], most_pairs=384, most_sites=128)[:128]
    assert taken[0] is several
    places = np.sort([int(g[0]) for g in taken[1:]])
    gaps = np.diff([0, *places, 1000])
    assert gaps.max() < 2 * 1000 / len(places)
    assert all(a is b for a, b in zip(all_over(crops[:100], 384, 128), crops[:100], strict=True))


def test_jackknife_intervals_cover():
    """Of ratios of sums over twelve unequal pieces of ground, at least nine in ten intervals hold the truth."""
    from stages.diagnose.likelihood.intervals import gain_interval

    rng = np.random.default_rng(3)
    held = 0
    for _ in range(300):
        before = rng.gamma(4.0, 1.0, 12)
        after = before * (0.9 + 0.05 * rng.normal(size=12))
        _, low, high = gain_interval(before, after)
        held += low < 10.0 < high
    assert held > 270


def test_intervals_of_skewed_gains_cover_and_see_what_every_piece_gains():
    """Few pieces gain much, most little, all of them something: there is a gain, which Student's t takes for scatter."""
    from stages.common.intervals import student_quantile
    from stages.diagnose.likelihood.intervals import interval, typical_bounds

    rng = np.random.default_rng(5)
    held = 0
    for _ in range(400):
        sizes = rng.gamma(4.0, 1.0, 12)
        low, high = typical_bounds(sizes * rng.exponential(size=12), sizes)
        held += low < 1.0 < high
    assert held > 340  # 85 %: a skewed law is not symmetric about its ratio
    gains = np.array([100.0, *np.full(11, 1.0)])
    scatter = float(gains.std(ddof=1)) / len(gains) ** 0.5
    assert gains.mean() - student_quantile(11) * scatter < 0 < interval(gains)[0]
    assert interval(gains * np.where(np.arange(12) % 2, -1, 1))[0] < 0  # signs that chance gives
    assert typical_bounds(gains[:5], np.ones(5)) is None
    assert typical_bounds(gains, np.array([1.0, *np.full(11, 1e-6)])) is None  # one piece says it all


def test_small_pieces_of_ground_tell_how_much_gains_scatter_where_a_few_hold_nearly_all():
    """Twelve craters, of which three lie in shadow for the most part: each gains its share, or only the largest does."""
    from stages.diagnose.likelihood.intervals import typical_bounds

    sizes = np.array([800.0, 480.0, 140.0, 60.0, 20.0, 12.0, 12.0, 10.0, 3.0, 3.0, 3.0, 2.0])
    rng, held = np.random.default_rng(6), 0
    for _ in range(1000):
        gains = sizes * (0.3 + 0.5 * rng.normal(size=12)) + 0.3 * np.sqrt(sizes) * rng.normal(size=12)
        low, high = typical_bounds(gains, sizes)
        held += low < 0.3 < high
    assert held > 930
    each = np.array([0.7, 0.3, 0.9, 0.85, 0.7, 0.8, 0.7, 0.8, 1.2, 1.0, 1.0, 0.5])
    assert typical_bounds(each * sizes, sizes)[0] > 0.1
    assert typical_bounds(np.where(sizes > 500, 0.7, 0.0) * sizes, sizes)[0] < 0


def test_a_sharpened_dem_keeps_its_borders():
    """A tilted plane is sharp already: mirrored at its borders it would have creases there."""
    from types import SimpleNamespace

    from stages.effects import get_effect

    row, column = np.mgrid[:48, :48]
    hill = 80 * np.exp(-((row - 24.0) ** 2 + (column - 24.0) ** 2) / (2 * 6.0**2))
    plane = torch.from_numpy(300.0 + 40 * row + 25 * column).float()[None]
    effect = get_effect("dem_smoothing")({"sigma2_px2": 1.0})
    state = SimpleNamespace(elevation=plane.clone())
    effect.apply(state)
    assert torch.allclose(state.elevation, plane, atol=0.02)
    state.elevation = plane + torch.from_numpy(hill).float()
    effect.apply(state)
    sharp = 80 * 36 / 35 * np.exp(-((row - 24.0) ** 2 + (column - 24.0) ** 2) / (2 * 35.0))
    assert np.abs(state.elevation[0].numpy() - plane[0].numpy() - sharp).max() < 0.1


def test_the_page_needs_nothing_else(diagnosed):
    page = (diagnosed("", 21) / "d.html").read_text()
    assert "data:image/" in page and "http" not in page.split("</style>")[1].replace("https://", "")


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
        file["valid"][:, 4:] = 0
    answer = diagnose.run(path).answer
    assert answer.verdict == "cannot_tell" and not answer.causes and "too few" in answer.sentence().lower()


@pytest.mark.slow
def test_a_model_that_does_not_fit_names_nothing(scene, tmp_path):
    path = _pairs(scene, tmp_path, {})
    with h5py.File(path, "a") as file:
        file["image"][...] = np.random.default_rng(1).exponential(0.05, file["image"].shape)
    answer = diagnose.run(path).answer
    assert answer.verdict == "unexplained" and not answer.causes


def test_one_dependence_for_all_images_is_weighed_in_place_of_the_gains_that_it_explains():
    """A pattern over images explains gains that follow it; gains that follow nothing stay what they are."""
    from types import SimpleNamespace

    from stages.diagnose.likelihood.weigh import in_place_of_gains
    from stages.diagnose.likelihood.whole import Whole

    rng = np.random.default_rng(4)
    azimuth = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    pattern = np.stack([np.sin(azimuth), np.cos(azimuth)], 1)
    columns = 5.0 * np.concatenate([pattern, np.eye(12)], 1)  # five standard errors per unit of a gain
    followed, none = pattern @ [2.0, 1.0], rng.normal(0, 1.5, 12)
    for measured, stands in ((followed, True), (none, False)):
        seen = 5.0 * measured + rng.normal(size=12)
        whole = Whole.__new__(Whole)
        whole.scattered, whole.plan = np.arange(2, 14), SimpleNamespace(per_frame=["image_gain"])
        whole.reduce = lambda places, exclude, seen=seen: (columns.T @ columns, columns.T @ seen, None, None)
        ratio, amount = in_place_of_gains(whole, np.arange(2), [])
        assert ratio > 30 if stands else ratio < 15
        if stands:
            assert amount == pytest.approx([2.0, 1.0], abs=0.3)
