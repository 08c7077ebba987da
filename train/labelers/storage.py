"""Labelers by their names and files: of a glove, for any layout, trained, exported, or a user's object.

A trained labeler is a safetensors file of weights and a model card in JSON, or a single ONNX file, which
onnxruntime runs without torch. Metadata of the weights repeat parts of the card for people who find only that
file; handsim reads only the card.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import hashlib
import io
import json
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.layout import MarkerLayout, list_layouts, load_layout
from handsim._checks import check_type
from handsim._plugins import import_extra, is_plugin, list_plugins
from handsim._version import full_version
from handsim.errors import DAMAGE, ArgumentError, HandSimWarning, WeightsError, choices
from handsim.files.arrays import read_npz
from handsim.files.inputs import read_bytes
from handsim.files.models import DIGEST, MAX_MODEL_BYTES, bounded_session, stamp_model
from handsim.files.outputs import atomic_write, plain_path, save_json, written_together
from train.labelers.cnn_labeler import CNNLabeler, MeanHand
from train.labelers.matching import matching_constants
from train.labelers.pose_prior import PosePrior
from train.labelers.protocol import (
    LABELERS,
    Labeler,
    Labeling,
    OwnLabeler,
    checked_names,
    label_by_scores,
    label_in_batches,
    pad_clouds,
)
from train.labelers.set_inference import TrainedSetLabeler, weight_shapes
from train.settings import CNNConfig, Kind, NetworkConfig, SetLabelerConfig

if TYPE_CHECKING:
    from torch import nn


ANY_LAYOUT: Final = "any-layout"
"""Name of the labeler that needs no training."""
WEIGHTS: Final = "labeler.safetensors"
CARD: Final = "labeler.json"
_ANY_LAYOUT: Final = "any_layout"  # file stem of the weights of the network for any layout
_PRIOR: Final = "pose_prior."  # prefix of the names of the prior's tensors
_METADATA: Final = "__metadata__"  # key in the header of a safetensors file
_LENGTH_BYTES: Final = 8  # bytes that hold the header's length
_CONFIGS: Final[dict[Kind, type[NetworkConfig]]] = {"set": SetLabelerConfig, "cnn": CNNConfig}
_SHIPPED: Final = Path(__file__).parents[1] / "weights"
GLOVE: Final = "glove.toml"
"""File with the marker layout of a run."""
RUN_SETTINGS: Final = "train.json"
"""File with the settings of a run, written at its beginning."""
_FEW_POSES: Final = 6000  # poses that describe a layout to a labeler that skips learning
_EXPECTED: Final = (
    "a MarkerLayout, the name or path of one, a Labeler, the folder of a trained one, an .onnx file, or "
    "module:name"
)
_NAMES: Final = "handsim.marker_names"  # key of the marker names in the file's metadata
_CNN: Final = "handsim.cnn"  # key of the settings of the paper's network
_ONNX_PRIOR: Final = "handsim.pose_prior"  # key of the pose prior: an .npz in base64
_MATCHING: Final = "handsim.matching"  # key of the constants of matching, for other programs
_IMAGES: Final = "images"  # input of the paper's network
_INPUTS: Final = "points", "present"
_OUTPUTS: Final = "point_scores", "label_scores"
_PAIRED: Final = "pairs", "costs"  # outputs for other programs
_OPSET: Final = 17
_DESCRIPTION: Final = (
    "Labels the reflective markers of one hand in one frame. Compute in float32: runtimes that choose "
    "bfloat16 by themselves change labels (OpenVINO: INFERENCE_PRECISION_HINT f32)."
)
_DESCRIPTIONS: Final = {
    "points": "Points of each frame in meters, less their mean; axes of any direction. Zeros where there is "
    "none.",
    "present": "Whether a row of points is one.",
    "point_scores": "Log-probability for each point of each marker, in the order of handsim.marker_names; "
    "the last column is a ghost.",
    "label_scores": "Log-probability for each marker of each point; the last column is that it is not seen.",
    "pairs": "Probability for each point of each marker, no two points of one marker; the last column is a "
    "ghost.",
    "costs": "What each marker costs each point, then each point as a ghost, in its own column: labels are "
    "the assignment of least cost, verified by a prior of hands (docs/own_labelers.md).",
    "images": "Depth images of Han et al. 2018: 52 x 52, a pixel a point, brightness its depth; 0 where "
    "there is none.",
    "positions": "Predicted position of each marker in the view: x right, y down, z away; 1 is half an "
    "image's width.",
}
"""Descriptions of inputs and outputs, stored in the file's metadata as `handsim.` and name."""


