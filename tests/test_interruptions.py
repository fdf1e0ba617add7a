"""Ctrl-C at odd moments, inputs that vanish and disks that fill while a stage works: one line, and nothing half-written."""

from __future__ import annotations

import contextlib
import gc
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import command
import h5py
import numpy as np
import pytest
from cluster_scene import assert_same, environment, finish, start
from rasterio.crs import CRS
from rasterio.transform import Affine

from schemas import SVBRDF, ArtefactWriter, InputError, atomic_path
from stages.physics.maps.geotiff import MapTiff
from stages.physics.maps.grid import Grid

LINE = "lunargr: interrupted; nothing half-written was kept.\n"


def python(program: str) -> subprocess.CompletedProcess:
    listen = (
        "signal.signal(signal.SIGINT, signal.default_int_handler)"  # shells make what runs in the background deaf to it
    )
    start = f"import os, signal, sys; {listen}; sys.argv = ['lunargr', 'schema', 'pairs']"
    words = [sys.executable, "-c", f"{start}; {program}"]
    return subprocess.run(words, capture_output=True, text=True)


@pytest.mark.parametrize(
    "program",
    [
        "import lunargr_cli; os.kill(os.getpid(), signal.SIGINT); import lunargr_cli.main",  # while it is imported
        "from lunargr_cli import main; main.app = lambda: os.kill(os.getpid(), signal.SIGINT); main.main()",
        # a library that makes another error of it, as numpy's and numba's imports do
        "import lunargr_cli.main as m\ndef app():\n try: os.kill(os.getpid(), signal.SIGINT)\n"
        " except KeyboardInterrupt: raise ImportError('numpy')\nm.app = app\nm.main()",
        # within an import, where compiled libraries print what breaks theirs
        f"import lunargr_cli.main as m, time; sys.path.insert(0, {str(Path(__file__).parent / 'support')!r})\n"
        "def app():\n import interrupted_import\n time.sleep(60)\nm.app = app\nm.main()",
        # where Python swallows it, and would print a traceback
        "import lunargr_cli.main as m, weakref\nclass Kept: pass\ndef app():\n kept = Kept()\n"
        " gone = weakref.ref(kept, lambda _: os.kill(os.getpid(), signal.SIGINT))\n del kept\n m.raise_again()\n"
        "m.raise_again = __import__('lunargr_cli').raise_again\nm.app = app\nm.main()",
    ],
)
def test_ctrl_c_is_one_line_wherever_it_falls(program):
    done = python(program)
    assert (done.returncode, done.stderr) == (130, LINE)


def test_a_terminated_command_says_so():
    """As by ``kill``, or at the end of a Slurm job's time."""
    done = python("from lunargr_cli import main; main.app = lambda: os.kill(os.getpid(), signal.SIGTERM); main.main()")
    assert (done.returncode, done.stderr) == (143, LINE)


def test_a_library_keeps_its_handlers():
    done = python("sys.argv = ['other']; import lunargr_cli; os.kill(os.getpid(), signal.SIGINT)")
    assert "KeyboardInterrupt" in done.stderr


@contextlib.contextmanager
def file_size_limit(size):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_disk_that_is_full_for_a_moment_leaves_nothing_that_looks_whole(tmp_path):
    """HDF5 writes what a dataset still holds when it is let go of, where a failure reaches nobody; then there is room again."""
    path, values = tmp_path / "map.h5", np.arange(3 * 64 * 64, dtype=np.float32).reshape(3, 64, 64)
    attributes = {"gsd_m": 5.0, "body_radius_m": 1737400.0, "model": "M2", "quantity": "I/F"}
    with (
        contextlib.suppress(InputError),
        ArtefactWriter(path, SVBRDF, {"coefficient": 3, "y": 64, "x": 64}, attributes=attributes) as writer,
    ):
        for name in ("x", "y", "elevation", "valid", "coefficient_name"):
            writer.write(name, ["a", "b", "c"] if name == "coefficient_name" else np.zeros(writer.dataset(name).shape))
        writer.write_crs("LOCAL_CS[]", (5, 0, 0, 0, -5, 0))
        data = writer.write("coefficients", values)
        room = next(p for p in tmp_path.iterdir() if ".partial-" in p.name)
        with file_size_limit(room.stat().st_size):
            del data
            gc.collect()
    if path.exists():
        with h5py.File(path) as file:
            np.testing.assert_array_equal(file["coefficients"][...], values)


