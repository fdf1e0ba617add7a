"""`lunargr render --trajectory --export`: read back with the formats' own readers, and true to the pixel."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
from conftest import ROOT
from PIL import Image, ImageSequence
from render_scene import LAT, LON, SUN, lunargr_render
from scipy.spatial.transform import Rotation

from stages.physics.cameras.pinhole import Pinhole
from stages.physics.maps.grid import read_grid, unit_vectors
from stages.render.dataset import to_quaternion
from stages.render.files import export_files
from stages.render.pictures import read_exr

TRAJECTORY = f"""view_id,longitude_deg,latitude_deg,altitude_m,look_longitude_deg,look_latitude_deg
one,{LON},{LAT},4000,{LON},{LAT}
two,{LON + 0.03},{LAT},4000,{LON},{LAT}
three,{LON},{LAT - 0.04},3500,{LON},{LAT}
"""
RADIUS = 1737400.0


def render_views(path, tmp_path, monkeypatch, capsys, kind):
    (tmp_path / "t.csv").write_text(TRAJECTORY)
    arguments = ("--trajectory", tmp_path / "t.csv", *SUN, "--size", "60,40", "--fov", "8", "--export", kind)
    code, error = lunargr_render(monkeypatch, capsys, path, *arguments, "-o", tmp_path / "views", "--quiet")
    assert code == 0, error
    return tmp_path / "views" / kind


@pytest.mark.parametrize("kind", ["colmap", "nerfstudio"])
def test_an_export_replaces_no_file_unless_told_to(hilly_map, tmp_path, monkeypatch, capsys, kind):
    target = render_views(hilly_map[0], tmp_path, monkeypatch, capsys, kind)
    files = export_files(["one", "two", "three"], target.parent, kind)
    assert sorted(files) == sorted(p for p in target.rglob("*") if p.is_file())
    arguments = ("--trajectory", tmp_path / "t.csv", *SUN, "--size", "60,40", "--fov", "8", "--export", kind)
    common = [monkeypatch, capsys, hilly_map[0], *arguments, "-o", target.parent, "--quiet", "--resume"]
    for path in files[1:]:
        path.unlink()
    files[0].write_text("somebody's own")
    code, error = lunargr_render(*common)
    assert code == 3 and "world.json: exists already; add --overwrite" in error
    assert [p for p in target.rglob("*") if p.is_file()] == files[:1] and files[0].read_text() == "somebody's own"
    assert lunargr_render(*common, "--overwrite")[0] == 0
    assert json.loads(files[0].read_text())["unit"] == "m"


def test_every_trajectory_leaves_its_cameras_and_both_exports_come_from_one_run(
    hilly_map, tmp_path, monkeypatch, capsys
):
    """The ground of each pixel, from the EXR's own longitude, latitude and depth, lies where cameras.json says."""
    target = render_views(hilly_map[0], tmp_path, monkeypatch, capsys, "colmap,nerfstudio").parent
    assert (target / "colmap" / "world.json").exists() and (target / "nerfstudio" / "transforms.json").exists()
    told = json.loads((target / "cameras.json").read_text())
    axes = np.array([told["axes_mcmf"][k] for k in ("east", "north", "up")])
    assert [view["view_id"] for view in told["views"]] == ["one", "two", "three"]
    for view in told["views"]:
        image = oiio.ImageInput.open(str(target / f"{view['view_id']}.exr"))
        header = json.loads(image.spec().getattribute("lunargr:camera"))
        image.close()
        assert header == {key: view[key] for key in header}
        seen = read_exr(target / f"{view['view_id']}.exr")
        camera = Pinhole.from_document(header, "header")
        line, sample = np.nonzero(np.isfinite(seen["depth"]))
        _, rays = camera.rays(line + 0.5, sample + 0.5)
        points = camera.centre + seen["depth"][line, sample, None] * rays
        expected = unit_vectors(*(seen[k][line, sample].astype(float) for k in ("longitude_deg", "latitude_deg")))
        away = np.linalg.norm(points - expected * np.linalg.norm(points, axis=1, keepdims=True), axis=1)
        assert away.max() < 0.3  # m: degrees are float32
        x, y, z, w = (view["quaternion_camera_to_enu_wxyz"][k] for k in (1, 2, 3, 0))
        np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).as_matrix(), axes @ camera.rotation, atol=1e-9)
        position = axes.T @ view["position_enu"] + told["origin_mcmf"]
        np.testing.assert_allclose(position, camera.centre, atol=1e-6)
        east, north, up = view["sun_direction_enu"]
        assert np.degrees(np.arctan2(east, north)) == pytest.approx(float(SUN[1]), abs=0.1)
        assert np.degrees(np.arcsin(up)) == pytest.approx(float(SUN[3]), abs=0.1)


