"""Departures of the ground's law from the nominal one, against laws that were written elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hidden.laws import LAWS
from orbital_angles import orbital_cosines
from planted import semi_real

from stages.diagnose.data.sites import Site, load_site
from stages.diagnose.judge.state import Cause, State
from stages.diagnose.likelihood.columns import Guise
from stages.diagnose.likelihood.patches import cuts
from stages.diagnose.likelihood.weigh import Found
from stages.diagnose.model.laws import departures
from stages.diagnose.model.nominal import fit, load_nominal, relative_misfit
from stages.diagnose.registration.explain import explain
from stages.effects import Survey, effect_names, get_effect
from stages.pairs.reader import PairReader
from stages.physics.formation.geometry import Angles
from stages.physics.photometry import get_model

# percent of brightness, rms: what a law leaves passes for causes, since noise of so many pixels is averaged to 0.01 %
LEFT = {
    "hapke": 0.1, "hapke_rough": 0.15, "lunar_lambert": 0.1, "akimov": 0.1, "minnaert": 0.1, "lroc_2014": 0.2, "lroc_2019": 0.1,
}  # fmt: skip


@pytest.fixture(scope="module")
def angles():
    """Cosines (3, N) of rough ground in twelve orbital images."""
    return torch.from_numpy(orbital_cosines(np.random.default_rng(5), np.radians(np.linspace(10, 70, 12)), 0.15, 1500))


M2 = get_model("M2")
VECTOR = torch.tensor([p.default for p in M2.parameters]).double()


@pytest.fixture(scope="module")
def laws(angles):
    return departures(M2, VECTOR, angles[:, ::2])


def _nominal(vector, at):
    return M2.radiance_factor(M2.unpack(vector[None, :, None], dim=1), at)[0]


@pytest.mark.parametrize("name", LEFT)
def test_a_law_is_followed_with_departures_that_are_no_surprise(laws, angles, name):
    """Amounts scatter as those of measured laws do: the law is one of them, as far as brightness can tell."""
    apart = angles[:, 1::2]
    truth = LAWS[name](*apart.numpy(), 1.0)
    at = Angles(*apart.unbind(0))
    parts = laws.parts(at).double().numpy()
    basis = torch.stack([_nominal(unit, at) for unit in torch.eye(len(VECTOR)).double()]).numpy()
    a = np.concatenate([basis, parts]) / truth
    known = np.diag(np.r_[np.zeros(len(basis)), np.ones(len(parts))])  # as of many pixels with a noise of 0.3 %
    level = _nominal(VECTOR, at).mean().item() / truth.mean()  # departures are of a law of this brightness
    found = np.linalg.solve(a @ a.T * 1e5 + known, a.sum(1) * level * 1e5)
    assert 100 * np.sqrt(np.mean((found @ a / level - 1) ** 2)) < LEFT[name]
    assert np.abs(found[len(basis) :]).max() < 4
    amounts = torch.from_numpy(found[len(basis) :])
    np.testing.assert_allclose(laws.added(amounts, at).numpy(), found[len(basis) :] @ parts, rtol=1e-4, atol=1e-7)


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
    laws = departures(M2, VECTOR, torch.cat([angles, torch.from_numpy(steep)], 1))
    at = Angles(*torch.from_numpy(between).unbind(0))
    assert (laws.parts(at).abs() / _nominal(VECTOR, at).mean()).max() < 2.5


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Four places in eight images each, to be filled."""
    with PairReader(semi_real(tmp_path_factory.mktemp("film") / "pairs.h5", 4711, sites=3)) as reader:
        sites = [load_site(reader, np.flatnonzero(reader.site == k)) for k in np.unique(reader.site)]
    return sites


@pytest.mark.parametrize("name", ["linear", "hapke", "akimov"])
def test_departures_are_fitted_where_the_ground_has_another_law(places, name):
    """They take most of what the nominal law leaves of another one, and nothing of what it leaves of itself: albedo."""
    nominal, rng = load_nominal(None, "M2", "iof"), np.random.default_rng(3)
    with torch.no_grad():
        for site in places:
            angles = nominal.chain(site, []).state.angles
            cosines = [c.double().clamp(min=1e-3).numpy() for c in (angles.cos_incidence, angles.cos_emission)]
            cosg = angles.cos_phase.double().numpy()
            light = LAWS[name](*cosines, cosg, rng.normal(1, 0.01, cosg.shape[-2:]))
            site.gain, site.offset = torch.ones(site.count), torch.zeros(site.count)
            site.read = site.image = torch.as_tensor(light).float()
        fit(nominal, places, [], "iof", [s.read for s in places], start=True)
        plain = relative_misfit(nominal, places)
        nominal.open_law(places)
        fit(nominal, places, [], "iof", [s.read for s in places], law=True)
        found = relative_misfit(nominal, places)
    assert bool(nominal.amounts.any()) and found < 0.015
    assert found < 0.7 * plain if name != "linear" else found > 0.9 * plain


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
            state.causes = [
                Cause(effect, Found(guise.effect, guise, np.zeros(1), np.ones(1), 0.0), np.zeros(1), np.ones(1))
            ]
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
