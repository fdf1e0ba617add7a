"""`lunargr evaluate` from files to files, with a network trained for a moment."""

from __future__ import annotations

import json

import cv2
import h5py
import numpy as np
import pytest
from evaluation_scene import make_scene, run_command, write_pairs

from schemas import EVALUATION, open_artefact
from stages import train
from stages.evaluate import least_squares

WIDTHS = (4, 8, 8)


@pytest.fixture(autouse=True)
def short_fits(monkeypatch):
    """Of Hapke's law to ground that is not Hapke's: how far a fit gets is judged in test_evaluate.py."""
    monkeypatch.setattr(least_squares, "ROUNDS", 15)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with pairs.h5 and checkpoint.h5, and the same on film (pairs_dn.h5, checkpoint_dn.h5)."""
    folder = tmp_path_factory.mktemp("evaluate")
    rng = np.random.default_rng(11)
    scene = make_scene(rng)
    scene.split[::7] = 1
    write_pairs(folder / "pairs.h5", scene)
    scene.images = np.float32([600, 900, 800, 700])[scene.frame][:, None, None] * scene.images + 12
    write_pairs(folder / "pairs_dn.h5", scene, "dn")
    config = train.Config(
        model="M2", epochs=3, batch=8, widths=WIDTHS, dropout=(0.0,) * 3, device="cpu", precision="fp32"
    )
    for suffix in ("", "_dn"):
        train.run(folder / f"pairs{suffix}.h5", folder / f"checkpoint{suffix}.h5", config)
    return folder


@pytest.mark.parametrize("suffix", ["", pytest.param("_dn", marks=pytest.mark.slow)])
def test_evaluate_writes_table_json_artefact_and_figures(trained, tmp_path, suffix):
    output, copy = tmp_path / "evaluation.h5", tmp_path / "copy.json"
    files = (trained / f"pairs{suffix}.h5", trained / f"checkpoint{suffix}.h5")
    options = ("-o", output, "--json", copy, "--figures", tmp_path / "figures", "--device", "cpu")
    code, printed = run_command("evaluate", *files, *options)
    assert code == 0
    result = json.loads(copy.read_text())
    assert result == json.loads((tmp_path / "evaluation.json").read_text())
    assert result["split"] == "test"
    keys = {"mse", "mse_low", "mse_high", "mse_crop_sum", "psnr", "psnr_crop_range", "ssim", "lpips"}
    for name in ("learned", "global", "lunar_lambert", "hapke_raw", "hapke_minmax", "hapke_gain", "hapke_gain_offset"):
        assert keys <= set(result["models"][name])
        assert name in printed
    assert result["models"]["learned"]["lpips"] is None and result["lpips_unavailable"]
    with open_artefact(output, EVALUATION) as file:
        names = [n.decode() for n in file["model_name"][...]]
        measured, rendered = file["measured"][...], file["rendered"][names.index("learned")]
        mse, pixels = file["mse"][names.index("learned")], file["valid_pixels"][...]
    errors = np.nanmean((measured.astype(float) - rendered) ** 2, axis=(1, 2))
    assert mse == pytest.approx(errors, rel=1e-4)
    assert result["models"]["learned"]["mse"] == pytest.approx((errors * pixels).sum() / pixels.sum(), rel=1e-4)
    for name in ("training_curves", "errors", "crop_best", "crop_median", "crop_worst"):
        picture = cv2.imread(str(tmp_path / "figures" / f"{name}.png"))
        assert picture.std() > 5, name


def test_results_do_not_hang_on_the_batch_size(trained, tmp_path):
    few = [word for name in ("learned", "global", "hapke_fitted") for word in ("--only", name)]
    found = []
    for batch in (1, 16):
        files = (trained / "pairs.h5", trained / "checkpoint.h5", "-o", tmp_path / f"{batch}.h5")
        assert run_command("evaluate", *files, *few, "--batch", batch, "--device", "cpu", "-q")[0] == 0
        found.append(json.loads((tmp_path / f"{batch}.json").read_text())["models"])
    for name, row in found[0].items():
        assert row["mse"] == pytest.approx(found[1][name]["mse"], rel=1e-5)


def _spoil(trained, tmp_path, case):
    pairs, checkpoint, options = trained / "pairs.h5", trained / "checkpoint.h5", ["-o", tmp_path / "out.h5"]
    if case == "a missing file":
        pairs = tmp_path / "absent.h5"
    elif case == "a checkpoint in place of pairs":
        pairs = checkpoint
    elif case == "a truncated checkpoint":
        (tmp_path / "short.h5").write_bytes(checkpoint.read_bytes()[:9000])
        checkpoint = tmp_path / "short.h5"
    elif case == "a checkpoint on DN":
        checkpoint = trained / "checkpoint_dn.h5"
    elif case == "an unknown split":
        options += ["--split", "tests"]
    elif case == "a split without pairs":
        pairs = tmp_path / "pairs.h5"
        pairs.write_bytes((trained / "pairs.h5").read_bytes())
        with h5py.File(pairs, "a") as file:
            file["split"][...] = 0
    elif case == "an existing output":
        (tmp_path / "out.h5").write_text("mine")
    elif case == "the input as output":
        options = ["-o", pairs, "--overwrite"]
    return "evaluate", pairs, checkpoint, *options, "--device", "cpu"


@pytest.mark.parametrize(
    "case",
    [
        "a missing file",
        "a checkpoint in place of pairs",
        "a truncated checkpoint",
        "a checkpoint on DN",
        "an unknown split",
        "a split without pairs",
        "an existing output",
        "the input as output",
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(trained, tmp_path, case):
    arguments = _spoil(trained, tmp_path, case)
    before = {p: p.stat().st_size for p in (*tmp_path.iterdir(), *trained.iterdir())}
    code, message = run_command(*arguments)
    assert code == 3 and message and "\n" not in message
    assert {p: p.stat().st_size for p in (*tmp_path.iterdir(), *trained.iterdir())} == before


def test_extend_scores_the_extended_model_in_further_rows(tmp_path):
    """A planted dark bias is what --extend takes away: the extended model's error falls back to that without bias."""
    from schemas import DIAGNOSIS, ArtefactWriter
    from stages.effects import Survey

    bias = 0.02
    scene = make_scene(np.random.default_rng(6), pairs=24)
    write_pairs(tmp_path / "clean.h5", scene)
    config = train.Config(
        model="M2", epochs=2, batch=8, widths=(4, 8), dropout=(0.0, 0.0), device="cpu", precision="fp32"
    )
    train.run(tmp_path / "clean.h5", tmp_path / "checkpoint.h5", config)
    scene.images += np.float32(bias)
    write_pairs(tmp_path / "biased.h5", scene)
    effect = {"effect": "dark_bias", "values": {"iof": bias}, "tables": {}, "survey": Survey().to_json()}
    content = {"report": "{}", "extension": json.dumps([effect])}
    with ArtefactWriter(tmp_path / "diagnosis.h5", DIAGNOSIS, {"frame": 4}, attributes=content, seed=0) as out:
        out.write("image_id", scene.image_ids)
    found = {}
    for name, more in (("clean", ()), ("biased", ("--extend", tmp_path / "diagnosis.h5"))):
        files = (tmp_path / f"{name}.h5", tmp_path / "checkpoint.h5", "-o", tmp_path / f"{name}_evaluation.h5")
        assert run_command("evaluate", *files, *more, "--device", "cpu", "-q")[0] == 0
        found[name] = json.loads((tmp_path / f"{name}_evaluation.json").read_text())["models"]
    clean, biased = found["clean"], found["biased"]
    assert biased["learned_extended"]["mse"] == pytest.approx(clean["learned"]["mse"], rel=1e-3)
    assert biased["learned"]["mse"] > 3 * biased["learned_extended"]["mse"]
    assert {"learned_extended_gain_offset", "global_extended"} <= set(biased) - set(clean)


