"""ONNX models that were made to fill the memory, all with a right checksum, are refused at a small cost."""

from __future__ import annotations

import base64
import io
import resource
import zipfile

import numpy as np
import pytest

from handsim.errors import WeightsError
from handsim.files.models import DIGEST, check_model, stamp_model
from train.labelers.storage import OnnxLabeler

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
helper, from_array = onnx.helper, onnx.numpy_helper.from_array
FLOAT = onnx.TensorProto.FLOAT
MOST_MEGABYTES = 1500.0
ONE = np.ones(1, np.float32)
SIDES = {"column": (60_000, 1), "row": (1, 60_000)}


def node(kind, inputs, outputs, **attributes):
    return helper.make_node(kind, inputs, outputs, **attributes)


def sized(*counts):
    return from_array(np.array(counts, np.int64), "size")


def bomb(depth=1):
    """An .npz of zeros that expands a thousandfold; with `depth`, archives in archives."""
    content = io.BytesIO()
    np.savez_compressed(content, means=np.zeros(400_000_000, np.uint8))
    for _ in range(depth - 1):
        inner, content = content.getvalue(), io.BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("means.npy", inner)
    return base64.b64encode(content.getvalue()).decode()


def loop():
    values = [helper.make_tensor_value_info(name, kind, []) for name, kind in (("i", 7), ("c", 9), ("d", 9))]
    grown = [helper.make_tensor_value_info(name, FLOAT, None) for name in ("a", "b")]
    nodes = [node("Identity", ["c"], ["d"]), node("Concat", ["a", "a"], ["b"], axis=0)]
    body = helper.make_graph(nodes, "body", [*values[:2], grown[0]], [values[2], grown[1]])
    return node("Loop", ["size", "", "points"], ["out"], body=body)


BOMBS = {
    "constant": ([node("ConstantOfShape", ["size"], ["out"], value=from_array(ONE))], [sized(1 << 31)]),
    "expand": ([node("Expand", ["points", "size"], ["out"])], [sized(1 << 26, 1, 5, 3)]),
    "range": (
        [node("Range", ["zero", "size", "step"], ["out"])],
        [sized(), from_array(np.array(0), "zero"), from_array(np.array(1), "step")],
    ),
    "doubling": (
        [node("Concat", [f"c{n}"] * 2, [f"c{n + 1}"], axis=0) for n in range(40)],
        [from_array(ONE, "c0")],
    ),
    "outer": (
        [node("MatMul", ["column", "row"], ["out"])],
        [
            from_array(np.ones((60_000, 1), np.float32), "column"),
            from_array(np.ones((1, 60_000), np.float32), "row"),
        ],
    ),
    "padding": ([node("Pad", ["points", "size"], ["out"])], [sized(0, 0, 0, 1 << 30, 0, 0)]),
    "tile": ([node("Tile", ["points", "size"], ["out"])], [sized(1 << 27, 1, 1)]),
    "loop": ([loop()], [sized(40)]),
    "many nodes": ([node("Neg", ["points"], [f"n{n}"]) for n in range(60_000)], []),
    "many weights": ([], [from_array(ONE, f"w{n}") for n in range(60_000)]),
    "many inputs": ([node("Sum", ["points"] * 1_000_000, ["out"])], []),
}


def model_of(nodes, weights, **metadata):
    points = helper.make_tensor_value_info("points", FLOAT, [None, None, 3])
    out = helper.make_tensor_value_info(nodes[-1].output[0] if nodes else "points", FLOAT, None)
    model = helper.make_model(
        helper.make_graph(nodes, "graph", [points], [out], weights),
        opset_imports=[helper.make_opsetid("", 13)],
        ir_version=8,
    )
    names = {"handsim.marker_names": '["a", "b", "c", "d"]', DIGEST: "0" * 64}
    helper.set_model_props(model, names | metadata)
    return model


def refused(model, tmp_path):
    """Megabytes by which refusing a model let the largest memory grow."""
    path = tmp_path / "bomb.onnx"
    path.write_bytes(stamp_model(model.SerializeToString()))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(WeightsError, match="damaged or not a labeler's"):
        OnnxLabeler(path)
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0


@pytest.mark.parametrize("kind", BOMBS)
def test_a_graph_that_would_fill_the_memory_is_refused(kind, tmp_path):
    assert refused(model_of(*BOMBS[kind]), tmp_path) < MOST_MEGABYTES


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_a_pose_prior_that_is_an_archive_bomb_is_refused(depth, tmp_path):
    named = {"handsim.pose_prior": bomb(depth)}
    model = model_of([node("Identity", ["points"], ["point_scores"])], [], **named)
    assert refused(model, tmp_path) < 300.0


def sparse(graph):
    values, places = from_array(ONE, "sparse"), from_array(np.zeros(1, np.int64), "places")
    graph.sparse_initializer.append(helper.make_sparse_tensor(values, places, [1 << 30]))


def external(graph):
    weights = graph.initializer.add(name="w", data_type=FLOAT, dims=[1 << 28], data_location=1)
    weights.external_data.add(key="location", value="/dev/zero")


def undersized(graph):
    graph.initializer.add(name="w", data_type=FLOAT, dims=[1 << 33], raw_data=b"1234")


@pytest.mark.parametrize("change", [sparse, external, undersized])
def test_weights_that_are_not_in_the_file_are_refused(change, tmp_path):
    model = model_of([node("Identity", ["points"], ["point_scores"])], [])
    change(model.graph)
    assert refused(model, tmp_path) < 300.0


def test_a_plain_model_passes_and_a_changed_byte_does_not():
    content = stamp_model(model_of([node("Neg", ["points"], ["out"])], []).SerializeToString())
    check_model(content)
    for changed in (content[:-1], content + b"\0", content.replace(b"Neg", b"Abs"), b"", b"\x0a\xff" * 40):
        with pytest.raises(ValueError):
            check_model(changed)