def load_labeler(
    glove: MarkerLayout | Labeler | str | Path, labeler: Labeler | str | Path | None = None
) -> Labeler:
    """The labeler of a glove, or a labeler by its name, path or object.

    A glove without a trained labeler gets the one for any layout, which learns the layout in about a
    minute. Only shipped labelers, folders and the one for any layout need torch.

    Args:
        glove: A marker layout, or its name or path, whose labeler is returned. Without `labeler` also a
            labeler: a folder written by `handsim train`, an .onnx file, `module:name` of a `Labeler` or of a
            class of them, an entry point of the group `handsim.labelers`, or a `Labeler`.
        labeler: A labeler as above, or `any-layout`, to be used with this glove; its markers must be the
            glove's.

    Returns:
        A labeler; `label_frames` gives labels (N,) and confidences (N,) of points (N, 3) [m].

    Raises:
        ArgumentError: An argument is none of these, or `any-layout` is given without a glove.
        LayoutError: The glove is unknown.
        WeightsError: The labeler is unknown, damaged, or knows other markers.

    Warns:
        HandSimWarning: The glove has no trained labeler, so that the one for any layout is used; or such a
            glove is nearly its own mirror image.
    """
    if labeler is None and not _is_glove(glove):
        return _resolved(glove)
    layout = load_layout(glove)  # type: ignore[arg-type]
    if labeler is None:
        return _shipped_labeler(layout) or _any_layout_labeler(layout, glove)  # type: ignore[arg-type]
    if labeler == ANY_LAYOUT:
        from train.labelers.layout_labeler import learned_labeler  # torch

        return learned_labeler(layout)
    found = _resolved(labeler)
    if found.marker_names != layout.names:
        raise WeightsError(
            f"the labeler knows markers {', '.join(found.marker_names)}, but glove '{layout.name}' has "
            f"{', '.join(layout.names)}; name the glove that it was trained on (--glove)"
        )
    return found


@functools.lru_cache(maxsize=32)
def labeler_at_once(layout: MarkerLayout) -> Labeler:
    """A labeler of a glove without any learning; it is good enough to recognize the glove."""
    shipped = _shipped_labeler(layout)
    if shipped is not None:
        return shipped
    from train.labelers.layout_labeler import LayoutLabeler, is_learned, learned_labeler  # torch

    return (
        learned_labeler(layout) if is_learned(layout) else LayoutLabeler.at_once(layout, num_poses=_FEW_POSES)
    )


def _is_glove(given: Any) -> bool:
    """Whether an argument is a glove rather than a labeler."""
    return (
        isinstance(given, MarkerLayout)
        or str(given) in list_layouts()
        or (isinstance(given, str | Path) and Path(given).suffix.lower() == ".toml")
    )


def _resolved(labeler: Any) -> Labeler:
    """Load a labeler given as an object, by name or by path."""
    if labeler == ANY_LAYOUT:
        raise ArgumentError(
            f"labeler '{ANY_LAYOUT}' needs a glove, expected load_labeler(GLOVE, '{ANY_LAYOUT}') with a "
            "MarkerLayout, or the name or path of one"
        )
    if hasattr(labeler, "label_frames") and not isinstance(labeler, type):
        ours = type(labeler).__module__.startswith("train.")
        return labeler if ours else OwnLabeler(labeler)
    check_type("labeler", labeler, (str, Path), _EXPECTED, list_layouts())
    name, path = str(labeler), Path(labeler)
    if path.suffix.lower() == ".onnx":
        return OnnxLabeler(path)
    if not path.exists() and (is_plugin(name) or name in list_plugins(LABELERS)):
        return OwnLabeler(name)
    return _read_labeler(*_files_of_labeler(name)).labeler()


def _shipped_labeler(layout: MarkerLayout) -> Labeler | None:
    """The shipped labeler of a layout, if there is one."""
    found = (name for name in shipped_labelers() if load_layout(name) == layout)
    return next((_read_labeler(*_files_of_labeler(name)).labeler() for name in found), None)


def untrained_labeler(layout: MarkerLayout) -> Labeler:
    """The labeler that a glove has without training: the shipped one, or the one for any layout."""
    return _shipped_labeler(layout) or load_labeler(layout, ANY_LAYOUT)


