"""Shared fixtures: where the outside reference data are, and a seeded generator."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = Path(os.environ.get("LUNARGR_SHARED", ROOT.parent / "shared"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of outside reference data; tests that need it skip where it is absent."""
    if not (SHARED / "oracles").is_dir():
        pytest.skip("reference data not found: set LUNARGR_SHARED to the folder that holds 'oracles' and 'data'")
    return SHARED


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261121)
