"""Track two hands through a capture of unlabeled points, and compare their motion with the truth.

    python examples/06_track_a_capture.py

The capture is tracked twice: with the true hands and gloves, as if their user had been calibrated, and with
hands whose size is measured in the capture, as `handsim track` does.
"""

from __future__ import annotations

import numpy as np

from gloves import Take
from handsim import HandModel
from track import track_capture
from train import simulate_take


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
    truth = simulate_take(kind="hand-controller", num_frames=240)  # 2 s at 120 Hz
    capture = truth.capture()  # no names, many gaps, some ghosts
    compare("known hands", track_capture(capture, hands=truth.hands), truth)
    compare("measured hands", track_capture(capture, glove="dense19"), truth)


if __name__ == "__main__":
    main()
