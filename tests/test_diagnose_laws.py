"""The measured laws that diagnose fits, against laws that were written elsewhere."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hidden.laws import LAWS
from laboratory.cases import Deal, make_case
from orbital_angles import orbital_cosines
from planted import semi_real

from stages import diagnose
from stages.diagnose.likelihood.found import Found
from stages.diagnose.model.form import better_form, measured_laws, other_laws, relative_misfit
from stages.diagnose.model.laws import LunarLaws, lunar_laws
from stages.diagnose.model.nominal import fit, load_nominal
from stages.diagnose.model.sites import Site, load_site, survey
from stages.diagnose.registration.explain import explain
from stages.diagnose.rows.columns import Guise
from stages.diagnose.rows.patches import cuts
from stages.diagnose.search.state import Cause, State
from stages.effects import Survey, effect_names, get_effect
from stages.pairs.reader import PairReader
from stages.physics.formation.geometry import Angles

# percent of brightness, rms: what a law leaves passes for causes, since noise of so many pixels is averaged to 0.01 %
LEFT = {
    "hapke": 0.04, "hapke_rough": 0.08, "lunar_lambert": 0.02, "akimov": 0.03, "minnaert": 0.03, "lroc_2014": 0.1,
    "lroc_2019": 0.02,
}  # fmt: skip


@pytest.fixture(scope="module")
def angles():
    """Cosines (3, N) of rough ground in twelve orbital images."""
    return torch.from_numpy(orbital_cosines(np.random.default_rng(5), np.radians(np.linspace(10, 70, 12)), 0.15, 1500))


@pytest.fixture(scope="module")
def laws(angles):
    return lunar_laws(angles[:, ::2])


@pytest.mark.parametrize("name", LEFT)
def test_a_law_is_followed_with_coefficients_that_are_no_surprise(laws, angles, name):
    """Coefficients scatter as those of measured laws: the law is one of them, as far as brightness can tell."""
    apart = angles[:, 1::2]
    truth = LAWS[name](*apart.numpy(), 1.0)
    parts = laws.parts(Angles(*apart.unbind(0))).double().numpy()
    a, b = (parts / truth).T, np.ones(len(truth))
    scatter = laws.scatter.double().numpy()
    precision = np.diag(np.r_[0.0, (np.abs(parts[0] / truth).mean() * scatter[1:]) ** -2])
    found = np.linalg.solve(a.T @ a * 1e5 + precision, a.T @ b * 1e5)  # as of many pixels with a noise of 0.3 %
    left = 100 * np.sqrt(np.mean((a @ found - b) ** 2))
    assert left < LEFT[name]
    assert np.abs(found[1:] / found[0] / scatter[1:]).max() < 4


def test_between_the_angles_of_a_steep_crater_and_of_all_other_ground_no_law_runs_away():
    """In three images a few of its facets have angles that no others have, and nothing holds polynomials between them and the rest."""
    rng = np.random.default_rng(8)
    angles = torch.from_numpy(orbital_cosines(rng, np.radians([30, 50, 75]), 0.1, 1500))
    incidence, emission = rng.uniform(0.2, 1.4, (2, 4000))
    phase = rng.uniform(np.abs(incidence - emission), incidence + emission)
    every = np.cos([incidence, emission, phase])
    steep = every[:, (emission > 1.05) & (emission < 1.1)][:, :5]
    low, high = np.minimum(steep.min(1), angles.numpy().min(1)), np.maximum(steep.max(1), angles.numpy().max(1))
    between = every[:, (every > low[:, None]).all(0) & (every < high[:, None]).all(0)]
    laws = lunar_laws(torch.cat([angles, torch.from_numpy(steep)], 1))
    parts = laws.parts(Angles(*torch.from_numpy(between).unbind(0)))
    mean = parts[0].numpy() / LAWS["akimov"](*between, 1.0)
    assert mean.min() > 0.4 * np.median(mean) and mean.max() < 2.5 * np.median(mean)


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Four places in eight images each, to be filled."""
    with PairReader(semi_real(tmp_path_factory.mktemp("film") / "pairs.h5", 4711, sites=3)) as reader:
        sites = [load_site(reader, np.flatnonzero(reader.site == k)) for k in np.unique(reader.site)]
    return sites


