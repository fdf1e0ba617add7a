"""Light besides the Sun's in renderings: one bounce and earthshine, against closed forms, in maps and camera views."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from relief import hills, metric_grid
from render_scene import LAT, LON, lunargr_render, write_dem

from schemas.files.outputs import Output
from stages import render
from stages.effects import get_effect
from stages.physics.bodies.ephemeris import earth_position
from stages.physics.formation.chain import Observation, form
from stages.physics.horizon import make_overview
from stages.physics.light.earth import EARTH_DISTANCE, earth_irradiance
from stages.physics.light.sky import Surroundings, terrain_light
from stages.physics.maps.window import Window
from stages.physics.photometry import get_model
from stages.physics.terrain.further_light import Bounce
from stages.physics.terrain.sun import sun_from_angles
from stages.physics.terrain.surface import Surface
from stages.render.pictures import read_exr

GSD, ALBEDO = 5.0, 0.3
SUN = {"sun_azimuth_deg": 90.0, "sun_elevation_deg": 20.0}
LAMBERT = {"model": "lambert", "parameters": {"albedo": ALBEDO}, "terrain_only": True}
OVERHEAD = {"view": "pinhole", "position": (LON, LAT, 5000.0), "fov_deg": 5.0, "size_px": (32, 32)}  # 4.4 m a pixel


def bowl(n=200, radius=420.0, rim=300.0):
    """A spherical crater in a plain, and the distance from its middle."""
    row, col = np.mgrid[:n, :n] - (n - 1) / 2
    away = np.hypot(row, col) * GSD
    level = math.sqrt(radius**2 - rim**2)
    z = np.where(away < rim, level - np.sqrt(np.maximum(radius**2 - away**2, 0)), 0).astype(np.float32)
    return z, away


@pytest.fixture(scope="module")
def crater(tmp_path_factory):
    z, away = bowl()
    return write_dem(tmp_path_factory.mktemp("crater") / "dem.tif", metric_grid(*z.shape, GSD, LON, LAT), z), away


def added(source, folder, more, **config):
    """What ``more`` adds to the image of the same view without it, and that view's channels."""
    images = []
    for name, extra in (("plain", {}), ("more", more)):
        output = Output(folder / f"{name}.exr", overwrite=True)
        render.run(source, output, render.Config(**SUN, **LAMBERT, **config, **extra))
        images.append(read_exr(folder / f"{name}.exr"))
    return images[1]["image"] - images[0]["image"], images[1]


def test_one_bounce_in_a_spherical_crater_is_buhls(crater, tmp_path):
    """Every facet of the bowl, lit or dark, receives the sunlight that enters over the sphere's surface (Buhl et al. 1968).

    Through the mouth, pi rim^2, comes sin(e) per area; 4 pi R^2 of sphere share it: albedo sin(e) (rim / 2R)^2.
    """
    dem, away = crater
    light, channels = added(dem, tmp_path, {"bounce": True})
    expected = ALBEDO**2 * math.sin(math.radians(20)) * (300 / (2 * 420)) ** 2
    inside = away < 250
    assert (channels["shadow"][inside] > 0.99).mean() > 0.3  # most of it where the Sun does not reach
    assert light[inside].mean() == pytest.approx(expected, rel=0.03)
    assert np.abs(light[inside] / expected - 1).max() < 0.06
    assert np.abs(light[away > 420]).max() < 0.02 * expected
    level = 1 - (420 - math.sqrt(420**2 - 300**2)) / (2 * 420)
    assert channels["sky_view"][inside].mean() == pytest.approx(level, abs=0.005)


