"""Follow two hands through a capture of unlabeled points, and compare their motion with the truth.

    python examples/06_track_a_capture.py

Once with the hands and gloves as they are, and once with hands of size M in gloves put on as designed, which
is what a tracker knows of a user who has not been calibrated.
"""

from __future__ import annotations

import numpy as np

from gloves.captures.capture import Capture
from gloves.fit import nominal_fit
from gloves.layout import load_layout
from gloves.takes.take import Take
from gloves.takes.tracked_take import TrackedTake
from handsim.hand.model import HandModel
from track.capture_tracking import track_capture
from track.tracker import Tracker
from train.labelers.storage import load_labeler
from train.simulation.takes import TakeConfig, simulate_take


def joints(hand: HandModel, qpos: np.ndarray) -> np.ndarray:
    """Where the bones begin [m], (T, 16, 3)."""
    return hand.forward_kinematics(qpos)[..., :3, 3]


def tell(name: str, take: TrackedTake, truth: Take) -> None:
    for number, true in enumerate(truth.hands):
        motion = take.motion(true.side)  # whole, also where the hand was lost for a while
        ours = joints(HandModel(take.hands[number].shape), motion.qpos)
        off = np.linalg.norm(ours - joints(HandModel(true.shape), true.qpos), axis=-1)
        filled = 100 * take.filled[:, number].mean()
        print(f"{name}, {true.side}: joints {1e3 * off.mean():.2f} mm off, {filled:.1f} % filled in")


def main() -> None:
    truth = simulate_take(TakeConfig(kind="hand-controller", num_frames=240))  # 2 s at 120 Hz
    columns = tuple(f"*{number}" for number in range(truth.points.shape[1]))
    capture = Capture(columns, truth.points, truth.rate)  # no names, many gaps, some ghosts
    labeler = load_labeler("dense19")
    known = [hand.fit for hand in truth.hands]
    usual = [nominal_fit(load_layout("dense19"), "M", hand.side) for hand in truth.hands]
    for name, hands in (("known hands", known), ("hands of size M", usual)):
        tell(name, track_capture(capture, Tracker(hands, labeler)), truth)


if __name__ == "__main__":
    main()
