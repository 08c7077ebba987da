"""Whether a calibration keeps what it says: held-out against fresh frames, places told against true ones.

    python -m benchmarks.held_out_calibration [--gloves dense19 dfki13 starter10]
        [--motions calibration hand-controller] [--people 2] [--seconds 30] [--captures DATA]

Simulated people in gloves that slipped as `handsim simulate` has it; labels are those of the tracker. Rich
motion is "calibration" (touches) or "free", poor motion "hand-controller", which leaves most joints where
they are. `track.calibrate` has the first seconds of a capture; the fresh ones are 20 s of the same motion
after them.

DATA is a folder of Mocap_SIG18_Data: each person's capture1 calibrates, capture2 is fresh (right hands).
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from benchmarks.paper.hand_errors import hand_errors
from benchmarks.people import read_markers
from benchmarks.record import describe, run
from gloves import Capture, GloveFit, Take, load_layout
from handsim import HandSimWarning
from track import calibrate, measure_hands
from track.kinematics.pose_solver import PoseSolver
from train import simulate_take
from train.simulation.scenes import SimulatedKind

FRESH, RATE = 20.0, 120.0  # [s], [Hz]
NAMES = ("held out before", "after", "fresh before", "after", "places told", "true")


def fit_error(hand: GloveFit, markers: np.ndarray) -> float:
    """Median over frames that show nearly all markers (T, M, 3) [m] of the RMS distance [mm]."""
    seen = markers[np.isfinite(markers[..., 0]).mean(axis=1) >= 0.75]
    return 1e3 * float(np.median(PoseSolver(hand).solve(seen[:: max(1, len(seen) // 300)]).rms))


def run_capture(truth: Take, seconds: float) -> list[list[float]]:
    """The figures of `NAMES` for each hand of a simulated capture; NaN for places of hands that stay."""
    count = round(seconds * RATE)
    seen, layout = truth.cut(0, count), load_layout(truth.hands[0].layout.name)  # as designed, not as worn
    before = measure_hands(seen, layout, hands=truth.sides)
    user = calibrate(seen, glove=layout, hands=truth.sides)
    rows = []
    for done, worn in zip(user.calibrations, user, strict=True):
        side = worn.side
        true = truth.hands[truth.hand_index(side)]
        fresh = truth.observed(side)[count:]
        assert done.held_out is not None
        kept = done.held_out.after if done.is_better else done.held_out.before
        rows.append(
            [1e3 * done.held_out.before, 1e3 * kept]
            + [fit_error(hand, fresh) for hand in (before.of_side(side), worn)]
            + [
                1e3 * done.place_error if done.is_better else np.nan,
                1e3 * float(np.sqrt((hand_errors(worn, true).positions ** 2).mean())),
            ]
        )
    return rows


def run_person(person: Path) -> list[float]:
    """The first five figures of `NAMES` for the right hand of a real person."""
    layout = load_layout("dense19")
    first, second = (
        read_markers(sorted((person / name).rglob("*_right.trc")), layout.names)
        for name in ("capture1", "capture2")
    )
    capture = Capture(tuple(f"*{column}" for column in range(first.shape[1])), first, RATE)
    before = measure_hands(capture, layout, hands="right")
    user = calibrate(capture, glove=layout, hands="right")
    (done,) = user.calibrations
    assert done.held_out is not None
    kept = done.held_out.after if done.is_better else done.held_out.before
    told = [1e3 * done.held_out.before, 1e3 * kept]
    return told + [fit_error(one[0], second) for one in (before, user)] + [1e3 * done.place_error]


def judge(rows: np.ndarray) -> str:
    """How many of the hands keep what is told of them."""
    told, before, fresh, places, true = rows[:, 1:6].T
    words = [f"{len(rows)} hands, {np.isfinite(places).sum()} calibrated"]
    words.append(f"worse on fresh frames by over 2 %: {(fresh > 1.02 * before).sum()}")
    for name, ratio in (("residual", told / fresh), ("places", (places / true)[np.isfinite(places)])):
        close = f"{(abs(ratio - 1.0) <= 0.2).sum()} told to 20 %"
        words.append(
            f"{name}: {close}, {ratio.mean():.2f} times in the mean, {ratio.min():.2f} to {ratio.max():.2f}"
        )
    return "; ".join(words)


def tell(name: str, values: np.ndarray) -> None:
    """A row of the table."""
    print(f"{name} | " + " | ".join(f"{value:.2f}" for value in values), flush=True)


def main(
    gloves: tuple[str, ...] = ("dense19", "dfki13", "starter10"),
    motions: tuple[SimulatedKind, ...] = ("calibration", "hand-controller"),
    people: int = 2,
    seconds: float = 30.0,
    captures: Path | None = None,
) -> None:
    warnings.simplefilter("ignore", HandSimWarning)
    print(describe("scipy", "numba"))
    print("[mm] | " + " | ".join(NAMES))
    if captures:
        for person in sorted(captures.glob("User*")):
            tell(person.name, np.array(run_person(person)))
    count = round((seconds + FRESH) * RATE)
    for glove in gloves:
        for motion in motions:
            rows = []
            for person in range(people):
                truth = simulate_take(motion, glove=glove, num_frames=count, seed=100 + person)
                for row in run_capture(truth, seconds):
                    tell(f"{glove}, {motion}, person {person}", np.array(row))
                    rows.append(row)
            tell(f"{glove}, {motion}, mean", np.nanmean(rows, axis=0))
            tell(f"{glove}, {motion}, worst", np.nanmax(rows, axis=0))
            print(f"{glove}, {motion}: {judge(np.array(rows))}", flush=True)


if __name__ == "__main__":
    run(main, __doc__)
