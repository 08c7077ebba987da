"""A labeler for any layout without a training set: one network that takes the layout as an input.

A layout is described by some seconds of simulation: the distribution of the distance between every two
markers over people and poses, and the pose prior (`train.labelers.pose_prior`). Some minutes of training
improve the labeler. The user's cache folder stores it under a digest of the layout, the cameras, the shipped
weights and the version.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import hashlib
import json
import math
import os
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Final, Self

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from gloves.layout import MarkerLayout, layout_lines, parse_layout
from handsim import __version__
from handsim.app.messages import share_of, show_state
from handsim.errors import HandSimWarning, WeightsError
from handsim.files.inputs import checksum
from handsim.files.outputs import atomic_write
from handsim.hand.shape import SIDES
from handsim.space.rig import CameraRig, load_rig
from train.data.batches import Cloud, draw_batch
from train.data.shards import row_dtype
from train.labelers.networks import LayoutNetwork, LayoutNetworkConfig, distance_features, layout_loss
from train.labelers.pose_prior import PosePrior, learn_pose_prior
from train.labelers.protocol import (
    LEARNED,
    Labeling,
    label_by_scores,
    label_in_batches,
    learned_folder,
    learned_gloves,
    pad_clouds,
    torch_threads,
)
from train.settings import TrainSettings, batch_recipe
from train.simulation.training_frames import (
    FrameSource,
    GenerateSettings,
    sample_hands,
    sample_single_hand,
    simulate_frames,
    wear_gloves,
)

NUM_POSES: Final = 40_000
"""Poses that describe a layout; fewer give a coarser pose prior."""
WEIGHTS: Final = "any_layout.safetensors"
SHIPPED: Final = Path(__file__).parents[1] / "weights"
_NETWORK, _PRIOR, _DISTANCES = "network.", "prior.", "distances"
_MANY_MARKERS: Final = 24  # Larger layouts use fewer poses and clouds, as work is quadratic.
_POSES_PER_PERSON: Final = 100

MAX_KEPT: Final = 32
"""Number of labelers in the cache; one takes about four megabytes."""
NUM_CLOUDS: Final = 15_000
_BATCH, _LEAST_BATCH = 64, 16  # clouds of a step
_PEAK_RATE, _WARM_UP = 2e-3, 20  # learning rate; number of steps until it is reached


class LayoutLabeler:
    """Labels a glove with the network for any layout and the glove's `mean_features`."""

    def __init__(
        self,
        layout: MarkerLayout,
        network: LayoutNetwork,
        distances: Float[Tensor, "1 M M K"],
        prior: PosePrior | None,
    ) -> None:
        self.network, self.distances, self.prior = network.eval(), distances, prior
        self.marker_names = layout.names

    @classmethod
    def at_once(cls, layout: MarkerLayout, *, num_poses: int = NUM_POSES, seed: int = 0) -> Self:
        """The shipped network for a layout described by a few seconds of simulation."""
        rng = np.random.default_rng(seed)
        markers = sample_worn_markers(layout, num_poses, rng=rng)
        network, prior = shipped_network(), learn_pose_prior(markers, rng=rng)
        return cls(layout, network, mean_features(markers, network.config)[None], prior)

    def tensors(self) -> dict[str, NDArray[np.generic]]:
        """All weights, features and the prior by name, for a file."""
        parts = {f"{_NETWORK}{name}": value.numpy() for name, value in self.network.state_dict().items()}
        prior = {} if self.prior is None else self.prior.tensors()
        parts |= {f"{_PRIOR}{name}": value for name, value in prior.items()}
        return parts | {_DISTANCES: self.distances.numpy()}

    @classmethod
    def of_tensors(cls, layout: MarkerLayout, tensors: Mapping[str, NDArray[np.generic]]) -> Self:
        """The labeler from the tensors of a file."""
        network = LayoutNetwork(LayoutNetworkConfig())
        parts, prior = (
            {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
            for prefix in (_NETWORK, _PRIOR)
        )
        try:
            distances = torch.from_numpy(np.array(tensors[_DISTANCES]))
            network.load_state_dict({name: torch.from_numpy(np.array(one)) for name, one in parts.items()})
        except (KeyError, RuntimeError, TypeError) as error:
            raise WeightsError(f"not a labeler of glove '{layout.name}': {error}") from error
        if distances.shape[:3] != (1, layout.num_markers, layout.num_markers):
            raise WeightsError(f"not a labeler of the {layout.num_markers} markers of glove '{layout.name}'")
        return cls(
            layout, network, distances, PosePrior.of_tensors(prior, layout.num_markers) if prior else None
        )

    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points [m] of every frame, see `train.labelers.protocol.Labeler`."""
        return label_in_batches(frames, self._label)

    @torch.inference_mode()
    def _label(self, clouds: list[NDArray[np.float64]]) -> list[Labeling]:
        points, present = pad_clouds(clouds)
        with torch_threads():
            scores = self.network(torch.from_numpy(points), torch.from_numpy(present), self.distances)[-1]
        return label_by_scores(clouds, scores.points.numpy(), scores.labels.numpy(), self.prior)


def mean_features(markers: Float[np.ndarray, "T M 3"], config: LayoutNetworkConfig) -> Float[Tensor, "M M K"]:
    """Mean over poses of the `distance_features` of a layout's markers [m]."""
    share = _share_of_work(markers.shape[1])
    # The features of this many poses are in memory together.
    markers, chunk = markers[:: math.ceil(1.0 / share)], int(500 * share)
    centered = torch.from_numpy((markers - markers.mean(axis=1, keepdims=True)).astype(np.float32))
    parts = torch.split(centered, chunk)
    # In a list, sums would lie between large freed tensors and keep their memory from being used again.
    sums = centered.new_empty(len(parts), *2 * markers.shape[1:2], config.num_distances)
    with torch_threads(1):
        for total, part in zip(sums, parts, strict=True):
            torch.sum(distance_features(part, config), 0, out=total)
    return sums.sum(0) / len(markers)


def _share_of_work(num_markers: int) -> float:
    """Share of poses and clouds used for a layout, so that large ones take about a minute, too."""
    return min(1.0, (_MANY_MARKERS / num_markers) ** 2)


@cache
def shipped_network() -> LayoutNetwork:
    """The shipped network for any layout."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    network = LayoutNetwork(LayoutNetworkConfig())
    try:
        tensors = load_file(SHIPPED / WEIGHTS)
        network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    except (SafetensorError, OSError, RuntimeError) as error:
        raise WeightsError(
            f"{SHIPPED / WEIGHTS} is missing or damaged; install handsim again ({error})"
        ) from error
    return network


def sample_worn_markers(
    layout: MarkerLayout, num_frames: int, *, rng: np.random.Generator
) -> Float[np.ndarray, "T M 3"]:
    """Markers [m] of right hands in valid poses, with a new person and glove fit every hundred frames."""
    config = GenerateSettings()
    parts, show = [], share_of(f"learning glove '{layout.name}', once: its poses")
    for first in range(0, num_frames, _POSES_PER_PERSON):
        show(first, num_frames)
        count = min(_POSES_PER_PERSON, num_frames - first)
        right = sample_hands(config.population, rng=rng)[SIDES.index("right")]
        scene = sample_single_hand(right, count, config, rng=rng)
        (fit,) = wear_gloves(layout, scene.hands, **config.slips, rng=rng)
        parts.append(fit.attachment.centers(right, right.forward_kinematics(scene.qpos[0])))
    return np.concatenate(parts)


def is_learned(layout: MarkerLayout) -> bool:
    """Whether the cache has a labeler of a glove."""
    return _cache_file(layout).exists()


def learned_labeler(layout: MarkerLayout, rig: CameraRig | str = "figure5") -> LayoutLabeler:
    """The labeler of a glove: learned in some minutes the first time, later read from the cache."""
    file = _cache_file(layout, rig)
    found = _read_cached(file, layout)
    if found is not None:
        return found
    learned = fine_tuned_labeler(layout, rig)
    try:
        _write_cached(file, learned)
    except OSError as error:
        kept = f"the labeler of glove '{layout.name}' cannot be kept in {file.parent} ({error.strerror})"
        warnings.warn(f"{kept}; set XDG_CACHE_HOME to a folder of yours", HandSimWarning, stacklevel=2)
        return learned
    return _read_cached(file, layout) or learned


@functools.lru_cache(maxsize=MAX_KEPT)
def _digest(layout: MarkerLayout, rig: CameraRig | str) -> str:
    """Digest of everything that a labeler depends on; of the layout's hand as its file has it."""
    saved = parse_layout(tomllib.loads("\n".join(layout_lines(dataclasses.replace(layout, forearm=())))))
    dependencies = {
        "layout": saved.record(),
        "rig": load_rig(rig).record(),
        "weights": checksum(SHIPPED / WEIGHTS),
        "version": __version__,
    }
    return hashlib.sha256(json.dumps(dependencies, sort_keys=True).encode()).hexdigest()[:32]


def _cache_file(layout: MarkerLayout, rig: CameraRig | str = "figure5") -> Path:
    """Path of a glove's labeler in the cache."""
    return learned_folder() / f"{_digest(layout, rig)}{LEARNED}"


def _read_cached(file: Path, layout: MarkerLayout) -> LayoutLabeler | None:
    """A labeler from the cache; None if it is missing or damaged. A damaged file is removed."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        stored = file.read_bytes()
    except OSError:
        return None
    try:
        labeler = LayoutLabeler.of_tensors(layout, load(stored))
        os.utime(file)
    except (OSError, SafetensorError, WeightsError):
        file.unlink(missing_ok=True)
        return None
    return labeler


def _write_cached(file: Path, labeler: LayoutLabeler) -> None:
    """Write a labeler into the cache, and remove the least recently used ones."""
    from safetensors.numpy import save

    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(file) as temporary:
        temporary.write_bytes(save(labeler.tensors()))
    for old in learned_gloves()[MAX_KEPT:]:
        old.unlink(missing_ok=True)


def fine_tuned_labeler(
    layout: MarkerLayout, rig: CameraRig | str = "figure5", *, num_clouds: int = NUM_CLOUDS, seed: int = 0
) -> LayoutLabeler:
    """Train the labeler for any layout on clouds of one layout, as seen by a rig.

    Layouts with more than 24 markers use fewer clouds, inversely to the square of their number.
    """
    rng = np.random.default_rng(seed)
    share = _share_of_work(layout.num_markers)
    num_clouds, batch = math.ceil(share * num_clouds), max(_LEAST_BATCH, int(share * _BATCH))
    labeler = LayoutLabeler.at_once(layout, seed=seed)
    source = FrameSource(GenerateSettings(), layout, load_rig(rig))
    rows = np.zeros(2 * num_clouds // 3, dtype=row_dtype(layout.num_markers))
    show = share_of(f"learning glove '{layout.name}', once: its simulation")
    for first in range(0, len(rows), _POSES_PER_PERSON):
        show(first, len(rows))
        models = sample_hands(source.settings.population, rng=rng)
        simulate_frames(rows[first : first + _POSES_PER_PERSON], models, source, rng=rng)
    network = copy.deepcopy(labeler.network).train()
    recipe = batch_recipe(TrainSettings(batch=batch), layout.num_markers)
    optimizer = new_optimizer(network)
    steps = -(-num_clouds // batch)
    show = share_of(f"learning glove '{layout.name}', once: its training")
    with torch_threads(1):
        for step in range(steps):
            show(step, steps)
            rate = min(1.0, (step + 1) / _WARM_UP) * 0.5 * (1.0 + np.cos(np.pi * step / steps))
            layout_step(network, optimizer, rate, draw_batch(rows, recipe, rng=rng).cloud, labeler.distances)
    show_state("")
    labeler.network = network.eval()
    return labeler


def new_optimizer(network: LayoutNetwork) -> torch.optim.Optimizer:
    """The optimizer of a network for any layout."""
    return torch.optim.AdamW(network.parameters(), lr=_PEAK_RATE, weight_decay=1e-4, fused=True)


def layout_step(
    network: LayoutNetwork,
    optimizer: torch.optim.Optimizer,
    rate: float,
    cloud: Cloud,
    layouts: Float[Tensor, "G M M K"],
) -> tuple[float, Float[Tensor, "B N M+1"]]:
    """Make a gradient step at a share of the peak rate; return the loss and point scores before it."""
    for group in optimizer.param_groups:
        group["lr"] = float(_PEAK_RATE * rate)
    points, present = torch.from_numpy(cloud.points.astype(np.float32)), torch.from_numpy(cloud.present)
    found = network(points, present, layouts)
    loss = layout_loss(found, torch.from_numpy(cloud.truth), present)
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
    optimizer.step()
    return float(loss.detach()), found[-1].points
