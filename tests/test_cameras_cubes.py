"""Framing cameras from ISIS cubes: Apollo Metric against USGSCSM and a real control network, others against ALE's ISDs."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from schemas.errors import InputError
from stages.physics.bodies.ephemeris import utc_to_et
from stages.physics.cameras import camera_from_document, open_camera
from stages.physics.cameras.isis_cube import Cube
from stages.physics.cameras.isis_instruments import document_of
from stages.physics.images.camera_image import open_camera_image
from stages.physics.images.labels import find_block, find_value, parse_pvl, read_label

SPICE = ("instrument_position", "sun_position", "instrument_pointing", "body_rotation")


def usgscsm(shared, table, isd):
    """(n, 11) line, sample, height, ground (3), (line, sample) back and camera (3) that USGSCSM gives for an ISD."""
    with (shared / f"oracles/usgscsm_{table}_image_ground.csv").open() as file:
        rows = [row for row in csv.reader(file) if row[0].split("~")[0] == isd]
    return np.array([[float(n or "nan") for n in row[1:]] for row in rows])


def lonlat(position):
    longitude = np.degrees(np.arctan2(position[1], position[0]))
    return longitude, np.degrees(np.arcsin(position[2] / np.linalg.norm(position)))


@pytest.mark.parametrize(
    ("number", "sun", "within"), [(297, (78.7382, 0.241), 5), (298, (78.7347, 0.241), 12), (299, (78.7311, 0.241), 34)]
)
def test_apollo_cubes_lie_where_usgscsm_puts_them(shared, number, sun, within):
    """USGSCSM ran on refitted radial terms without decentring, which is 4 to 33 m from the kernel's own distortion."""
    path = shared / f"data/apollo15_cubes/AS15-M-0{number}_crop.cub"
    camera, rows = open_camera(path), usgscsm(shared, "apollo_cubes", f"AS15-M-0{number}_crop")
    away = np.linalg.norm(camera.image_to_ground(*rows[:, :3].T) - rows[:, 3:6], axis=-1)
    assert away.max() < within and np.median(away) < 4
    np.testing.assert_allclose(camera.centre, rows[0, 8:11], atol=1e-3)
    np.testing.assert_allclose(lonlat(camera.sun), sun, atol=1e-3)
    # SPICE, which made the label, knows no leap seconds before 1972: UTC was then 0.493 s off its whole seconds
    started = utc_to_et(str(find_value(read_label(path), "StartTime")))
    assert camera.time == pytest.approx(started - 0.493, abs=1e-3)
    line, sample = np.mgrid[0:500:9j, 0:500:9j]
    back = camera.ground_to_image(camera.image_to_ground(line, sample, 1500.0))
    np.testing.assert_allclose(back, [line, sample], atol=1e-9)


def network(shared):
    """By image: its camera, the points on the ground (n, 3), and the measured (line, sample) of each, CSM pixels."""
    folder = shared / "oracles/apollo15_network"
    with (folder / "measures.csv").open() as file:
        rows = list(csv.DictReader(file))
    for image in sorted({row["image"] for row in rows}):
        label = parse_pvl((folder / f"{image}.pvl").read_text(encoding="latin-1"), image)
        tables = json.loads((folder / f"{image}.isd").read_text())
        cube = Cube(image, label, find_block(label, "NaifKeywords"), {key: tables[key] for key in SPICE})
        mine = [row for row in rows if row["image"] == image]
        points = np.array([[float(row[k]) for k in ("x_m", "y_m", "z_m")] for row in mine])
        measured = np.array([[float(row[k]) - 0.5 for k in ("line_isis", "sample_isis")] for row in mine])
        yield camera_from_document(document_of(cube), image), points, measured


def test_an_apollo_control_network_is_met(shared):
    """The labels hold the pose before the adjustment that gave the points: 0.75 km and 4.5 mrad leave half a pixel."""
    before, after = [], []
    for camera, points, measured in network(shared):

        def residual(pose, camera=camera, points=points, measured=measured):
            turned = camera.rotation @ Rotation.from_rotvec(1e-3 * pose[3:]).as_matrix()
            moved = replace(camera, centre=camera.centre + 1e3 * pose[:3], rotation=turned)
            return (np.stack(moved.ground_to_image(points), axis=-1) - measured).ravel()

        before.append(residual(np.zeros(6)).reshape(-1, 2))
        if len(points) > 100:
            pose = least_squares(residual, np.zeros(6), loss="soft_l1").x
            after.append(residual(pose).reshape(-1, 2))
            assert np.linalg.norm(pose[:3]) < 1.0 and np.linalg.norm(pose[3:]) < 5
    assert np.median(np.linalg.norm(np.concatenate(before), axis=-1)) < 40
    assert np.median(np.linalg.norm(np.concatenate(after), axis=-1)) < 0.5