def test_training_runs_of_one_model_are_one_learned_row(trained, tmp_path):
    config = train.Config(
        model="M2",
        epochs=1,
        batch=8,
        widths=WIDTHS,
        dropout=(0.0,) * 3,
        device="cpu",
        precision="fp32",
        lr=1e-2,
        seed=5,
    )
    train.run(trained / "pairs.h5", tmp_path / "other.h5", config)
    files = (trained / "pairs.h5", trained / "checkpoint.h5", tmp_path / "other.h5")
    options = ("--only", "learned", "--only", "global", "--device", "cpu", "-o", tmp_path / "both.h5")
    code, printed = run_command("evaluate", *files, *options)
    assert code == 0 and "2 training runs" in printed
    result = json.loads((tmp_path / "both.json").read_text())
    row = result["models"]["learned"]
    assert result["seeds"] == [0, 5] and row["mse"] == pytest.approx(np.mean(row["mse_runs"]))
    with open_artefact(tmp_path / "both.h5", EVALUATION) as file:
        assert file["run_seed"][...].tolist() == [0, 5]
        pixels, runs = file["valid_pixels"][...], file["run_mse"][...]
    assert (runs * pixels).sum(axis=1) / pixels.sum() == pytest.approx(row["mse_runs"])
    code, message = run_command("evaluate", files[0], files[1], files[1], "-o", tmp_path / "twice.h5")
    assert code == 3 and "seed 0 again" in message and "\n" not in message


