"""Reflectance models against numbers that nobody here wrote: ISIS, ASP, GIANT, LROC and the reference implementation."""

from __future__ import annotations

import json

import numpy as np
import photometry_oracles as oracles
import pytest
import torch
from conftest import SHARED

from stages.physics.formation import geometry
from stages.physics.formation.geometry import Angles
from stages.physics.photometry import evaluate, get_model, masked_radiance_factor

TOLERANCE = 1e-6
FOLDER = SHARED / "oracles"
ABSENT = [
    pytest.param(None, marks=pytest.mark.skip(reason=f"no tables of other programs at {FOLDER}: set LUNARGR_SHARED"))
]


def _comparisons():
    if not FOLDER.is_dir():
        return ABSENT
    return [
        pytest.param(c, id=f"{c.table.removesuffix('.csv')}: {c.case}")
        for table in oracles.TABLES.values()
        for c in table(FOLDER)
    ]


@pytest.mark.parametrize("comparison", _comparisons())
def test_agrees_with_the_table(comparison):
    worst = int(np.argmax(comparison.relative_error))
    assert comparison.worst <= TOLERANCE, (
        f"{comparison.case}: row {worst} expected {comparison.expected[worst]}, computed {comparison.computed[worst]}"
    )


def test_every_row_of_the_tables_is_compared(shared):
    rows = {name: len(oracles.read(FOLDER / name)) for name in oracles.TABLES}
    compared = {name: sum(len(c.expected) for c in table(FOLDER)) for name, table in oracles.TABLES.items()}
    left_out = {
        "isis_photometry_truth.csv": 9,  # with an atmosphere
        "giant_illumination_dense_grid.csv": 240,  # Ashikhmin-Shirley: examples/new_reflectance_model.py
        "lunar_g2r_material_grid.csv": 1,  # lost to rounding
    }
    for name, count in rows.items():
        factor = 2 if name.startswith("lroc") else 1  # two laws per row
        assert compared[name] == factor * count - left_out.get(name, 0), name


@pytest.mark.parametrize("quantity", ["average", "standard_deviation", "minimum", "maximum", "sum", "valid_pixels"])
def test_lrowacphomap_through_the_sato_map(shared, quantity):
    """ISIS' own statistics hold for the bands that ISIS mixed up, and not for the band of the image."""
    expected, as_isis, right_band = oracles.lrowacphomap(FOLDER)
    assert as_isis[quantity] == pytest.approx(expected[quantity], rel=TOLERANCE)
    if quantity == "average":
        assert right_band[quantity] == pytest.approx(165.385, abs=5e-4)  # as the table's warning says


def test_lrowacphomap_parameters_are_those_of_the_map(shared):
    """The map as a table and the record of the test's single cell are the same numbers."""
    expected = json.loads((FOLDER / "isis_lrowacphomap_expected.json").read_text())["params_at_cell_5_3"]
    cells = oracles.groups(
        oracles.read(FOLDER / "sato2014_hapke_map_isis_test_reduced.csv"), "band_nm", "cell_sample", "cell_line"
    )
    for band, values in expected.items():
        assert {k: float(cells[band, "5", "3"][0][k]) for k in values} == pytest.approx(values)


GIANT = ["LambertianIllumination", "LommelSeeligerIllumination", "McEwenIllumination", "GaskellIllumination"]


@pytest.mark.parametrize("name", GIANT)
def test_derivatives_to_slope_and_albedo_agree_with_giant(shared, name):
    """Autograd through slopes, angles and reflectance against GIANT's own Jacobian, differentiated numerically there.

    GIANT's Sun stands towards -x at azimuth 0, its camera turns with the azimuth column.
    """
    rows = [r for r in oracles.read(FOLDER / "giant_illumination_dense_grid.csv") if r["model"] == name]
    values = json.loads(rows[0]["params_json"])
    i, e, phase = oracles.angles(rows)
    azimuth = np.radians(oracles.columns(rows, "azimuth_deg")[0])
    sun = torch.tensor(np.stack([-np.sin(i), np.zeros_like(i), np.cos(i)], axis=1))
    view = tuple(
        torch.tensor(v)[:, None, None] for v in (-np.sin(e) * np.cos(azimuth), -np.sin(e) * np.sin(azimuth), np.cos(e))
    )
    slopes = torch.zeros(2, len(rows), 1, 1, dtype=torch.float64, requires_grad=True)
    albedo = torch.full((len(rows), 1, 1), values["albedo"], dtype=torch.float64, requires_grad=True)
    model, parameters = oracles.giant_parameters(name, 1.0, np.degrees(phase))
    tensors = {k: torch.as_tensor(np.broadcast_to(v, i.shape).copy())[:, None, None] for k, v in parameters.items()}
    tensors["albedo"] = tensors["albedo"] * albedo
    angles = geometry.photometric_angles(slopes[0], slopes[1], sun, view)
    image = masked_radiance_factor(get_model(model), tensors, angles)
    by_slope, by_albedo = torch.autograd.grad(image.sum(), (slopes, albedo))
    computed = np.stack([by_slope[0].numpy().ravel(), by_slope[1].numpy().ravel(), by_albedo.numpy().ravel()])
    expected = np.stack(oracles.columns(rows, "dI_dhx", "dI_dhy", "dI_dalbedo"))
    # GIANT's Jacobian comes from finite differences of 1e-6 or so, printed to 12 digits
    assert np.abs(computed - expected).max() < 2e-6


def _hillshade():
    if not FOLDER.is_dir():
        return ABSENT
    return [pytest.param(r, id=r["case"]) for r in oracles.read(FOLDER / "isis_hillshade_truth.csv")]


@pytest.mark.parametrize("row", _hillshade())
def test_lambert_shading_agrees_with_isis_hillshade(row):
    """ISIS divides the difference of rows two apart by ONE pixel: its slopes are twice the true ones.

    At half its pixel size our true slopes are its slopes; all its cases tilt along columns only.
    """
    z = torch.tensor([float(row[f"z{r}{c}"]) for r in range(3) for c in range(3)], dtype=torch.float64).view(1, 3, 3)
    azimuth, zenith = np.radians(float(row["azimuth_deg"])), np.radians(float(row["sun_zenith_deg"]))
    sun = torch.tensor([[np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)]])
    flat = torch.zeros_like(z)
    up = (flat, flat, flat + 1)
    expected = float(row["expected_shade"])

    def shade(gsd: float) -> Angles:
        return geometry.photometric_angles(*geometry.slopes(z, gsd), sun, up)

    resolution = float(row["resolution_m"])
    at_half = shade(resolution / 2)
    assert float(at_half.cos_incidence[0, 1, 1]) == pytest.approx(expected, abs=5e-9)
    lit = masked_radiance_factor(get_model("lambert"), {"albedo": torch.ones(1)}, at_half)
    assert float(lit[0, 1, 1]) == pytest.approx(max(expected, 0.0), abs=5e-9)
    if row["case"] == "tilted towards sun":  # what it should have said: a slope of 1/3, 18.4 deg
        assert float(shade(resolution).cos_incidence[0, 1, 1]) == pytest.approx(np.cos(np.pi / 4 - np.arctan(1 / 3)))


def test_lroc_2019_gives_the_value_in_the_comment_of_its_test(shared):
    """isis/tests/FunctionalTestsLronacpho.cpp notes 0.087598 for (30, 0, 30)."""
    assert evaluate("lroc_empirical_2019", {}, np.radians(30), 0.0, np.radians(30)) == pytest.approx(0.087598, abs=5e-7)
