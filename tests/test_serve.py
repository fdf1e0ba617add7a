"""`lunargr serve`: a process of its own, asked over a real socket by clients good, bad and gone."""

from __future__ import annotations

import json
import math
import runpy
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT
from relief import hills
from render_scene import LAT, LON, make_grid, write_dem

from stages import render

zmq = pytest.importorskip("zmq")

EXAMPLE = runpy.run_path(str(ROOT / "examples" / "serve_client.py"))
SUN = {"sun_azimuth_deg": 100.0, "sun_elevation_deg": 30.0}
POSE = {"position": [LON, LAT, 900.0], "fov_deg": 30.0, "size_px": [48, 32]}
SIZE, GSD = 256, 4.0


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    """A rough DEM with detail down to its pixels."""
    rng = np.random.default_rng(5)
    rough = np.cumsum([hills(rng, SIZE, GSD, 0.15), 0.15 * hills(rng, SIZE, GSD)[::-1]], axis=0)[-1]
    rough += rng.normal(size=(SIZE, SIZE)).astype(np.float32) * 0.15
    return write_dem(tmp_path_factory.mktemp("ground") / "dem.tif", make_grid(SIZE, SIZE, GSD), rough), rough


@pytest.fixture(scope="module")
def server(ground):
    """The address of a server that runs for the module's tests, and its process."""
    options = [
        "--dem",
        str(ground[0]),
        "--model",
        "lommel_seeliger",
        "--samples",
        "1",
        "--sensor",
        "mardi",
        "--port",
        "0",
    ]
    command = [sys.executable, "-m", "lunargr_cli.main", "serve", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        line = process.stdout.readline()
        assert " at tcp://127.0.0.1:" in line, process.stderr.read()
        yield line.split(" at ")[1].strip(), process
        process.terminate()
        _, told = process.communicate(timeout=30)
    assert process.returncode == 143 and "Traceback" not in told


def ask(address, *frames):
    """The header of the reply to raw frames."""
    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.linger, socket.rcvtimeo = 0, 60000
        socket.connect(address)
        socket.send_multipart(frames)
        return json.loads(socket.recv_multipart()[0])


def test_arrays_are_those_of_the_renderer(server, ground):
    with EXAMPLE["Client"](server[0]) as client:
        seen = client.view(POSE, SUN, ["image", "depth", "longitude_deg", "dn"], seed=9)
    with render.Renderer(ground[0], "mardi", model="lommel_seeliger", samples=1) as renderer:
        frame = renderer.view(POSE, SUN, seed=9)
    assert seen["dn"].dtype == np.uint16 and seen["image"].shape == (32, 48)
    for name, values in seen.items():
        np.testing.assert_array_equal(values, getattr(frame, name))


BAD = [
    (b"{", "expected JSON"),
    (b"\xff", "UTF-8"),
    (b"[]", "expected a JSON object"),
    (b"{}", "'camera': expected a JSON object"),
    (json.dumps({"camera": POSE, "camra": POSE}).encode(), "unknown key 'camra', did you mean 'camera'"),
    (json.dumps({"camera": POSE}).encode(), "Sun"),
    (json.dumps({"camera": {**POSE, "position": [LON, LAT, math.nan]}, "sun": SUN}).encode(), "finite"),
    (json.dumps({"camera": {**POSE, "size_px": [30000, 30000]}, "sun": SUN}).encode(), "at most"),
    (json.dumps({"camera": {**POSE, "position": [LON + 9, LAT, 900.0]}, "sun": SUN}).encode(), "misses"),
    (json.dumps({"camera": POSE, "sun": SUN, "arrays": ["colour"]}).encode(), "'arrays': expected a list of image"),
    (json.dumps({"camera": POSE, "sun": SUN, "seed": -1}).encode(), "'seed'"),
    (json.dumps({"camera": {"type": "pinhole"}, "sun": SUN}).encode(), "camera: expected the key"),
]


@pytest.mark.parametrize(("message", "words"), BAD)
def test_a_bad_request_gets_one_line_and_the_next_client_its_view(server, message, words):
    error = ask(server[0], message)["error"]
    assert words in error and "\n" not in error and "internal" not in error
    with EXAMPLE["Client"](server[0]) as client:
        assert client.view(POSE, SUN, ["image"])["image"].shape == (32, 48)


def test_two_frames_are_refused(server):
    assert "one frame" in ask(server[0], b"{}", b"{}")["error"]


def test_clients_that_die_hold_nobody_up(server):
    """One is killed between its request and the reply, one sends what ZeroMQ does not speak."""
    request = {"camera": {**POSE, "size_px": [400, 400]}, "sun": SUN}
    code = (
        f"import json,os,zmq;s=zmq.Context().socket(zmq.REQ);s.connect({server[0]!r});"
        f"s.send(json.dumps({request!r}).encode());s.poll(50);os._exit(9)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 9
    import socket

    with socket.create_connection(("127.0.0.1", int(server[0].rpartition(":")[2]))) as stranger:
        stranger.sendall(b"GET / HTTP/1.0\r\n\r\n")
    with EXAMPLE["Client"](server[0]) as client:
        assert client.view(POSE, SUN, ["image"])["image"].shape == (32, 48)
    assert server[1].poll() is None


def test_a_lander_finds_its_way_down(server, ground):
    """Its place, believed 50 m off at 700 m, is known to a thousandth of the height at the end; without a correction it stays off."""
    height = float(ground[1].mean())
    start = np.array([-60.0, 40.0, height + 700.0])
    believed = start + np.array([30.0, -35.0, 15.0])
    target = np.array([0.0, 0.0, height + 250.0])
    with EXAMPLE["Client"](server[0]) as client:
        lander = EXAMPLE["Lander"](client, LON, LAT, SUN, size=192)
        errors = EXAMPLE["descend"](lander, start, believed, target, steps=5, taken="dn")
    assert errors[0] > 45 and max(errors[2:]) < 0.7 and errors[-1] < 0.25


def test_an_address_that_is_taken_is_one_line(server, ground):
    port = server[0].rpartition(":")[2]
    options = ["--dem", str(ground[0]), "--model", "lambert", "--port", port]
    done = subprocess.run(
        [sys.executable, "-m", "lunargr_cli.main", "serve", *options], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 3 and "choose another --port" in done.stderr and done.stderr.count("\n") == 1