def test_light_that_diagnose_looks_for_is_buhls_wherever_the_camera_stands():
    """Of a law that is brighter towards the Sun, between facets as bright as at 30 deg; explaining a measurement, in the dark alone."""
    z, away = bowl(n=192, radius=400.0, rim=300.0)
    sun = torch.tensor([[math.cos(math.radians(20)), 0.0, math.sin(math.radians(20))]] * 2)
    cameras = torch.tensor([[1e7, 0.0, 1e7], [-1e7, 0.0, 1e7]])
    ground = torch.from_numpy(z)[None].expand(2, -1, -1).contiguous()
    # the rim's circle as seen from inside: the Sun is hidden where the mouth is left before the sphere
    row, col = np.mgrid[:192, :192] - 95.5
    top = np.sqrt(np.maximum(300.0**2 - (row * GSD) ** 2, 0)) - col * GSD
    horizon = np.where(away < 300, np.arctan2(-z, np.maximum(top, 1e-3)), -1.0)
    scene = Observation(ground, sun, cameras, GSD, 1e9, torch.from_numpy(horizon).float()[None].expand(2, -1, -1))
    model = get_model("M2")
    coefficients = torch.tensor([0.2, 0.1, 0.0])[None, :, None, None]
    effect = get_effect("interreflection")({"strength": 1.0})
    light = form(scene, model, coefficients, [effect]) - form(scene, model, coefficients)
    albedo = (0.2 * math.cos(math.radians(30)) + 0.1 * math.cos(math.radians(30))) / math.cos(math.radians(30))
    expected = albedo**2 * math.sin(math.radians(20)) * (300 / (2 * 400)) ** 2
    inside = torch.from_numpy(away < 240)
    torch.testing.assert_close(light[0], light[1], atol=1e-7, rtol=0)
    assert float(light[0][inside].mean()) == pytest.approx(expected, rel=0.1)  # of cells of 15 m


def test_a_camera_sees_the_bounce_that_the_map_shows(crater, tmp_path):
    dem, _ = crater
    light, _ = added(dem, tmp_path, {"bounce": True}, **OVERHEAD)
    expected = ALBEDO**2 * math.sin(math.radians(20)) * (300 / (2 * 420)) ** 2
    assert light.mean() == pytest.approx(expected, rel=0.03)


def test_level_and_evenly_sloping_ground_light_nothing(tmp_path):
    row, col = np.mgrid[:90, :110]
    for name, z in (("level", 0 * row), ("slope", (0.2 * col - 0.1 * row) * GSD)):
        dem = write_dem(tmp_path / f"{name}.tif", metric_grid(90, 110, GSD, LON, LAT), z.astype(np.float32))
        light, channels = added(dem, tmp_path, {"bounce": True})
        assert np.abs(light[3:-3, 3:-3]).max() < 1e-7
        assert np.abs(channels["sky_view"][3:-3, 3:-3] - 1).max() < 1e-3


def test_far_terrain_as_means_gives_the_light_of_every_pixel(rng):
    z = hills(rng, 512, GSD, 0.4)
    bright = (0.1 + 0.05 * np.sin(np.arange(512) / 15.0)[:, None] + 0 * z).astype(np.float32)
    part = Window(200, 180, 64, 96)
    whole, sky = terrain_light(z, bright, GSD, inner=part, body_radius=1737400.0)
    means = make_overview(z, 2), make_overview(bright, 2)
    around = part.padded(Surroundings.margin_px(means[0]), z.shape)
    assert around.height < 256
    found, free = terrain_light(
        z[around.part], bright[around.part], GSD, inner=part.within(around), body_radius=1737400.0,
        surroundings=Surroundings(*means, around.row, around.col),
    )  # fmt: skip
    assert found.mean() == pytest.approx(whole.mean(), rel=0.01)
    assert np.sqrt(((found - whole) ** 2).mean()) < 0.05 * whole.mean()
    assert np.abs(free - sky).max() < 0.01


class Counting:
    """An elevation that notes the largest window read of it."""

    def __init__(self, z: np.ndarray) -> None:
        self.z, self.shape, self.ndim, self.dtype, self.largest = z, z.shape, 2, z.dtype, 0

    def __getitem__(self, key):
        part = self.z[key]
        self.largest = max(self.largest, part.size)
        return part


def test_a_bounce_reads_windows_of_the_map_and_never_all_of_it(rng, tmp_path):
    z = Counting(hills(rng, 640, GSD))
    grid = metric_grid(640, 640, GSD, LON, LAT)
    surface = Surface(tmp_path, grid, z, get_model("lambert"), None, np.array([ALBEDO], np.float32))  # type: ignore[arg-type]
    bounce = Bounce(surface, sun_from_angles(90.0, 20.0, grid), None)
    assert z.largest <= 258 * 640  # one band of rows at a time for the means
    z.largest = 0
    light, sky = bounce.window(300, 280, 40, 50)
    assert light.shape == sky.shape == (40, 50) and (light > 0).any()
    margin = 2 * 32 + 1  # of cells of two pixels, and one more for slopes
    assert z.largest <= (40 + 2 * margin) * (50 + 2 * margin)