def _any_layout_labeler(layout: MarkerLayout, glove: MarkerLayout | str | Path) -> Labeler:
    """The labeler for any layout, with a warning that the glove has no trained one."""
    from train.labelers.layout_labeler import is_learned, learned_labeler  # torch
    from train.labelers.pose_prior import is_mirror_like  # kernels

    own = isinstance(glove, MarkerLayout) and layout not in map(load_layout, list_layouts())
    name = layout.name if isinstance(glove, MarkerLayout) else str(glove)
    how = (
        "has learned it before"
        if is_learned(layout)
        else "learns it now, once, in about a minute of an idle core"
    )
    warnings.warn(
        f"no labeler was trained on glove '{name}', so that the one for any layout labels it, which {how}; "
        f"handsim generate --glove {'GLOVE.toml' if own else name} --out SET && handsim train SET --out RUN "
        "trains one and says which of the two is better",
        HandSimWarning,
        stacklevel=3,
    )
    if is_mirror_like(layout):
        warnings.warn(
            f"glove '{name}' is nearly its own mirror image, so that right and left may be exchanged for a "
            "whole capture; put a marker on the thumb, or move those on the back away from any symmetry",
            HandSimWarning,
            stacklevel=3,
        )
    return learned_labeler(layout)


def shipped_labelers() -> tuple[str, ...]:
    """Names of the gloves with shipped trained labelers."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.safetensors") if path.stem != _ANY_LAYOUT))


def load_network(name_or_path: str | Path) -> tuple[nn.Module, dict[str, Any]]:
    """A trained network and its model card."""
    stored = _read_labeler(*_files_of_labeler(str(name_or_path)))
    return stored.network(), stored.card


def _files_of_labeler(name: str) -> tuple[Path, Path]:
    """Paths of weights and card, of a shipped labeler or in a folder."""
    if name in shipped_labelers():
        return _SHIPPED / f"{name}.safetensors", _SHIPPED / f"{name}.json"
    weights, card = Path(name) / WEIGHTS, Path(name) / CARD
    if not weights.is_file() or not card.is_file():
        if (Path(name) / RUN_SETTINGS).is_file():
            raise WeightsError(
                f"{name} is an unfinished run without weights; the same handsim train command goes on with it"
            )
        unknown = choices(name, shipped_labelers(), noun="labeler or glove")
        raise WeightsError(
            f"{unknown}, a layout's .toml file, a folder that handsim train wrote, an .onnx file, or "
            "module:name"
        )
    return weights, card


@dataclass(frozen=True, slots=True, eq=False)
class _Stored:
    """Contents of a labeler's two files."""

    config: NetworkConfig
    card: dict[str, Any]
    weights: dict[str, NDArray[Any]]
    """Weights of the network by name."""
    prior: PosePrior | None

    def labeler(self) -> Labeler:
        """The labeler; the set labeler works without torch."""
        names = tuple(self.card["marker_names"])
        if isinstance(self.config, SetLabelerConfig):
            return TrainedSetLabeler(self.config, self.weights, self.prior, names)
        from train.labelers.networks import labeler_of

        return labeler_of(self.network(), names)

    def network(self) -> nn.Module:
        """The network in torch."""
        import torch

        from train.labelers.networks import new_network

        network = new_network(self.config)
        network.load_state_dict({name: torch.from_numpy(one) for name, one in self.weights.items()})
        if self.prior is not None:
            network.prior = self.prior  # type: ignore[assignment]
        return network


def _read_labeler(weights: Path, card: Path) -> _Stored:
    """Read and validate weights and card."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        content = json.loads(read_bytes(card, error=WeightsError, max_bytes=1 << 24))
    except (ValueError, RecursionError) as error:
        raise WeightsError(f"{card} is damaged or not a labeler's: it holds no JSON") from error
    try:
        names = checked_names(content["marker_names"])
        config = _CONFIGS[content.get("labeler", "set")](**content["network"])
        if len(names) != config.num_labels:
            raise WeightsError(f"{card} names {len(names)} markers for {config.num_labels} labels")
        expected = _shapes_of(config)
        if content.get("sha256", digest := _digest(content, weights.read_bytes())) != digest:
            raise ValueError(f"its weights and {card.name} do not have the SHA-256 that the card names")
        if weights.stat().st_size < 4 * sum(map(math.prod, expected.values())):
            raise ValueError("it is too short for the network that its card describes")
        tensors = load_file(weights)
        tables = {
            name.removeprefix(_PRIOR): tensors.pop(name) for name in list(tensors) if name.startswith(_PRIOR)
        }
        for name in sorted(expected.keys() | tensors.keys()):
            found = tensors[name].shape if name in tensors else None
            if found != expected.get(name):
                raise ValueError(f"{name} has shape {found}, expected {expected.get(name)}")
        prior = PosePrior.of_tensors(tables, config.num_labels) if tables else None
    except WeightsError:
        raise
    except (*DAMAGE, SafetensorError, OSError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise WeightsError(f"{weights} is damaged or not a labeler's: {reason}") from error
    for name, tensor in tensors.items():
        if not np.isfinite(tensor).all():
            raise WeightsError(f"{weights} is damaged: {name} holds NaN or infinite values")
    return _Stored(config, content, tensors, prior)


def _digest(card: dict[str, Any], weights: bytes) -> str:
    """SHA-256 of all that determines labels: markers, network and weights."""
    described = json.dumps([card["marker_names"], card.get("labeler"), card["network"]])
    return hashlib.sha256(described.encode() + weights).hexdigest()


def _shapes_of(config: NetworkConfig) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network's weights."""
    if isinstance(config, SetLabelerConfig):
        return weight_shapes(config)
    import torch

    from train.labelers.networks import new_network

    with torch.device("meta"):
        return {name: tuple(one.shape) for name, one in new_network(config).state_dict().items()}