LET_GO = """
import gc, numpy as np, resource
from pathlib import Path
from schemas import SVBRDF, ArtefactWriter, InputError
try:
    with ArtefactWriter(Path("map.h5"), SVBRDF, {"coefficient": 1, "y": 4, "x": 4}) as writer:
        group = writer.file.create_group("weights")
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limit[1]))
        group.create_dataset("w", data=np.ones((8, 256), np.float32), chunks=(8, 256))
        gc.collect()
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        for v in (v for v in SVBRDF.variables if v.required):
            shape = [writer.sizes[d] for d in v.dims]
            writer.write(v.name, ["a"] if v.dtype == "string" else np.zeros(shape))
        writer.file.attrs.update({a.name: 1 for a in SVBRDF.attributes})
except InputError as error:
    print(error)
    os._exit(3)  # as the command does: HDF5 is not to be trusted any more
"""


def test_a_failure_where_a_dataset_is_let_go_of_is_not_lost(tmp_path):
    """Also of datasets that the writer did not make, such as a checkpoint's weights; HDF5 crashes where it goes on."""
    words = [sys.executable, "-c", f"import os{LET_GO}"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, env=environment())
    assert done.returncode == 3 and "disk is full" in done.stdout, done.stderr
    assert list(tmp_path.iterdir()) == []


STATE = """
import os, resource, sys, torch
from pathlib import Path
from types import SimpleNamespace
from schemas import InputError
from stages.train.resume import History, copy_weights, save
net = torch.nn.Sequential(*[torch.nn.Conv2d(16, 16, 3) for _ in range(4)])
optimizer = torch.optim.Adam(net.parameters())
net(torch.zeros(1, 16, 20, 20)).sum().backward()
optimizer.step()
training = SimpleNamespace(modules={"net": net}, optimizer=optimizer, precision="fp32")
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
try:
    save(Path("x.resume.h5"), "identity", training, History(), copy_weights(training))
except InputError as error:
    print(error)
    os._exit(3)
"""


