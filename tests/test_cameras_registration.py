"""`lunargr project --register`: a camera model that is off by pixels is found out over rough ground, and put right."""

from __future__ import annotations

import csv
import json

import h5py
import numpy as np
import pytest
import small_scene
from rasterio.transform import Affine
from raw_frames import overhead_camera, photograph, run_all, write_frame, write_image
from scipy.ndimage import map_coordinates
from small_scene import write_raster
from typer.testing import CliRunner

from lunargr_cli.main import app
from schemas.errors import ConfigError
from schemas.packing import read
from stages import merge, project


class Rough:
    """Fractal ground, twice as fine as its DEM: relief of one wavelength only could be moved along unnoticed."""

    def __init__(self, rng: np.random.Generator, size: int = 512, spacing: float = 10.0) -> None:
        f = np.fft.fftfreq(size)
        k = np.hypot(f[:, None], f[None])
        k[0, 0] = 1
        spectrum = np.fft.fft2(rng.standard_normal((size, size))) * k**-1.7 * np.exp(-((k / 0.35) ** 4))
        spectrum[0, 0] = 0
        z = np.fft.ifft2(spectrum).real
        self.z = z * 0.12 * spacing / np.gradient(z)[0].std()
        self.half, self.spacing = size * spacing / 2, spacing
        south, east = np.gradient(self.z, spacing)
        sun = small_scene.sun_enu()
        cosine = (sun[2] - east * sun[0] + south * sun[1]) / np.sqrt(1 + east**2 + south**2)
        self.shade = 0.1 * np.clip(cosine, 0, None)

    def _at(self, values, x, y):
        col, row = (x + self.half) / self.spacing - 0.5, (self.half - y) / self.spacing - 0.5
        return map_coordinates(values, [row, col], order=1, mode="nearest")

    def height(self, x, y):
        return self._at(self.z, x, y)

    def reflect(self, x, y):
        return self._at(self.shade, x, y)

    def write_dem(self, path):
        n = self.z.shape[0] // 2
        dem = self.z.reshape(n, 2, n, 2).mean(axis=(1, 3)).astype(np.float32)
        move = Affine(2 * self.spacing, 0, -self.half, 0, -2 * self.spacing, self.half)
        return write_raster(path, dem, small_scene.local_crs(), move)


@pytest.fixture(scope="module")
def rough(tmp_path_factory):
    ground = Rough(np.random.default_rng(11))
    folder = tmp_path_factory.mktemp("rough")
    return ground.write_dem(folder / "dem.tif"), photograph(overhead_camera(), ground.height, ground.reflect)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "command"), [("constant", ["--register"]), ("affine", ["--register", "affine"])])
def test_a_camera_that_is_off_is_found_out_and_put_right(rough, tmp_path, kind, command):
    """The image is the true one, its camera model believes to have stood 50 m, 2.5 px, further east."""
    dem, image = rough
    right = run_all(dem, write_frame(tmp_path / "right", overhead_camera(), image), tmp_path / "right")[1]
    images = write_frame(tmp_path / "off", overhead_camera(50.0), image)
    off = run_all(dem, images, tmp_path / "off")[1]
    crops, put_right = str(tmp_path / "off/crops.h5"), str(tmp_path / "put.h5")
    found = CliRunner().invoke(app, ["project", crops, *command, "-o", put_right, "--shifts", str(tmp_path / "s.csv")])
    assert found.exit_code == 0, found.output
    with h5py.File(right) as r, h5py.File(off) as o, h5py.File(tmp_path / "put.h5") as put:
        assert put["shift_col_px"][0] == pytest.approx(2.5, abs=0.1)
        assert put["shift_row_px"][0] == pytest.approx(0.0, abs=0.1)
        assert put["shift_sigma_px"][0] < 0.25
        assert json.loads(put.attrs["config"])["register"] == kind
        assert put["relief_share"][0] == 0  # a known camera leaves no relief displacement
        # both footprints were sampled apart: ground that crops of both show must look alike again
        truth, wrong, mended = (mosaic(file) for file in (r, o, put))
        before, after = np.nanstd(wrong - truth), np.nanstd(mended - truth)
        assert np.isfinite(mended - truth).sum() > 1000
        assert after < 0.2 * before
    assert len((tmp_path / "s.csv").read_text().splitlines()) >= 5


