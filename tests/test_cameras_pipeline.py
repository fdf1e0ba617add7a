"""From a raw camera image and its camera model to pairs: what a user does who has nothing map-projected."""

from __future__ import annotations

import csv
import json
import math

import h5py
import numpy as np
import OpenImageIO as oiio
import pytest
import small_scene
from rasterio.transform import Affine
from scipy.ndimage import map_coordinates
from small_scene import LAT, LON, RADIUS, local_xy, write_raster
from typer.testing import CliRunner

from lunargr_cli.main import app
from schemas.errors import ConfigError, GeometryError, InputError, LunargrError
from stages import ingest, merge, project, sample
from stages.physics.bodies import find_body
from stages.physics.cameras import open_camera
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.ephemeris import subsolar_point
from stages.physics.frames import read_frames
from stages.physics.grid import unit_vectors
from stages.physics.labels import index_images, label_time, product_time

ALTITUDE = 120e3


def camera(east: float = 0.0, north: float = 0.0) -> Pinhole:
    """Nearly overhead; ``east`` and ``north`` metres off, pointing with it, so that the ground it sees moves by as much."""
    up = unit_vectors(LON, LAT)
    to_east = np.cross([0, 0, 1.0], up)
    to_east /= np.linalg.norm(to_east)
    shift = east * to_east + north * np.cross(up, to_east)
    return Pinhole.looking_at(up * (RADIUS + ALTITUDE) + shift, up * RADIUS + shift, math.radians(3.4), (400, 380))


def photograph(view: Pinhole, height=small_scene.height, reflect=small_scene.radiance_factor) -> np.ndarray:
    """What ``view`` sees of the small scene's closed form along the ray of each pixel's centre."""

    def height_at(longitude, latitude):
        return height(*local_xy(longitude, latitude))

    line, sample_ = np.meshgrid(np.arange(view.lines) + 0.5, np.arange(view.samples) + 0.5, indexing="ij")
    points = view.image_to_terrain(line, sample_, height_at, tolerance=0.05)
    radius = np.linalg.norm(points, axis=-1)
    x, y = local_xy(
        np.degrees(np.arctan2(points[..., 1], points[..., 0])), np.degrees(np.arcsin(points[..., 2] / radius))
    )
    return reflect(x, y).astype(np.float32)


def write_image(path, image):
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), oiio.ImageSpec(image.shape[1], image.shape[0], 1, oiio.FLOAT))
    assert output.write_image(np.ascontiguousarray(image[..., None]))
    output.close()


