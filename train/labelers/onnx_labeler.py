"""A labeler as one ONNX file: written with torch, run by onnxruntime without it."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim import __version__
from handsim.errors import HandSimError, WeightsError
from handsim.files.outputs import atomic_write, plain_path
from train.config import CNNConfig
from train.labelers.cnn_labeler import CNNLabeler
from train.labelers.protocol import Labeling, checked_names, label_by_scores, label_in_batches, pad_clouds
from train.labelers.views import MeanHand
from train.matching.pose_prior import PosePrior
from train.matching.verification import matching_constants

if TYPE_CHECKING:
    import onnx
    from torch import nn


_NAMES: Final = "handsim.marker_names"  # key of the marker names in the file's metadata
_DIGEST: Final = "handsim.sha256"  # key of the file's SHA-256, as if this were 64 zeros
_CNN: Final = "handsim.cnn"  # key of the settings of the paper's network
_PRIOR: Final = "handsim.pose_prior"  # key of the pose prior: an .npz in base64
_MATCHING: Final = "handsim.matching"  # key of the constants that labels are chosen by, for other programs
_IMAGES: Final = "images"  # its input
_INPUTS: Final = "points", "present"
_OUTPUTS: Final = "point_scores", "label_scores"
_PAIRED: Final = "pairs", "costs"  # outputs for other programs
_OPSET: Final = 17
_DESCRIPTION: Final = (
    "Labels the reflective markers of one hand in one frame. Compute in float32: runtimes that choose "
    "bfloat16 by themselves change labels (OpenVINO: INFERENCE_PRECISION_HINT f32)."
)
_MEANINGS: Final = {
    "points": "Points of each frame in meters, less their mean; axes of any direction. Zeros where there is "
    "none.",
    "present": "Whether a row of points is one.",
    "point_scores": "Log-probability for each point of each marker, in the order of handsim.marker_names; "
    "the last column is a ghost.",
    "label_scores": "Log-probability for each marker of each point; the last column is that it is not seen.",
    "pairs": "Probability for each point of each marker, no two points of one marker; the last column is a "
    "ghost.",
    "costs": "What each marker costs each point, then each point as a ghost, in its own column: labels are "
    "the assignment of least cost, verified by a prior of hands (docs/how_to/onnx.md).",
    "images": "Depth images of Han et al. 2018: 52 x 52, a pixel a point, brightness its depth; 0 where "
    "there is none.",
    "positions": "Predicted position of each marker in the view: x right, y down, z away; 1 is half an "
    "image's width.",
}
"""What inputs and outputs are; in the file's metadata under `handsim.` and their names."""
_HINT: Final = "install it with: pip install 'handsim[onnx]'"


class OnnxLabeler:
    """A labeler of either kind from an ONNX file, on one thread, as `handsim export` wrote it.

    Raises:
        HandSimError: onnxruntime is not installed.
        WeightsError: The file is missing, damaged, or not a labeler.
    """

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise HandSimError(f"an .onnx labeler needs onnxruntime; {_HINT}") from error
        if not path.is_file():
            raise WeightsError(f"{path} is missing, expected an .onnx file that handsim export wrote")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # a frame is too small to share
        options.log_severity_level = 4
        options.add_session_config_entry("session.set_denormal_as_zero", "1")  # distance bumps underflow
        try:
            content = path.read_bytes()
            if sign_model(content) != content:  # onnxruntime crashes on some damaged files
                raise ValueError("the SHA-256 is another one")
            # Without its fallback, which prints on standard output.
            self._session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"], enable_fallback=0
            )
            metadata = self._session.get_modelmeta().custom_metadata_map
            self._scores_alone = onnxruntime.RunOptions()  # not what other programs need beside them
            self._scores_alone.only_execute_path_to_fetches = True
            self.marker_names = checked_names(json.loads(metadata[_NAMES]))
            self.prior = _unpacked(metadata[_PRIOR]) if _PRIOR in metadata else None
            self._label = self._label_by_images(metadata[_CNN]) if _CNN in metadata else self._label_by_scores
            self._try(_IMAGES if _CNN in metadata else _INPUTS[0])
        except Exception as error:  # onnxruntime's errors have no common class of their own
            raise WeightsError(
                f"{path} is damaged or not a labeler's: expected what handsim export wrote"
            ) from error

    def _try(self, given: str) -> None:
        """Raise a ValueError unless the network gives finite numbers of the right shapes."""
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
        """The set labeler."""
        given = dict(zip(_INPUTS, pad_clouds(clouds), strict=True))
        by_point, by_label = self._session.run(_OUTPUTS, given, self._scores_alone)
        return label_by_scores(clouds, by_point, by_label, self.prior)

    def _label_by_images(self, settings: str) -> Callable[[list[NDArray[np.float64]]], list[Labeling]]:
        """The paper's network, with what its metadata tells of its use."""
        content = json.loads(settings)
        hand = MeanHand(*(np.array(content["mean_hand"][field.name]) for field in fields(MeanHand)))
        config = CNNConfig(**content["config"])

        def positions(images: NDArray[np.float32]) -> NDArray[np.float32]:
            predicted: NDArray[np.float32] = self._session.run(None, {_IMAGES: images})[0]
            return predicted

        return CNNLabeler(positions, hand, config, self.marker_names).label_batch


