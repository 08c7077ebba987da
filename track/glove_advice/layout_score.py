"""Everything that is known of a layout before anybody wears it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Float

from gloves.layout import MarkerLayout
from handsim.hand.shape import Side
from handsim.space.transforms import MIRROR
from track.glove_advice.joint_spread import joint_spreads
from track.glove_advice.observed_hands import ObservedHand
from track.glove_advice.trials import Trial
from train.data.batches import Corruption, corrupt, paper_corruption
from train.evaluation import LabelingReport, cloud_frames, evaluate_frames, evaluate_labeler
from train.labelers.pose_prior import SideClassifier
from train.labelers.protocol import Labeler

_NEAR: Final = 0.003  # between two markers' surfaces [m], where gloves and blobs touch
_SIDE_FRAMES: Final = 500
_JOINT_FRAMES: Final = 600


@dataclass(frozen=True, slots=True, eq=False)
class LayoutScore:
    """How well a layout can be labeled, and what it tells of each joint."""

    layout: MarkerLayout
    observed: LabelingReport
    """Labels of the frames as the rig sees them, on average over both hands."""
    clean: LabelingReport
    """Labels where every marker is seen."""
    corrupted: LabelingReport
    """Labels with the drops and ghosts of the paper's recipe."""
    seen: Float[np.ndarray, "M"]
    """Share of the frames in which each marker is seen by two cameras and becomes a point."""
    near: Float[np.ndarray, "M M"]
    """Share of the frames in which two markers touch or nearly do."""
    joints: Float[np.ndarray, "20"]
    """Standard deviation that the markers leave of each joint of a calibrated hand [rad]."""
    joints_without: Float[np.ndarray, "M 20"]
    """The same without each marker [rad]."""
    sides_right: float
    """Share of the frames in which left and right are told apart by the labeled markers."""
    trials: Mapping[str, Trial] = field(default_factory=dict)
    """What became of simulated captures of each kind of work; empty where none was tried."""
    is_trained: bool = False
    """Whether the labeler was trained on the layout; else it is the network for any layout."""
    seen_by: str = ""
    """Whose motion was seen by which rig, in words."""
    advice: tuple[str, ...] = ()
    """What to move, add or drop, in sentences, the most important first."""


def score_layout(
    layout: MarkerLayout, hands: Sequence[ObservedHand], labeler: Labeler, *, rng: np.random.Generator
) -> LayoutScore:
    """Label and count what a rig sees of gloved hands.

    Args:
        labeler: A labeler of this layout; `train.labelers.layout_labeler.LayoutLabeler` needs no training.
        rng: Order of points, and the random parts of the paper's recipe.
    """
    observed = np.concatenate([hand.frames.observed for hand in hands])
    ghosts = np.concatenate([hand.frames.ghosts for hand in hands])
    markers = np.concatenate([hand.frames.markers for hand in hands])
    center = markers.mean(axis=1, keepdims=True)
    cloud = corrupt(observed - center, Corruption(occlude=0, ghosts=0), ghosts=ghosts - center, rng=rng)
    recipe = paper_corruption(layout.num_markers)
    some = _some(hands, _JOINT_FRAMES)
    return LayoutScore(
        layout,
        evaluate_frames(labeler, [cloud_frames(cloud)]),
        evaluate_labeler(labeler, markers - center, Corruption(occlude=0, ghosts=0), rng=rng),
        evaluate_labeler(labeler, markers - center, recipe, rng=rng),
        np.isfinite(observed[..., 0]).mean(axis=0),
        _near_pairs(layout, markers),
        joint_spreads(some),
        np.array([joint_spreads(some, without=marker) for marker in range(layout.num_markers)]),
        _sides_right(layout, hands, rng),
    )


def _some(hands: Sequence[ObservedHand], count: int) -> list[ObservedHand]:
    """About so many frames, evenly chosen."""
    step = max(1, sum(len(hand.qpos) for hand in hands) // count)
    return [
        ObservedHand(hand.fit, hand.qpos[::step], type(hand.frames)(*(part[::step] for part in hand.frames)))
        for hand in hands
    ]


def _near_pairs(layout: MarkerLayout, markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "M M"]:
    """Share of the frames in which two markers touch or nearly do; zero on the diagonal."""
    apart = np.linalg.norm(markers[:, :, None] - markers[:, None], axis=-1)
    near: Float[np.ndarray, "M M"] = (apart < 2.0 * layout.radius + _NEAR).mean(axis=0)
    np.fill_diagonal(near, 0.0)
    return near


def _sides_right(layout: MarkerLayout, hands: Sequence[ObservedHand], rng: np.random.Generator) -> float:
    """Share of the frames whose side is recognized from the markers that are seen, by the true labels."""
    classifier, right, count = SideClassifier(layout, rng=rng), 0, 0
    for hand in _some(hands, _SIDE_FRAMES):
        observed, side = hand.frames.observed, hand.fit.side
        for markers, one in ((observed, side), (observed @ MIRROR, _other(side))):
            right += int(classifier.recognized(markers, one).sum())
            count += len(markers)
    return right / max(1, count)


def _other(side: Side) -> Side:
    return "left" if side == "right" else "right"