# InstrumentId; what the label adds; keywords that ISIS adds to ALE's; half a pixel between ALE's centre and ISIS's
INSTRUMENTS = {
    "messmdis": ("MDIS-NAC", {"PixelBinningMode": 2, "FpuBinningMode": 0}, {"TempDependentFocalLength": 549.5535053027719}, 0),
    "dawnfc": ("FC2", {}, {"INS-203126_ITRANSS": [0.0, 71.40816909454442, 0.0], "INS-203126_ITRANSL": [0.0, 0.0, 71.40816909454442]}, 0),
    "clem_nir": ("NIR", {}, {"INS-40003_FOCAL_LENGTH": 96.1740404}, 0.5),
    "clem_hires": ("HIRES", {}, {}, 0.5),
    "f735a00": ("VISUAL_IMAGING_SUBSYSTEM_CAMERA_B", {"SpacecraftName": "VIKING_ORBITER_1"}, {}, None),
}  # fmt: skip


def cube_of(shared, name, **label):
    """The cube whose kernel keywords and SPICE tables ALE wrote, as spiceinit would leave it."""
    isd = json.loads((shared / f"oracles/ale_isds/{name}.json").read_text())
    instrument, more, keywords, _ = INSTRUMENTS[name]
    code = next(k for k in isd["naif_keywords"] if k.endswith("_ITRANSL")).split("_")[0][3:]
    axes = [isd["radii"]["semimajor"], isd["radii"]["semimajor"], isd["radii"]["semiminor"]]
    size = {"Lines": isd["image_lines"], "Samples": isd["image_samples"]}
    full = {"Dimensions": size, "InstrumentId": instrument, "NaifFrameCode": int(code)} | more | label
    known = isd["naif_keywords"] | keywords | {"BODY499_RADII": axes}
    return Cube(f"{name}.cub", full, known, {key: isd[key] for key in SPICE}), isd


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_cubes_of_other_instruments_are_the_cameras_that_ale_makes(shared, name):
    cube, isd = cube_of(shared, name)
    camera = camera_from_document(document_of(cube), name)
    rows = usgscsm(shared, "ale_isds", name)
    line, sample, height = rows[:, :3].T
    shift = INSTRUMENTS[name][3]
    if shift is None:  # ALE's centre of the Viking cameras is the image's corner
        assert camera.detector.centre == (527.5, 601.5) and "reseau" in camera.notes[0]
        camera = replace(camera, detector=replace(camera.detector, centre=(0.0, 0.0)))
        shift = 0
    # ISIS counts pixels of its kernels from 1.0, and ALE takes some of these numbers for CSM's, from 0.5
    away = np.linalg.norm(camera.image_to_ground(line - shift, sample - shift, height) - rows[:, 3:6], axis=-1)
    assert away.max() < (0.03 if name == "dawnfc" else 1e-4)  # USGSCSM's undistortion stops early
    assert camera.detector.focal_length == isd["focal_length_model"]["focal_length"]