def save_network(folder: Path, network: nn.Module, card: dict[str, Any]) -> None:
    """Write the weights, with the pose prior if there is one, and the model card."""
    import torch
    from safetensors.torch import save

    config: NetworkConfig = network.config  # type: ignore[assignment]
    kind = "cnn" if isinstance(config, CNNConfig) else "set"
    card = {"labeler": kind, "network": dataclasses.asdict(config), **card}
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    prior = getattr(network, "prior", None)
    if isinstance(prior, PosePrior):
        tensors |= {_PRIOR + name: torch.from_numpy(table) for name, table in prior.tensors().items()}
    content = _with_metadata(save(tensors), weights_metadata(card))
    with written_together():
        with atomic_write(folder / WEIGHTS) as temporary:
            temporary.write_bytes(content)  # safetensors' own writer does not report a full disk
        save_json(folder / CARD, card | {"sha256": _digest(card, content)})


def weights_metadata(card: dict[str, Any]) -> dict[str, str]:
    """Metadata of the weights: those parts of the card that describe them, as text."""
    known = {
        "format": "pt",
        "library_name": "handsim",
        "handsim_version": card.get("handsim"),
        "labeler": card.get("labeler"),
        "layout": card.get("dataset", {}).get("layout", {}).get("name"),
        "marker_names": json.dumps(card["marker_names"]),
        "units": "points in meters",
        "trained_on": card.get("trained_on"),
        "license": card.get("license"),
    }
    return {name: value for name, value in known.items() if value is not None}


def _with_metadata(content: bytes, metadata: dict[str, str]) -> bytes:
    """A safetensors file with its metadata in this order; safetensors' own writer shuffles them."""
    end = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
    tensors = json.loads(content[_LENGTH_BYTES:end])
    tensors.pop(_METADATA, None)
    header = json.dumps({_METADATA: metadata, **tensors}, separators=(",", ":"), ensure_ascii=False).encode()
    header += b" " * (-len(header) % _LENGTH_BYTES)  # Tensors must begin at a multiple of eight bytes.
    return len(header).to_bytes(_LENGTH_BYTES, "little") + header + content[end:]


