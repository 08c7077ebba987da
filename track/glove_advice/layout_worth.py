"""How good a layout is, quickly: labels of the same hands with the same losses for all that are compared."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from track.glove_advice.worn_places import Columns, WornPlaces
from train.any_layout.layout_labeler import mean_features, shipped_network
from train.data.augmentation import Corruption, corrupt
from train.evaluation.metrics import LabelCounts
from train.matching.assignment import match_probabilities, pair_probabilities
from train.threads import labeling_threads

_TESTED: Final = 240  # frames whose labels are counted
_GHOSTS: Final = 2  # at most
_OF_JOINTS: Final = 3.0  # percent of the slots that a degree of the joints counts for


class Worth(NamedTuple):
    """How good a layout is."""

    slots: float
    """Share of slots that are right, as a rig sees them and with ghosts."""
    joints: float
    """Root mean square spread of the joints [rad]."""
    by_marker: Float[np.ndarray, "M"]
    """Share of each marker's slots that are right."""

    @property
    def cost(self) -> float:
        """What a better layout has less of: wrong slots [%] and, weighted, the spread of the joints [deg]."""
        return 100.0 * (1.0 - self.slots) + _OF_JOINTS * float(np.rad2deg(self.joints))


def judge(people: WornPlaces, layout: Columns, *, seed: int) -> Worth:
    """Label a layout with the network for any layout, without verification by a pose, and count.

    Args:
        people: Who wears it.
        layout: Its columns.
        seed: Of losses and ghosts: the same for layouts that are compared.
    """
    network = shipped_network()
    features = mean_features(layout.positions, network.config)[None]
    rng = np.random.default_rng(seed)
    step = max(1, len(layout.positions) // _TESTED)
    points = layout.positions[::step] - layout.positions[::step].mean(axis=1, keepdims=True)
    observed = np.where(layout.seen[::step, :, None], points, np.nan)
    half = len(layout.places) // 8  # the rig loses few; half of the paper's recipe on top
    cloud = corrupt(observed, Corruption(occlude=half, ghosts=_GHOSTS), rng=rng)
    with torch.inference_mode(), labeling_threads():
        scores = network(
            torch.from_numpy(cloud.points.astype(np.float32)), torch.from_numpy(cloud.present), features
        )[-1]
    count, right = len(layout.places), np.zeros(len(layout.places))
    counts = LabelCounts(confusion=np.zeros((count + 1, count + 1), dtype=np.int64))
    for by_point, by_label, here, truth in zip(
        scores.points.numpy(), scores.labels.numpy(), cloud.present, cloud.truth, strict=True
    ):
        of_points = np.concatenate([by_label[:, :-1][:, here], by_label[:, -1:]], axis=1)
        labels = match_probabilities(pair_probabilities(by_point[here], of_points))
        right += counts.add(labels, truth[here], count)
    by_marker = right / len(cloud.truth)
    spreads = people.joint_spreads(layout)
    return Worth(float(by_marker.mean()), float(np.sqrt((spreads**2).mean())), by_marker)