def to_world(target, lon, lat, height):
    told = json.loads((target / "world.json").read_text())
    axes = np.array([told["axes_mcmf"][k] for k in ("east", "north", "up")])
    places = unit_vectors(lon, lat) * (RADIUS + height)[..., None]
    return (places - np.array(told["origin_mcmf"])) @ axes.T


def test_colmap_reads_the_cameras_and_every_point_lies_where_it_is_seen(hilly_map, tmp_path, monkeypatch, capsys):
    pycolmap = pytest.importorskip("pycolmap")
    target = render_views(hilly_map[0], tmp_path, monkeypatch, capsys, "colmap")
    model = pycolmap.Reconstruction(str(target / "sparse" / "0"))
    assert len(model.images) == 3 and len(model.cameras) == 1
    errors, lengths = [], []
    for point in model.points3D.values():
        lengths.append(len(point.track.elements))
        for element in point.track.elements:
            image = model.images[element.image_id]
            errors.append(image.project_point(point.xyz) - image.points2D[element.point2D_idx].xy)
    assert np.abs(errors).max() < 0.01
    assert np.mean(np.array(lengths) > 1) > 0.5  # seen in several views
    for image in model.images.values():
        assert cv2.imread(str(target / "images" / image.name)).shape == (40, 60, 3)


@pytest.mark.parametrize("distortion", [{"k1": -0.2, "k2": 0.05, "p1": 1e-3}, {"model": "fisheye", "k1": 0.1}])
def test_colmap_reads_a_distorted_camera(hilly_map, tmp_path, monkeypatch, capsys, distortion):
    pycolmap = pytest.importorskip("pycolmap")
    camera = {
        "type": "pinhole", "focal_px": 200.0, "principal_point_px": [30, 20], "size_px": [60, 40],
        "position_mcmf": [RADIUS + 5, 0, 0], "rotation_camera_to_mcmf": [0, 0, 0, 1], "distortion": distortion,
    }  # fmt: skip
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    (tmp_path / "t.csv").write_text(TRAJECTORY)
    arguments = (
        "--trajectory",
        tmp_path / "t.csv",
        *SUN,
        "--camera",
        tmp_path / "camera.json",
        "--export",
        "colmap,nerfstudio",
    )
    code, error = lunargr_render(monkeypatch, capsys, hilly_map[0], *arguments, "-o", tmp_path / "views", "--quiet")
    assert code == 0, error
    model = pycolmap.Reconstruction(str(tmp_path / "views" / "colmap" / "sparse" / "0"))
    errors = [
        model.images[e.image_id].project_point(point.xyz) - model.images[e.image_id].points2D[e.point2D_idx].xy
        for point in model.points3D.values()
        for e in point.track.elements
    ]
    assert len(model.cameras) == 1 and len(errors) > 500 and np.abs(errors).max() < 0.01
    document = json.loads((tmp_path / "views" / "nerfstudio" / "transforms.json").read_text())
    assert document["frames"][0]["k1"] == distortion["k1"]
    assert document["camera_model"] == ("OPENCV_FISHEYE" if "model" in distortion else "OPENCV")


def test_colmaps_points_lie_on_the_map(hilly_map, tmp_path, monkeypatch, capsys):
    import h5py

    target = render_views(hilly_map[0], tmp_path, monkeypatch, capsys, "colmap")
    rows = [line.split() for line in (target / "sparse/0/points3D.txt").read_text().splitlines()[1:]]
    points = np.array([row[1:4] for row in rows], float)
    with h5py.File(hilly_map[0]) as file:
        grid = read_grid(file, hilly_map[0])
    told = json.loads((target / "world.json").read_text())
    axes = np.array([told["axes_mcmf"][k] for k in ("east", "north", "up")])
    body = points @ axes + np.array(told["origin_mcmf"])
    lon = np.degrees(np.arctan2(body[:, 1], body[:, 0]))
    lat = np.degrees(np.arcsin(body[:, 2] / np.linalg.norm(body, axis=1)))
    row, col = grid.rowcol_of_lonlat(lon, lat)
    inside = (row > 1) & (col > 1) & (row < grid.height - 2) & (col < grid.width - 2)
    ground = hilly_map[2][np.rint(row[inside]).astype(int), np.rint(col[inside]).astype(int)]
    height = np.linalg.norm(body, axis=1)[inside] - RADIUS
    assert inside.sum() > 100 and np.median(np.abs(height - ground)) < 1.0