@pytest.mark.parametrize("view", [{}, OVERHEAD])
def test_extended_models_get_the_same_further_light(crater, tmp_path, monkeypatch, view):
    """Light that bounces goes through the extended chain, before what the sensor does to it."""

    class Half:
        slot = "sensor"

        def apply(self, state) -> None:
            state.image = 0.5 * state.image

    dem, _ = crater
    more = {"bounce": True, "earthshine": True, "earth_azimuth_deg": 0.0, "earth_elevation_deg": 60.0}
    light, _ = added(dem, tmp_path, more, **view)
    monkeypatch.setattr("stages.effects.load_extension", lambda *_: [Half()])
    halved, _ = added(dem, tmp_path, more, **view, extend=str(dem))
    known = np.isfinite(light) & np.isfinite(halved)
    assert known.mean() > 0.9
    assert halved[known].mean() == pytest.approx(0.5 * light[known].mean(), rel=0.02)


@pytest.mark.parametrize("view", [{}, OVERHEAD])
def test_earthshine_is_lamberts_law_for_the_earth(crater, tmp_path, view):
    """Level ground: irradiance times sin(elevation); the bowl's shadow of the Earth stays dark."""
    dem, away = crater
    earth = {"earthshine": True, "earth_azimuth_deg": 270.0, "earth_elevation_deg": 25.0}
    light, _ = added(dem, tmp_path, earth, **view)
    # the Sun in the east, the Earth in the west, 45 deg apart from opposite: Sun-Earth-Moon is 180 - 135 deg
    expected = ALBEDO * float(earth_irradiance(math.radians(45), EARTH_DISTANCE)) * math.sin(math.radians(25))
    if view:
        assert 0 < light.mean() < 3 * expected
        return
    assert np.median(light[away > 420]) == pytest.approx(expected, rel=2e-3)
    west = np.abs(np.mgrid[:200, :200][0] - 99.5) < 5
    west &= np.abs(np.mgrid[:200, :200][1] - 45) < 2  # the foot of the western wall
    assert np.abs(light[west]).max() < 1e-9


def test_the_earth_shines_alone_by_night(crater, tmp_path):
    dem, away = crater
    config = render.Config(
        **LAMBERT, subsolar_longitude_deg=138.0, subsolar_latitude_deg=-17.0, earthshine=True, earth_azimuth_deg=90.0,
        earth_elevation_deg=45.0,
    )  # fmt: skip
    render.run(dem, tmp_path / "night.exr", config)
    found = read_exr(tmp_path / "night.exr")
    assert (found["shadow"] == 1).all()
    level = found["image"][away > 420]
    assert 1e-6 < np.median(level) < 1e-4
    assert np.ptp(level) < 0.01 * np.median(level)


def test_the_earths_place_is_meeus():
    """Astronomical Algorithms (1998), examples 47.a and 53.a: 1992 April 12, 0 h TD."""
    place = earth_position("1992-04-11T23:59:01")
    distance = np.linalg.norm(place)
    assert distance == pytest.approx(368409.7e3, rel=2e-4)
    assert math.degrees(math.atan2(place[1], place[0])) == pytest.approx(-1.23, abs=0.05)
    assert math.degrees(math.asin(place[2] / distance)) == pytest.approx(4.20, abs=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--earthshine",), "expected --time, or --earth-azimuth"),
        (("--earth-azimuth", "3"), "expected --earthshine with both"),
        (("--earthshine", "--earth-azimuth", "3"), "expected --earthshine with both"),
        (("--earthshine", "--earth-azimuth", "3", "--earth-elevation", "-20"), "Earth is below the horizon"),
        (("--earthshine", "--earth-azimuth", "3", "--earth-elevation", "95"), "degrees in -90..90"),
        (("--earthshine", "--body", "1737400"), "expected the Moon"),
    ],
)
def test_an_earth_that_cannot_shine_is_one_line(crater, tmp_path, monkeypatch, capsys, options, message):
    code, error = lunargr_render(
        monkeypatch, capsys, "--dem", crater[0], "--model", "lambert", "--sun-azimuth", "90", "--sun-elevation", "20",
        *options, "-o", tmp_path / "o.exr",
    )  # fmt: skip
    assert code == 3 and message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_command_line_reaches_both(crater, tmp_path, monkeypatch, capsys):
    code, error = lunargr_render(
        monkeypatch, capsys, "--dem", crater[0], "--model", "lambert", "--time", "2011-03-12T00:00:00", "--bounce",
        "--earthshine", "--quiet", "-o", tmp_path / "o.exr",
    )  # fmt: skip
    assert (code, error) == (0, "")
    assert "sky_view" in read_exr(tmp_path / "o.exr")
