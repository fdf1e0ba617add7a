"""The renderer against Mitsuba, which was given the same heights as a triangle mesh and the same camera by its own means."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rasterio.transform import Affine
from relief import body_point, hills
from scipy.ndimage import gaussian_filter

from stages.physics.light.sun_disc import SUN_RADIUS
from stages.physics.maps.grid import Grid, local_metric_crs, unit_vectors
from stages.physics.photometry import get_model
from stages.physics.terrain.further_light import Bounce
from stages.physics.terrain.shading import Light
from stages.physics.terrain.sun import Sun, sun_from_angles
from stages.physics.terrain.sun_visibility import SunHorizon
from stages.physics.terrain.surface import Surface
from stages.render.grounds import Grounds
from stages.render.perspective import render_view
from stages.render.scene import make_scene
from stages.render.viewpoint import look_at, pinhole_view

mi = pytest.importorskip("mitsuba", reason="the test extra brings mitsuba")

RADIUS = 1737400.0
ALBEDO = 0.3
SIZE = 384
WIDTH, HEIGHT, FOV = 128, 96, 24.0


class Rows:
    """An array that looks like a raster's elevation."""

    def __init__(self, z: np.ndarray) -> None:
        self.z, self.shape, self.ndim, self.dtype = z, z.shape, 2, z.dtype

    def __getitem__(self, key):
        return self.z[key]


def lambert_surface(tmp_path, grid: Grid, z: np.ndarray) -> Surface:
    return Surface(tmp_path / "hills", grid, Rows(z), get_model("lambert"), None, np.array([ALBEDO], np.float32))


class Peer:
    """Mitsuba with the scene's mesh about the scene's centre, in pixels: its ray offsets want numbers of that size."""

    def __init__(self, grid: Grid, z: np.ndarray, path) -> None:
        mi.set_variant("scalar_rgb")
        rows, cols = (v.ravel() for v in np.indices(z.shape))
        self.centre = body_point(grid, (grid.height - 1) / 2, (grid.width - 1) / 2, 0.0)
        points = unit_vectors(*grid.lonlat(rows, cols)) * (grid.radius + z.ravel()[:, None].astype(float)) - self.centre
        self.unit = grid.gsd
        index = np.arange(z.size).reshape(z.shape)
        a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel()
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([c, b, d], 1)])
        mesh = mi.Mesh("terrain", len(points), len(faces), has_vertex_normals=True)
        params = mi.traverse(mesh)
        params["vertex_positions"] = (points / self.unit).astype(np.float32).ravel()
        params["faces"] = faces.astype(np.uint32).ravel()
        params.update()  # Mitsuba makes the vertex normals itself
        mesh.write_ply(str(path))
        bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}}
        self.mesh = mi.load_dict({"type": "ply", "filename": str(path), "bsdf": bsdf})

    def scene(self, sun: Sun) -> object:
        direction = -sun.directions(self.centre)
        light = {
            "type": "directional",
            "direction": direction.tolist(),
            "irradiance": {"type": "rgb", "value": math.pi},
        }
        return mi.load_dict({"type": "scene", "terrain": self.mesh, "sun": light})

    def image(self, sun: Sun, camera, samples: int, bounces: int = 0) -> np.ndarray:
        """I/F: radiance under an irradiance of pi, after at most so many bounces between facets."""
        eye = (camera.centre - self.centre) / self.unit
        forward, down = camera.rotation[:, 2], camera.rotation[:, 1]
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": FOV,
                "fov_axis": "x",
                "to_world": mi.ScalarTransform4f().look_at(
                    origin=eye.tolist(), target=(eye + 1000.0 * forward).tolist(), up=(-down).tolist()
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": WIDTH,
                    "height": HEIGHT,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                },
                "sampler": {"type": "stratified", "sample_count": samples},
            }
        )
        path = {"type": "path", "max_depth": 2 + bounces, "rr_depth": 100, "hide_emitters": True}
        integrator = mi.load_dict(path if bounces else {"type": "direct", "hide_emitters": True})
        return np.array(mi.render(self.scene(sun), sensor=sensor, integrator=integrator, seed=1))[..., 0]

    def depth(self, sun: Sun, camera) -> np.ndarray:
        line, sample = np.indices((HEIGHT, WIDTH)) + 0.5
        origins, directions = camera.rays(line.ravel(), sample.ravel())
        eye = mi.Point3f(*((origins[0] - self.centre) / self.unit).tolist())
        scene = self.scene(sun)
        found = [scene.ray_intersect(mi.Ray3f(eye, mi.Vector3f(*d.tolist()))).t for d in directions]
        return self.unit * np.array(found).reshape(HEIGHT, WIDTH)


