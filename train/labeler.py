"""What every labeler promises, and how a trained one is kept: safetensors for numbers, JSON for words."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from handsim.errors import ShapeError, WeightsError, choices
from handsim.io import atomic_write
from train.config import SetLabelerConfig
from train.matching import match_scores
from train.set_labeler import SetLabeler
from train.shards import save_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float, Int

WEIGHTS: Final = "labeler.safetensors"
CARD: Final = "labeler.json"
_SHIPPED: Final = Path(__file__).parent / "weights"
_MOST_POINTS: Final = 512
_BATCH: Final = 256


@dataclass(frozen=True, slots=True, eq=False)
class Labelling:
    """Labels of one frame's points."""

    labels: Int[np.ndarray, "N"]
    """Place of each point's marker in the layout, -1 for a ghost; no marker twice."""
    confidence: Float[np.ndarray, "N"]
    """How sure each label is, 0 to 1."""


class Labeler(Protocol):
    """Names the points of a frame, each frame on its own."""

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Markers that it knows, in label order."""
        ...

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labelling]:
        """Label the points [m] of every frame; a frame may be empty."""
        ...


class TrainedSetLabeler:
    """The set labeler with weights, ready to use.

    Args:
        network: Trained network.
        marker_names: Markers in label order.
    """

    def __init__(self, network: SetLabeler, marker_names: tuple[str, ...]) -> None:
        self.network = network.eval()
        self.marker_names = marker_names

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labelling]:
        """Label the points [m] of every frame; a frame may be empty.

        Raises:
            ShapeError: A frame is not (N, 3), not finite, too large, or holds more than 512 points.
        """
        clouds = [_check_cloud(points, number) for number, points in enumerate(frames)]
        # Frames of like size share a batch, so that padding stays small; results return in frame order.
        order = sorted(range(len(clouds)), key=lambda number: len(clouds[number]))
        results: list[Labelling | None] = [None] * len(clouds)
        for first in range(0, len(order), _BATCH):
            chosen = order[first : first + _BATCH]
            for number, labelling in zip(chosen, self._label([clouds[i] for i in chosen]), strict=True):
                results[number] = labelling
        return [result for result in results if result is not None]

    @torch.inference_mode()
    def _label(self, clouds: list[Float[np.ndarray, "N 3"]]) -> list[Labelling]:
        longest = max(len(cloud) for cloud in clouds)
        if longest == 0:
            return [Labelling(np.zeros(0, dtype=np.int64), np.zeros(0)) for _ in clouds]
        points = np.zeros((len(clouds), longest, 3), dtype=np.float32)
        present = np.zeros((len(clouds), longest), dtype=bool)
        for row, cloud in enumerate(clouds):
            if len(cloud):
                points[row, : len(cloud)] = cloud - cloud.mean(axis=0)  # before float32 cuts far-off places
            present[row, : len(cloud)] = True
        scores = self.network(torch.from_numpy(points), torch.from_numpy(present))
        by_point, by_label = scores.points.numpy(), scores.labels.numpy()
        labellings = []
        for row, cloud in enumerate(clouds):
            count = len(cloud)
            columns = [*range(count), longest]
            labellings.append(Labelling(*match_scores(by_point[row, :count], by_label[row][:, columns])))
        return labellings


def _check_cloud(points: Float[np.ndarray, "N 3"], frame: int) -> Float[np.ndarray, "N 3"]:
    cloud = np.asarray(points, dtype=np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ShapeError(f"frame {frame} has shape {cloud.shape}, wanted (N, 3)")
    if not np.isfinite(cloud).all():
        raise ShapeError(f"frame {frame} holds NaN or infinite points; leave missing points out")
    if len(cloud) > _MOST_POINTS:
        raise ShapeError(f"frame {frame} holds {len(cloud)} points, wanted at most {_MOST_POINTS}")
    return cloud


def save_labeler(folder: Path, network: SetLabeler, card: dict[str, Any]) -> None:
    """Write weights and model card; `card` holds at least `marker_names`."""
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    with atomic_write(folder / WEIGHTS) as temporary:
        save_file(tensors, temporary)
    save_json(folder / CARD, {"network": dataclasses.asdict(network.config), **card})


def shipped_labelers() -> tuple[str, ...]:
    """Gloves whose trained labeler comes with the package."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.safetensors")))


def load_labeler(name_or_path: str | Path) -> TrainedSetLabeler:
    """The shipped labeler of a glove, or one that `handsim train` left in a folder.

    Raises:
        WeightsError: Unknown, damaged, or not a labeler's weights.
    """
    if str(name_or_path) in shipped_labelers():
        weights, card = _SHIPPED / f"{name_or_path}.safetensors", _SHIPPED / f"{name_or_path}.json"
    else:
        weights, card = Path(name_or_path) / WEIGHTS, Path(name_or_path) / CARD
        if not weights.is_file() or not card.is_file():
            unknown = choices(str(name_or_path), shipped_labelers(), noun="labeler")
            raise WeightsError(f"{unknown}, or a folder that handsim train wrote")
    try:
        content = json.loads(card.read_text(encoding="utf-8"))
        names = tuple(content["marker_names"])
        network = SetLabeler(SetLabelerConfig(**content["network"]))
        network.load_state_dict(load_file(weights))
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise WeightsError(f"{weights} is damaged or no labeler's: {str(error).splitlines()[0]}") from error
    if len(names) != network.config.num_labels:
        raise WeightsError(f"{card} names {len(names)} markers for {network.config.num_labels} labels")
    return TrainedSetLabeler(network, names)
