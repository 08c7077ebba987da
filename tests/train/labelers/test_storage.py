"""Labelers by name, folder, ONNX file and object."""

from __future__ import annotations

import ast
import dataclasses
import itertools
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from benchmarks.people import read_markers
from gloves import Capture, MarkerLayout, MarkerPlace, attach, load_layout, read_capture, write_capture
from handsim import HandModel, HandSimError, HandSimWarning
from handsim.cli.main import main
from handsim.errors import ArgumentError, WeightsError
from handsim.files.models import stamp_model
from handsim.hand.shape import DIGITS
from poses import sample_poses
from tests.programs import run_python
from tests.sentences import error_names
from train import CNNConfig, Corruption, SetLabelerConfig, corrupt, evaluate_labeler, load_labeler
from train.labelers.cnn_labeler import MeanHand
from train.labelers.layout_labeler import LayoutLabeler
from train.labelers.networks import labeler_of, new_network
from train.labelers.protocol import OwnLabeler
from train.labelers.set_inference import TrainedSetLabeler
from train.labelers.storage import (
    _SHIPPED,
    CARD,
    WEIGHTS,
    OnnxLabeler,
    export_onnx,
    load_network,
    save_network,
    shipped_labelers,
    weights_metadata,
)

SHIPPED = json.loads((_SHIPPED / "dense19.json").read_text())
NETWORK = SHIPPED["network"]
CARDS = {
    "no names": {key: value for key, value in SHIPPED.items() if key != "marker_names"},
    "a number for names": SHIPPED | {"marker_names": 5},
    "a name twice": SHIPPED | {"marker_names": ["a"] * 19},
    "too few names": SHIPPED | {"marker_names": ["a"]},
    "a list": [1],
    "a list of settings": SHIPPED | {"network": [1]},
    "no width": SHIPPED | {"network": NETWORK | {"width": 0}},
    "text for a number": SHIPPED | {"network": NETWORK | {"reach": "far"}},
    "NaN": SHIPPED | {"network": NETWORK | {"reach": float("nan")}},
    "a network beyond any memory": SHIPPED | {"network": NETWORK | {"width": 4096, "depth": 100}},
    "an unknown kind": SHIPPED | {"labeler": "graph"},
    "a list for a kind": SHIPPED | {"labeler": []},
    "nested without end": "[" * 200_000,
}
NO_TORCH = """
import sys

class NoTorch:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "torch":
            raise ModuleNotFoundError("torch is not installed")

sys.meta_path.insert(0, NoTorch())
"""


EXAMPLE = Path(__file__).parents[3] / "examples" / "17_label_with_onnxruntime.py"


def write(folder, card, tensors=None):
    (folder / CARD).write_text(card if isinstance(card, str) else json.dumps(card))
    save_file(tensors or load_file(_SHIPPED / "dense19.safetensors"), folder / WEIGHTS)


@pytest.mark.parametrize("name", CARDS)
def test_a_card_that_is_none_is_told(tmp_path, name):
    write(tmp_path, CARDS[name])
    with pytest.raises(WeightsError, match=r"damaged or not a labeler's|names 1 markers for 19 labels"):
        load_labeler(tmp_path)


@pytest.mark.parametrize("value", [np.nan, np.inf, None])
def test_weights_that_are_no_numbers_or_lost_are_told(tmp_path, value):
    tensors = load_file(_SHIPPED / "dense19.safetensors")
    name = sorted(tensors)[0]
    tensor = tensors.pop(name).copy()
    if value is not None:
        tensor.flat[0] = value
        tensors[name] = tensor
    write(tmp_path, SHIPPED, tensors)
    words = "is damaged or not" if value is None else f"is damaged: {name} holds NaN or infinite values"
    with pytest.raises(WeightsError, match=words):
        load_labeler(tmp_path)


def test_a_pose_prior_of_another_glove_is_told(tmp_path):
    tensors = load_file(_SHIPPED / "dense19.safetensors")
    others = load_file(_SHIPPED / "sparse13.safetensors")
    priors = {name: table for name, table in others.items() if name.startswith("pose_prior.")}
    write(tmp_path, SHIPPED, tensors | priors)
    with pytest.raises(WeightsError, match="pose prior has 13 markers for 19 labels"):
        load_labeler(tmp_path)


def test_weights_without_a_pose_prior_are_read(tmp_path):
    tensors = load_file(_SHIPPED / "dense19.safetensors")
    write(tmp_path, SHIPPED, {name: one for name, one in tensors.items() if "pose_prior" not in name})
    assert load_labeler(tmp_path).prior is None


def header(content: bytes) -> dict:
    """A safetensors file's header by its published layout: its length, then JSON."""
    length = int.from_bytes(content[:8], "little")
    assert length % 8 == 0  # so that tensors are aligned
    return json.loads(content[8 : 8 + length])


