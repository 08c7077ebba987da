"""How near a calibration comes to the truth, on simulated users.

    python -m benchmarks.calibration [--users 6] [--captures FOLDER]

Each user is one hand, right and left in turn: a size's mean hand made 8 % larger or smaller, with the
individual spreads of `handsim.hand.shape.sample_shape`, in a glove whose markers sit 5 mm from where they
belong, along the skin, and 0.3 mm above or below it. It makes a capture of touches and free motion before
the 16 cameras of "figure5"; labels are the truth's. The calibration begins with the size's mean hand and the
glove as designed.

The same capture is calibrated once more with flesh that moves every marker by 0.5 mm RMS as its digit bends.

FOLDER holds labeled dense19 captures of real people, one sub-folder each (right hands, *_right.trc): the
first half of each calibrates, the second is tracked. There the truth is not known, only what markers are off.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from benchmarks.paper.hand_errors import hand_errors
from benchmarks.people import displace_markers, flesh_motion, right_hands
from benchmarks.record import Figures, describe, run, save_figures
from gloves import GloveFit, MarkerLayout, load_layout
from gloves.fit import attach_markers, nominal_fit
from handsim import HandModel, HandShape, sample_shape
from handsim.hand.shape import SIDES, SIZES, shape_from_measures
from track.calibration.user_calibration import calibrate_hand
from track.kinematics.pose_solver import PoseSolver
from train.simulation.scenes import CalibrationTakeConfig
from train.simulation.takes import simulate_calibration

OFF, SLIP, LIFT = 0.08, 0.005, 0.0003
FLESH = 0.0005  # [m]
EVERY = 5  # held-out frames


def draw_shape(size: str, factor: float, rng: np.random.Generator) -> HandShape:
    """A size's mean hand, scaled, with one person's own proportions."""
    person = sample_shape(rng=rng)
    mean = shape_from_measures(person.length, person.breadth)
    hand = shape_from_measures(*(factor * measure for measure in SIZES[size]))
    return dataclasses.replace(
        hand,
        bone_lengths=hand.bone_lengths * person.bone_lengths / mean.bone_lengths,
        knuckles=hand.knuckles + person.knuckles - mean.knuckles,
        base_angles=person.base_angles,
        radii=hand.radii * person.radii / mean.radii,
        palm_thickness=hand.palm_thickness * person.palm_thickness / mean.palm_thickness,
    )


def draw_user(number: int, layout: MarkerLayout, rng: np.random.Generator) -> tuple[GloveFit, GloveFit]:
    """Somebody's hand in its glove, and the hand that a calibration begins with."""
    sizes, index, side = list(SIZES), 1 + number % 3, SIDES[1 - number % 2]
    grown = 1 if number % 4 < 2 else -1
    shape = draw_shape(sizes[index], 1.0 + OFF * grown, rng)
    model = HandModel(shape)
    worn = displace_markers(attach_markers(layout, model), shape, SLIP, LIFT, rng=rng)
    return GloveFit(model, worn).with_side(side), nominal_fit(layout, sizes[index], side)


def tell(name: str, hand: GloveFit, true: GloveFit) -> list[float]:
    """Print how far a hand is from the truth; returns what is averaged over users."""
    errors = hand_errors(hand, true)
    off, lengths = 1e3 * errors.positions, 100.0 * np.abs(errors.lengths)
    tips = 100.0 * np.abs(errors.tips)
    print(f"  {name}: places {off.mean():.2f} mm (worst {off.max():.2f}; palm's in the wrist's frame: "
          f"{1e3 * errors.wrist_positions.mean():.2f}), bones {lengths.mean():.2f} % "
          f"(worst {lengths.max():.1f}), tips {tips.mean():.1f} %")  # fmt: skip
    return [off.mean(), off.max(), 1e3 * errors.wrist_positions.mean(), lengths.mean(), lengths.max(),
            tips.mean()]  # fmt: skip


def run_user(rng: np.random.Generator, number: int, layout: MarkerLayout) -> dict[str, list[float]]:
    """Simulate a user, calibrate in every way, print; what is averaged over users, by the way."""
    true, start = draw_user(number, layout, rng)
    take = simulate_calibration((true,), CalibrationTakeConfig(), rng=rng)
    markers = take.observed(true.side)
    ways = {
        "after": markers,
        "flesh": markers + flesh_motion(true.attachment, take.qpos[:, 0], FLESH, rng=rng),
    }
    print(f"user {number}, {true.side}: {take.num_frames} frames")
    rows = {"before": tell("before", start, true)}
    for name, seen in ways.items():
        result = calibrate_hand(seen, start, take.rate)
        within = (1e3 * hand_errors(result.hand, true).wrist_positions < 2e3 * result.position_errors).mean()
        rows[name] = tell(name, result.hand, true)
        rows[f"{name} within"] = [100 * within]
        print(f"    {len(result.touches)} touches; {within:.0%} of places within two standard errors")
    return rows


def tell_people(captures: Path, layout: MarkerLayout) -> list[list[float]]:
    """What markers are off by on captures that a calibration has not seen, medians before and after [mm]."""
    medians: list[list[float]] = [[], []]
    for name, markers in right_hands(captures, layout.names).items():
        half = len(markers) // 2
        seen = markers[half:][np.isfinite(markers[half:, :, 0]).all(axis=1)][::EVERY]
        result = calibrate_hand(markers[:half], nominal_fit(layout, "M", "right"), 120.0)
        off = [1e3 * PoseSolver(hand).solve(seen).rms for hand in (result.start, result.hand)]
        print(f"{name}: {len(seen)} held-out frames, 3D RMS median {np.median(off[0]):.2f} mm before, "
              f"{np.median(off[1]):.2f} mm after (p95 {np.percentile(off[1], 95):.2f}); "
              f"{len(result.touches)} touches found")  # fmt: skip
        for one, values in zip(medians, off, strict=True):
            one.append(float(np.median(values)))
    return medians


def main(users: int = 6, captures: Path | None = None, save: str | None = None) -> None:
    print(describe("scipy", "numba"))
    glove = load_layout("dense19")
    told = [run_user(np.random.default_rng((0, number)), number, glove) for number in range(users)]
    figures: Figures = {}
    within = [user["after within"][0] for user in told]
    figures["within"] = "marker positions within two standard errors, by user [%]", [min(within), max(within)]
    for name in ("before", "after", "flesh"):
        mean, worst = (by([user[name] for user in told], axis=0) for by in (np.mean, np.max))
        print(f"{name}: places {mean[0]:.2f} mm (worst {worst[1]:.2f}; in the wrist's frame {mean[2]:.2f}), "
              f"bones {mean[3]:.2f} % (worst {worst[4]:.1f}), tips {mean[5]:.1f} %")  # fmt: skip
        what = (
            f"{users} simulated users, mean and worst: marker positions [mm] | bones between joints [%] "
            f"| last bones to their tips [%]: {name}"
        )
        figures[name] = what, [[mean[0], worst[1]], [mean[3], worst[4]], mean[5]]
        if name == "after":
            figures["wrist_frame"] = "marker positions in the wrist's frame, mean [mm]", mean[2]
    if captures:
        before, after = tell_people(captures, glove)
        figures["people_before"] = "real people, held-out frames, 3D RMS median before [mm]", before
        figures["people_after"] = "the same after calibration [mm]", after
    save_figures(save, figures)


if __name__ == "__main__":
    run(main, __doc__)
