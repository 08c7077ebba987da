"""An hour of the same ten seconds: whether anything that the tracker learns drifts.

python -m benchmarks.drift [dense19 sparse13 starter10] [--hands true measured] [--minutes 60] [--rate 120]

Two simulated hands go through five seconds forwards and then backwards, again and again, each round with new
IDs, so that every minute shows the same frames. The last minute is compared with the second one: the RMS
distance of the markers from the hand's own places, and the distance of the keypoints from the truth. "true"
hands are calibrated, their gloves are as worn; "measured" ones have the size that is measured in the take,
and gloves as designed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import tyro

from benchmarks.paper.take_evaluation import measured_users, seen_frame, true_users
from benchmarks.record import describe, run
from gloves import GloveFit, Take
from gloves.takes.take import keypoints_of
from track import Tracker
from train import load_labeler, simulate_take

HALF_ROUND = 5.0  # [s] forwards; as long backwards
MINUTE = 60.0  # [s]
TOLD = 5  # Every so many minutes are told on the way.
FEWEST = 3  # minutes: the first settles, and the last is compared with the second


def main(
    gloves: tyro.conf.Positional[tuple[Literal["dense19", "sparse13", "starter10"], ...]] = (
        "dense19",
        "sparse13",
        "starter10",
    ),
    *,
    hands: tuple[Literal["true", "measured"], ...] = ("true", "measured"),
    minutes: int = 60,
    rate: int = 120,
    seed: int = 0,
) -> None:
    print(describe("numba", "torch"))
    for glove in gloves:
        take = simulate_take("hand-hand", glove=glove, num_frames=round(120 * HALF_ROUND) + 1, seed=seed)
        labeler = load_labeler(glove)
        for name in hands:
            users = true_users(take) if name == "true" else measured_users(take, labeler)
            print(f"{glove}, {name} hands, {rate} Hz", flush=True)
            errors = follow(take, users, Tracker(users, labeler), max(minutes, FEWEST), rate)
            tell(errors, take)


def follow(take: Take, users: Sequence[GloveFit], tracker: Tracker, minutes: int, rate: int) -> np.ndarray:
    """Mean RMS distance and keypoint error of each hand in each minute (minutes, 2, H) [m]."""
    order = np.arange(0, take.num_frames, round(take.rate / rate))
    order = np.concatenate([order, order[-2:0:-1]])
    seen, lap = [seen_frame(take, frame) for frame in order], int(take.ids.max()) + 1
    truth = keypoints_of(take.hands, take.qpos)[order]
    found = []
    for minute in range(minutes):
        numbers = range(round(minute * MINUTE * rate), round((minute + 1) * MINUTE * rate))
        poses, rms = [], []
        for number in numbers:
            turn, place = divmod(number, len(order))
            ids = np.where(seen[place].ids >= 0, seen[place].ids + turn * lap, -1)
            tracked = tracker.step(seen[place].points, ids, number / rate)
            poses.append([hand.qpos for hand in tracked.hands])
            rms.append([hand.rms for hand in tracked.hands])
        off = keypoints_of(users, np.array(poses)) - truth[np.array(numbers) % len(order)]
        errors = np.linalg.norm(off, axis=-1).mean(axis=-1)
        found.append(np.nanmean([rms, errors], axis=1))
        if minute % TOLD == 1:
            markers, keypoints = 1e3 * found[-1].mean(axis=1)
            print(
                f"  minute {minute + 1}: markers {markers:.3f} mm, keypoints {keypoints:.3f} mm", flush=True
            )
    return np.array(found)


def tell(errors: np.ndarray, take: Take) -> None:
    """Print the second minute, the worst one after it, and the last one."""
    for number, what in enumerate(("markers", "keypoints")):
        for hand, side in enumerate(take.sides):
            second, *later = 1e3 * errors[1:, number, hand]
            print(
                f"  {what}, {side}: {second:.3f} mm in the second minute, {max(later):.3f} at most, "
                f"{later[-1]:.3f} in the last ({100 * (later[-1] / second - 1):+.1f} %)",
                flush=True,
            )


if __name__ == "__main__":
    run(main, __doc__)