def write_frame(folder, view, image, **columns):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.json").write_text(json.dumps(view.to_document()))
    write_image(folder / "raw.tif", image)
    row = {
        "image_id": "RAW", "path": "raw.tif", "units": "iof", "camera": "camera.json",
        "subsolar_longitude_deg": small_scene.SUN[0], "subsolar_latitude_deg": small_scene.SUN[1], "solar_distance_au": 1.0,
    } | columns  # fmt: skip
    with (folder / "images.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, row.keys())
        writer.writeheader()
        writer.writerow(row)
    return folder / "images.csv"


def run_all(dem, images, folder, **config):
    ingest.run(dem, images, folder / "scene.h5", ingest.Config(gsd=20, crop=32), overwrite=True)
    sample.run(folder / "scene.h5", folder / "crops.h5", sample.Config(count=60, crop=32), overwrite=True)
    summary = project.run(folder / "crops.h5", folder / "pairs.h5", project.Config(**config), overwrite=True)
    return summary, folder / "pairs.h5"


@pytest.fixture(scope="module")
def raw():
    return photograph(camera())


@pytest.fixture(scope="module")
def pairs(small_files, raw, tmp_path_factory):
    folder = tmp_path_factory.mktemp("raw")
    images = write_frame(folder, camera(), raw)
    return run_all(small_files.dem, images, folder)


def truth(file, k, east=0.0):
    size = file["elevation"].shape[1]
    half = small_scene.SIZE * small_scene.GSD / 2
    col = file["col"][k] - size // 2 + np.arange(size) + 0.5
    row = file["row"][k] - size // 2 + np.arange(size) + 0.5
    x, y = np.meshgrid(col * small_scene.GSD - half + east, half - row * small_scene.GSD)
    return small_scene.radiance_factor(x, y)


def residual(path, east=0.0):
    with h5py.File(path) as file:
        found = [file["image"][k] - truth(file, k, east) for k in range(file["row"].shape[0])]
    found = np.concatenate([f[np.isfinite(f)] for f in found])
    return float(np.sqrt(np.mean(found**2)))


def test_a_raw_image_reaches_the_ground_it_shows(pairs):
    summary, path = pairs
    assert summary.valid_share > 0.99
    assert residual(path) < 0.3 * residual(path, 0.25 * small_scene.GSD)  # a quarter pixel elsewhere fits much worse
    assert residual(path) < 3e-4


def test_spacecraft_and_detector_come_from_the_camera_model(pairs):
    _, path = pairs
    view = camera()
    with h5py.File(path) as file:
        distance = np.linalg.norm(file["camera_position_enu"][...], axis=1)
        assert np.all(np.abs(distance - ALTITUDE) < 1e3)
        line, sample_ = file["detector_line"][...], file["detector_sample"][...]
        assert np.nanmin(line) > -1 and np.nanmax(line) < view.lines
        assert np.nanmin(sample_) > -1 and np.nanmax(sample_) < view.samples
        k = 0
        middle = file["elevation"].shape[1] // 2
        radius = RADIUS + float(file["elevation"][k, middle - 1 : middle + 1, middle - 1 : middle + 1].mean())
        place = unit_vectors(file["longitude_deg"][k], file["latitude_deg"][k]) * radius
        expected = view.ground_to_image(place)
        found = [v[k, middle - 1 : middle + 1, middle - 1 : middle + 1].mean() + 0.5 for v in (line, sample_)]
        np.testing.assert_allclose(found, expected, atol=0.02)
        # vertical view over gentle slopes; the Sun stands 45 deg from the vertical
        assert np.nanmax(file["emission_deg"][...]) < 30
        np.testing.assert_allclose(file["phase_deg"][...], 45, atol=3)


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
    return ground.write_dem(folder / "dem.tif"), photograph(camera(), ground.height, ground.reflect)


@pytest.mark.parametrize(
    ("kind", "command"),
    [("shift", ["--register"]), pytest.param("affine", ["--register", "affine"], marks=pytest.mark.slow)],
)
def test_a_camera_that_is_off_is_found_out_and_put_right(rough, tmp_path, kind, command):
    """The image is the true one, its camera model believes to have stood 50 m, 2.5 px, further east."""
    dem, image = rough
    right = run_all(dem, write_frame(tmp_path / "right", camera(), image), tmp_path / "right")[1]
    images = write_frame(tmp_path / "off", camera(50.0), image)
    off = run_all(dem, images, tmp_path / "off")[1]
    crops, put_right = str(tmp_path / "off/crops.h5"), str(tmp_path / "put.h5")
    found = CliRunner().invoke(app, ["project", crops, *command, "-o", put_right, "--shifts", str(tmp_path / "s.csv")])
    assert found.exit_code == 0, found.output
    with h5py.File(right) as r, h5py.File(off) as o, h5py.File(tmp_path / "put.h5") as put:
        assert put["shift_col_px"][0] == pytest.approx(2.5, abs=0.1)
        assert put["shift_row_px"][0] == pytest.approx(0.0, abs=0.1)
        assert put["shift_sigma_px"][0] < 0.25
        assert json.loads(put.attrs["config"])["register"] == kind
        # both footprints were sampled apart: ground that crops of both show must look alike again
        truth, wrong, mended = (mosaic(file) for file in (r, o, put))
        before, after = np.nanstd(wrong - truth), np.nanstd(mended - truth)
        assert np.isfinite(mended - truth).sum() > 1000
        assert after < 0.2 * before
    assert len((tmp_path / "s.csv").read_text().splitlines()) >= 5


@pytest.mark.parametrize("planted", [(4.0, -4.0), (-3.25, 2.5), (1.75, 3.6)])
def test_planted_shifts_of_four_pixels_come_back(rough, tmp_path, planted):
    """Both axes at once, whole and fractional pixels, over ground whose albedo the rendering does not know."""
    dem, image = rough
    rows, cols = np.meshgrid(np.arange(image.shape[0]), np.arange(image.shape[1]), indexing="ij")
    albedo = 1 + 0.08 * np.sin(rows / 5.3 + 0.7) * np.cos(cols / 6.1) + 0.06 * np.sin((rows + 2 * cols) / 17)
    table = write_frame(tmp_path, camera(planted[0] * 20, -planted[1] * 20), (image * albedo).astype(np.float32))
    summary, path = run_all(dem, table, tmp_path, register="shift")
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
    for row, col, image in zip(file["row"][...], file["col"][...], file["image"][...], strict=True):
        part = whole[row - half : row + half, col - half : col + half]
        part[np.isfinite(image)] = image[np.isfinite(image)]
    return whole


def test_registration_refuses_an_image_of_something_else(rough, rng, tmp_path):
    noise = rng.random((380, 400)).astype(np.float32)
    summary, path = run_all(rough[0], write_frame(tmp_path, camera(), noise), tmp_path, register="shift")
    assert "regions agree" in summary.registered[0].field.refused
    with h5py.File(path) as file:
        assert np.isnan(file["shift_col_px"][0])


def test_registration_options_are_checked(small_artefacts, tmp_path):
    for config, message in (({"register": "spline"}, "'shift' or 'affine'"), ({"max_shift": 99.0}, "1 to 32 px")):
        with pytest.raises(ConfigError, match=message):
            project.run(small_artefacts["crops"], tmp_path / "pairs.h5", project.Config(**config))


# --- what the table leaves out --------------------------------------------------------------------------------------


def test_a_time_alone_is_enough_for_the_sun(raw, tmp_path):
    empty = {"subsolar_longitude_deg": "", "subsolar_latitude_deg": "", "solar_distance_au": ""}
    frame = read_frames(write_frame(tmp_path, camera(), raw, start_time="2010-11-09T13:06:40", **empty))[0]
    expected = subsolar_point("2010-11-09T13:06:40")
    found = frame.subsolar_longitude_deg, frame.subsolar_latitude_deg, frame.solar_distance_au
    assert found == pytest.approx(tuple(expected))
    assert frame.spacecraft_altitude_m == pytest.approx(ALTITUDE)
    assert frame.spacecraft_longitude_deg == pytest.approx(LON)


def test_a_nac_product_id_is_a_time(raw, tmp_path):
    empty = {"subsolar_longitude_deg": "", "subsolar_latitude_deg": "", "solar_distance_au": ""}
    frame = read_frames(write_frame(tmp_path, camera(), raw, image_id="M143947267LE", **empty))[0]
    expected = subsolar_point("2010-11-09T13:06:40.356")
    assert frame.subsolar_longitude_deg == pytest.approx(expected.longitude_deg, abs=1e-3)


@pytest.mark.parametrize(
    ("product", "start"),
    [  # start times of the products' own labels
        ("M143947267LE", "2010-11-09T13:06:40.356"),
        ("M103595705LE", "2009-07-30T12:20:38.18"),
        ("M1181493219CE", "2015-03-20T12:19:12.019"),
    ],
)
def test_product_ids_count_the_clock(product, start):
    from stages.physics.ephemeris import utc_to_et

    assert abs(utc_to_et(product_time(product)) - utc_to_et(start)) < 1.0
    assert product_time("AS15-M-0295") is None


def test_isd_and_cube_give_everything(shared):
    import os

    cube = shared / "data/formats/M143947267L.cal.echo.crop.cub"
    rows = [{"image_id": "NAC", "path": str(cube), "camera": str(cube), "units": "iof"}]
    from stages.physics.frame_geometry import complete_row

    row = complete_row(rows[0], cube, cube, find_body("moon"), "table")
    view = open_camera(cube)
    sun = subsolar_point(row["start_time"])
    assert float(row["subsolar_longitude_deg"]) == pytest.approx(sun.longitude_deg, abs=0.01)
    assert float(row["spacecraft_altitude_m"]) == pytest.approx(
        np.linalg.norm(view.position(200.0)) - 1737400, abs=1e-3
    )
    assert os.path.exists(row["path"])


def test_the_body_must_be_the_cameras(raw, tmp_path):
    with pytest.raises(GeometryError, match=r"expected a camera at a body of 3.3895e\+06 m radius, found 1.7374e\+06"):
        read_frames(write_frame(tmp_path, camera(), raw), find_body("Mars"))


def test_labels_hold_times(tmp_path, shared):
    (tmp_path / "a.img").write_bytes(b"PDS_VERSION_ID = PDS3\r\nSTART_TIME = 2010-11-09T13:06:40.356\r\nEND\r\n")
    assert label_time(tmp_path / "a.img") == "2010-11-09T13:06:40.356"
    (tmp_path / "b.tif").write_bytes(b"II*\0")
    (tmp_path / "b.lbl").write_text(
        "PDS_VERSION_ID = PDS3\nOBJECT = IMAGE\n  LINES = 3 /* rows */\nEND_OBJECT = IMAGE\nSTART_TIME = 2009-211T12:20:38\nEND\n"
    )
    assert label_time(tmp_path / "b.tif") == "2009-211T12:20:38"
    (tmp_path / "c.xml").write_text(
        '<Product xmlns="http://pds.nasa.gov/pds4/pds/v1"><Time_Coordinates><start_date_time>2020-01-02T03:04:05Z'
        "</start_date_time></Time_Coordinates></Product>"
    )
    assert label_time(tmp_path / "c.img") == "2020-01-02T03:04:05Z"
    assert label_time(shared / "data/formats/M143947267L.cal.echo.crop.cub") == "2010-11-09T13:06:40.356"


# --- a PDS index in place of the table ------------------------------------------------------------------------------

COLUMNS = (
    ("FILE_SPECIFICATION_NAME", 40, "{:<38}"), ("PRODUCT_ID", 16, "{:<14}"), ("START_TIME", 26, "{:<24}"),
    ("SUB_SOLAR_LATITUDE", 10, "{:>10}"), ("SUB_SOLAR_LONGITUDE", 10, "{:>10}"), ("SOLAR_DISTANCE", 14, "{:>14}"),
    ("SUB_SPACECRAFT_LATITUDE", 10, "{:>10}"), ("SUB_SPACECRAFT_LONGITUDE", 10, "{:>10}"), ("SPACECRAFT_ALTITUDE", 10, "{:>10}"),
)  # fmt: skip


def write_index(folder, rows, columns=COLUMNS):
    label, start = (
        ["PDS_VERSION_ID = PDS3", '^INDEX_TABLE = "CUMINDEX.TAB"', "OBJECT = INDEX_TABLE", f"  ROWS = {len(rows)}"],
        1,
    )
    for name, width, _ in columns:
        quoted = int("<" in _)
        label += [
            "  OBJECT = COLUMN",
            f"    NAME = {name}",
            f"    START_BYTE = {start + quoted}",
            f"    BYTES = {width - 2 * quoted}",
            "  END_OBJECT = COLUMN",
        ]
        start += width + 1
    (folder / "CUMINDEX.LBL").write_text("\n".join([*label, "END_OBJECT = INDEX_TABLE", "END", ""]))
    lines = []
    for row in rows:
        cells = [
            f'"{form.format(v)}"' if "<" in form else form.format(v)
            for (_, _, form), v in zip(columns, row, strict=True)
        ]
        lines.append(",".join(cells))
    (folder / "CUMINDEX.TAB").write_text("\r\n".join(lines) + "\r\n")
    return folder / "CUMINDEX.TAB"


def test_a_cumulative_index_replaces_the_table(tmp_path):
    rows = [
        ("DATA/MAP/2010313/NAC/M143947267LE.IMG", "M143947267LE", "2010-11-09 13:06:40.356", -1.12, 143.61, 147900798.0, 35.9, 102.6, 54.47),
        ("DATA/MAP/2010313/NAC/M143947267RE.IMG", "M143947267RE", "2010-11-09 13:06:40.356", -1.12, 143.61, 147900798.0, 35.9, 102.5, 54.47),
    ]  # fmt: skip
    index = write_index(tmp_path, rows)
    write_raster(
        tmp_path / "m143947267le.cal.tif",
        np.ones((20, 20), np.float32),
        small_scene.local_crs(),
        Affine(20, 0, 0, 0, -20, 0),
    )
    for given in (index, index.with_suffix(".LBL")):
        frames = read_frames(given)
        assert [f.image_id for f in frames] == ["M143947267LE"]  # the other product's image is not there
        frame = frames[0]
        assert frame.path.name == "m143947267le.cal.tif" and frame.units == "iof"
        assert frame.spacecraft_altitude_m == pytest.approx(54470)
        assert frame.solar_distance_au == pytest.approx(0.98866, abs=1e-5)
        assert (frame.subsolar_latitude_deg, frame.subsolar_longitude_deg) == (-1.12, 143.61)


def one_pixel(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_raster(path, np.ones((4, 4), np.float32), small_scene.local_crs(), Affine(20, 0, 0, 0, -20, 0))


def test_an_index_finds_images_in_the_archives_own_tree(tmp_path):
    """LROC's paths begin at the server's root; what is not known is -9999 or N/A."""
    place = "/LRO-L-LROC-2-EDR-V1.0/LROLRC_0001/DATA/MAP/M1.tif"
    rows = [(place, "M1", "2010-11-09 13:06:40.356", -1.12, -9999.0, 147900798.0, "N/A", 102.6, 54.47)]
    for kept in ("LRO-L-LROC-2-EDR-V1.0/LROLRC_0001", "LROLRC_0001", "."):
        top = tmp_path / kept.replace("/", "_").replace(".", "here")
        volume = top / kept
        one_pixel(volume / "DATA/MAP/M1.tif")
        (volume / "INDEX").mkdir()
        columns = [("FILE_SPECIFICATION_NAME", 60, "{:<58}"), *COLUMNS[1:]]
        row = index_images(write_index(volume / "INDEX", rows, columns))[0]
        assert (volume / "INDEX" / row["path"]).resolve() == (volume / "DATA/MAP/M1.tif").resolve()
        assert float(row["subsolar_latitude_deg"]) == -1.12 and float(row["spacecraft_altitude_m"]) == 54470
        assert not {"subsolar_longitude_deg", "spacecraft_latitude_deg"} & set(row)


def test_indices_of_messenger_and_hirise_name_their_files_otherwise(tmp_path):
    """MDIS: PATH_NAME and FILE_NAME (msgrmds_2001/INDEX/CUMINDEX.LBL); HiRISE: FILE_NAME_SPECIFICATION; CTX: IMAGE_TIME."""
    one_pixel(tmp_path / "2011088/EN0209877468M.tif")
    times = ("IMAGE_TIME", 26, "{:<24}")
    split = [("PATH_NAME", 12, "{:<10}"), ("FILE_NAME", 24, "{:<22}"), ("PRODUCT_ID", 18, "{:<16}"), times]
    row = index_images(
        write_index(tmp_path, [("2011088", "EN0209877468M.tif", "EN0209877468M", "2011-03-29T09:20:03")], split)
    )[0]
    assert row["path"] == "2011088/EN0209877468M.tif" and row["start_time"] == "2011-03-29T09:20:03"
    whole = [("FILE_NAME_SPECIFICATION", 40, "{:<38}"), ("PRODUCT_ID", 18, "{:<16}")]
    row = index_images(write_index(tmp_path, [("2011088/EN0209877468M.tif", "EN0209877468M")], whole))[0]
    assert row["path"] == "2011088/EN0209877468M.tif" and row["start_time"] == ""


def test_bad_indices_get_one_clear_line(tmp_path):
    index = write_index(tmp_path, [("X.IMG", "X", "2010-01-01 00:00:00", 0, 0, 1.5e8, 0, 0, 50)])
    with pytest.raises(InputError, match="expected an image of at least one of its 1 products near it"):
        read_frames(index)
    (tmp_path / "CUMINDEX.LBL").unlink()
    with pytest.raises(InputError, match=r"expected its label 'CUMINDEX\.LBL' beside it"):
        read_frames(index)


# --- bad input ------------------------------------------------------------------------------------------------------


def test_bad_camera_images_get_one_clear_line(small_files, raw, tmp_path):
    images = write_frame(tmp_path, camera(), raw[:-1])
    cases = {"expected 380 lines x 400 samples as its camera model has, found 379 x 400": images}
    away = Pinhole.looking_at(camera().centre, camera().centre * 2, 0.05, (400, 380))
    (tmp_path / "b").mkdir()
    cases["does not touch the DEM"] = write_frame(tmp_path / "b", away, raw, **SPACECRAFT)
    (tmp_path / "c").mkdir()
    cases["no such file; expected a camera model"] = write_frame(tmp_path / "c", camera(), raw, camera="none.json")
    for message, table in cases.items():
        with pytest.raises(LunargrError, match=message) as caught:
            ingest.run(small_files.dem, table, tmp_path / "scene.h5", ingest.Config(gsd=20, crop=32))
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "scene.h5").exists()


SPACECRAFT = {"spacecraft_longitude_deg": LON, "spacecraft_latitude_deg": LAT, "spacecraft_altitude_m": ALTITUDE}


def test_shards_join_into_what_one_run_gives(rough, tmp_path):
    """Each shard registers the images it holds, by all their crops: parts agree, and the whole knows every shift."""
    dem, image = rough
    table = write_frame(tmp_path, camera(), image)
    (tmp_path / "b.json").write_text(json.dumps(camera(50.0).to_document()))
    with table.open("a", newline="") as stream:
        csv.writer(stream).writerow(["RAW2", "raw.tif", "iof", "b.json", *small_scene.SUN, 1.0])
    _, whole = run_all(dem, table, tmp_path, register="shift")
    parts = []
    for k in (0, 1):
        parts.append(tmp_path / f"part{k}.h5")
        project.run(tmp_path / "crops.h5", parts[-1], project.Config(register="shift", shard=(k, 2)))
    merge.run(parts, tmp_path / "joined.h5")
    with h5py.File(whole) as one, h5py.File(tmp_path / "joined.h5") as joined:
        for name in ("shift_col_px", "shift_row_px", "image", "detector_line", "emission_deg"):
            np.testing.assert_array_equal(joined[name][...], one[name][...])
        assert np.isfinite(one["shift_col_px"][...]).all()
        assert one["shift_col_px"][1] - one["shift_col_px"][0] == pytest.approx(2.5, abs=0.15)