@pytest.mark.parametrize("glove", shipped_labelers())
def test_shipped_weights_and_their_cards_tell_of_themselves(glove):
    card = json.loads((_SHIPPED / f"{glove}.json").read_text())
    content = (_SHIPPED / f"{glove}.safetensors").read_bytes()
    told = header(content)["__metadata__"]
    assert told == weights_metadata(card) and len(content) < 5_000_000
    assert card["dataset"]["glove"] == glove and tuple(card["marker_names"]) == load_layout(glove).names
    assert told["format"] == "pt"
    assert told["license"] == "apache-2.0"
    assert told["layout"] == glove
    assert json.loads(told["marker_names"]) == card["marker_names"]
    assert told["trained_on"] == "simulated frames only"
    assert told["handsim_version"] == card["handsim"]


def test_saved_weights_are_the_networks_and_the_same_bytes_each_time(tmp_path):
    network, card = load_network("dense19")
    for folder in ("one", "other"):
        save_network(tmp_path / folder, network, card)
    content = (tmp_path / "one" / WEIGHTS).read_bytes()
    assert content == (tmp_path / "other" / WEIGHTS).read_bytes()
    assert next(iter(header(content))) == "__metadata__"
    tensors, shipped = load_file(tmp_path / "one" / WEIGHTS), load_file(_SHIPPED / "dense19.safetensors")
    assert tensors.keys() == shipped.keys()
    for name, tensor in tensors.items():
        np.testing.assert_array_equal(tensor, shipped[name])
        assert tensor.dtype == shipped[name].dtype


def test_names_beyond_ascii_and_cards_that_say_little(tmp_path):
    network, _ = load_network("dense19")
    names = [f"Märker{number}" for number in range(19)]
    save_network(tmp_path, network, {"marker_names": names})
    told = header((tmp_path / WEIGHTS).read_bytes())["__metadata__"]
    assert json.loads(told["marker_names"]) == names
    assert "license" not in told
    assert load_labeler(tmp_path).marker_names == tuple(names)


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
    run_python(program)
    assert read_capture(tmp_path / "out.trc").names[:19] == names


@pytest.fixture(scope="module")
def program():
    """The example that needs no handsim, of which docs/own_labelers.md tells."""
    return EXAMPLE.read_text("utf-8")


def test_the_example_is_short_and_needs_no_handsim(program):
    nodes = list(ast.walk(ast.parse(program)))
    imported = [
        one.names[0].name if isinstance(one, ast.Import) else one.module
        for one in nodes
        if isinstance(one, ast.Import | ast.ImportFrom)
    ]
    others = {name.partition(".")[0] for name in imported} - sys.stdlib_module_names
    assert others == {"numpy", "onnxruntime", "scipy"}
    (function,) = [one for one in nodes if isinstance(one, ast.FunctionDef) and one.name == "label"]
    assert function.end_lineno - function.lineno < 43


@pytest.mark.parametrize("strength", [1.0, 0.3, 0.15], ids=["trained", "weak", "weaker"])
def test_the_example_labels_as_handsim_does(program, tmp_path, strength):
    network, card = load_network("sparse13")
    with torch.no_grad():  # as of a short training: scores of labels are closer together
        network.to_scores.weight *= strength
        network.to_scores.bias *= strength
    save_network(tmp_path, network, card)
    export_onnx(network, card["marker_names"], tmp_path / "weak.onnx")
    example, clouds, rng = {}, [], np.random.default_rng(3)
    exec(program, example)
    for size, side in itertools.product(("XS", "S", "M", "L", "XL"), ("right", "left")):
        model = HandModel.named(size, side=side)
        markers, _ = attach("sparse13", model).markers(sample_poses(model, 20, rng=rng))
        for occlude in (2, 7, 9):
            cloud = corrupt(markers[occlude::6], Corruption(occlude=occlude, ghosts=2), rng=rng)
            clouds += [points[there] for points, there in zip(cloud.points, cloud.present, strict=True)]
    clouds += [rng.uniform(-0.1, 0.1, (count, 3)) for count in (1, 1, 3, 4, 8, 8, 8, 8, 13)]
    expected = load_labeler(tmp_path).label_frames(clouds)
    labeler = example["open_labeler"](str(tmp_path / "weak.onnx"))
    same = [
        np.array_equal(example["label"](cloud, *labeler), one.labels)
        for cloud, one in zip(clouds, expected, strict=True)
    ]
    assert len(same) > 80 and np.mean(same) >= 0.99


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
    assert stamp_model(content) == content
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
    with error_names(HandSimError, f"needs the package {missing}, | run `pip install 'handsim[onnx]'`"):
        if missing == "onnx":
            export_onnx(new_network(SetLabelerConfig()), ("a",) * 19, tmp_path / "x.onnx")
        else:
            OnnxLabeler(exported)


