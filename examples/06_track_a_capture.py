"""Track two hands through a capture of unlabeled points, and compare their motion with the truth.

    python examples/06_track_a_capture.py

The capture is tracked twice: with the true hands and gloves, and with hands of size M in gloves put on as
designed, which is what a tracker knows of a user who has not been calibrated.
"""

from __future__ import annotations

import numpy as np

from gloves import Take, load_layout, nominal_fit
from handsim import HandModel
from track import Tracker, track_capture
from train import TakeConfig, load_labeler, simulate_take


def joints(model: HandModel, qpos: np.ndarray) -> np.ndarray:
    """Where the bones begin [m], (T, 16, 3)."""
    return model.forward_kinematics(qpos)[..., :3, 3]


def compare(name: str, tracked: Take, truth: Take) -> None:
    for number, hand in enumerate(truth.hands):
        motion = tracked.motion(hand.side)  # without gaps, also where the hand was lost for a while
        ours = joints(tracked.hands[number].model, motion.qpos)
        off = np.linalg.norm(ours - joints(hand.model, truth.qpos[:, number]), axis=-1)
        filled = 100 * tracked.filled(hand.side).mean()
        print(f"{name}, {hand.side}: joints {1e3 * off.mean():.2f} mm off, {filled:.1f} % filled in")


def main() -> None:
    truth = simulate_take(TakeConfig(kind="hand-controller", num_frames=240))  # 2 s at 120 Hz
    capture = truth.capture()  # no names, many gaps, some ghosts
    labeler = load_labeler("dense19")
    known = list(truth.hands)
    usual = [nominal_fit(load_layout("dense19"), "M", hand.side) for hand in truth.hands]
    for name, hands in (("known hands", known), ("hands of size M", usual)):
        compare(name, track_capture(capture, Tracker(hands, labeler)), truth)


if __name__ == "__main__":
    main()
