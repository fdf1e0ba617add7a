"""`lunargr render` with bad input, interrupted and out of space: one clear line, and nothing half-written."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest
from rasterio.transform import Affine
from render_scene import LAT, LON, SUN, lunargr_render, write_dem

from stages import render
from stages.render import ortho

BAD = [
    ((*SUN[:2], "--sun-elevation", "-5"), "below the horizon"),
    (("--subsolar-longitude", "138", "--subsolar-latitude", "-17"), "below the horizon everywhere"),
    ((), "--sun-azimuth"),
    ((*SUN, "--time", "2010-11-09"), "more than one"),
    ((*SUN[:2],), "--sun-elevation"),
    ((*SUN, "--view", "pinhole"), "--position"),
    ((*SUN, "--view", "pinhole", "--position", f"{LON},{LAT},-500"), "under the ground"),
    ((*SUN, "--view", "pinhole", "--position", "10,10,5000"), "misses svbrdf.h5"),
    ((*SUN, "--view", "pinhole", "--position", f"{LON},{LAT},5000", "--look-at", "100,0"), "does not see|misses"),
    ((*SUN, "--view", "pinhole", "--position", f"{LON},{LAT},5000", "--quaternion", "1,1,0,0"), "unit length"),
    ((*SUN, "--view", "pinhole", "--position", f"{LON},{LAT}"), "3 numbers"),
    ((*SUN, "--view", "pinhole", "--position", f"{LON},{LAT},5000", "--fov", "200"), "--fov"),
    ((*SUN, "--size", "0,10", "--view", "pinhole", "--position", f"{LON},{LAT},5000"), "--size"),
    ((*SUN, "--view", "fisheye"), "ortho, pinhole"),
    ((*SUN, "--quaternion", "0,0,0,0"), "--position"),  # a camera's options imply its view
    ((*SUN, "--look-at", f"{LON},{LAT}"), "--position"),
    ((*SUN, "--view", "ortho", "--fov", "30"), "--fov.* --view ortho"),
    ((*SUN, "--samples", "3"), "--samples.* --view ortho"),
    ((*SUN, "--view", "ortho", "--camera", "svbrdf.h5"), "--camera: expected without --view ortho"),
    ((*SUN, "--camera", "svbrdf.h5", "--size", "8,8"), "--size.* --camera"),
    ((*SUN, "--position", f"{LON},{LAT},5000", "--fov", "30", "--backplanes"), "--backplanes.* --view pinhole"),
    ((*SUN, "--png-only"), "--png-only.* --view ortho"),
    ((*SUN, "--convergence", "5,9"), "--convergence.* --stereo"),
    ((*SUN, "--quaternion", "1,0,0,0", "--trajectory", "svbrdf.h5", "-o", "views"), "--quaternion.* a trajectory"),
    ((*SUN, "--model", "hapke"), "--dem"),
    ((*SUN, "-o", "out.jpg"), ".exr, .tif or .png"),
    ((*SUN, "--camera", "missing.json"), "no such file"),
    ((*SUN, "--trajectory", "missing.csv", "-o", "views"), "no such file"),
    ((*SUN, "--samples", "99"), "--samples"),
    ((*SUN, "--shard", "1/2"), "--trajectory"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_bad_input_is_one_clear_line(hilly_map, tmp_path, monkeypatch, capsys, arguments, message):
    path, *_ = hilly_map
    monkeypatch.chdir(tmp_path)
    output = () if "-o" in arguments else ("-o", "out.exr")
    code, error = lunargr_render(monkeypatch, capsys, path, *arguments, *output, "--quiet")
    assert code == 3
    assert error.count("\n") == 1 and re.search(message, error), error
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == ["svbrdf.h5"]


def test_options_of_a_camera_imply_its_view(hilly_map, tmp_path, monkeypatch, capsys):
    path, *_ = hilly_map
    monkeypatch.chdir(tmp_path)
    asked = (*SUN, "--position", f"{LON},{LAT},5000", "--fov", "30", "--size", "16,12", "--quiet")
    for name, view in (("implied", ()), ("named", ("--view", "pinhole"))):
        assert lunargr_render(monkeypatch, capsys, path, *asked, *view, "-o", f"{name}.png")[0] == 0
    assert (tmp_path / "implied.png").read_bytes() == (tmp_path / "named.png").read_bytes()


def test_files_that_cannot_be_rendered(rng, hilly_map, tmp_path, monkeypatch, capsys):
    path, grid, elevation, _ = hilly_map
    degrees = write_dem(
        tmp_path / "degrees.tif",
        grid,
        elevation,
        crs="+proj=longlat +R=1737400",
        transform=Affine(0.01, 0, 10, 0, -0.01, 20),
    )
    empty = write_dem(tmp_path / "empty.tif", grid, np.full_like(elevation, np.nan))
    mars = write_dem(tmp_path / "mars.tif", grid, elevation, crs="+proj=stere +lat_0=10 +lon_0=20 +R=3389500")
    (tmp_path / "text.h5").write_text("not HDF5")
    out = ("-o", tmp_path / "o.exr", "--quiet")
    for arguments, message in (
        ((path, "--dem", degrees), "one of the two"),
        (("--dem", degrees), "lunargr ingest"),
        (("--dem", path), "no reflectance"),
        ((write_dem(tmp_path / "dem.tif", grid, elevation),), "no reflectance"),
        (("--dem", empty, "--model", "lambert"), "nodata"),
        (("--dem", mars), "--body"),
        (("--dem", tmp_path / "none.tif"), "no such file"),
        ((tmp_path / "text.h5",), "another kind of file"),
        (("--dem", path, "--model", "nonsense"), "choose one of"),
        (("--dem", path, "--parameters", "albedo"), "NAME=VALUE"),
        (("--dem", path, "--model", "lambert", "--parameters", "colour=1"), "unknown parameter"),
        (("--dem", path, "--model", "hapke", "--parameters", "theta=20"), "0..1.0472 rad, found 20"),
    ):
        code, error = lunargr_render(monkeypatch, capsys, *arguments, *SUN, *out)
        assert code == 3 and message in error and error.count("\n") == 1, error
    assert lunargr_render(monkeypatch, capsys, path, *SUN, *out)[0] == 0
    code, error = lunargr_render(monkeypatch, capsys, path, *SUN, *out)
    assert code == 3 and "--overwrite" in error
    assert not [p.name for p in tmp_path.iterdir() if "partial" in p.name]


def test_an_interrupted_render_leaves_nothing(hilly_map, tmp_path, monkeypatch):
    path, *_ = hilly_map
    calls = []

    def stop(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return original(*arguments)

    original = ortho.shade_block
    monkeypatch.setattr(ortho, "shade_block", stop)
    monkeypatch.setattr(ortho, "BAND_ROWS", 40)
    with pytest.raises(KeyboardInterrupt):
        render.run(path, tmp_path / "o.exr", render.Config(sun_azimuth_deg=1.0, sun_elevation_deg=40.0))
    assert [p.name for p in tmp_path.iterdir()] == ["svbrdf.h5"]


@pytest.mark.parametrize("suffix", ["exr", "tif"])
def test_a_file_that_cannot_grow_is_one_line_and_nothing_half_written(hilly_map, tmp_path, suffix):
    """As on a full disk or over quota: the process may write no more than 60 kB into one file."""
    path, *_ = hilly_map
    out = tmp_path / "out"
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000));"
        f"sys.argv = ['lunargr', 'render', {str(path)!r}, *{SUN!r}, '-o', {str(out / f'o.{suffix}')!r}, '-q'];"
        "from lunargr_cli.main import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    told = [line for line in done.stderr.splitlines() if line.startswith("lunargr")]
    assert done.returncode == 3 and len(told) == 1 and "Traceback" not in done.stderr, done.stderr
    assert not out.exists()
