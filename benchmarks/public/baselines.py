"""Our trackers as participants: they read what every tracker may read, and write results like others.

Two methods cannot find a hand by themselves; they are given the true labels of each capture's first frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
from jaxtyping import Int

from benchmarks.paper.assignment_trackers import HungarianTracker, NearestNeighborTracker
from benchmarks.paper.paper_tracker import PaperTracker
from benchmarks.paper.take_evaluation import FrameTracker
from benchmarks.public.answers import SIDES, Answers, BenchmarkError, poses_of, save_answers
from benchmarks.public.difficulties import BENCHMARK, GLOVE
from benchmarks.public.manifest import Benchmark
from gloves import Capture, GloveFit
from handsim.files.outputs import claim
from handsim.hand.shape import NUM_QPOS
from track import Tracker, measure_hands
from track.frames import capture_frames
from train import Labeler, load_labeler

MakeTracker = Callable[[Sequence[GloveFit], Labeler, Int[np.ndarray, "N"]], FrameTracker]

TrackerName = Literal["handsim", "paper", "hungarian", "nearest"]
Users = Literal["uncalibrated", "calibrated"]
ABOUT: Final = "about.json"
"""What results were made with."""
_SEED: Final = 0  # of the paper's loop, which pairs hands and clusters at random
_TRACKERS: Final[dict[TrackerName, MakeTracker]] = {
    "handsim": lambda users, labeler, first: Tracker(users, labeler),
    "paper": lambda users, labeler, first: PaperTracker(users, labeler, rng=np.random.default_rng(_SEED)),
    "hungarian": lambda users, labeler, first: HungarianTracker(users, first),
    "nearest": lambda users, labeler, first: NearestNeighborTracker(users, first),
}
TRACKERS: Final[tuple[TrackerName, ...]] = get_args(TrackerName)


def run_baseline(
    benchmark: Benchmark,
    tracker: TrackerName,
    out: Path,
    *,
    users: Users = "uncalibrated",
    progress: Callable[[int], None] | None = None,
) -> None:
    """Track every capture and write results; captures that have some are left out.

    Args:
        benchmark: The benchmark.
        tracker: The method.
        out: Folder of the results.
        users: Whether the tracker gets the true hands and gloves, or measures the size of the hands.
        progress: Called with the number of frames that were done since the last call.

    Raises:
        BenchmarkError: `out` holds something else, or a file of the benchmark is damaged.
    """
    about = {"benchmark": BENCHMARK, "size": benchmark.size, "tracker": tracker, "users": users}
    claim(out / ABOUT, about, noun="set of results", error=BenchmarkError)
    labeler = load_labeler(GLOVE, None)
    for one in benchmark.captures:
        path = out / f"{one.name}.npz"
        if not path.is_file():
            capture, truth = benchmark.capture(one.name), benchmark.truth(one.name)
            here = np.isfinite(capture.positions[0, :, 0])
            if users == "calibrated":
                hands = benchmark.user(one.name)
            else:
                hands = measure_hands(capture, GLOVE, labeler=labeler, hands=SIDES)
            made = _TRACKERS[tracker](hands, labeler, truth.labels[0, here])
            save_answers(path, track_answers(capture, hands, made))
        if progress is not None:
            progress(one.num_frames)


def track_answers(capture: Capture, hands: Sequence[GloveFit], tracker: FrameTracker) -> Answers:
    """What a tracker of these hands says of a capture."""
    present = np.isfinite(capture.positions[..., 0])
    labels = np.full(present.shape, -1)
    qpos = np.full((capture.num_frames, len(hands), NUM_QPOS), np.nan)
    for number, frame in enumerate(capture_frames(capture)):
        tracked = tracker.step(frame.points, frame.ids, frame.time)
        labels[number, present[number]] = tracked.labels
        qpos[number] = [hand.qpos for hand in tracked.hands]
    return Answers(labels, *poses_of(hands, qpos))
