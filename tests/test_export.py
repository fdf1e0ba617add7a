"""`lunargr export`: the network of a checkpoint in another program gives the same coefficients."""

from __future__ import annotations

import json
import sys

import h5py
import numpy as np
import pytest
import torch
from render_scene import run_lunargr

from stages.network.predictor import load_predictor

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")


def test_onnx_gives_the_same_coefficients_for_any_size(small_checkpoint, tmp_path, monkeypatch, capsys, rng):
    output = tmp_path / "model.onnx"
    assert run_lunargr(monkeypatch, capsys, "export", small_checkpoint, "-o", output)[0] == 0
    session = onnxruntime.InferenceSession(str(output), providers=["CPUExecutionProvider"])
    predictor = load_predictor(small_checkpoint)
    for shape in ((1, 32, 32), (2, 20, 44)):
        elevation = (np.cumsum(rng.normal(size=shape), axis=-1) * 3 - 2600).astype(np.float32)
        (found,) = session.run(None, {"elevation": elevation})
        expected = predictor.coefficients(torch.from_numpy(elevation)).numpy()
        np.testing.assert_allclose(found, expected, atol=1e-5)
        assert np.ptp(found, axis=(0, 2, 3)).max() > 0
    facts = session.get_modelmeta().custom_metadata_map
    assert json.loads(facts["coefficients"]) == ["h", "gamma", "B0"] and facts["gsd_m"] == "20"
    card = (tmp_path / "model.md").read_text()
    with h5py.File(small_checkpoint) as file:
        best = file["validation_loss"][int(file.attrs["best_epoch"]) - 1]
    assert f"{best:.4g}" in card and "hapke_g2r" in card and "pairs.h5" in card


def test_what_cannot_be_exported_is_one_line(small_checkpoint, small_artefacts, tmp_path, monkeypatch, capsys):
    for arguments, message in (
        ((small_checkpoint, "-o", tmp_path / "m.pt"), "ends in .onnx"),
        ((small_artefacts["pairs"], "-o", tmp_path / "m.onnx"), "checkpoint"),
        ((small_checkpoint, "-o", tmp_path / "m.onnx", "--opset", "3"), "--opset"),
    ):
        code, error = run_lunargr(monkeypatch, capsys, "export", *arguments)
        assert code == 3 and message in error and error.count("\n") == 1, error
    monkeypatch.setitem(sys.modules, "onnx", None)
    code, error = run_lunargr(monkeypatch, capsys, "export", small_checkpoint, "-o", tmp_path / "m.onnx")
    assert code == 3 and "lunargr[onnx]" in error
    assert not [p for p in tmp_path.iterdir() if p.is_file()]