class OnnxLabeler:
    """A labeler of either kind from an ONNX file written by `handsim export`, on one thread."""

    def __init__(self, path: Path) -> None:
        onnxruntime = import_extra("onnxruntime", "an .onnx labeler", "onnx")
        if not path.is_file():
            raise WeightsError(f"{path} is missing, expected an .onnx file that handsim export wrote")
        content = read_bytes(path, error=WeightsError, max_bytes=MAX_MODEL_BYTES)
        try:
            self._session = bounded_session(content)
            metadata = self._session.get_modelmeta().custom_metadata_map
            self._scores_alone = onnxruntime.RunOptions()  # skips the outputs for other programs
            self._scores_alone.only_execute_path_to_fetches = True
            self.marker_names = checked_names(json.loads(metadata[_NAMES]))
            self.prior = None
            if _ONNX_PRIOR in metadata:
                stored = base64.b64decode(metadata[_ONNX_PRIOR], validate=True)
                self.prior = PosePrior.of_tensors(read_npz(stored), len(self.marker_names))
            self._label = self._label_by_images(metadata[_CNN]) if _CNN in metadata else self._label_by_scores
            self._check_outputs(_IMAGES if _CNN in metadata else _INPUTS[0])
        except Exception as error:  # onnxruntime's errors have no common class.
            raise WeightsError(
                f"{path} is damaged or not a labeler's: expected what handsim export wrote"
            ) from error

    def _check_outputs(self, given: str) -> None:
        """Raise a ValueError unless the outputs are finite and have a labeler's shapes."""
        count = len(self.marker_names)
        if given == _IMAGES:
            found = self._session.run(None, {_IMAGES: np.zeros((1, 1, 52, 52), np.float32)})[:1]
            shapes = [(1, count, 3)]
        else:
            points = np.linspace(0.0, 0.1, 15, dtype=np.float32).reshape(1, 5, 3)
            found = self._session.run(
                _OUTPUTS, dict(zip(_INPUTS, (points, np.ones((1, 5), bool)), strict=True))
            )
            shapes = [(1, 5, count + 1), (1, count, 6)]
        if [output.shape for output in found] != shapes or not all(np.isfinite(one).all() for one in found):
            raise ValueError("the outputs are not those of a labeler")

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points [m] of every frame, see `train.labelers.protocol.Labeler`."""
        return label_in_batches(frames, self._label)

    def _label_by_scores(self, clouds: list[NDArray[np.float64]]) -> list[Labeling]:
        """Label a batch with the set labeler."""
        given = dict(zip(_INPUTS, pad_clouds(clouds), strict=True))
        by_point, by_label = self._session.run(_OUTPUTS, given, self._scores_alone)
        return label_by_scores(clouds, by_point, by_label, self.prior)

    def _label_by_images(self, settings: str) -> Callable[[list[NDArray[np.float64]]], list[Labeling]]:
        """A function that labels a batch with the paper's network, given its settings in JSON."""
        content = json.loads(settings)
        hand = MeanHand(*(np.array(content["mean_hand"][field.name]) for field in fields(MeanHand)))
        config = CNNConfig(**content["config"])

        def positions(images: NDArray[np.float32]) -> NDArray[np.float32]:
            return np.asarray(self._session.run(None, {_IMAGES: images})[0])

        return CNNLabeler(positions, hand, config, self.marker_names).label_batch


def export_onnx(network: nn.Module, marker_names: Sequence[str], path: Path) -> None:
    """Write a trained labeler as an ONNX file for any number of clouds of any size."""
    import torch

    from train.labelers.cnn_network import DeepLabelCNN
    from train.labelers.networks import PairedScores

    onnx = import_extra("onnx", "exporting", "onnx")
    properties = {_NAMES: json.dumps(list(marker_names)), DIGEST: "0" * 64, "handsim.version": full_version()}
    example: tuple[torch.Tensor, ...]
    if isinstance(network, DeepLabelCNN):
        example, inputs, outputs = (torch.zeros(2, 1, 52, 52),), [_IMAGES], ["positions"]
        axes = {name: {0: "images"} for name in (*inputs, *outputs)}
        hand = {name: value.tolist() for name, value in asdict(network.mean_hand.get()).items()}
        properties[_CNN] = json.dumps({"config": asdict(network.config), "mean_hand": hand})
    else:
        example = torch.randn(2, 5, 3), torch.tensor([[True] * 5, [True] * 4 + [False]])
        inputs, outputs = list(_INPUTS), list(_OUTPUTS)
        axes = {name: {0: "frames", 1: "points"} for name in _INPUTS}
        axes |= {_OUTPUTS[0]: {0: "frames", 1: "points"}, _OUTPUTS[1]: {0: "frames", 2: "points_and_none"}}
        prior = getattr(network, "prior", None)
        if isinstance(prior, PosePrior):
            stored = io.BytesIO()
            np.savez(stored, **prior.tensors())  # type: ignore[arg-type]
            properties[_ONNX_PRIOR] = base64.b64encode(stored.getvalue()).decode()
            properties[_MATCHING] = json.dumps(matching_constants())
            network, outputs = PairedScores(network), [*outputs, *_PAIRED]
            axes |= {name: {0: "frames", 1: "points"} for name in _PAIRED}
            axes[_PAIRED[1]][2] = "markers_and_points"
    with atomic_write(path) as temporary, plain_path(temporary) as plain, warnings.catch_warnings():
        # The newer exporter needs another package, and fixes the sizes of expanded arrays.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.eval(),
            example,
            str(plain),
            input_names=inputs,
            output_names=outputs,
            dynamic_axes=axes,
            opset_version=_OPSET,
            dynamo=False,
        )
        model = onnx.load(str(plain))
        model.producer_name, model.producer_version = "handsim", full_version()
        model.doc_string = model.graph.doc_string = _DESCRIPTION
        for value in (*model.graph.input, *model.graph.output):
            value.doc_string = properties[f"handsim.{value.name}"] = _DESCRIPTIONS[value.name]
        onnx.helper.set_model_props(model, properties)
        onnx.checker.check_model(model, full_check=True)
        temporary.write_bytes(stamp_model(model.SerializeToString()))
