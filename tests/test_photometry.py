"""What every reflectance model must keep: gradients, finiteness, reciprocity, precision, bounds; and closed forms."""

from __future__ import annotations

import itertools
import math

import numpy as np
import photometry_oracles as oracles
import pytest
import torch
from conftest import SHARED
from orbital_angles import orbital_cosines
from photometry_samples import directions, interior, reciprocity_error

from schemas import RegistryError
from stages.physics.formation.geometry import Angles
from stages.physics.photometry import (
    evaluate,
    get_model,
    get_set,
    masked_radiance_factor,
    model_names,
    published_sets,
)
from stages.physics.photometry.hapke import coherent_backscatter, h_1981, h_2002, porosity
from stages.physics.photometry.published import find_reflectance, hapke_set
from stages.physics.photometry.quantities import (
    from_bidirectional_reflectance,
    from_brdf,
    from_reflectance_factor,
    to_bidirectional_reflectance,
    to_brdf,
    to_reflectance_factor,
)
from stages.physics.photometry.rusinkiewicz import half_difference_cosines

MODELS = model_names()
EXPECTED_NAMES = {
    *("lambert", "lommel_seeliger", "lunar_lambert", "lunar_lambert_empirical", "minnaert", "akimov", "hapke"),
    *(
        "hapke_h1981",
        "hapke_legendre",
        "lroc_empirical_2014",
        "lroc_empirical_2019",
        "M1",
        "M2",
        "M3",
        "M4",
        "M5",
        "M6",
        "kernels",
    ),
}


def test_all_models_of_the_plan_are_there():
    assert set(MODELS) >= EXPECTED_NAMES


@pytest.mark.parametrize("name", MODELS)
def test_gradcheck_in_every_parameter_and_angle(name, rng):
    model = get_model(name)
    i, e, g, _ = directions(rng, 12)
    names = [p.name for p in model.parameters]
    values = interior(model, rng, 12)
    # In units of the range between the bounds: a finite difference of 1e-6 is no small step for 1/degree^2.
    spans = [p.upper - p.lower for p in model.parameters]
    scaled = [values[n] / span for n, span in zip(names, spans, strict=True)]
    inputs = [torch.tensor(v, requires_grad=True) for v in (i, e, g, *scaled)]

    def image(i, e, g, *parameters):
        return evaluate(name, {n: x * span for n, x, span in zip(names, parameters, spans, strict=True)}, i, e, g)

    assert torch.autograd.gradcheck(image, inputs, eps=1e-6, atol=1e-7, rtol=1e-5)
    gradients = torch.autograd.grad(image(*inputs).sum(), inputs, allow_unused=True)
    dead = [n for n, x in zip(["i", "e", "g", *names], gradients, strict=True) if x is None or not x.any()]
    # models that do not look at emission or phase say so by a gradient of exactly 0; every parameter must act
    assert not set(dead) & set(names)


EDGES = [0.0, 1e-6, 1e-3, 30.0, 60.0, 89.999, 89.9999999, 90.0, 91.0, 120.0, 180.0]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("name", MODELS)
def test_finite_at_every_edge(name, dtype):
    """Values and gradients at phase 0, incidence or emission 90 deg, Sun or camera behind; parameters at their bounds."""
    model = get_model(name)
    grid = torch.tensor(list(itertools.product(EDGES, repeat=3)), dtype=dtype).deg2rad()
    for kind in ("default", "lower", "upper"):
        i, e, g = (grid[:, k].clone().requires_grad_() for k in range(3))
        p = {q.name: torch.full_like(i, getattr(q, kind)).requires_grad_() for q in model.parameters}
        value = evaluate(name, p, i, e, g)
        gradients = torch.autograd.grad(value.sum(), [i, e, g, *p.values()], allow_unused=True)
        dark = (i >= math.radians(90)) | (e >= math.radians(90))
        assert value.dtype == dtype
        assert value.isfinite().all(), kind
        assert (value[dark] == 0).all(), kind
        for what, gradient in zip(["i", "e", "g", *p], gradients, strict=True):
            if gradient is not None:
                assert gradient.isfinite().all(), (kind, what)
                assert (gradient[dark] == 0).all(), (kind, what)


