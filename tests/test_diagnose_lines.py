"""Lines of an image that are shifted against each other: seen by one half of their samples, asked of the other half."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from planted import semi_real
from scipy.ndimage import map_coordinates

from stages.diagnose.data.sites import load_site
from stages.diagnose.judge.claim import Reason, decide, of_size
from stages.diagnose.model.nominal import fit, load_nominal
from stages.diagnose.registration.explain import explain
from stages.effects.line_jitter import ORDERS, LineJitter
from stages.pairs.reader import PairReader

SIZE, RMS = 64, 0.4


@pytest.fixture(scope="module")
def registered(tmp_path_factory):
    """What registration finds where pixels show ground that lies further east, by a function of (generator, rows, columns), px.

    dem_smooth : px, sigma of the Gaussian that the given DEM was smoothed with
    """

    folder = tmp_path_factory.mktemp("lines")

    def register(shift, dem_smooth=0.0):
        pairs = folder / f"{dem_smooth}.h5"
        if not pairs.exists():
            semi_real(pairs, 4713, images=4, size=SIZE, truth={"dem_smooth_px": dem_smooth})
        with PairReader(pairs) as reader:
            sites = [load_site(reader, np.flatnonzero(reader.site == k)) for k in np.unique(reader.site)[:4]]
            frames = len(reader.image_ids)
        rng, (rows, columns) = np.random.default_rng(1), np.indices((SIZE, SIZE))
        for k, site in enumerate(sites):
            site.place = (100.0 * k, 80.0 * (3 * k % 4))
            moved = [
                map_coordinates(one, [rows, columns + shift(rng, rows, columns)], order=3, mode="nearest")
                for one in site.read.numpy()
            ]
            site.read = site.image = torch.from_numpy(np.stack(moved))
        nominal = load_nominal(None, "M2", "iof")
        with torch.no_grad():
            fit(nominal, sites, [], "iof", [s.read for s in sites], start=True)
            return explain(sites, nominal, [], frames, 0.0), sites, frames

    return register


def _wave(rng, along):
    return RMS * math.sqrt(2) * np.sin(2 * math.pi * along / rng.uniform(20, 50) + rng.uniform(0, 2 * math.pi))


def test_lines_that_tremble_differently_in_every_crop_are_found_with_their_size(registered):
    found, sites, frames = registered(lambda rng, rows, columns: _wave(rng, rows))
    assert found.lines_tremble
    assert found.lines.rms == pytest.approx(RMS, rel=0.15)
    # ... which is no displacement of the crop's lines that all crops have in common
    common = found.lines.over_the_crop(sites, frames)
    assert common.shape == (frames, 2 * len(ORDERS))
    assert float(common.square().sum(1).mean().sqrt()) < 0.7 * RMS


@pytest.mark.slow
def test_jitter_that_all_crops_of_a_frame_share_becomes_values_of_the_frame(registered):
    rows = 2 * RMS * np.cos(math.pi * (np.arange(SIZE) + 0.5) / SIZE)[:, None]
    side = itertools.cycle([1, -1])  # of the four frames of a place in turn: cameras do not shake alike twice
    found, sites, frames = registered(lambda *_: next(side) * rows)
    common = found.lines.over_the_crop(sites, frames)
    assert found.lines_tremble
    assert common[:, 0].abs().numpy() == pytest.approx(np.full(frames, math.sqrt(2) * RMS), rel=0.2)


@pytest.mark.parametrize(
    "name", ["nothing", *(pytest.param(n, marks=pytest.mark.slow) for n in ("columns", "a bend of the whole crop"))]
)
def test_what_is_not_alike_along_a_line_is_no_trembling(registered, name):
    shifts = {
        "nothing": lambda rng, rows, columns: 0 * rows,
        "columns": lambda rng, rows, columns: _wave(rng, columns),
        "a bend of the whole crop": lambda rng, rows, columns: 0.8 * (columns / SIZE - 0.5) * (rows / SIZE - 0.5),
    }
    found, _, _ = registered(shifts[name])
    assert not found.lines_tremble


@pytest.mark.slow
def test_relief_that_a_smooth_dem_lacks_is_no_jitter(registered):
    # the DEM's errors displace what is seen by 0.2 to 0.3 px in either half of a line, each half by an amount of its own
    found, _, _ = registered(lambda rng, rows, columns: 0 * rows, dem_smooth=2.0)
    assert abs(found.lines.square) < 3 * found.lines.square_error
    assert found.lines.ordinary
    assert not found.lines_tremble


def test_a_registered_size_has_to_pass_the_rules_of_every_name():
    before = np.full(8, 100.0)

    def refused(size, error):
        return decide(of_size(LineJitter({}), "rms_px", size, error, before, before - np.arange(1.0, 9.0)))

    assert refused(0.5, 0.05) is None
    assert refused(0.16, 0.035).reason is Reason.ORDINARY
    assert refused(0.5, 0.15).reason is Reason.UNSURE
