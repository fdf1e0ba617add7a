"""The data of `make reproduce-apollo15`, fetched from a server on the loopback that holds the same files."""

from __future__ import annotations

import runpy
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio

from schemas.errors import InputError
from stages.physics.images.table import read_frames

SCRIPT = SimpleNamespace(
    **runpy.run_path(str(Path(__file__).resolve().parent.parent / "examples" / "fetch_apollo15.py"))
)


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


@pytest.fixture
def server(shared, tmp_path):
    """(address, folder) of what the public repositories serve, from the reference copies."""
    folder = tmp_path / "server"
    for name in SCRIPT.CUBES:
        path = folder / SCRIPT.CUBE.format(name=name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(shared / "data/apollo15_cubes" / name)
    with rasterio.open(shared / "data/apollo15/gld100_64ppd.tif") as dataset:
        code = dataset.read(1).astype(int) + 10000
    for j, y in enumerate(SCRIPT.ROWS):
        for i, x in enumerate(SCRIPT.COLUMNS):
            tile = code[256 * j : 256 * j + 256, 256 * i : 256 * i + 256]
            path = folder / SCRIPT.TILE.format(x=x, y=y)
            path.parent.mkdir(parents=True, exist_ok=True)
            with rasterio.open(path, "w", driver="PNG", dtype="uint8", count=3, height=256, width=256) as png:
                png.write(np.stack([tile % 256, tile // 256, 0 * tile]).astype(np.uint8))
    httpd = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=httpd.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{httpd.server_address[1]}", folder
    httpd.shutdown()
    thread.join()
    httpd.server_close()


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_cubes_and_elevations_are_fetched_once(shared, server, tmp_path):
    source, folder = server
    table = SCRIPT.make_ready(tmp_path / "out", None, source)
    frames = read_frames(table)
    assert [f.image_id for f in frames] == ["AS15-M-0297", "AS15-M-0298", "AS15-M-0299"]
    assert frames[0].subsolar_longitude_deg == pytest.approx(78.7382, abs=1e-3)
    with (
        rasterio.open(tmp_path / "out/dem.tif") as ours,
        rasterio.open(shared / "data/apollo15/gld100_64ppd.tif") as known,
    ):
        assert np.array_equal(ours.read(1), known.read(1)) and ours.transform == known.transform
    for path in folder.rglob("*.*"):  # the second time nothing is asked for
        path.unlink()
    assert read_frames(SCRIPT.make_ready(tmp_path / "out", None, source)) == frames


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_other_files_and_no_network_are_one_line(server, tmp_path):
    source, folder = server
    tile = folder / SCRIPT.TILE.format(x=35, y=28)
    tile.write_bytes((folder / SCRIPT.TILE.format(x=35, y=27)).read_bytes())
    with pytest.raises(
        InputError, match="expected GLD100 tiles that decode to the elevations of 694609547544, found others"
    ):
        SCRIPT.make_ready(tmp_path / "out", None, source)
    assert not (tmp_path / "out/dem.tif").exists()
    cube = folder / SCRIPT.CUBE.format(name="AS15-M-0298_crop.cub")
    cube.unlink()
    cube.write_bytes(b"something else")
    with pytest.raises(InputError, match="expected a file of SHA-256 c67373") as caught:
        SCRIPT.make_ready(tmp_path / "other", None, source)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"cannot be fetched .* without a network set LUNARGR_SHARED") as caught:
        SCRIPT.make_ready(tmp_path / "offline", None, "http://127.0.0.1:9")
    assert "\n" not in str(caught.value)


def test_nothing_is_fetched_where_the_reference_folder_is(shared, tmp_path):
    frames = read_frames(SCRIPT.make_ready(tmp_path, shared, "http://127.0.0.1:9"))
    assert all(f.path == f.camera and f.path.samefile(shared / "data/apollo15_cubes" / f.path.name) for f in frames)
    assert (tmp_path / "dem.tif").resolve() == (shared / "data/apollo15/gld100_64ppd.tif").resolve()