@pytest.mark.parametrize("name", MODELS)
def test_finite_from_cosines_alone(name):
    """As the chain calls it: cosines of float32 that rounding pushes past 1 and triples that no directions have."""
    model = get_model(name)
    cosines = torch.tensor([-1.0000001, -1, -1e-9, 0, 1e-9, 1e-7, 1.1e-7, 1e-3, 0.5, 0.99999994, 1, 1.0000001])
    grid = torch.cartesian_prod(cosines, cosines, cosines)
    mu0, mu, cos_phase = (grid[:, k].clone().requires_grad_() for k in range(3))
    p = {q.name: torch.full_like(mu0, q.default).requires_grad_() for q in model.parameters}
    value = masked_radiance_factor(model, p, Angles(mu0, mu, cos_phase))
    gradients = torch.autograd.grad(value.sum(), [mu0, mu, cos_phase, *p.values()], allow_unused=True)
    assert value.isfinite().all()
    assert all(x.isfinite().all() for x in gradients if x is not None)


@pytest.mark.parametrize("name", MODELS)
def test_reciprocity_is_as_declared(name, rng):
    error = reciprocity_error(name, rng)
    assert error < 1e-9 if get_model(name).reciprocal else error > 1e-3


@pytest.mark.parametrize("name", MODELS)
def test_float32_keeps_its_digits(name, rng):
    """From cosines in float32, as in training, against float64: incidence and emission to 87 deg, phase over 1 deg."""
    model = get_model(name)
    i, e, g, _ = directions(rng, 20000)
    keep = g > math.radians(1)
    i, e, g = i[keep], e[keep], g[keep]
    exact = evaluate(name, {}, i, e, g)
    single = Angles(*(torch.tensor(np.cos(a), dtype=torch.float32) for a in (i, e, g)))
    parameters = {p.name: torch.tensor(p.default, dtype=torch.float32) for p in model.parameters}
    image = masked_radiance_factor(model, parameters, single)
    assert image.dtype == torch.float32
    scale = np.abs(exact) + 0.01 * np.abs(exact).max()
    error = np.abs(image.numpy() - exact) / scale
    assert np.median(error) < 1e-6
    assert error.max() < 1e-3


@pytest.mark.parametrize("name", MODELS)
def test_constrain_and_unconstrain(name, rng):
    model = get_model(name)
    raw = torch.tensor(rng.normal(0, 2, (3, len(model.parameters), 4, 5)))
    values = model.constrain(raw, 1)
    assert torch.allclose(model.unconstrain(values, 1), raw, atol=1e-6)
    if name not in ("M1", "M2", "M3", "M4", "M5", "M6"):  # those are unbounded: LeakyReLU
        for k, p in enumerate(model.parameters):
            assert ((values[:, k] >= p.lower) & (values[:, k] <= p.upper)).all()
    unpacked = model.unpack(values, 1)
    assert list(unpacked) == [p.name for p in model.parameters]
    assert all(torch.equal(unpacked[p.name], values[:, k]) for k, p in enumerate(model.parameters))


@pytest.mark.parametrize("law", ["hapke", "lunar_lambert", "akimov"])
def test_kernels_follow_lunar_laws(law, rng):
    """Least squares of the kernels to laws written elsewhere, at angles of orbital images: a few thousandths are left."""
    from hidden.laws import LAWS

    mu0, mu, cosine = orbital_cosines(rng, np.radians(rng.uniform(10, 70, 12)), 0.12, 1000)
    truth = LAWS[law](mu0, mu, cosine, 1.0)
    model = get_model("kernels")
    angles = (np.arccos(c) for c in (mu0, mu, cosine))
    i, e, g = angles
    zero = dict.fromkeys((p.name for p in model.parameters), 0.0)
    columns = np.stack([evaluate("kernels", {**zero, p.name: 1.0}, i, e, g) for p in model.parameters], 1)
    fitted = columns @ np.linalg.lstsq(columns / truth[:, None], np.ones(len(truth)), rcond=None)[0]
    assert np.sqrt(np.mean((fitted / truth - 1) ** 2)) < 0.004