def _descends_from(path, sample_config):
    """What an artefact says that was made from a sample with this config."""
    record = {"schema": "crops", "config": sample_config, "inputs": [], "seed": 0}
    record |= {key: "" for key in ("history", "command", "folder", "version")}
    with h5py.File(path, "a") as file:
        file.attrs["provenance"] = json.dumps({"0" * 64: record})


def test_a_diagnosis_that_may_have_learned_from_the_test_ground_is_refused(trained, tmp_path):
    from schemas import DIAGNOSIS, ArtefactError, ArtefactWriter
    from stages.effects.extension import check_ground

    pairs, diagnosis = tmp_path / "pairs.h5", tmp_path / "diagnosis.h5"
    pairs.write_bytes((trained / "pairs.h5").read_bytes())
    content = {"report": "{}", "extension": "[]"}
    with ArtefactWriter(diagnosis, DIAGNOSIS, {"frame": 1}, attributes=content, seed=0) as out:
        out.write("image_id", ["frame0"])
    assert "cannot be told" in check_ground(diagnosis, pairs)[0]
    here, elsewhere = [10.0, 10.2, -1.0, 1.0], [50.0, 50.2, -1.0, 1.0]
    _descends_from(pairs, {"split_id": "a", "split_ground_deg": here})
    for ident, ground, allowed in (("a", here, True), ("b", elsewhere, True), ("b", here, False)):
        _descends_from(diagnosis, {"split_id": ident, "split_ground_deg": ground})
        if allowed:
            assert check_ground(diagnosis, pairs) == []
            continue
        with pytest.raises(ArtefactError, match="learned from the test ground"):
            check_ground(diagnosis, pairs)
        commands = (
            ("evaluate", pairs, trained / "checkpoint.h5", "--extend", diagnosis, "-o", tmp_path / "e.h5"),
            ("train", pairs, "--extend", diagnosis, "-o", tmp_path / "c.h5"),
        )
        for command in commands:
            code, message = run_command(*command, "--device", "cpu")
            assert code == 3 and "--tile-m, --split and --seed" in message and "\n" not in message
    assert not (tmp_path / "e.h5").exists() and not (tmp_path / "c.h5").exists()