@pytest.mark.parametrize(
    "name", [n if n in ("linear", "hapke") else pytest.param(n, marks=pytest.mark.slow) for n in LAWS]
)
def test_film_is_fitted_by_measured_laws_unless_the_ground_has_the_nominal_form(places, name):
    """Albedo leaves most of the residual, whatever the law: what the right one leaves surely less need not be half of it."""
    generator = torch.Generator().manual_seed(3)
    nominal = load_nominal(None, "M2", "dn")
    with torch.no_grad():
        for site in places:
            angles = nominal.chain(site, []).state.angles
            cosines = [c.double().clamp(min=1e-3).numpy() for c in (angles.cos_incidence, angles.cos_emission)]
            light = torch.as_tensor(LAWS[name](*cosines, angles.cos_phase.double().numpy(), 0.1)).float()
            albedo = 1 + 0.03 * torch.randn(light.shape[1:], generator=generator)
            gain, offset = torch.rand(2, site.count, 1, 1, generator=generator) + 0.5
            site.gain, site.offset = torch.ones(site.count), torch.zeros(site.count)
            site.read = site.image = 2000 * gain * light * albedo + 50 * offset
        fit(nominal, places, [], "dn", [s.read for s in places], start=True)
        nominal.laws = other_laws(nominal, places, "dn")
        other = better_form(nominal, places, Survey(units="dn"))
    assert isinstance(other and other.model, LunarLaws) == (name != "linear")


@pytest.mark.parametrize("name", ["surge", "akimov"])
def test_what_one_effect_of_the_law_explains_is_no_other_law(places, name):
    """Both leave the nominal law far more than measured ones; a peak at opposition, written as another function here, is a cause all the same."""
    nominal, rng = load_nominal(None, "M2", "iof"), np.random.default_rng(3)
    with torch.no_grad():
        for site in places:
            angles = nominal.chain(site, []).state.angles
            cosines = [c.double().clamp(min=1e-3).numpy() for c in (angles.cos_incidence, angles.cos_emission)]
            cosg = angles.cos_phase.double().numpy()
            light = LAWS["akimov" if name == "akimov" else "linear"](
                *cosines, cosg, rng.normal(1, 0.03, cosg.shape[-2:])
            )
            if name == "surge":
                light = light * (1 + 1.5 * np.exp(-np.arccos(cosg) / 0.3))
            site.gain, site.offset = torch.ones(site.count), torch.zeros(site.count)
            site.read = site.image = torch.as_tensor(light).float()
        fit(nominal, places, [], "iof", [s.read for s in places], start=True)
        nominal.laws = other_laws(nominal, places, "iof")
        measured = measured_laws(nominal, places, "iof")
        assert relative_misfit(measured, places) ** 2 < 0.5 * relative_misfit(nominal, places) ** 2
        other = better_form(nominal, places, survey(places, 8, "iof"))
    assert (other is not None) == (name == "akimov")


def test_an_image_whose_own_gain_is_not_known_does_not_fit_the_law(places):
    """Beside gains of images one that shows too little lit ground for a gain of its own would bend the law; without such a cause it counts."""
    nominal = load_nominal(None, "M2", "iof")
    dim = places[0].frames[3]
    with torch.no_grad():
        for site in places:
            image = nominal.chain(site, []).predict().clone()
            image[site.frames == dim] *= 0.7
            site.gain, site.offset = torch.ones(site.count), torch.zeros(site.count)
            site.read = site.image = image
        true = nominal.vector.clone()
        gains = Guise("image_gain", get_effect("image_gain").trials(Survey())[0], (0,), per_frame=True)
        moved = Guise("misregistration", get_effect("misregistration").trials(Survey())[0], (0,), per_frame=True)
        state = State(nominal, places, Survey(), 8, "iof", frozenset(), 1, seldom=frozenset({int(dim)}))
        off = {}
        for guise in (gains, moved):
            effect = get_effect(guise.effect)({}, Survey())
            state.causes = [Cause(effect, Found(guise.effect, guise, np.zeros(1), np.ones(1), 0.0))]
            state.fit()
            off[guise.effect] = float((nominal.vector / true - 1).abs().max())
            assert [site.unknown for site in places] == [frozenset({3} if guise is gains else ())] * len(places)
    assert off["image_gain"] < 1e-3 < 0.02 < off["misregistration"]