@pytest.mark.parametrize("name", MODELS)
def test_defaults_lie_within_bounds_and_are_lunar(name):
    """Every default set is a plausible Moon: I/F 0.02 to 0.2 at incidence and phase 30 deg seen from above."""
    model = get_model(name)
    assert all(p.lower <= p.default <= p.upper for p in model.parameters)
    assert 0.02 < evaluate(name, {}, math.radians(30), 0.0, math.radians(30)) < 0.2


@pytest.mark.parametrize("name", [n for n in MODELS if get_model(n).linear])
def test_linear_models_are_linear(name, rng):
    i, e, g, _ = directions(rng, 50)
    one, two = interior(get_model(name), rng, 50), interior(get_model(name), rng, 50)
    both = {k: 2 * one[k] + 3 * two[k] for k in one}
    expected = 2 * evaluate(name, one, i, e, g) + 3 * evaluate(name, two, i, e, g)
    assert evaluate(name, both, i, e, g) == pytest.approx(expected, rel=1e-12)


def test_evaluate_takes_numbers_arrays_tensors_and_maps(rng):
    scalar = evaluate("hapke", {}, 0.5, 0.2, 0.4)
    assert isinstance(scalar, float)
    array = evaluate("hapke", {"w": np.full((4, 1), 0.3)}, np.full(5, 0.5), 0.2, 0.4)
    assert array.shape == (4, 5)
    assert array.dtype == np.float64
    assert np.ptp(array) == 0
    single = evaluate("hapke", {}, np.float32([0.5]), np.float32([0.2]), np.float32([0.4]))
    assert single.dtype == np.float32
    tensor = evaluate("hapke", {}, torch.tensor(0.5, dtype=torch.float64), 0.2, 0.4)
    assert isinstance(tensor, torch.Tensor)
    assert float(tensor) == scalar
    assert float(single[0]) == pytest.approx(scalar, rel=1e-5)


def test_evaluate_takes_radians_or_degrees_by_name():
    radians = evaluate("hapke", {"theta": math.radians(20)}, 0.5, 0.2, 0.4)
    assert evaluate("hapke", {"theta_deg": 20}, 0.5, 0.2, 0.4) == pytest.approx(radians, rel=1e-14)


def test_unknown_names_list_the_choices():
    with pytest.raises(RegistryError, match=r"unknown reflectance model 'hapkee'; choose one of: .*hapke"):
        evaluate("hapkee", {}, 0, 0, 0)
    with pytest.raises(RegistryError, match=r"unknown parameter of hapke 'omega'; choose one of: .*theta_deg.* w"):
        evaluate("hapke", {"omega": 0.3}, 0, 0, 0)


def test_quantities_go_there_and_back(rng):
    value, cosine = rng.uniform(0.01, 0.2, 10), rng.uniform(0.1, 1, 10)
    assert from_bidirectional_reflectance(to_bidirectional_reflectance(value)) == pytest.approx(value)
    assert from_reflectance_factor(to_reflectance_factor(value, cosine), cosine) == pytest.approx(value)
    assert from_brdf(to_brdf(value, cosine), cosine) == pytest.approx(value)
    # a perfect white Lambert surface: BRDF 1/pi, reflectance factor 1, everywhere
    white = evaluate("lambert", {"albedo": 1.0}, np.arccos(cosine), 0.0, np.arccos(cosine))
    assert to_brdf(white, cosine) == pytest.approx(np.full(10, 1 / math.pi))
    assert to_reflectance_factor(white, cosine) == pytest.approx(np.ones(10))


# closed forms of single models


