"""Whether the standard deviations of joint angles and keypoints are true, on simulated people.

    OMP_NUM_THREADS=1 python -m benchmarks.doubt [--gloves dense19 sparse13 starter10]
        [--seeds 0 1 2 3] [--frames 480] [--free 20] [--files]

Each person makes a twin of one of the paper's four kinds of captures, in turn. It is tracked with hands of
the nearest size, with hands that are measured in it, and with hands that were calibrated in a capture of
their own, whose labels are the truth's. Counted are the errors of all poses within one and within two
standard deviations: of a normal distribution 68 and 95 %. A person's error is the same in all frames, so that
single joints need many people. --files tracks real-like takes as `handsim track` does, without and with
--calibrate: gloves have slipped, markers move with the skin, and poses are smoothed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.paper.take_evaluation import measured_users, nearest_size, nominal_users, seen_frame
from benchmarks.record import Figures, describe, run, save_figures
from gloves import GloveFit, Take
from gloves.fit import nominal_fit
from gloves.takes.take import keypoints_of
from handsim.hand.shape import JOINT_NAMES
from track import Tracker, User, track_capture
from track.calibration.user_calibration import calibrate_hand
from track.settings import USUAL_SIZE
from track.user import MEASURED
from train import load_labeler, simulate_take
from train.simulation.scenes import KINDS, CalibrationTakeConfig
from train.simulation.takes import simulate_calibration

EVERY = 4  # frames
Pose = tuple[np.ndarray, ...]  # found and true qpos, standard deviations of angles and keypoints


class Errors(NamedTuple):
    """Errors of poses over their standard deviations, and the errors alone."""

    angles: np.ndarray
    """(P, 20)."""
    keypoints: np.ndarray
    """(P, 21, 3)."""
    degrees: np.ndarray
    """(P, 20) [deg]."""
    spread: np.ndarray
    """(P, 20), the standard deviations [deg]."""


def errors_of(take: Take, user: User, glove: str) -> list[Errors]:
    """The errors of a tracked take, hand by hand."""
    tracker = Tracker(user, load_labeler(glove))
    poses: list[list[Pose]] = [[] for _ in user]
    for number in range(take.num_frames):
        seen = seen_frame(take, number)
        tracked = tracker.step(seen.points, seen.ids, number / take.rate)
        for index, hand in enumerate(tracked.hands):
            true = take.qpos[number, index]
            if number % EVERY == 0 and hand.has_pose and np.isfinite(true[0]):
                poses[index].append((hand.qpos, true, hand.angle_spread, hand.keypoint_spread))
    return errors_over(poses, user, take)


def errors_of_file(truth: Take, found: Take) -> list[Errors]:
    """The errors of a take that was tracked as a file, hand by hand."""
    poses: list[list[Pose]] = []
    for number, side in enumerate(found.sides):
        there = np.flatnonzero(np.isfinite(found.qpos[:, number, 0]))[::EVERY]
        columns = (found.qpos[:, number], truth.qpos[:, truth.hand_index(side)])
        columns += (found.angle_spread[:, number], found.keypoint_spread[:, number])
        poses.append(list(zip(*(column[there] for column in columns), strict=True)))
    return errors_over(poses, found.hands, truth)


def errors_over(poses: Sequence[Sequence[Pose]], hands: Sequence[GloveFit], truth: Take) -> list[Errors]:
    """The errors of found and true poses, hand by hand."""
    found = []
    for index, rows in enumerate(poses):
        if not rows:
            continue
        qpos, true, angles, keypoints = map(np.array, zip(*rows, strict=True))
        off = qpos[:, 7:] - true[:, 7:]
        places = keypoints_of([hands[index]], qpos[:, None])[:, 0]
        mine = truth.hands[truth.hand_index(hands[index].side)]
        places -= keypoints_of([mine], true[:, None])[:, 0]
        found.append(Errors(off / angles, places / keypoints[..., None], np.rad2deg(off), np.rad2deg(angles)))
    return found


def calibrated_hands(take: Take, glove: str, seed: int, free: float) -> User:
    """The people of a take, each hand calibrated in a capture of its own with the true labels."""
    rng = np.random.default_rng((seed, 1))
    made = simulate_calibration(take.hands, CalibrationTakeConfig(free=free, rounds=2), rng=rng)
    hands: list[GloveFit] = []
    for hand in take.hands:
        start = nominal_fit(glove, nearest_size(hand.shape.length), hand.side)
        hands.append(calibrate_hand(made.observed(hand.side), start, made.rate).hand)
    return User(tuple(hands))


def tell(name: str, errors: Sequence[Errors]) -> list[float]:
    """Print a line of the table: shares within one and two [%], and what the worst joint has."""
    angles, keypoints = (np.abs(np.concatenate(some)) for some in list(zip(*errors, strict=True))[:2])
    shares = [[100.0 * (some < limit).mean() for limit in (1, 2)] for some in (angles, keypoints)]
    joints = [100.0 * (angles < limit).mean(axis=0) for limit in (1, 2)]
    off, spread = (
        np.sqrt(np.mean(np.concatenate(some) ** 2)) for some in list(zip(*errors, strict=True))[2:]
    )
    row = [*shares[0], *(joint.min() for joint in joints), *shares[1]]
    print(
        f"{name:24s} | {row[0]:5.1f} {row[1]:5.1f} | {row[2]:5.1f} {JOINT_NAMES[joints[0].argmin()]}, "
        f"{row[3]:5.1f} {JOINT_NAMES[joints[1].argmin()]} | {row[4]:5.1f} {row[5]:5.1f} | "
        f"{off:5.2f} {spread:5.2f}",
        flush=True,
    )
    return [float(number) for number in row]


def main(
    gloves: tuple[str, ...] = ("dense19", "sparse13", "starter10"),
    seeds: tuple[int, ...] = (0, 1, 2, 3),
    frames: int = 480,
    free: float = 20.0,
    files: bool = False,
    save: str | None = None,
) -> None:
    print(describe("numba", "torch"))
    print(
        "errors within 1 and 2 standard deviations [%] | joint angles | worst joints | keypoints | RMS of "
        "angle errors, of standard deviations [deg]"
    )
    table: dict[str, list[Errors]] = {}
    for glove in gloves:
        for seed in seeds:
            if files:
                take = simulate_take("real-like", glove=glove, num_frames=frames, seed=seed)
                for name, calibrate in {"measured": False, "calibrated": True}.items():
                    found = track_capture(take.capture(), glove=glove, calibrate=calibrate)
                    table.setdefault(f"{glove} {name}", []).extend(errors_of_file(take, found))
                continue
            kind = KINDS[seed % len(KINDS)]
            take = simulate_take(kind=kind, glove=glove, num_frames=frames, seed=seed)
            take = take.without_body()
            users = {
                "named": User(tuple(nominal_users(take)), USUAL_SIZE),  # the notes of hands of a size
                "measured": User(tuple(measured_users(take, load_labeler(glove))), f"{MEASURED}twin"),
                "calibrated": calibrated_hands(take, glove, seed, free),
            }
            for name, user in users.items():
                table.setdefault(f"{glove} {name}", []).extend(errors_of(take, user, glove))
    figures: Figures = {}
    what = "within 1, 2 standard deviations [%]: joint angles, the worst joint of each, keypoints"
    for name, errors in {**table, "all": [one for some in table.values() for one in some]}.items():
        figures[name.replace(" ", "_")] = f"{name}: {what}", tell(name, errors)
    save_figures(save, figures)


if __name__ == "__main__":
    run(main, __doc__)