# (camera's row, column, altitude in pixels; row, column that it looks at); a wide scene is as curved as the body
VIEWS = {
    "nadir": ("flat", (SIZE / 2, SIZE / 2, 500), (SIZE / 2, SIZE / 2)),
    "oblique": ("flat", (SIZE * 0.95, SIZE / 2, 240), (SIZE * 0.5, SIZE / 2)),
    "low": ("flat", (SIZE * 0.9, SIZE * 0.3, 100), (SIZE * 0.45, SIZE * 0.55)),
    "wide": ("wide", (SIZE * 1.2, SIZE / 2, 200), (SIZE * 0.4, SIZE / 2)),
}
SCENES = {"flat": (5.0, 0.3), "wide": (200.0, 0.2)}  # gsd, steepness


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Terrains and their peers, made once each."""
    result = {}
    for name, (gsd, steepness) in SCENES.items():
        crs = local_metric_crs(-20.0, 61.0, RADIUS)
        transform = Affine(gsd, 0, -SIZE * gsd / 2, 0, -gsd, SIZE * gsd / 2)
        grid = Grid(crs.to_wkt(), transform, SIZE, SIZE, RADIUS)
        z = hills(np.random.default_rng(4), SIZE, gsd, steepness)
        result[name] = grid, z, Peer(grid, z, tmp_path_factory.mktemp("peer") / f"{name}.ply")
    return result


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("sun_elevation_deg", [55.0, 18.0])
def test_views_agree_with_mitsuba(scenes, tmp_path, name, sun_elevation_deg):
    scene_name, (row, col, altitude_px), target = VIEWS[name]
    grid, z, peer = scenes[scene_name]
    place = (row, col, altitude_px * grid.gsd)
    position = body_point(grid, *place)
    camera = pinhole_view(position, look_at(position, body_point(grid, *target, 0.0)), FOV, (WIDTH, HEIGHT), RADIUS)
    sun = sun_from_angles(120.0, sun_elevation_deg, grid)
    sun = Sun(sun.position, 1e-3 * SUN_RADIUS)  # Mitsuba's Sun is a point
    surface = lambert_surface(tmp_path, grid, z)
    relief = (float(z.min()), float(z.max()))
    light = Light(sun, SunHorizon(surface.elevation, grid, sun, relief[1] - relief[0]), None)
    bands = list(render_view(surface, camera, light, make_scene(Grounds(surface), camera, light, relief, 4)))
    ours = {k: np.concatenate([b[k] for b in bands]) for k in bands[0]}
    theirs, depth = peer.image(sun, camera, 36), peer.depth(sun, camera)
    both = np.isfinite(ours["depth"]) & np.isfinite(depth)
    assert both.mean() > 0.85
    assert abs(float(ours["image"][both].mean() / theirs[both].mean()) - 1) < 0.01
    # Away from edges: no shadow boundary, no occlusion and no border of the scene within two pixels.
    uniform = np.ones(both.shape, bool)
    relative = np.nan_to_num(ours["depth"], nan=0.0)
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            moved = {
                k: np.roll(v, (dy, dx), (0, 1))
                for k, v in (("s", ours["shadow"]), ("d", relative), ("t", theirs), ("b", both))
            }
            uniform &= (moved["s"] == ours["shadow"]) & moved["b"] & ((moved["t"] > 0.002) == (theirs > 0.002))
            uniform &= np.abs(moved["d"] / np.maximum(relative, 1) - 1) < 0.06
    uniform[:2], uniform[-2:], uniform[:, :2], uniform[:, -2:] = False, False, False, False
    lit = uniform & (ours["shadow"] < 0.5)
    assert lit.sum() > 2000
    # relative to the mean: a pixel at grazing light has no level of its own
    error = np.abs(ours["image"] - theirs)[lit] / theirs[lit].mean()
    assert np.percentile(error, 99) < 0.025, np.percentile(error, [50, 90, 99, 100])
    dark = uniform & (ours["shadow"] == 1)
    if dark.any():
        assert (theirs[dark] < 0.01 * theirs[lit].mean()).mean() > 0.99
    miss = np.abs(ours["depth"] - depth)[uniform]
    assert np.percentile(miss, 99) < 0.1 * grid.gsd, np.percentile(miss, [50, 90, 99, 100])


@pytest.mark.parametrize("name", [pytest.param("nadir", marks=pytest.mark.slow), "oblique"])
def test_one_bounce_agrees_with_mitsuba(scenes, tmp_path, name):
    """What a low Sun's light adds after one bounce, in shadows and beside them, through a camera."""
    scene_name, (row, col, altitude_px), target = VIEWS[name]
    grid, z, peer = scenes[scene_name]
    position = body_point(grid, row, col, altitude_px * grid.gsd)
    camera = pinhole_view(position, look_at(position, body_point(grid, *target, 0.0)), FOV, (WIDTH, HEIGHT), RADIUS)
    sun = sun_from_angles(120.0, 18.0, grid)
    sun = Sun(sun.position, 1e-3 * SUN_RADIUS)
    surface = lambert_surface(tmp_path, grid, z)
    relief = (float(z.min()), float(z.max()))
    horizon = SunHorizon(surface.elevation, grid, sun, relief[1] - relief[0])
    images = []
    for bounce in (None, Bounce(surface, sun, horizon)):
        light = Light(sun, horizon, None, bounce=bounce)
        bands = render_view(surface, camera, light, make_scene(Grounds(surface), camera, light, relief, 2))
        images.append(np.concatenate([b["image"] for b in bands]))
    ours = images[1] - images[0]
    theirs = peer.image(sun, camera, 256, bounces=1) - peer.image(sun, camera, 256)
    inner = np.zeros(ours.shape, bool)
    inner[8:-8, 8:-8] = True
    inner &= np.isfinite(ours)
    assert theirs[inner].mean() > 0.002 * images[0][inner].mean()  # it is there to be seen
    assert ours[inner].mean() == pytest.approx(theirs[inner].mean(), rel=0.03)
    smooth = [gaussian_filter(np.where(inner, v, 0), 3)[inner] for v in (ours, theirs)]
    assert np.corrcoef(*smooth)[0, 1] > 0.98