def test_m6_angles_are_those_of_rusinkiewicz(rng):
    """By his own construction: the half vector turned to the pole about the normal and the binormal, in vectors."""
    i, e, g, azimuth = directions(rng, 300)
    sun = np.stack([np.sin(i), np.zeros_like(i), np.cos(i)], -1)  # the tangent x is the Sun's projection
    view = np.stack([np.sin(e) * np.cos(azimuth), np.sin(e) * np.sin(azimuth), np.cos(e)], -1)
    half = (sun + view) / np.linalg.norm(sun + view, axis=-1, keepdims=True)
    theta_h, phi_h = np.arccos(half[:, 2]), np.arctan2(half[:, 1], half[:, 0])
    turned = np.empty_like(sun)
    for k in range(len(i)):
        c, s = np.cos(-phi_h[k]), np.sin(-phi_h[k])
        about_normal = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        c, s = np.cos(-theta_h[k]), np.sin(-theta_h[k])
        about_binormal = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        turned[k] = about_binormal @ about_normal @ sun[k]
    theta_d, phi_d = np.arccos(turned[:, 2]), np.arctan2(turned[:, 1], turned[:, 0])
    computed = half_difference_cosines(Angles.from_angles(*map(torch.tensor, (i, e, g))))
    for found, angle in zip(computed, (theta_h, theta_d, phi_h, phi_d), strict=True):
        assert found.numpy() == pytest.approx(np.cos(angle), abs=1e-9)


def test_m6_at_its_singular_points():
    """Where an azimuth has no meaning its cosine is 0; seen from above the Sun's plane, both are 1."""
    angles = Angles.from_angles(*(torch.tensor(v, dtype=torch.float64) for v in ([0.0, 0.7], [0.0, 0.0], [0.0, 0.7])))
    theta_h, theta_d, phi_h, phi_d = (v.numpy() for v in half_difference_cosines(angles))
    assert theta_h == pytest.approx([1, math.cos(0.35)])
    assert theta_d == pytest.approx([1, math.cos(0.35)])
    assert phi_h == pytest.approx([0, 1], abs=1e-9)
    assert phi_d == pytest.approx([0, 1], abs=1e-9)


@pytest.mark.parametrize("eta", [1.0, 0.34])
def test_akimov_in_photometric_coordinates(rng, eta):
    phase = rng.uniform(0.01, 2.5, 400)
    longitude = rng.uniform(phase - math.pi / 2 + 0.01, math.pi / 2 - 0.01)
    latitude = rng.uniform(-1.5, 1.5, 400)
    i = np.arccos(np.cos(latitude) * np.cos(phase - longitude))
    e = np.arccos(np.cos(latitude) * np.cos(longitude))
    k = math.pi / (math.pi - phase)
    expected = (
        np.cos(phase / 2)
        * np.cos(k * (longitude - phase / 2))
        * np.cos(latitude) ** (eta * (k - 1))
        / np.cos(longitude)
    )
    assert evaluate("akimov", {"albedo": 1.0, "eta": eta}, i, e, phase) == pytest.approx(expected, rel=1e-9)


def test_akimov_is_flat_at_full_moon_and_one_at_the_mirror_point():
    angle = np.linspace(0, 1.5, 20)
    assert evaluate("akimov", {"albedo": 1.0}, angle, angle, np.zeros(20)) == pytest.approx(np.ones(20), abs=1e-6)
    assert evaluate("akimov", {"albedo": 1.0}, angle / 2, angle / 2, angle) == pytest.approx(np.ones(20), rel=1e-9)


def test_lunar_lambert_between_its_two_laws(rng):
    i, e, g, _ = directions(rng, 50)
    for share, law in ((0.0, "lambert"), (1.0, "lommel_seeliger")):
        mixed = evaluate("lunar_lambert_fixed", {"albedo": 0.3, "L": share}, i, e, g)
        assert mixed == pytest.approx(evaluate(law, {"albedo": 0.3}, i, e, g), rel=1e-12)
    zero = evaluate("lunar_lambert", {"albedo": 0.3}, 0.0, 0.0, 0.0)
    assert zero == pytest.approx(0.3)  # normal albedo


