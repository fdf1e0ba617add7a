"""Ground that a network learned from is not scored: one scene, sampled with two seeds."""

from __future__ import annotations

import shutil

import h5py
import numpy as np
import pytest

from schemas import ArtefactError
from stages import albedo, evaluate, infer, match, project, sample, train
from stages.pairs.ground import COLUMNS, EDGE, leave_out_learned
from stages.pairs.reader import PairReader

CROP = 32


@pytest.fixture(scope="module")
def trained(small_artefacts, tmp_path_factory):
    """Folder with a checkpoint of the scene's first split, and pairs.h5 of another one."""
    folder = tmp_path_factory.mktemp("ground")
    sample.run(small_artefacts["scene"], folder / "crops.h5", sample.Config(count=90, tile_m=1280, seed=5, block=100))
    project.run(folder / "crops.h5", folder / "pairs.h5", project.Config())
    config = train.Config(model="M2", epochs=1, batch=16, widths=(4, 8), device="cpu", precision="fp32")
    train.run(small_artefacts["pairs"], folder / "checkpoint.h5", config)
    return folder


def overlapping(scored, learned, wanted, parts) -> np.ndarray:
    """By the crops' rows and columns on the scene's grid: they share pixels where both differ by less than a crop."""
    with h5py.File(scored) as a, h5py.File(learned) as b:
        there = np.isin(b["split"][...], parts)
        apart = [np.abs(a[n][...][wanted][:, None] - b[n][...][there][None]) for n in ("row", "col")]
    return (np.maximum(*apart) < CROP).any(axis=1)


@pytest.mark.parametrize(("split", "parts"), [("test", (0, 1)), ("validation", (0,)), ("train", ())])
def test_crops_that_overlap_what_was_learned_from_are_left_out(trained, small_artefacts, split, parts):
    with PairReader(trained / "pairs.h5") as reader:
        wanted = reader.indices(split)
        shared = overlapping(reader.path, small_artefacts["pairs"], wanted, parts)
        clean, notes = leave_out_learned(reader, wanted, trained / "checkpoint.h5", split)
    assert (0 < shared.sum() < len(wanted)) or split == "train"
    np.testing.assert_array_equal(clean, wanted[~shared])
    told = f"{shared.sum()} of {len(wanted)} {split} pairs are left out: checkpoint.h5 learned from their ground"
    assert notes == ([told] if shared.any() else [])


def test_the_split_that_was_trained_on_loses_nothing(trained, small_artefacts):
    with PairReader(small_artefacts["pairs"]) as reader:
        wanted = reader.indices("test")
        clean, notes = leave_out_learned(reader, wanted, trained / "checkpoint.h5", "test")
        assert notes == [] and np.array_equal(clean, wanted)
        # training crops under the name of test pairs, and all of them
        with pytest.raises(
            ArtefactError, match=r"expected 'test' pairs on ground that checkpoint.h5 did not learn from"
        ):
            leave_out_learned(reader, reader.indices("train"), trained / "checkpoint.h5", "test")


def test_a_checkpoint_without_the_record_says_so(trained, small_artefacts, tmp_path):
    old = tmp_path / "old.h5"
    shutil.copy(trained / "checkpoint.h5", old)
    with h5py.File(old, "r+") as file:
        for name in COLUMNS:
            del file[name]
        del file.attrs[EDGE]
    for pairs, count in ((trained / "pairs.h5", 1), (small_artefacts["pairs"], 0)):
        with PairReader(pairs) as reader:
            wanted = reader.indices("test")
            clean, notes = leave_out_learned(reader, wanted, old, "test")
        assert np.array_equal(clean, wanted) and len(notes) == count
        assert all(note.startswith("old.h5 does not record the ground") for note in notes)


def test_every_score_leaves_it_out(trained, small_artefacts, tmp_path, monkeypatch):
    from stages.diagnose import stage as diagnose

    pairs, checkpoint = trained / "pairs.h5", trained / "checkpoint.h5"
    with PairReader(pairs) as reader:
        wanted = reader.indices("test")
        clean, notes = leave_out_learned(reader, wanted, checkpoint, "test")
    result = evaluate.run(
        pairs, checkpoint, tmp_path / "e.h5", evaluate.Config(device="cpu", only=("learned",), renderings=False)
    )
    assert result["pairs"] == len(clean) and notes[0] in result["warnings"]
    with h5py.File(tmp_path / "e.h5") as file:
        np.testing.assert_array_equal(file["pair_index"][...], clean)
    said = []
    result = match.run(
        [pairs, checkpoint], None, match.Config(matchers=("sift",), count=1000, device="cpu"), said.append
    )
    assert result["crops"] == len(clean) and result["warnings"] == notes and notes[0] in said[0]
    scored = []
    monkeypatch.setattr(diagnose, "load", lambda reader, found, config: scored.append(found) or [])
    diagnose.run(pairs, checkpoint, config=diagnose.Config(), say=said.append)
    np.testing.assert_array_equal(scored[1], clean)
    assert notes[0] in said[-1]


def test_maps_carry_the_record_to_the_judgement_of_unseen_images(trained, small_artefacts, tmp_path):
    svbrdf, fold = tmp_path / "svbrdf.h5", tmp_path / "fold.h5"
    with PairReader(trained / "pairs.h5") as reader:
        wanted = reader.indices("test")
        clean, notes = leave_out_learned(reader, wanted, trained / "checkpoint.h5", "test")
        image = int(np.bincount(reader.frame[clean]).argmax())
        unseen, name = clean[reader.frame[clean] == image], reader.image_ids[image]
    infer.run(small_artefacts["scene"], trained / "checkpoint.h5", svbrdf, infer.Config(device="cpu", geotiff=False))
    albedo.run(svbrdf, small_artefacts["scene"], None, fold, albedo.Config(leave_out=(name,), geotiff=False))
    result = evaluate.run_held_out(trained / "pairs.h5", [fold], tmp_path / "e.h5", evaluate.HeldOutConfig())
    assert len(unseen) and result["pairs"] == len(unseen)
    assert result["warnings"] == [notes[0].replace("checkpoint.h5", "fold.h5")]