def test_kernels_distortions_are_taken(shared):
    """Lunar Orbiter Medium, NEAR MSI, Clementine UVVIS: the formulas that ISIS's camera models state, at one place."""

    def undistorted(name, instrument, code, at, **label):
        isd = json.loads((shared / f"oracles/ale_isds/{name}.json").read_text())
        size = {"Lines": isd["image_lines"], "Samples": isd["image_samples"]}
        full = {"Dimensions": size, "InstrumentId": instrument, "NaifFrameCode": code} | label
        keywords = isd["naif_keywords"] | {"BODY301_RADII": [1737.4] * 3}
        cube = Cube(name, full, keywords, {key: isd[key] for key in SPICE})
        camera = camera_from_document(document_of(cube), name)
        f = camera.detector.focal_length
        looking = camera.detector.directions(*at)
        return looking[:2] * f / looking[2]

    x, y = 1.0, -1.5  # mm
    u = undistorted("msi", "MSI", -93001, (206 + 62.5 * 1.5, 268.5 + 62.5))
    np.testing.assert_allclose(u, np.array([x, y]) * (1 - 7e-5 * (x * x + y * y)), rtol=1e-12)
    u = undistorted("clem_uvvis", "UVVIS", -40021, (144 - 43.47826087 * 1.5, 192 + 43.47826087))
    r2, p1, p2 = x * x + y * y, 2.255006e-5, 2.108941e-5
    expected = [
        x - 2.422842e-5 * r2 * x + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y,
        y - 2.422842e-5 * r2 * y + 2 * p1 * x * y + p2 * (r2 + 2 * y * y),
    ]
    np.testing.assert_allclose(u, expected, rtol=1e-12)
    # Lunar Orbiter Medium in pixels: s = sp - dS(s), s the distance from the point of symmetry
    sample, line = np.array([7000.0, 6000.0]) - [5624.274 - 4.608, 4543.709 - 4.608]
    k, s = [23.3145, 0.9998, -17.4798], np.hypot(sample, line)
    for _ in range(40):
        n = s / 5000
        s = np.hypot(sample, line) - (k[0] * n + k[1] * n**3 + k[2] * n**5)
    places = np.array([sample, line]) * s / np.hypot(sample, line) + [-4.608, -4.608]
    where = {"BoresightLine": 4543.709, "BoresightSample": 5624.274}
    u = undistorted("lomediumcamera", "Medium Resolution Camera", -533002, (5999.5, 6999.5), **where)
    np.testing.assert_allclose(u, places * [-1, 1] / 144, atol=1e-6)


@pytest.mark.parametrize("name", ["dawnfc", "messmdis"])
def test_cropped_and_reduced_cubes_see_the_same_ground(shared, name):
    """A quarter of an image, reduced three times along lines and twice along samples."""
    whole = camera_from_document(document_of(cube_of(shared, name)[0]), name)
    lines, samples = whole.lines, whole.samples
    alpha = {
        "AlphaLines": lines, "AlphaSamples": samples, "BetaLines": 30, "BetaSamples": 50,
        "AlphaStartingLine": 100.5, "AlphaEndingLine": 190.5, "AlphaStartingSample": 200.5, "AlphaEndingSample": 300.5,
    }  # fmt: skip
    cube, _ = cube_of(shared, name, AlphaCube=alpha, Dimensions={"Lines": 30, "Samples": 50})
    part = camera_from_document(document_of(cube), name)
    line, sample = np.mgrid[0:30:7j, 0:50:7j]
    expected = whole.image_to_ground(100 + 3 * line, 200 + 2 * sample, 500.0)
    np.testing.assert_allclose(part.image_to_ground(line, sample, 500.0), expected, atol=1e-6)


def test_a_reduced_line_scanner_s_cube_sees_the_same_ground(shared):
    cube = Cube.open(shared / "data/formats/M143947267L.cal.echo.crop.cub")
    whole = camera_from_document(document_of(cube), "nac")
    group = dict(find_block(cube.label, "AlphaCube"))
    size = {"Lines": 100, "Samples": 50}
    other = {"InstrumentId": "NACL", "AlphaCube": group, "Dimensions": size}
    other |= {
        key: find_value(cube.label, key) for key in ("LineExposureDuration", "SpatialSumming", "SampleFirstPixel")
    }
    reduced = camera_from_document(document_of(replace(cube, label=other)), "nac")
    line, sample = np.mgrid[0:100:5j, 0:50:5j]
    expected = whole.image_to_ground(4 * line, 8 * sample)
    np.testing.assert_allclose(reduced.image_to_ground(line, sample), expected, atol=1e-4)
    np.testing.assert_allclose(reduced.ground_to_image(expected), [line, sample], atol=1e-4)


