"""The tracker on the twins: calibrated as users are, among ghosts, from nothing.

    OMP_NUM_THREADS=1 python -m benchmarks.tracking [calibrated drums starts]
        [--kinds hand-hand ... --seeds 0 1 --frames N --starts 200 --recoveries 100]

calibrated: the people of a twin make a calibration capture in their gloves, simulated like the twin; `handsim
    calibrate` measures their size, has the tracker label the capture, and writes their hands. With these the
    twin is tracked.
drums: the twins with twenty ghosts a frame near the hands (`drum_takes`), and without.
starts: a tracker begins at a random frame, or has a second of darkness behind it; how many frames pass until
    every point and pose of a frame is right. "Within 3" is the third frame at the latest.

All sections when none is named. Twins have the paper's number of frames unless told otherwise; the points of
a rigid body with markers of its own are left out, as in the paper's tables. What counts as right and valid is
told in docs/tracking.md. One core is used.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache
from typing import Annotated, Literal

import numpy as np
import tyro

from benchmarks.drum_takes import with_drum
from benchmarks.paper.hand_errors import hand_errors
from benchmarks.paper.take_evaluation import (
    TrackingReport,
    evaluate_tracker,
    measured_users,
    nominal_users,
    true_users,
)
from benchmarks.paper.trials import initialization_times, recovery_times
from benchmarks.record import Figures, describe, run, save_figures
from gloves import GloveFit, Take
from track import Tracker, calibrate
from train import Labeler, load_labeler, simulate_take
from train.simulation.scenes import KINDS, CalibrationTakeConfig, SimulatedKind
from train.simulation.takes import simulate_calibration

TRIALS = {"start": (initialization_times, 3), "recovery": (recovery_times, 5)}
"""What is tried, and the frames within which all should be right."""
Section = Literal["calibrated", "drums", "starts"]
HANDS = {
    "true": true_users,
    "uncalibrated": lambda take: measured_users(take, labeler()),
}


@cache
def twin(kind: SimulatedKind, frames: int | None, seed: int) -> Take:
    return simulate_take(kind=kind, num_frames=frames, seed=seed).without_body()


@cache
def labeler() -> Labeler:
    return load_labeler("dense19")


def follow(take: Take, users: Sequence[GloveFit]) -> TrackingReport:
    return evaluate_tracker(take, users, Tracker(users, labeler()))


def tell(name: str, report: TrackingReport) -> None:
    figures = report.figures()
    shares = " ".join(f"{100 * figures[key]:7.2f}" for key in ("right", "valid", "right_of_valid"))
    errors = " ".join(
        "          -  " if not count else f"{1e3 * joint:5.2f} /{np.rad2deg(angle):6.2f}"
        for count, joint, angle in report.by_occlusion().values()
    )
    print(f"  {name:30s} {shares}   {errors}", flush=True)


def right_of(takes: dict[str, Take]) -> str:
    """What a list of shares is, one of each take."""
    return f"frames all of whose labels are right [%]: {', '.join(takes)}"


def head(title: str) -> None:
    print(f"\n{title}")
    print(
        "  % of frames, joints [mm] / hinges [deg]    right   valid  of these   "
        "by markers missing: none, 1-2, 3-5, 6 or more"
    )


def calibrated_users(take: Take, seed: int, free: float) -> list[GloveFit]:
    """The people of a take as `handsim calibrate` finds them in a capture that they make for it."""
    people = tuple(true_users(take))
    rng = np.random.default_rng((seed, 1))
    made = simulate_calibration(people, CalibrationTakeConfig(free=free), rng=rng)
    return list(calibrate(made).of_sides(take.sides))


def calibrated(takes: dict[str, Take], seed: int, free: float) -> Figures:
    head("calibrated as users are")
    reports = []
    for name, take in takes.items():
        began = time.perf_counter()
        found = calibrated_users(take, seed, free)
        took = time.perf_counter() - began
        reports.append(follow(take, found))
        tell(name, reports[-1])
        for one, true in zip(found, true_users(take), strict=True):
            errors = hand_errors(one, true)
            print(
                f"    {one.side}: places {1e3 * errors.positions.mean():.2f} mm, bones "
                f"{100 * np.abs(errors.lengths).mean():.2f} %, tips {100 * np.abs(errors.tips).mean():.1f} %"
            )
        print(f"    calibration capture, its labels and the calibration took {took:.0f} s")
    occlusions = [list(report.by_occlusion().values()) for report in reports]
    errors = [
        [1e3 * np.nanmax([one[1] for one in same]), np.rad2deg(np.nanmax([one[2] for one in same]))]
        for same in zip(*occlusions, strict=True)
    ]
    missing = "mean errors of joints [mm], joint angles [deg] by markers missing: none, 1-2, 3-5, 6 or more"
    return {
        "right": (right_of(takes), [100 * report.right.mean() for report in reports]),
        "errors": (f"{missing}: calibrated from a capture, the worst of the takes", errors),
    }


def drums(takes: dict[str, Take], seed: int) -> Figures:
    head("twenty ghosts a frame near the hands")
    right: dict[str, list[float]] = {}
    for name, take in takes.items():
        noisy = with_drum(take, rng=np.random.default_rng(seed))
        for users, hands in HANDS.items():
            for when, one in {"without": take, "ghosts": noisy}.items():
                report = follow(one, hands(take))
                tell(f"{name} {users}, {when}", report)
                right.setdefault(f"{users}_{when}", []).append(100 * report.right.mean())
    return {key: (f"hands and ghosts {key}: {right_of(takes)}", shares) for key, shares in right.items()}


def starts(takes: dict[str, Take], seed: int, tried: dict[str, int]) -> Figures:
    figures: Figures = {}
    print(f"\nfrom nothing, and after a second of darkness; {len(takes)} takes")
    for users, hands in HANDS.items():
        waits: dict[str, list[np.ndarray]] = {"start": [], "recovery": []}
        for name, take in takes.items():
            rng = np.random.default_rng(seed)
            for what, trials in tried.items():
                wait, within = TRIALS[what]
                count, known = -(-trials // len(takes)), hands(take)
                waits[what].append(
                    wait(take, lambda _, known=known: Tracker(known, labeler()), count, rng=rng)
                )
                tell_waits(f"{name}, {users}: {what}", waits[what][-1], within)
        for what, found in waits.items():
            waited, within = np.concatenate(found), TRIALS[what][1]
            tell_waits(f"all, {users}: {what}", waited, within)
            share = 100 * np.mean(waited < within)
            words = f"{users} hands, {what}: right within {within} frames [%]; not in 120 frames, of how many"
            figures[f"{users}_{what}"] = words, [share, [np.isnan(waited).sum(), len(waited)]]
            if (users, what) == ("true", "start") and "hand-hand 0" in takes:
                touching = 100 * np.mean(found[list(takes).index("hand-hand 0")] < within)
                figures["touching"] = f"true hands of hand-hand: right within {within} frames [%]", touching
    return figures


def tell_waits(name: str, waits: np.ndarray, within: int) -> None:
    never = np.where(np.isnan(waits), np.inf, waits)
    print(
        f"  {name:46s} {100 * np.mean(never < within):6.1f} % within {within} frames, "
        f"{100 * np.mean(never == 0):5.1f} % in the first, {np.isinf(never).sum()}/{len(waits)} not in 120",
        flush=True,
    )


def main(
    sections: tyro.conf.Positional[tuple[Section, ...]] = ("calibrated", "drums", "starts"),
    *,
    kinds: tuple[SimulatedKind, ...] = KINDS,
    seeds: tuple[int, ...] = (0, 1),
    frames: int | None = None,
    free: float = 40.0,
    starts_tried: Annotated[int, tyro.conf.arg(name="starts")] = 200,
    recoveries: int = 100,
    save: str | None = None,
) -> None:
    print(describe("numba", "scipy", "torch"))
    takes = {f"{kind} {seed}": twin(kind, frames, seed) for seed in seeds for kind in kinds}
    for take in takes.values():
        Tracker(nominal_users(take), labeler()).warm_up()
    work = {
        "calibrated": lambda: calibrated(takes, seeds[0], free),
        "drums": lambda: drums(takes, seeds[0]),
        "starts": lambda: starts(takes, seeds[0], {"start": starts_tried, "recovery": recoveries}),
    }
    figures: Figures = {}
    for section in sections:
        figures |= work[section]()
    save_figures(save, figures)


if __name__ == "__main__":
    run(main, __doc__)
