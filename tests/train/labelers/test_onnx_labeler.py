"""The ONNX file says what torch says, needs no torch, and tells what is wrong with it."""

from __future__ import annotations

import ast
import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from gloves.captures.capture import Capture
from gloves.captures.formats import read_capture, write_capture
from gloves.fit import attach
from gloves.layout import load_layout
from handsim.cli.main import main
from handsim.errors import HandSimError, WeightsError
from handsim.hand.model import HandModel
from poses import sample_poses
from train import Corruption, corrupt
from train.config import CNNConfig, SetLabelerConfig
from train.glove_labeler import load_labeler
from train.labelers.kinds import labeler_of, new_network
from train.labelers.onnx_labeler import OnnxLabeler, export_onnx, sign_model
from train.labelers.views import MeanHand

PAGE = Path(__file__).parents[3] / "docs" / "how_to" / "onnx.md"
NO_TORCH = """
import sys

class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "torch":
            raise ModuleNotFoundError("torch is not installed")

sys.meta_path.insert(0, NoTorch())
"""


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    path = tmp_path_factory.mktemp("onnx") / "dense19.onnx"
    assert main(["export", "dense19", "--out", str(path)]) == 0
    return path


def test_labels_are_those_of_torch(exported, rng):
    frames = [
        rng.normal(scale=0.04, size=(count, 3)) for count in rng.integers(3, 40, size=50)
    ]  # two points are alike
    ours, theirs = load_labeler(exported), load_labeler("dense19")
    assert ours.marker_names == theirs.marker_names
    for one, other in zip(ours.label_frames(frames), theirs.label_frames(frames), strict=True):
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_allclose(one.confidence, other.confidence, atol=1e-4)


def test_a_capture_is_labeled_without_torch(exported, tmp_path, rng):
    names = load_layout("dense19").names
    capture = Capture(names, rng.uniform(0.0, 0.15, size=(4, 19, 3)), 120.0)
    write_capture(tmp_path / "take.trc", capture)
    arguments = ["label", str(tmp_path / "take.trc"), "--labeler", str(exported)]
    arguments += ["--out", str(tmp_path / "out.trc")]
    program = NO_TORCH + f"from handsim.cli.main import main\nraise SystemExit(main({arguments!r}))"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)
    assert read_capture(tmp_path / "out.trc").names[:19] == names


def test_the_program_of_the_page_labels_as_handsim_does_and_needs_no_handsim(exported):
    """docs/how_to/onnx.md, on simulated hands with drops and ghosts."""
    program = PAGE.read_text("utf-8").split("```python\n")[1].split("```")[0]
    nodes = list(ast.walk(ast.parse(program)))
    imported = [
        one.names[0].name if isinstance(one, ast.Import) else one.module
        for one in nodes
        if isinstance(one, ast.Import | ast.ImportFrom)
    ]
    assert {name.partition(".")[0] for name in imported} == {
        "base64",
        "io",
        "json",
        "numpy",
        "onnxruntime",
        "scipy",
    }
    (function,) = [one for one in nodes if isinstance(one, ast.FunctionDef) and one.name == "label"]
    assert function.end_lineno - function.lineno < 40
    page = {}
    exec(program, page)
    labeler, clouds, rng = page["open_labeler"](str(exported)), [], np.random.default_rng(3)
    for size, side in itertools.product(("XS", "S", "M", "L", "XL"), ("right", "left")):
        model = HandModel.named(size, side=side)
        markers, _ = attach("dense19", model).markers(sample_poses(model, 20, rng=rng))
        cloud = corrupt(markers, Corruption(occlude=5, ghosts=2), rng=rng)
        clouds += [points[there] for points, there in zip(cloud.points, cloud.present, strict=True)]
    expected = load_labeler("dense19").label_frames(clouds)
    same = [
        np.array_equal(page["label"](cloud, *labeler), one.labels)
        for cloud, one in zip(clouds, expected, strict=True)
    ]
    assert len(same) == 200 and np.mean(same) >= 0.995