def test_what_a_cube_lacks_is_named(shared):
    for change, message in (
        ({"NaifFrameCode": -1}, r"expected 'INS-1_CCD_CENTER' in its NAIF keywords"),
        ({"InstrumentId": "CRISM"}, r"expected a cube of .*METRIC.* found instrument 'CRISM'"),
        ({"AlphaCube": {"AlphaLines": 3}}, r"expected numbers in its AlphaCube group"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            document_of(cube_of(shared, "dawnfc", **change)[0])
        assert "\n" not in str(caught.value)


def shaded_gld100(shared, camera):
    """(brightness, body-fixed points) of the GLD100 below a camera: Lambert's law on its own slopes, 474 m a pixel."""
    with rasterio.open(shared / "data/apollo15/gld100_64ppd.tif") as dataset:
        longitude, latitude = lonlat(camera.image_to_ground(camera.lines / 2, camera.samples / 2))
        row, col = (int(v) for v in dataset.index(longitude, latitude))
        window = rasterio.windows.Window(col - 100, row - 100, 200, 200)
        height, place = dataset.read(1, window=window).astype(float), dataset.window_transform(window)
    longitude = np.radians(place.c + (np.arange(200) + 0.5) * place.a)[None, :]
    latitude = np.radians(place.f + (np.arange(200) + 0.5) * place.e)[:, None]
    up = np.stack(
        np.broadcast_arrays(
            np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
        ),
        -1,
    )
    points = (1737400.0 + height)[..., None] * up
    normal = np.cross(np.gradient(points, axis=1), -np.gradient(points, axis=0))
    to_sun = camera.sun / np.linalg.norm(camera.sun)
    return normal @ to_sun / np.linalg.norm(normal, axis=-1), points


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_an_apollo_cube_shows_the_ground_that_its_camera_sees(shared):
    """North up and not turned; 3.1 px east and 3.3 north of 474 m: its pose, and 1.2 px of the GLD100 file against LOLA."""
    path = shared / "data/apollo15_cubes/AS15-M-0297_crop.cub"
    camera = open_camera(path)
    with rasterio.open(path) as dataset:
        image = gaussian_filter(dataset.read(1).astype(float), 1.5)
    shade, points = shaded_gld100(shared, camera)
    line, sample = camera.ground_to_image(points)

    def fine(values):
        return values - gaussian_filter(values, 12)

    def best(picture):
        seen = map_coordinates(picture, [line - 0.5, sample - 0.5], order=1, mode="nearest")
        inner, whole = np.s_[60:140, 60:140], fine(seen)
        found = {
            (dy, dx): np.corrcoef(whole[inner].ravel(), np.roll(fine(shade), (dy, dx), (0, 1))[inner].ravel())[0, 1]
            for dy in range(-8, 9)
            for dx in range(-8, 9)
        }
        return max(found.items(), key=lambda item: item[1])

    (dy, dx), correlation = best(image)
    assert correlation > 0.75 and abs(dy) <= 4 and abs(dx) <= 4
    assert best(image[::-1, ::-1])[1] < 0.3


# --- the camera of another image ------------------------------------------------------------------------------------

NAC, APOLLO = "formats/M143947267L.cal.echo.crop.cub", "apollo15_cubes/AS15-M-0297_crop.cub"


def moved_in_time(document, seconds):
    tables = {key: dict(document[key]) for key in SPICE}
    for table in tables.values():
        table["ephemeris_times"] = np.asarray(table["ephemeris_times"]) + seconds
    return document | tables | {"center_ephemeris_time": document["center_ephemeris_time"] + seconds}


def whole(document, cube):
    """What ALE made of cropped cubes: the crop's size with the first line, sample and time of the whole image."""
    if "line_scan_rate" in document:
        return moved_in_time(document, -cube.extent().corner[0] * document["line_scan_rate"][0][2])
    return document | {"starting_detector_line": 0, "starting_detector_sample": 0}


def unreduced(document, cube):
    return document | {key: 0.5 * document[key] for key in ("detector_line_summing", "detector_sample_summing")}


def later(document, cube):
    return moved_in_time(document, 25.2)


@pytest.mark.parametrize("cube", [NAC, APOLLO])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (None, ""),
        (whole, r"expected the camera of this part of the image \(AlphaCube\), found one of the whole image"),
        (unreduced, r"expected a camera that sums \S+ detector pixels to one \w+ of the cube"),
        (later, r"expected a camera of the image that began at \S+, found one \+(24|31)\.\d s from it"),
    ],
)
def test_the_camera_of_another_image_is_refused(shared, cube, change, message):
    path = shared / "data" / cube
    opened = Cube.open(path)
    document = document_of(opened)
    camera = camera_from_document(change(document, opened) if change else document, "camera.json")
    if change is None:
        with open_camera_image(path, camera, "an image") as image:
            assert (image.lines, image.samples) == (camera.lines, camera.samples)
        return
    with pytest.raises(InputError, match=message) as caught, open_camera_image(path, camera, "an image"):
        pass
    assert "\n" not in str(caught.value)