def _unpacked(text: str) -> PosePrior:
    """The pose prior in a file's metadata."""
    with np.load(io.BytesIO(base64.b64decode(text, validate=True))) as tables:  # unpickles nothing
        return PosePrior.of_tensors(dict(tables))


def _packed(prior: PosePrior) -> str:
    """The pose prior as text."""
    file = io.BytesIO()
    np.savez(file, **prior.tensors())  # type: ignore[arg-type]
    return base64.b64encode(file.getvalue()).decode()


def sign_model(content: bytes) -> bytes:
    """The bytes of an ONNX model with the SHA-256 of what they are now; of one that was signed before."""
    key = _DIGEST.encode() + b"\x12\x40"  # protobuf's tag of the value, and its length
    if content.count(key) != 1:
        raise ValueError("the file has no SHA-256")
    first = content.index(key) + len(key)
    place = slice(first, first + 64)
    blank = content[: place.start] + b"0" * 64 + content[place.stop :]
    return content[: place.start] + hashlib.sha256(blank).hexdigest().encode() + content[place.stop :]


def export_onnx(network: nn.Module, marker_names: Sequence[str], path: Path) -> None:
    """Write a trained labeler as an ONNX file for any number of clouds of any size."""
    import torch

    from train.labelers.cnn_network import DeepLabelCNN
    from train.labelers.set_network import PairedScores

    try:
        import onnx
    except ImportError as error:
        raise HandSimError(f"exporting needs onnx; {_HINT}") from error
    properties = {_NAMES: json.dumps(list(marker_names)), _DIGEST: "0" * 64, "handsim.version": __version__}
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
            properties[_PRIOR] = _packed(prior)
            properties[_MATCHING] = json.dumps(matching_constants())
            network, outputs = PairedScores(network), [*outputs, *_PAIRED]
            axes |= {name: {0: "frames", 1: "points"} for name in _PAIRED}
            axes[_PAIRED[1]][2] = "markers_and_points"
    with atomic_write(path) as temporary, plain_path(temporary) as plain, warnings.catch_warnings():
        # The newer exporter needs another package and fixes the sizes of expanded arrays.
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
        _describe(model, properties)
        onnx.checker.check_model(model, full_check=True)
        temporary.write_bytes(sign_model(model.SerializeToString()))


def _describe(model: onnx.ModelProto, properties: dict[str, str]) -> None:
    """Say who wrote a model and what goes in and out, and add these properties."""
    import onnx.helper

    model.producer_name, model.producer_version = "handsim", __version__
    model.doc_string = model.graph.doc_string = _DESCRIPTION
    for value in (*model.graph.input, *model.graph.output):
        value.doc_string = properties[f"handsim.{value.name}"] = _MEANINGS[value.name]
    onnx.helper.set_model_props(model, properties)
