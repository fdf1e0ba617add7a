"""Shared fixtures: where the outside reference data are, and a seeded generator."""

from __future__ import annotations

import os
from pathlib import Path

# One thread a process: the arrays here are small, and the tests run in as many processes as there are cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "2")

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = Path(os.environ.get("LUNARGR_SHARED", ROOT.parent / "shared"))


# Two workers take one file after the other: the longest ones first, or one of them waits at the end. The second begins with
# files that compile nothing: two workers that compile the same loops at the same time would do so twice.
FIRST = (
    "test_fanout",
    "test_evaluate",
    "test_evaluate_command",
    "test_albedo",
    "test_provenance",
    "test_diagnose_leaks",
    "test_train",
    "test_interruptions",
    "test_infer",
    "test_diagnose_shadows",
    "test_malformed",
    "test_simulate_scene",
    "test_view_browser",
    "test_view_controls",
)


def pytest_collection_modifyitems(items):
    """The longest files first. `-m shared` and `-m "not shared"` choose by what a test asks for: nobody has to mark it."""
    for item in items:
        if "shared" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.shared)
    places = {name: place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of outside reference data; tests that need it skip where it is absent."""
    if not (SHARED / "oracles").is_dir():
        pytest.skip("reference data not found: set LUNARGR_SHARED to the folder that holds 'oracles' and 'data'")
    return SHARED


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)


@pytest.fixture(scope="session")
def small_files(tmp_path_factory):
    """The user's files of the small analytic scene."""
    from small_scene import write_scene

    return write_scene(tmp_path_factory.mktemp("files"))


@pytest.fixture(scope="session")
def small_artefacts(small_files, tmp_path_factory):
    """scene.h5, crops.h5 and pairs.h5 of the small scene, made once: a dict of paths."""
    from stages import ingest, project, sample

    folder = tmp_path_factory.mktemp("artefacts")
    paths = {name: folder / f"{name}.h5" for name in ("scene", "crops", "pairs")}
    ingest.run(small_files.dem, small_files.images, paths["scene"], ingest.Config(gsd=20, crop=32, block=100))
    sample.run(paths["scene"], paths["crops"], sample.Config(count=90, tile_m=1280, seed=3, block=100))
    project.run(paths["crops"], paths["pairs"], project.Config())
    return paths


@pytest.fixture(scope="session")
def small_checkpoint(small_artefacts, tmp_path_factory):
    """A network trained for a moment on the small scene, for tests to which what it learned does not matter."""
    from stages import train

    path = tmp_path_factory.mktemp("trained") / "checkpoint.h5"
    config = train.Config(model="hapke_g2r", epochs=1, batch=16, widths=(4, 8, 8), device="cpu", precision="fp32")
    train.run(small_artefacts["pairs"], path, config)
    return path


@pytest.fixture
def hilly_map(rng, tmp_path):
    """svbrdf.h5 of a hilly map, alone in the test's folder, with its grid, elevation and coefficients."""
    from render_scene import write_hilly_map

    return write_hilly_map(rng, tmp_path / "svbrdf.h5")