def test_nerfstudios_rays_end_on_the_ground(hilly_map, tmp_path, monkeypatch, capsys):
    target = render_views(hilly_map[0], tmp_path, monkeypatch, capsys, "nerfstudio")
    document = json.loads((target / "transforms.json").read_text())
    assert len(document["frames"]) == 3
    for frame in document["frames"]:
        depth = np.load(target / frame["depth_file_path"]) * 1e-3  # nerfstudio's depth_unit_scale_factor
        assert depth.shape == (frame["h"], frame["w"]) == (40, 60)
        name = frame["file_path"].split("/")[1].removesuffix(".png")
        planes = read_exr(target.parent / f"{name}.exr")
        # nerfstudio's pinhole: pixel centres at 0.5, y up, looking along -z
        col, row = np.meshgrid(np.arange(60) + 0.5, np.arange(40) + 0.5)
        rays = np.stack(
            [(col - frame["cx"]) / frame["fl_x"], -(row - frame["cy"]) / frame["fl_y"], -np.ones_like(col)], -1
        )
        matrix = np.array(frame["transform_matrix"])
        points = (rays * depth[..., None]) @ matrix[:3, :3].T + matrix[:3, 3]
        known = np.isfinite(planes["depth"])
        assert (depth[~known] == 0).all() and known.mean() > 0.5
        seen = to_world(target, planes["longitude_deg"], planes["latitude_deg"], np.zeros(known.shape))
        # the backplanes' places in single precision are good to half a metre
        assert np.abs(points - seen)[known][:, :2].max() < 3.0


def test_a_rotation_comes_back_from_its_quaternion(rng):
    for _ in range(50):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.sign(np.linalg.det(rotation))
        w, x, y, z = to_quaternion(rotation)
        back = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        np.testing.assert_allclose(back, rotation, atol=1e-12)


@pytest.mark.parametrize("suffix", ["webp", "mp4"])
def test_a_trajectory_becomes_a_film(hilly_map, tmp_path, monkeypatch, capsys, suffix):
    render_views(hilly_map[0], tmp_path, monkeypatch, capsys, "colmap")
    film = tmp_path / f"film.{suffix}"
    command = [sys.executable, ROOT / "examples" / "film.py", tmp_path / "views", film, "--rate", "3"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr
    if suffix == "webp":
        with Image.open(film) as opened:
            assert opened.n_frames == 3 and opened.size == (60, 40)
            frames = [np.asarray(frame.convert("L"), float) for frame in ImageSequence.Iterator(opened)]
    else:
        reader = cv2.VideoCapture(str(film))
        frames = [reader.read()[1][..., 0].astype(float) for _ in range(3)]
        assert reader.read()[0] is False
    assert np.abs(frames[0] - frames[1]).mean() > 1 and frames[0].std() > 5


def test_what_makes_no_data_set_is_one_line(hilly_map, tmp_path, monkeypatch, capsys):
    (tmp_path / "t.csv").write_text(TRAJECTORY)
    path, views = hilly_map[0], ("--trajectory", tmp_path / "t.csv", "-o", tmp_path / "v")
    for arguments, message in (
        ((*views, "--export", "ply"), "colmap, nerfstudio"),
        (("--export", "colmap", "-o", tmp_path / "o.exr"), "--trajectory"),
        ((*views, "--export", "colmap", "--png-only"), "--png-only"),
        ((*views, "--export", "colmap", "--shard", "1/2"), "--shard"),
    ):
        code, error = lunargr_render(monkeypatch, capsys, path, *SUN, *arguments)
        assert code == 3 and message in error and error.count("\n") == 1, error