def test_a_disk_that_fills_under_the_state_of_a_training_is_one_line(tmp_path):
    done = subprocess.run([sys.executable, "-c", STATE], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 3 and "x.resume.h5: the disk is full" in done.stdout, done
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", [100_000, 1_000_000, 5_000_000])  # while tiles are written, and while they are copied
def test_a_disk_that_fills_under_a_geotiff_leaves_nothing(tmp_path, rng, size):
    values = rng.normal(size=(2, 768, 768)).astype(np.float32)
    path, transform = tmp_path / "map.tif", Affine(5, 0, 0, 0, -5, 0)
    grid = Grid(CRS.from_proj4("+proj=eqc +R=1737400").to_wkt(), transform, 768, 768, 1737400.0)
    attributes = {"gsd_m": 5.0, "body_radius_m": 1737400.0, "model": "M2", "quantity": "I/F"}
    with (
        file_size_limit(size),
        pytest.raises(InputError, match=r"map\.tif: the disk is full"),
        atomic_path(path) as partial,
        MapTiff(partial, grid, ["a", "b"], attributes) as tiff,
    ):
        for row in range(0, 768, 256):
            tiff.put(row, 0, values[:, row : row + 256])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(  # the lock, the middle, and the end that HDF5 writes when it closes the file
    "share", [*(pytest.param(share, marks=pytest.mark.slow) for share in (0.0, 0.5)), 0.999]
)
def test_a_disk_that_fills_at_any_moment_is_one_line_and_leaves_nothing(small_artefacts, tmp_path, share):
    size = int(small_artefacts["crops"].stat().st_size * share)
    words = ["sample", small_artefacts["scene"], "--count", 90, "--tile-m", 1280, "--seed", 3, "--quiet"]
    process = start(
        [*words, "-o", tmp_path / "new" / "crops.h5"],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)),
    )
    code, said = finish(process)
    assert code == 3 and len(said.splitlines()) == 1 and "crops.h5: " in said and "run the command again" in said, said
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_under_a_simulated_scene_leaves_nothing_and_replaces_nothing(tmp_path):
    """truth.h5 is written after DEM and images: without it they are of no use."""
    # fills numba's cache: compiled loops would not fit on the full disk either
    done = command.lunargr("simulate", "--size-px", 64, "--images", 2, "--quiet", "-o", tmp_path / "compiled")
    assert done.returncode == 0, done.stderr
    shutil.rmtree(tmp_path / "compiled")
    folder, earlier = tmp_path / "scene", {}
    (folder / "images").mkdir(parents=True)
    for name in ("dem.tif", "truth.h5", "images/S0001O.tif"):
        earlier[folder / name] = name
        (folder / name).write_text(name)
    process = start(
        ["simulate", "--size-px", 64, "--images", 2, "--overwrite", "--quiet", "-o", folder],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (80_000, 80_000)),
    )
    code, said = finish(process)
    assert code == 3 and len(said.splitlines()) == 1 and "scene/truth.h5: the disk is full" in said
    assert {p: p.read_text() for p in tmp_path.rglob("*") if p.is_file()} == earlier


def test_an_exr_or_png_without_its_end_is_no_image(tmp_path, rng):
    """OpenEXR and libpng say nothing when the last bytes of a file find no room."""
    from stages.render.pictures import write_exr, write_png

    image = rng.random((64, 64), dtype=np.float32)

    def exr(path):
        with write_exr(path, 64, 64, ["image"]) as file:
            file.write({"image": image})

    for suffix, write in ((".exr", exr), (".png", lambda path: write_png(path, image))):
        write(tmp_path / f"whole{suffix}")
        size = (tmp_path / f"whole{suffix}").stat().st_size
        with file_size_limit(size - 6), pytest.raises(InputError, match="free some space"):
            write(tmp_path / f"cut{suffix}")
        assert not list(tmp_path.glob("*cut*")) and not list(tmp_path.glob(".*"))


def test_a_full_disk_keeps_the_parts(small_artefacts, tmp_path):
    """Each part fits, the whole does not: one line, and the same command goes on when there is room."""
    output = tmp_path / "pairs.h5"
    words = ["project", small_artefacts["crops"], "--resume", "--parts", 2, "-o", output]
    size = small_artefacts["pairs"].stat().st_size * 2 // 3
    process = start([*words, "--quiet"], preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)))
    code, said = finish(process)
    assert code == 3 and len(said.splitlines()) == 1 and "disk is full" in said
    assert not output.exists()
    code, said = command.outcome(*words)
    assert code == 0 and "2 of 2 parts are there already" in said
    assert_same(small_artefacts["pairs"], output)


def test_an_input_that_is_lost_on_the_way_is_one_line(small_artefacts, tmp_path):
    """Cut short while it is being read: by a copy that starts anew, or a network drive that goes away."""
    crops, output = tmp_path / "crops.h5", tmp_path / "pairs.h5"  # a folder beside that of the artefacts
    crops.write_bytes(small_artefacts["crops"].read_bytes())
    process = start(["project", crops, "--scene", small_artefacts["scene"], "--quiet", "-o", output])
    while not list(tmp_path.glob(".pairs.h5.partial-*")):
        assert process.poll() is None, finish(process)
        time.sleep(0.002)
    os.truncate(crops, 4096)
    code, said = finish(process)
    assert code == 3 and len(said.splitlines()) == 1 and str(crops) in said, said
    assert [p.name for p in tmp_path.iterdir()] == ["crops.h5"]
