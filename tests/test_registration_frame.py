"""A whole map-projected image that was never orthorectified: found out against its rendering, and put right by project."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.crs import CRS
from scipy.ndimage import gaussian_filter, map_coordinates

from stages.physics.horizon.scene import SceneTerrain
from stages.physics.images.displacement import Basis, Field, relief_displacement
from stages.physics.images.register_frame import choose_blocks, register_frame, render_region
from stages.physics.images.source_images import open_source
from stages.physics.images.table import Frame
from stages.physics.maps.grid import Grid

SIZE, GSD, RADIUS = 320, 400.0, 1737400.0
CAMERA_ALTITUDE = 110000.0


def drift(row, col):
    """px (dx, dy): what the image is off by besides relief."""
    return 0.9 * np.sin(row / 90) + 1.2, -0.8 * np.cos(col / 110)


class Scene:
    def __init__(self, folder: Path, relief_share: float) -> None:
        rng = np.random.default_rng(5)
        f = np.fft.fftfreq(SIZE)
        k = np.hypot(f[:, None], f[None])
        k[0, 0] = 1
        z = np.fft.ifft2(np.fft.fft2(rng.standard_normal((SIZE, SIZE))) * k**-1.5).real
        z = gaussian_filter(z, 1.0)
        self.elevation = (z * 0.15 * GSD / np.gradient(z)[0].std()).astype(np.float32)
        half = SIZE * GSD / 2
        crs = CRS.from_proj4(f"+proj=eqc +R={RADIUS} +units=m +no_defs")
        self.grid = Grid(crs.to_wkt(), Affine(GSD, 0, -half, 0, -GSD, half), SIZE, SIZE, RADIUS)
        self.frame = Frame("A", folder / "a.tif", "dn", None, "", 62.0, 5.0, 1.0, 0.0, 0.0, CAMERA_ALTITUDE)
        self.terrain = SceneTerrain.of(self.elevation, self.grid)
        rendering, *_ = render_region(self.frame, self.elevation, self.terrain, 0, 0)
        albedo = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 2.0)
        self.truth = 20 + 500 * rendering * (1 + 0.05 * albedo / albedo.std())
        self.relief = relief_displacement(self.grid, self.frame.camera_position(RADIUS), 0.0)
        self.share = relief_share
        image = self.shown() + rng.normal(0, 1, (SIZE, SIZE))
        profile = {"driver": "GTiff", "height": SIZE, "width": SIZE, "count": 1, "dtype": "float32", "crs": crs}
        with rasterio.open(folder / "a.tif", "w", transform=self.grid.transform, **profile) as file:
            file.write(image.astype(np.float32), 1)

    def displacement(self, row, col):
        dx, dy = drift(row, col)
        if not self.share:
            return dx, dy
        height = map_coordinates(self.elevation, [row, col], order=1, mode="nearest")
        east, south = self.relief(row, col, height)
        return dx + self.share * east, dy + self.share * south

    def shown(self):
        row, col = np.mgrid[:SIZE, :SIZE].astype(float)
        r, c = row.copy(), col.copy()
        for _ in range(15):
            dx, dy = self.displacement(r, c)
            r, c = row - dy, col - dx
        return map_coordinates(self.truth, [r, c], order=3, mode="nearest")

    def open(self):
        return open_source(self.frame, self.grid, self.elevation, (0.0, 1.0))

    def register(self, form):
        row, col = (v.ravel() for v in np.mgrid[32:SIZE:64, 32:SIZE:64])
        blocks = choose_blocks(row, col, 64, self.grid)
        with self.open() as source:
            return register_frame(self.frame, source, self.terrain, blocks, form, 8.0), source.read(64, 64, 192, 192)


@pytest.mark.parametrize("share", [1.0, 0.0])
def test_a_field_and_relief_displacement_are_captured_and_taken_off(tmp_path, share):
    scene = Scene(tmp_path, share)
    (field, shifts), _ = scene.register("field")
    assert field.accepted and field.basis.form == "field" and len(shifts) == 25
    row, col = np.mgrid[40:280:8, 40:280:8].astype(float)
    dx, dy = field.at(row, col, scene.relief(row, col, map_coordinates(scene.elevation, [row, col], order=1)))
    true_dx, true_dy = scene.displacement(row, col)
    assert np.sqrt(np.mean((dx - true_dx) ** 2)) < 0.1 and np.sqrt(np.mean((dy - true_dy) ** 2)) < 0.1
    if share:
        assert field.share == pytest.approx(1.0, abs=max(0.05, 3 * field.share_error))
    else:
        assert abs(field.share) < 0.1
    part = np.s_[64:256, 64:256]
    with scene.open() as source:
        before, after = source.read(64, 64, 192, 192), source.read(64, 64, 192, 192, field)
    assert after.valid.all()
    wrong, left = (np.std(p.values - scene.truth[part]) for p in (before, after))
    assert left < 0.35 * wrong


def test_a_moved_window_is_the_image_at_the_displaced_places(tmp_path):
    """By half a pixel both ways: the mean of four neighbours, which bilinear sampling gives exactly."""
    scene = Scene(tmp_path, 0.0)
    half = Field(Basis("constant", (0.0, 0.0)), np.array([[0.5], [0.5]]), 9, 9, 0.1, 0.1, 0.9)
    with scene.open() as source:
        plain, moved = source.read(100, 100, 41, 41).values, source.read(100, 100, 40, 40, half).values
    np.testing.assert_allclose(
        moved, (plain[:-1, :-1] + plain[1:, :-1] + plain[:-1, 1:] + plain[1:, 1:]) / 4, rtol=1e-5
    )


def test_an_image_of_other_ground_is_refused(tmp_path):
    scene = Scene(tmp_path, 0.0)
    with rasterio.open(scene.frame.path, "r+") as file:
        file.write(np.random.default_rng(1).random((1, SIZE, SIZE)).astype(np.float32))
    (field, shifts), _ = scene.register("field")
    assert "regions" in field.refused and not any(s.accepted for s in shifts[:3])


def test_blocks_are_those_that_crops_touch_and_no_more_than_asked_for():
    crs = CRS.from_proj4(f"+proj=eqc +R={RADIUS} +units=m +no_defs")
    grid = Grid(crs.to_wkt(), Affine(GSD, 0, 0, 0, -GSD, 0), 1000, 700, RADIUS)
    assert choose_blocks([100], [100], 64, grid) == [
        (64, 64, 64, 64),
        (64, 128, 64, 64),
        (128, 64, 64, 64),
        (128, 128, 64, 64),
    ]
    everywhere = choose_blocks(*(v.ravel() for v in np.mgrid[32:1000:20, 32:700:20]), 64, grid)
    assert all(r + h <= 1000 and c + w <= 700 for r, c, h, w in everywhere)
    assert len(choose_blocks(*(v.ravel() for v in np.mgrid[32:1000:20, 32:700:20]), 64, grid, count=20)) == 20
