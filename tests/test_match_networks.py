"""ALIKED, DISK and LightGlue through OpenCV, with small networks that have the inputs and outputs of the real ones.

The stand-ins describe patches of 16 px by random zero-mean filters and match by the largest inner product, so what
must come out is known; the real networks' weights are not ours to ship.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from schemas import ConfigError, InputError
from stages.match.base import Models, get_matcher

onnx = pytest.importorskip("onnx")
if not hasattr(cv2, "ALIKED_create"):
    pytest.skip("OpenCV 5 has these matchers", allow_module_level=True)

FLOAT, INT = onnx.TensorProto.FLOAT, onnx.TensorProto.INT64
STRIDE, CHANNELS = 16, 128


def _save(path, nodes, inputs, outputs, constants):
    helper = onnx.helper
    graph = helper.make_graph(
        nodes,
        "stand_in",
        [helper.make_tensor_value_info(*i) for i in inputs],
        [helper.make_tensor_value_info(*o) for o in outputs],
        [onnx.numpy_helper.from_array(v, k) for k, v in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def _features(path, size, points, points_type, batched):
    """A network that describes every 16 px patch of a (1, 3, size, size) image."""
    rng = np.random.default_rng(1)
    filters = rng.normal(size=(CHANNELS, 3, STRIDE, STRIDE)).astype(np.float32)
    filters -= filters.mean(axis=(1, 2, 3), keepdims=True)
    count = (size // STRIDE) ** 2
    lead = (1,) if batched else ()
    node = onnx.helper.make_node
    nodes = [
        node("Conv", ["image", "filters"], ["patches"], strides=[STRIDE, STRIDE]),
        node("Reshape", ["patches", "flat"], ["channels"]),
        node("Transpose", ["channels"], ["rows"], perm=[1, 0]),
        node("Reshape", ["rows", "shape"], ["descriptors"]),
        node("Identity", ["points"], ["keypoints"]),
        node("Identity", ["ones"], ["scores"]),
    ]
    outputs = [
        ("keypoints", points_type, [*lead, count, 2]),
        ("descriptors", FLOAT, [*lead, count, CHANNELS]),
        ("scores", FLOAT, [*lead, count] if batched else [count, 1]),
    ]
    constants = {
        "filters": filters,
        "flat": np.array([CHANNELS, count]),
        "shape": np.array([*lead, count, CHANNELS]),
        "points": points.reshape(*lead, count, 2),
        "ones": np.ones([*lead, count] if batched else [count, 1], np.float32),
    }
    return _save(path, nodes, [("image", FLOAT, [1, 3, size, size])], outputs, constants)


def _centres(size):
    steps = np.arange(STRIDE / 2, size, STRIDE)
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def _lightglue(path, count):
    """Every point of the first image with its most similar point of the second."""
    node = onnx.helper.make_node
    nodes = [
        node("Transpose", ["desc1"], ["turned"], perm=[0, 2, 1]),
        node("MatMul", ["desc0", "turned"], ["similarity"]),
        node("ArgMax", ["similarity"], ["partner"], axis=2, keepdims=0),
        node("Reshape", ["partner", "column"], ["second"]),
        node("Concat", ["first", "second"], ["matches0"], axis=1),
        node("ReduceMax", ["similarity"], ["best"], axes=[2], keepdims=0),
        node("Concat", ["kpts0", "kpts1"], ["places"], axis=1),
        node("ReduceMax", ["places"], ["place"], axes=[0, 1, 2], keepdims=1),
        node("Mul", ["place", "zero"], ["nothing"]),
        node("Add", ["best", "nothing"], ["scored"]),
        node("Reshape", ["scored", "line"], ["mscores0"]),
    ]
    inputs = [(f"{n}{k}", FLOAT, [1, count, d]) for n, d in (("kpts", 2), ("desc", CHANNELS)) for k in (0, 1)]
    outputs = [("matches0", INT, [count, 2]), ("mscores0", FLOAT, [count])]
    constants = {
        "column": np.array([count, 1]),
        "first": np.arange(count)[:, None],
        "zero": np.zeros((1, 1, 1), np.float32),
        "line": np.array([count]),
    }
    return _save(path, nodes, inputs, outputs, constants)


@pytest.fixture(scope="module")
def networks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("networks")
    relative = np.float32(_centres(640) / 640 * 2 - 1)
    return {
        "aliked": _features(folder / "aliked.onnx", 640, relative, FLOAT, batched=False),
        "disk": _features(folder / "disk.onnx", 1024, np.int64(_centres(1024)), INT, batched=True),
        "lightglue": _lightglue(folder / "lightglue.onnx", (640 // STRIDE) ** 2),
    }


@pytest.fixture(scope="module")
def pictures():
    rng = np.random.default_rng(8)
    field = cv2.GaussianBlur(rng.normal(size=(384, 512)), (0, 0), 3)
    noisy = field + 0.2 * field.std() * rng.normal(size=field.shape)
    return [np.uint8(np.clip(128 + 50 * f / field.std(), 0, 255)) for f in (field, noisy)]


@pytest.mark.parametrize(("name", "lightglue"), [("aliked", False), ("aliked", True), ("disk", False)])
def test_equal_ground_is_matched_to_itself(networks, pictures, name, lightglue):
    models = Models(networks[name], networks["lightglue"] if lightglue else None)
    matches = get_matcher(name, models).match(*pictures)
    size = {"aliked": 640, "disk": 1024}[name]
    assert len(matches.errors) > 0.9 * (size // STRIDE) ** 2
    assert np.mean(matches.errors < 1) > 0.9
    scale = np.array([512 / size, 384 / size])  # points come back in pixels of the picture
    expected = {tuple(p) for p in (_centres(size) * scale).round(2).tolist()}
    assert {tuple(p) for p in matches.measured.round(2).tolist()} <= expected


def test_another_network_is_one_clear_error(networks, pictures):
    with pytest.raises(InputError, match="aliked network"):
        get_matcher("aliked", Models(networks["lightglue"])).match(*pictures)
    with pytest.raises(InputError, match="LightGlue network"):
        get_matcher("aliked", Models(networks["aliked"], networks["aliked"])).match(*pictures)


@pytest.mark.skipif(hasattr(cv2, "LG_DISK"), reason="this OpenCV knows LightGlue for DISK")
def test_lightglue_for_disk_is_refused_where_opencv_lacks_it(networks):
    with pytest.raises(ConfigError, match="ALIKED only"):
        get_matcher("disk", Models(networks["disk"], networks["lightglue"]))