@pytest.mark.parametrize(
    "planted", [(-3.25, 2.5), *(pytest.param(p, marks=pytest.mark.slow) for p in ((4.0, -4.0), (1.75, 3.6)))]
)
def test_planted_shifts_of_four_pixels_come_back(rough, tmp_path, planted):
    """Both axes at once, whole and fractional pixels, over ground whose albedo the rendering does not know."""
    dem, image = rough
    rows, cols = np.meshgrid(np.arange(image.shape[0]), np.arange(image.shape[1]), indexing="ij")
    albedo = 1 + 0.08 * np.sin(rows / 5.3 + 0.7) * np.cos(cols / 6.1) + 0.06 * np.sin((rows + 2 * cols) / 17)
    table = write_frame(
        tmp_path, overhead_camera(planted[0] * 20, -planted[1] * 20), (image * albedo).astype(np.float32)
    )
    summary, path = run_all(dem, table, tmp_path, register="constant")
    with h5py.File(path) as file:
        found = file["shift_col_px"][0], file["shift_row_px"][0]
        sigma = file["shift_sigma_px"][0]
    assert found == (pytest.approx(planted[0], abs=0.1), pytest.approx(planted[1], abs=0.1))
    assert max(abs(found[0] - planted[0]), abs(found[1] - planted[1])) < 3 * sigma < 0.6
    assert summary.registered[0].field.used >= 4


def mosaic(file):
    """The pairs' images side by side on the scene's grid, NaN where there is none."""
    whole = np.full((256, 256), np.nan)
    half = file["image"].shape[1] // 2
    for row, col, image in zip(file["row"][...], file["col"][...], read(file["image"], ...), strict=True):
        part = whole[row - half : row + half, col - half : col + half]
        part[np.isfinite(image)] = image[np.isfinite(image)]
    return whole


def test_registration_refuses_an_image_of_something_else(rough, rng, tmp_path):
    noise = rng.random((380, 400)).astype(np.float32)
    summary, path = run_all(rough[0], write_frame(tmp_path, overhead_camera(), noise), tmp_path, register="constant")
    assert "regions agree" in summary.registered[0].field.refused
    with h5py.File(path) as file:
        assert np.isnan(file["shift_col_px"][0])


def test_registration_options_are_checked(small_artefacts, tmp_path):
    for config, message in (
        ({"register": "spline"}, "'constant', 'affine' or 'field'"),
        ({"max_shift": 99.0}, "1 to 32 px"),
    ):
        with pytest.raises(ConfigError, match=message):
            project.run(small_artefacts["crops"], tmp_path / "pairs.h5", project.Config(**config))


@pytest.mark.slow
def test_shards_join_into_what_one_run_gives(rough, tmp_path):
    """Each shard registers the images it holds, by all their crops: parts agree, and the whole knows every shift."""
    dem, image = rough
    table = write_frame(tmp_path, overhead_camera(), image)
    (tmp_path / "b.json").write_text(json.dumps(overhead_camera(50.0).to_document()))
    write_image(tmp_path / "raw2.tif", image * np.float32(1.001))  # one file under two names is refused
    with table.open("a", newline="") as stream:
        csv.writer(stream).writerow(["RAW2", "raw2.tif", "iof", "b.json", *small_scene.SUN, 1.0])
    _, whole = run_all(dem, table, tmp_path, register="constant")
    parts = []
    for k in (0, 1):
        parts.append(tmp_path / f"part{k}.h5")
        project.run(tmp_path / "crops.h5", parts[-1], project.Config(register="constant", shard=(k, 2)))
    merge.run(parts, tmp_path / "joined.h5")
    with h5py.File(whole) as one, h5py.File(tmp_path / "joined.h5") as joined:
        for name in ("shift_col_px", "shift_row_px", "image", "detector_line", "emission_deg"):
            np.testing.assert_array_equal(joined[name][...], one[name][...])
        assert np.isfinite(one["shift_col_px"][...]).all()
        assert one["shift_col_px"][1] - one["shift_col_px"][0] == pytest.approx(2.5, abs=0.15)
