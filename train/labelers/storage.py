"""Trained labelers on disk: safetensors for weights and JSON for the model card, or one ONNX file.

The weights' own metadata repeat what others ask of a file that they find alone: what it is, of which layout,
who wrote it, from what data, under which license. Nothing here reads it back: the card is what counts.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import platformdirs
from numpy.typing import NDArray

from handsim._plugins import is_plugin, list_plugins
from handsim.errors import HandSimError, WeightsError, choices
from handsim.files.inputs import read_bytes
from handsim.files.json_files import save_json
from handsim.files.outputs import atomic_write, written_together
from train.config import CNNConfig, Kind, NetworkConfig, SetLabelerConfig
from train.labelers.protocol import LABELERS, Labeler, OwnLabeler, checked_names
from train.labelers.set_inference import TrainedSetLabeler, weight_shapes
from train.matching.pose_prior import PosePrior

if TYPE_CHECKING:
    from torch import nn

LEARNED: Final = ".safetensors"
"""How the files in `learned_folder` end."""
WEIGHTS: Final = "labeler.safetensors"
CARD: Final = "labeler.json"
_ANY_LAYOUT: Final = "any_layout"  # weights of the network for any layout
_PRIOR: Final = "pose_prior."  # in the names of the prior's tensors
_METADATA: Final = "__metadata__"  # key in the header of a safetensors file
_LENGTH: Final = 8  # bytes that hold the header's length
_LEAST_BYTES: Final = 4  # of a number of a network
_MOST_CARD: Final = 1 << 24  # bytes
_CONFIGS: Final[dict[Kind, type[NetworkConfig]]] = {"set": SetLabelerConfig, "cnn": CNNConfig}
_SHIPPED: Final = Path(__file__).parents[1] / "weights"


def learned_folder() -> Path:
    """Where labelers of learned gloves are kept, see `train.any_layout`; `XDG_CACHE_HOME` moves it."""
    return Path(platformdirs.user_cache_dir("handsim", appauthor=False)) / "gloves"


def learned_gloves() -> tuple[Path, ...]:
    """The files of the gloves that are kept, the most recently used first."""
    files = learned_folder().glob(f"*{LEARNED}")
    return tuple(sorted(files, key=lambda file: file.stat().st_mtime, reverse=True))


def shipped_labelers() -> tuple[str, ...]:
    """Gloves whose trained labeler comes with the package."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("*.safetensors") if path.stem != _ANY_LAYOUT))


def load_stored_labeler(name_or_path: str | Path) -> Labeler:
    """A labeler: the shipped one of a glove, one that was trained or exported, or one of your own.

    Args:
        name_or_path: A glove with a shipped labeler, a folder that `handsim train` wrote, an .onnx file,
            `module:name` of a `Labeler` or of a class of them, or the name of an entry point of the group
            `handsim.labelers`.

    Returns:
        A labeler; `label_frames` gives labels (N,) and confidences (N,) of points (N, 3) [m].

    Raises:
        WeightsError: Unknown, damaged, or not a labeler's weights.
    """
    if Path(name_or_path).suffix.lower() == ".onnx":
        from train.labelers.onnx_labeler import OnnxLabeler

        return OnnxLabeler(Path(name_or_path))
    name = str(name_or_path)
    if not Path(name).exists() and (is_plugin(name) or name in list_plugins(LABELERS)):
        return OwnLabeler(name)
    stored = _read(*_files(name_or_path))
    if isinstance(stored.config, SetLabelerConfig):
        return TrainedSetLabeler(stored.config, stored.weights, stored.prior, stored.marker_names)
    from train.labelers.kinds import labeler_of  # torch

    return labeler_of(stored.network(), stored.marker_names)


def load_network(name_or_path: str | Path) -> tuple[nn.Module, dict[str, Any]]:
    """A trained network and its model card.

    Raises:
        WeightsError: Unknown, damaged, or not a labeler's weights.
    """
    stored = _read(*_files(name_or_path))
    return stored.network(), stored.card


def _files(name_or_path: str | Path) -> tuple[Path, Path]:
    """Weights and card of a shipped labeler or a folder."""
    if str(name_or_path) in shipped_labelers():
        return _SHIPPED / f"{name_or_path}.safetensors", _SHIPPED / f"{name_or_path}.json"
    weights, card = Path(name_or_path) / WEIGHTS, Path(name_or_path) / CARD
    if not weights.is_file() or not card.is_file():
        unknown = choices(str(name_or_path), shipped_labelers(), noun="labeler or glove")
        raise WeightsError(
            f"{unknown}, a layout's .toml file, a folder that handsim train wrote, an .onnx file, or "
            "module:name"
        )
    return weights, card


@dataclass(frozen=True, slots=True, eq=False)
class _Stored:
    """What the two files of a labeler hold."""

    config: NetworkConfig
    card: dict[str, Any]
    weights: dict[str, NDArray[Any]]
    """The network's weights by name."""
    prior: PosePrior | None

    @property
    def marker_names(self) -> tuple[str, ...]:
        """Markers in label order."""
        return tuple(self.card["marker_names"])

    def network(self) -> nn.Module:
        """The network in torch."""
        import torch

        from train.labelers.kinds import new_network

        network = new_network(self.config)
        network.load_state_dict({name: torch.from_numpy(one) for name, one in self.weights.items()})
        if self.prior is not None:
            network.prior = self.prior  # type: ignore[assignment]
        return network