@pytest.mark.parametrize("damage", ["nan", "names", "twice"])
def test_a_file_whose_network_is_of_no_use_is_told(exported, tmp_path, damage):
    onnx = pytest.importorskip("onnx")
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
    path.write_bytes(stamp_model(model.SerializeToString()))
    with pytest.raises(WeightsError, match=r"damaged.onnx is damaged or not a labeler's"):
        OnnxLabeler(path)


def test_the_file_tells_what_goes_in_and_out(exported):
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(exported))
    told = {entry.key: entry.value for entry in model.metadata_props}
    ends = [*model.graph.input, *model.graph.output]
    assert " ".join(end.name for end in ends) == "points present point_scores label_scores pairs costs"
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


class First:
    """The first point is the first marker, the others are ghosts."""

    marker_names = load_layout("tips8").names

    def label_frames(self, frames):
        labels = [np.where(np.arange(len(one)) == 0, 0, -1) for one in frames]
        return [SimpleNamespace(labels=one, confidence=np.ones(len(one))) for one in labels]


def test_a_layout_that_is_a_shipped_one_has_its_labeler(tmp_path):
    layout = load_layout("dense19")
    layout.save(tmp_path / "mine.toml")
    for glove in ("dense19", layout, tmp_path / "mine.toml", str(tmp_path / "mine.toml")):
        found = load_labeler(glove)
        assert isinstance(found, TrainedSetLabeler) and found.marker_names == layout.names


@pytest.mark.parametrize("given", ["name", "object", "path"])
def test_any_other_layout_is_learned_and_that_is_told(given, quickly_learned, tmp_path):
    layout = dataclasses.replace(load_layout("tips8"), name="mine")
    layout.save(tmp_path / "mine.toml")
    glove = {"name": "tips8", "object": layout, "path": tmp_path / "mine.toml"}[given]
    with pytest.warns(HandSimWarning, match="no labeler was trained on glove"):
        found = load_labeler(glove)
    assert isinstance(found, LayoutLabeler) and found.marker_names == layout.names
    labeling = found.label_frames([np.random.default_rng(0).normal(0, 0.05, (6, 3))])[0]
    assert labeling.labels.shape == (6,)


def test_a_glove_like_its_own_mirror_image_is_told(quickly_learned):
    fingers = [MarkerPlace(digit, f"{digit}_distal", 0.7, 0.0) for digit in DIGITS[1:]]
    places = [(along, across) for along in (0.3, 0.7) for across in (0.2, -0.2)]
    back = [MarkerPlace(f"{place}", "palm", place[0], 0.0, place[1]) for place in places]
    with pytest.warns(HandSimWarning, match="glove 'even' is nearly its own mirror image"):
        load_labeler(MarkerLayout("even", (*fingers, *back), 0.0032))
    with pytest.warns(HandSimWarning) as told:
        load_labeler("tips8")
    assert not any("mirror image" in str(one.message) for one in told)


def test_a_layout_of_the_same_name_and_other_places_is_another(quickly_learned):
    layout = load_layout("sparse13")
    moved = dataclasses.replace(layout.markers[0], along=layout.markers[0].along + 0.1)
    with pytest.warns(HandSimWarning, match="'sparse13'"):
        found = load_labeler(dataclasses.replace(layout, markers=(moved, *layout.markers[1:])))
    assert isinstance(found, LayoutLabeler)


def test_any_layout_needs_a_glove(quickly_learned):
    with pytest.raises(ArgumentError, match="'any-layout' needs a glove, expected load_labeler"):
        load_labeler("any-layout")
    assert isinstance(load_labeler("tips8", "any-layout"), LayoutLabeler)


def test_an_object_is_a_labeler_behind_checks():
    found = load_labeler(First())
    assert isinstance(found, OwnLabeler)
    assert found.label_frames([np.zeros((2, 3))])[0].labels.tolist() == [0, -1]
    assert load_labeler("tips8", First()).marker_names == First.marker_names
    shipped = load_labeler("dense19")
    assert load_labeler(shipped) is shipped
    with pytest.raises(WeightsError, match=r"the labeler knows markers .*, but glove 'dense19' has"):
        load_labeler("dense19", First())


def test_an_unfinished_run_is_named(tmp_path):
    (tmp_path / "train.json").write_text("{}")
    with pytest.raises(WeightsError, match=r"is an unfinished run .* same handsim train command"):
        load_labeler(tmp_path)


@pytest.mark.parametrize(("corruption", "least"), [(Corruption(0, 0), 0.985), (Corruption(), 0.92)])
def test_real_people_are_labeled(sig18, corruption, least, rng):
    labeler = load_labeler("dense19")
    files = sorted(sig18.rglob("*.trc"))
    chosen = rng.choice(len(files), size=40, replace=False)
    markers = read_markers([files[number] for number in chosen], labeler.marker_names)
    frames = markers[rng.choice(len(markers), size=min(2000, len(markers)), replace=False)]
    assert evaluate_labeler(labeler, frames, corruption, rng=rng).figures["slot_accuracy"] >= least