def test_damaged_files_are_told(exported, tmp_path):
    for name, content in (
        ("cut.onnx", exported.read_bytes()[:-5000]),
        ("empty.onnx", b""),
        ("words.onnx", b"x" * 500),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(WeightsError, match=rf"{name} is damaged or not a labeler's"):
            OnnxLabeler(tmp_path / name)
    with pytest.raises(WeightsError, match=r"none\.onnx is missing"):
        OnnxLabeler(tmp_path / "none.onnx")


def test_a_changed_byte_is_told_before_onnxruntime_reads_it(exported, tmp_path, rng):
    content, path = exported.read_bytes(), tmp_path / "changed.onnx"
    assert sign_model(content) == content
    for place in rng.integers(len(content), size=200):
        changed = bytearray(content)
        changed[place] ^= 1 + int(rng.integers(255))
        path.write_bytes(changed)
        with pytest.raises(WeightsError, match=r"changed\.onnx is damaged or not a labeler's"):
            OnnxLabeler(path)


def test_the_papers_network_labels_alike_in_both_runtimes(tmp_path, rng):
    torch.manual_seed(0)
    network = new_network(CNNConfig(num_labels=4, reject=0.03))
    hands = rng.normal(scale=0.05, size=(50, 4, 3))
    network.mean_hand.set(MeanHand.of_clouds(hands, hands, np.ones((50, 4), dtype=bool)))
    export_onnx(network, tuple("abcd"), tmp_path / "cnn.onnx")
    frames = [hands[0], hands[1, :3]]
    by_torch = labeler_of(network, tuple("abcd")).label_frames(frames)
    found = OnnxLabeler(tmp_path / "cnn.onnx").label_frames(frames)
    for labeling, expected in zip(found, by_torch, strict=True):
        assert labeling.labels.tolist() == expected.labels.tolist()
        np.testing.assert_allclose(labeling.confidence, expected.confidence, atol=1e-4)


@pytest.mark.parametrize("missing", ["onnx", "onnxruntime"])
def test_what_is_not_installed_is_told(exported, tmp_path, monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(
        HandSimError, match=rf"needs {missing}; install it with: pip install 'handsim\[onnx\]'"
    ):
        if missing == "onnx":
            export_onnx(new_network(SetLabelerConfig()), ("a",) * 19, tmp_path / "x.onnx")
        else:
            OnnxLabeler(exported)


@pytest.mark.parametrize("damage", ["nan", "names", "twice"])
def test_a_file_whose_network_is_of_no_use_is_told(exported, tmp_path, damage):
    import json

    import onnx

    model = onnx.load(str(exported))
    if damage == "nan":
        (weights, *_) = [one for one in model.graph.initializer if "embed.0.bias" in one.name]
        weights.CopyFrom(
            onnx.numpy_helper.from_array(np.full(weights.dims, np.nan, np.float32), weights.name)
        )
    else:
        entry = next(entry for entry in model.metadata_props if "names" in entry.key)
        names = json.loads(entry.value)
        entry.value = json.dumps(names[:-1] if damage == "names" else [*names[:-1], names[0]])
    path = tmp_path / "damaged.onnx"
    path.write_bytes(sign_model(model.SerializeToString()))
    with pytest.raises(WeightsError, match=r"damaged.onnx is damaged or not a labeler's"):
        OnnxLabeler(path)


def test_the_file_tells_what_goes_in_and_out(exported):
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(exported))
    told = {entry.key: entry.value for entry in model.metadata_props}
    ends = [*model.graph.input, *model.graph.output]
    assert [end.name for end in ends] == [
        "points",
        "present",
        "point_scores",
        "label_scores",
        "pairs",
        "costs",
    ]
    for end in ends:
        assert told[f"handsim.{end.name}"] == end.doc_string != ""
    assert "meters" in told["handsim.points"]
    assert model.producer_name == "handsim"
    assert "float32" in model.doc_string


def test_what_it_tells_is_so(exported, rng):
    """Log-probabilities, whatever is in the padding; the last columns are a ghost and not seen."""
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(exported.read_bytes(), providers=["CPUExecutionProvider"])
    points = rng.normal(scale=0.04, size=(2, 9, 3)).astype(np.float32)
    present = np.array([[True] * 9, [True] * 6 + [False] * 3])
    by_point, by_label = session.run(["point_scores", "label_scores"], {"points": points, "present": present})
    assert by_point.shape == (2, 9, 20)
    assert by_label.shape == (2, 19, 10)
    np.testing.assert_allclose(np.exp(by_point).sum(axis=-1), 1.0, atol=1e-4)
    np.testing.assert_allclose(np.exp(by_label).sum(axis=-1), 1.0, atol=1e-4)
    assert np.exp(by_label[1, :, 6:9]).max() < 1e-6  # no marker is a point of the padding
    points[1, 6:] = 5.0
    again = session.run(["point_scores", "label_scores"], {"points": points, "present": present})
    np.testing.assert_allclose(again[0][1, :6], by_point[1, :6], atol=1e-4)
    np.testing.assert_allclose(again[1], by_label, atol=1e-4)