def _read(weights: Path, card: Path) -> _Stored:
    """What two files hold; nothing in them is trusted."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        content = json.loads(read_bytes(card, error=WeightsError, most=_MOST_CARD))
        names = checked_names(content["marker_names"])
        config = _CONFIGS[content.get("labeler", "set")](**content["network"])
        if len(names) != config.num_labels:
            raise WeightsError(f"{card} names {len(names)} markers for {config.num_labels} labels")
        expected = _shapes_of(config)
        if weights.stat().st_size < _LEAST_BYTES * sum(map(math.prod, expected.values())):
            raise ValueError("it is too short for the network that its card describes")
        tensors = load_file(weights)
        tables = {name: tensors.pop(name) for name in list(tensors) if name.startswith(_PRIOR)}
        _check_shapes(tensors, expected)
        prior = _read_prior(tables, config.num_labels) if tables else None
    except WeightsError:
        raise
    except (HandSimError, SafetensorError, OSError, ValueError, LookupError, TypeError) as error:
        raise _damaged(weights, error) from error
    except (AttributeError, RuntimeError, RecursionError, OverflowError) as error:
        raise _damaged(weights, error) from error
    for name, tensor in tensors.items():
        if not np.isfinite(tensor).all():
            raise WeightsError(f"{weights} is damaged: {name} holds NaN or infinite values")
    return _Stored(config, content, tensors, prior)


def _shapes_of(config: NetworkConfig) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network's weights, which are not made."""
    if isinstance(config, SetLabelerConfig):
        return weight_shapes(config)
    import torch

    from train.labelers.kinds import new_network

    with torch.device("meta"):
        return {name: tuple(one.shape) for name, one in new_network(config).state_dict().items()}


def _check_shapes(tensors: Mapping[str, NDArray[Any]], expected: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse tensors that are not those of a network, by a `ValueError`."""
    for name, shape in expected.items():
        if name not in tensors:
            raise ValueError(f"it lacks {name}")
        if tensors[name].shape != shape:
            raise ValueError(f"{name} has shape {tensors[name].shape}, expected {shape}")
    for name in tensors:
        if name not in expected:
            raise ValueError(f"it holds {name}, which is no part of the network")


def _read_prior(tensors: dict[str, NDArray[Any]], num_labels: int) -> PosePrior:
    """The pose prior of a network with so many labels, from its tensors."""
    prior = PosePrior.of_tensors({name.removeprefix(_PRIOR): one for name, one in tensors.items()})
    if prior.num_markers != num_labels:
        raise WeightsError(f"the pose prior has {prior.num_markers} markers for {num_labels} labels")
    return prior


def _damaged(weights: Path, error: Exception) -> WeightsError:
    reason = (str(error) or type(error).__name__).splitlines()[0]
    return WeightsError(f"{weights} is damaged or not a labeler's: {reason}")


def save_network(folder: Path, network: nn.Module, card: dict[str, Any]) -> None:
    """Write weights, with the pose prior if there is one, and model card with at least `marker_names`."""
    import torch
    from safetensors.torch import save

    config: NetworkConfig = network.config  # type: ignore[assignment]
    kind = "cnn" if isinstance(config, CNNConfig) else "set"
    card = {"labeler": kind, "network": dataclasses.asdict(config), **card}
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    prior = getattr(network, "prior", None)
    if isinstance(prior, PosePrior):
        tensors |= {_PRIOR + name: torch.from_numpy(table) for name, table in prior.tensors().items()}
    with written_together():
        with atomic_write(folder / WEIGHTS) as temporary:
            # safetensors' own writing hides that a disk is full
            temporary.write_bytes(_with_metadata(save(tensors), weights_metadata(card)))
        save_json(folder / CARD, card)


def weights_metadata(card: dict[str, Any]) -> dict[str, str]:
    """What a file of weights tells of itself; all text, as safetensors has it."""
    dataset = card.get("dataset", {})
    layout = dataset.get("layout", {}).get("name")
    known = {
        "format": "pt",
        "library_name": "handsim",
        "handsim_version": card.get("handsim"),
        "labeler": card.get("labeler"),
        "layout": layout,
        "marker_names": json.dumps(card["marker_names"]),
        "units": "points in meters",
        "trained_on": card.get("trained_on"),
        "license": card.get("license"),
    }
    return {name: value for name, value in known.items() if value is not None}


def _with_metadata(content: bytes, metadata: dict[str, str]) -> bytes:
    """A safetensors file with metadata in this order; safetensors' own writing shuffles them each time."""
    end = _LENGTH + int.from_bytes(content[:_LENGTH], "little")
    tensors = json.loads(content[_LENGTH:end])
    tensors.pop(_METADATA, None)
    header = json.dumps({_METADATA: metadata, **tensors}, separators=(",", ":"), ensure_ascii=False).encode()
    header += b" " * (-len(header) % _LENGTH)  # tensors begin at multiples of eight bytes
    return len(header).to_bytes(_LENGTH, "little") + header + content[end:]
