"""Comparison of all trackers on the same takes, with calibrated and uncalibrated hands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float

from benchmarks.paper.assignment_trackers import HungarianTracker, NearestNeighborTracker
from benchmarks.paper.paper_tracker import PaperTracker
from benchmarks.paper.take_evaluation import (
    FrameTracker,
    TrackingReport,
    evaluate_tracker,
    measured_users,
    seen_frame,
    true_users,
)
from benchmarks.paper.trials import FEWEST_FRAMES, initialization_times, recovery_times
from gloves import GloveFit, Take
from handsim.errors import ArgumentError
from handsim.space.objects import named_object
from track import RigidTemplate, Tracker
from train import Labeler

MakeTracker = Callable[[Take, Sequence[GloveFit]], FrameTracker]

OURS: Final = "handsim"
PAPERS_LOOP: Final = "paper's loop"
NEED_FIRST_LABELS: Final = ("nearest point", "Hungarian")
"""Methods that get the labels of the first frame and cannot initialize a hand."""
USERS: Final[dict[str, Callable[[Take, Labeler], list[GloveFit]]]] = {
    "calibrated": lambda take, _: true_users(take),
    "uncalibrated": measured_users,
}
TRIALS: Final = 10
_WARM_UP: Final = 30  # frames before time is measured, in which kernels are loaded


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """Results of one tracker on one take."""

    method: str
    """Name of the tracker."""
    users: str
    """Name of the hands, one of `USERS`."""
    capture: str
    """Name of the take."""
    report: TrackingReport
    initialization: Float[np.ndarray, "S"]
    """Frames until all was right, from random frames of the take; NaN: never. See `trials`."""
    recovery: Float[np.ndarray, "S"]
    """The same after a second without points."""


def trackers(labeler: Labeler, seed: int) -> dict[str, MakeTracker]:
    """Functions that make a tracker for a take (or a part of it) and hands, by the method's name.

    Args:
        labeler: Labeler for the methods that need one.
        seed: Seed of the paper's loop.
    """
    return {
        OURS: lambda take, users: Tracker(users, labeler),
        PAPERS_LOOP: lambda take, users: PaperTracker(users, labeler, rng=np.random.default_rng(seed)),
        NEED_FIRST_LABELS[0]: lambda take, users: NearestNeighborTracker(users, seen_frame(take, 0).labels),
        NEED_FIRST_LABELS[1]: lambda take, users: HungarianTracker(users, seen_frame(take, 0).labels),
    }


def compare_trackers(
    takes: Mapping[str, Take],
    labeler: Labeler,
    *,
    seed: int,
    trials: int = 0,
    done: Callable[[], None] | None = None,
) -> list[Measurement]:
    """Run every tracker over every take, with calibrated and uncalibrated hands.

    Args:
        takes: Simulated takes, by name.
        labeler: Labeler for the methods that need one.
        seed: Seed of the paper's loop and of the first frames of trials.
        trials: Number of trials of initialization and of recovery in each take that is long enough.
        done: Called after each frame of a take; trials are not counted.
    """
    wearers = {
        (users, capture): hands_of(take, labeler)
        for users, hands_of in USERS.items()
        for capture, take in takes.items()
    }
    measured = []
    for name, make in trackers(labeler, seed).items():
        for (users, capture), hands in wearers.items():
            take = takes[capture]
            report = _report(take, hands, make, done)
            waits = _run_trials(take, hands, name, make, trials, seed)
            measured.append(Measurement(name, users, capture, report, *waits))
    return measured


def measure_with_body(
    capture: str, take: Take, labeler: Labeler, *, done: Callable[[], None] | None = None
) -> list[Measurement]:
    """Run our tracker over a take with its body tracked beside the hands; the body's labels count too.

    Args:
        capture: The take's name.
        take: A simulated take with one of handsim's objects.
        labeler: Labeler of the hands' glove.
        done: Called after each frame.

    Raises:
        ArgumentError: The take has no body, or one with too few markers.
    """
    if not take.bodies:
        raise ArgumentError(f"{capture}: the take has no body, expected one with three markers or more")
    body = RigidTemplate.of(named_object(take.bodies[0].name))
    nothing, measured = np.zeros(0), []
    for users, hands_of in USERS.items():
        report = _report(
            take, hands_of(take, labeler), lambda _, hands: Tracker(hands, labeler, (body,)), done
        )
        measured.append(Measurement(f"{OURS}, {body.name} too", users, capture, report, nothing, nothing))
    return measured


def _report(
    take: Take, hands: Sequence[GloveFit], make: MakeTracker, done: Callable[[], None] | None
) -> TrackingReport:
    """Results of a tracker on a take, after a warm-up on its first frames."""
    start = take.cut(0, min(_WARM_UP, take.num_frames))
    evaluate_tracker(start, hands, make(start, hands))
    return evaluate_tracker(take, hands, make(take, hands), done=done)


def _run_trials(
    take: Take, hands: Sequence[GloveFit], name: str, make: MakeTracker, trials: int, seed: int
) -> tuple[Float[np.ndarray, "S"], Float[np.ndarray, "S"]]:
    """Frames until all was right in trials of initialization and of recovery; empty without trials."""
    nothing = np.zeros(0)
    if take.num_frames < FEWEST_FRAMES or not trials:
        return nothing, nothing
    rng = np.random.default_rng(seed)
    recovery = recovery_times(take, lambda part: make(part, hands), trials, rng=rng)
    if name in NEED_FIRST_LABELS:
        return nothing, recovery
    return initialization_times(take, lambda part: make(part, hands), trials, rng=rng), recovery