def test_lunar_lambert_never_goes_negative():
    """McEwen's cubic does, beyond 105 deg of phase."""
    i, e, g = (np.radians(v) for v in (89.0, 75.0, 164.0))
    assert evaluate("lunar_lambert_empirical", {"albedo": 1.0}, i, e, g) < 0
    assert evaluate("lunar_lambert", {"albedo": 1.0}, i, e, g) == 0


def ambartsumian(w, order=64):
    """The H function from its integral equation, 1/H = sqrt(1-w) + w/2 int H(x) x/(x + mu) dx, by iteration."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    x, weights = 0.5 * (nodes + 1), 0.5 * weights
    h = np.ones(order)
    for _ in range(500):
        h = 1 / (math.sqrt(1 - w) + w / 2 * (weights * h * x / (x + x[:, None])).sum(axis=1))
    return x, h


@pytest.mark.parametrize(("function", "limit"), [(h_1981, 0.041), (h_2002, 0.01)])
@pytest.mark.parametrize("w", [0.1, 0.4, 0.8, 0.99])
def test_h_functions_approximate_the_integral_equation(function, limit, w):
    """Hapke gives 4 % for the form of 1981 and under 1 % for that of 2002."""
    x, exact = ambartsumian(w)
    computed = function(torch.tensor(x), torch.tensor(w, dtype=torch.float64)).numpy()
    assert np.abs(computed / exact - 1).max() < limit


def test_roughness_vanishes_at_zero_slope(rng):
    i, e, g, _ = directions(rng, 200)
    mu0, mu = np.cos(i), np.cos(e)
    flat = {"w": 0.4, "b": 0.0, "c": 0.0, "Bs0": 0.0, "theta": 0.0}
    h = (h_2002(torch.tensor(x), torch.tensor(0.4, dtype=torch.float64)).numpy() for x in (mu0, mu))
    assert evaluate("hapke", flat, i, e, g) == pytest.approx(0.1 * mu0 / (mu0 + mu) * math.prod(h), rel=1e-9)
    near = evaluate("hapke", {**flat, "theta": 1e-5}, i, e, g)
    assert near == pytest.approx(evaluate("hapke", flat, i, e, g), rel=1e-4)


def test_roughness_darkens_the_terminator():
    """Hapke (1984): facets tilted away from a low Sun lie in shadow."""
    rough = [evaluate("hapke", {"theta_deg": t}, math.radians(80), 0.0, math.radians(80)) for t in (0, 10, 20, 30)]
    assert rough == sorted(rough, reverse=True)


def test_opposition_terms_at_their_limits():
    one = torch.ones((), dtype=torch.float64)
    tangent = torch.tensor([0.0, 1e-12, 1e-3, 0.00999, 0.01001, 1e6], dtype=torch.float64)
    value = coherent_backscatter(tangent, one)
    assert float(value[0]) == 1
    x = tangent[2:].numpy()
    expected = (1 - np.expm1(-x) / x) / (2 * (1 + x) ** 2)
    assert value[2:].numpy() == pytest.approx(expected, rel=1e-10)
    assert float(porosity(torch.zeros((), dtype=torch.float64))) == pytest.approx(1, abs=1e-12)
    filling = 0.5
    y = 1.209 * filling ** (2 / 3)
    assert float(porosity(one * filling)) == pytest.approx(-math.log(1 - y) / y, rel=1e-14)
    full, none = (evaluate("hapke", {"Bs0": b}, 0.0, 0.0, 0.0) for b in (1.0, 0.0))
    away = [evaluate("hapke", {"Bs0": b}, 0.7, 0.7, 1.4) for b in (1.0, 0.0)]
    assert full / none > 1.5 > 1.1 > away[0] / away[1]


@pytest.mark.parametrize("entry", published_sets(), ids=lambda s: s.name)
def test_published_sets_fit_their_models(entry):
    model = get_model(entry.model)
    assert set(entry.values) == {p.name for p in model.parameters}
    assert all(p.lower <= entry.values[p.name] <= p.upper for p in model.parameters)
    assert get_set(entry.name) is entry
    assert entry.reference
    relative = entry.values.get("albedo") == 1.0
    here = evaluate(entry.model, entry.values, math.radians(30), 0.0, math.radians(30))
    assert 0.02 < here < (1.0 if relative else 0.15)


@pytest.mark.parametrize("band", ["321", "360", "415", "566", "604", "643", "689"])
def test_sato_sets_are_the_mean_of_the_map(shared, band):
    rows = oracles.read(SHARED / "oracles" / "sato2014_hapke_map_isis_test_reduced.csv")
    rows = [r for r in rows if r["band_nm"] == band]
    weights = np.cos(np.radians(oracles.columns(rows, "center_lat_deg")[0]))
    entry = get_set(f"sato2014_{band}nm")
    for name in ("w", "b", "c", "Bs0", "hs"):
        assert entry.values[name] == pytest.approx(
            np.average(oracles.columns(rows, name)[0], weights=weights), abs=6e-6
        )
    assert math.degrees(entry.values["theta"]) == pytest.approx(float(rows[0]["theta"]), abs=1e-4)


def test_unknown_set_lists_the_choices():
    with pytest.raises(RegistryError, match=r"unknown parameter set 'sato'; choose one of: .*sato2014_643nm"):
        get_set("sato")


@pytest.mark.parametrize("name", MODELS)
def test_models_stay_on_the_device_of_their_inputs(name):
    """The meta device computes nothing, but like a GPU it refuses to meet tensors of the CPU."""
    model = get_model(name)
    angles = Angles(*(torch.empty(2, 3, 4, device="meta") for _ in range(3)))
    raw = torch.empty(2, len(model.parameters), 3, 4, device="meta", requires_grad=True)
    image = masked_radiance_factor(model, model.unpack(model.constrain(raw, 1), 1), angles)
    (gradient,) = torch.autograd.grad(image.sum(), raw)
    assert image.shape == (2, 3, 4)
    assert gradient.device.type == "meta"
    assert model.unconstrain(raw.detach(), 1).device.type == "meta"


def test_lambert_and_lommel_seeliger_in_closed_form():
    """Incidence 60 and emission 30 deg, which must not change places."""
    incidence, emission, phase = math.radians(60), math.radians(30), math.radians(90)
    lambert = evaluate("lambert", {"albedo": 0.2}, incidence, emission, phase)
    assert float(lambert) == pytest.approx(0.2 * 0.5, rel=1e-9)
    seeliger = evaluate("lommel_seeliger", {"albedo": 0.2}, incidence, emission, phase)
    assert float(seeliger) == pytest.approx(0.2 * 2 * 0.5 / (0.5 + math.sqrt(3) / 2), rel=1e-9)


def test_hapke_s_published_parameters_follow_the_wavelength_or_the_name():
    assert [hapke_set(nm).name for nm in (float("nan"), 410.0, 1000.0)] == [
        "sato2014_643nm", "sato2014_415nm", "sato2014_689nm",
    ]  # fmt: skip
    assert hapke_set(410.0, "helfenstein1987").wavelength_nm == 550
    with pytest.raises(
        RegistryError, match=r"unknown set of Hapke's parameters 'mcewen1996'; choose one of: .*sato2014_321nm"
    ):
        hapke_set(410.0, "mcewen1996")


def test_a_published_set_is_named_where_a_model_is():
    model, values = find_reflectance("sato2014_415nm")
    assert model.name == "hapke" and values == get_set("sato2014_415nm").values
    assert find_reflectance("Hapke")[1] == get_model("hapke").defaults()
    with pytest.raises(RegistryError, match=r"unknown reflectance model or parameter set 'sato'.*sato2014_643nm"):
        find_reflectance("sato")