def test_ground_that_is_darker_than_other_ground_does_not_bend_the_law(places):
    """Two halves of a scene, one of them half as bright and shown under other Suns: what differs between grounds is their albedo."""
    nominal = load_nominal(None, "M2", "iof")
    kept = [site.valid for site in places]
    with torch.no_grad():
        suns = torch.stack([site.observation.sun_direction[:, 2] for site in places]).mean(0)
        high = suns > suns.median()
        for k, site in enumerate(places):
            dark = k % 2 == 1
            site.gain, site.offset = torch.ones(site.count), torch.zeros(site.count)
            site.read = site.image = nominal.chain(site, []).predict() * (0.5 if dark else 1.0)
            site.valid = kept[k] & (high == dark)[:, None, None]
        true = nominal.vector / nominal.vector[0]
        fit(nominal, places, [], "iof", [s.read for s in places], start=True)
        for site, valid in zip(places, kept, strict=True):
            site.valid = valid
    assert float((nominal.vector / nominal.vector[0] / true - 1).abs().max()) < 0.05


@pytest.mark.parametrize("adds", [500.0, 5000.0])
def test_an_effect_of_the_law_beside_which_another_law_gains_is_a_part_of_that_law(monkeypatch, adds):
    """Without a name any one effect of the law has to leave as little as another law does; beside one with a name a second is no excuse, and 5 % rms of what is left are."""
    guise = Guise("phase_slope", get_effect("phase_slope").trials(Survey())[0], (0,))
    whole = SimpleNamespace(
        form_places=lambda: np.array([1]), gram=np.array([[1e6]]), plan=SimpleNamespace(guises=[guise]), seen=np.ones(2, bool),
        places=lambda guise: np.array([1]), another_law=lambda guise, surely: 0.0 if guise else adds, exclude=lambda guise: [],
        reduce=lambda *_: (np.eye(1), np.array([amount]), None, None),
    )  # fmt: skip
    size = abs(next(iter(guise.trial.columns[0].values())))
    measured = object()
    monkeypatch.setattr("stages.diagnose.search.state.measured_laws", lambda *_: measured)
    monkeypatch.setattr(State, "fit", lambda self: None)
    nominal = load_nominal(None, "M2", "iof")
    nominal.laws = object()
    state = State(nominal, [], Survey(), 0, "iof", frozenset(), 1)
    amount = 0.1 / size
    assert not state.law_is_another(SimpleNamespace(whole=whole))
    amount = 0.7 / size  # more than any departure from a law is: another law
    assert State(copy.copy(nominal), [], Survey(), 0, "iof", frozenset(), 1).law_is_another(
        SimpleNamespace(whole=whole)
    )
    of_law, other = (
        Cause(get_effect(name)({}, Survey()), Found(name, guise, np.ones(1), np.ones(1), 9.0))
        for name in ("limb_darkening", "column_pattern")
    )
    state.causes = [of_law, other]
    assert state.law_is_another(SimpleNamespace(whole=whole)) == (adds > 1250)
    assert (state.nominal is measured) == (adds > 1250)
    assert state.causes == ([other] if adds > 1250 else [of_law, other])


def test_beside_free_gains_no_effect_of_the_law_is_visible():
    of_law = [get_effect(n) for n in effect_names() if get_effect(n).of_law]
    assert len(of_law) > 3
    assert not any(e.visible(Survey(units="dn"), frozenset()) for e in of_law)
    assert all(e.visible(Survey(units="iof"), frozenset()) for e in of_law)


def test_pieces_of_one_place_are_left_out_side_by_side(tmp_path, monkeypatch):
    """Of few places, pieces are left out one by one, on several threads at a time: none may change what the others look at."""
    with PairReader(semi_real(tmp_path / "pairs.h5", 4712, sites=2)) as reader:
        sites = [load_site(reader, np.flatnonzero(reader.site == k)) for k in np.unique(reader.site)[:2]]
        frames = len(reader.image_ids)
    nominal, changed = load_nominal(None, "M2", "iof"), set()
    with torch.no_grad():
        fit(nominal, sites, [], "iof", [s.read for s in sites], start=True)
        change = object.__setattr__
        with monkeypatch.context() as patch:
            patch.setattr(Site, "__setattr__", lambda site, name, value: (changed.add(name), change(site, name, value)))
            found = explain(sites, nominal, [], frames, 0.0)
    assert "valid" not in changed
    assert found.squares["none"].shape == (len(sites) * cuts(sites[0].image.shape[-1], len(sites)) ** 2, frames)


@pytest.mark.slow
def test_what_the_test_pairs_refuse_of_the_law_was_another_law(tmp_path):
    """Another laboratory's ground, seen obliquely: limb darkening of a half takes 17,000 nats away, and makes ground that was not learned worse."""
    path = tmp_path / "pairs.h5"
    make_case(95, Deal("b", effect="albedo_map"), 20261126, path)
    answer = diagnose.run(path).answer
    assert answer.form == "measured lunar laws"
    assert "limb_darkening" not in {c.effect.name for c in answer.causes}
