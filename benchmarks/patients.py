"""Joints that do not move: whether their angles are found, and whether the stated deviations have the error.

python -m benchmarks.patients FOLDER [--patients 24] [--methods measured]

Each simulated patient moves one hand in which one or two digits have two fixed joints: PIP and DIP of a
finger, or MCP and IP of the thumb, anywhere between -20 and 90 and -15 and 60 degrees. The gloves dense19,
sparse13 and starter15 take turns; they are worn with slips, and their markers move with the flesh. Each
capture is tracked with measured hands, with --calibrate, or with the inner fixed joint of each digit known.

The folder keeps captures and results, so that a stopped run continues.
"""

from __future__ import annotations

import dataclasses
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import Figures, describe, kept, report, run
from gloves import Take, load_layout, load_take
from gloves.fit import GlovedHand
from handsim import HandSimWarning, load_rig
from handsim.hand.shape import DIGITS, EVERYBODY, JOINT_NAMES
from track import track_capture
from train import GenerateSettings
from train.simulation.room import RoomConfig, record_take
from train.simulation.scenes import CalibrationTakeConfig, sample_calibration_scene
from train.simulation.training_frames import move_skin, sample_hands, wear_gloves

GLOVES = ("dense19", "sparse13", "starter15")
SEED, SECONDS = 9300, 12.0  # of all patients, and of a capture
# [deg] of the PIP and DIP; of the thumb MCP and IP, within its ranges
INNER, OUTER = (-20.0, 90.0), (-15.0, 60.0)
METHODS = ("measured", "calibrated", "known")


def patient(number: int) -> Take:
    """A capture of a patient with its truth; the settings say which joints are fixed [deg]."""
    rng = np.random.default_rng((SEED, number))
    layout, settings = load_layout(GLOVES[number % len(GLOVES)]), GenerateSettings()
    model = next(one for one in sample_hands(EVERYBODY, rng=rng) if one.shape.side == "right")
    (worn,) = wear_gloves(layout, [model], **settings.slips, rng=rng)
    scene = sample_calibration_scene((worn,), CalibrationTakeConfig(free=SECONDS, rounds=0), rng=rng)
    qpos, fixed = scene.hands[0].qpos.copy(), {}
    digits = rng.permutation(len(DIGITS))[: rng.integers(1, 3)]
    for digit in digits.tolist():
        inner = rng.uniform(-10.0, 50.0) if digit == 0 else rng.uniform(*INNER)
        for joint, angle in ((2, inner), (3, rng.uniform(*OUTER))):
            fixed[4 * digit + joint] = angle
            qpos[:, 7 + 4 * digit + joint] = np.deg2rad(angle)
    hand = GlovedHand(worn, qpos)
    moving = dataclasses.replace(scene, hands=(hand,), skin=(move_skin(hand, rng=rng),))
    told = {JOINT_NAMES[joint]: angle for joint, angle in fixed.items()}
    return record_take(moving, load_rig("figure5"), RoomConfig(), {"fixed": told}, rng=rng)


def tracked(path: Path, take: Take, method: str) -> dict[str, Any]:
    """Angles, deviations and time of a capture."""

    def make() -> dict[str, Any]:
        began = time.process_time()
        inner = list(take.settings["fixed"].items())[::2] if method == "known" else ()
        found = track_capture(
            take.capture(),
            glove=take.hands[0].layout,
            hands="right",
            calibrate=method == "calibrated",
            known={f"right:{name}": angle for name, angle in inner},
        )
        assert found.angle_spread is not None
        off = np.rad2deg(found.qpos[:, 0, 7:] - take.qpos[:, 0, 7:])
        spread = np.rad2deg(found.angle_spread[:, 0])
        seen = np.isfinite(off[:, 0])
        return {
            "mean": np.mean(off[seen], axis=0).tolist(),
            "rmse": np.sqrt(np.mean(off[seen] ** 2, axis=0)).tolist(),
            "spread": np.sqrt(np.mean(spread[seen] ** 2, axis=0)).tolist(),
            "rms": 1e3 * float(np.nanmedian(found.rms)),
            "seconds": time.process_time() - began,
        }

    found: dict[str, Any] = kept(path, make)
    return found


def main(
    folder: Path,
    patients: int = 24,
    methods: tuple[str, ...] = METHODS[:2],
    save: str | None = None,
) -> None:
    warnings.simplefilter("ignore", HandSimWarning)
    print(describe("numba"))
    folder.mkdir(parents=True, exist_ok=True)
    rows: dict[str, list[tuple[float, ...]]] = {method: [] for method in methods}
    others: dict[str, list[float]] = {method: [] for method in methods}
    for number in range(patients):
        stem = f"patient_{SEED}_{SECONDS:g}_{number}"
        path = folder / f"{stem}.npz"
        if not path.exists():
            patient(number).save(path)
        take = load_take(path)
        for method in methods:
            found = tracked(folder / f"{stem}.{method}.json", take, method)
            joints = [JOINT_NAMES.index(name) for name in take.settings["fixed"]]
            told = []
            for joint in joints[1::2] if method == "known" else joints:
                rows[method].append((found["mean"][joint], found["spread"][joint]))
                true = take.settings["fixed"][JOINT_NAMES[joint]]
                off, told_off = found["mean"][joint], found["spread"][joint]
                told.append(f"{JOINT_NAMES[joint]} {true:.0f}: {off:+.1f} +- {told_off:.1f}")
            digits = {hand for hand in take.hands[0].attachment.digits.tolist() if hand >= 0}
            rest = [j for j in range(20) if j // 4 in digits and j not in joints]
            others[method] += [found["rmse"][joint] for joint in rest]
            moving = f"rest {np.mean(np.array(found['rmse'])[rest]):.2f}, RMS {found['rms']:.2f} mm"
            name, spent = take.hands[0].layout.name, f"{found['seconds']:.0f} s"
            print(number, name, method, *told, moving, spent, sep="; ", flush=True)
    figures: Figures = {}
    for method in methods:
        figures[f"{method}_rest"] = "RMSE of the joints that move [deg], mean", float(np.mean(others[method]))
        off, spread = np.abs(np.array(rows[method])).T
        ratio = off / spread
        figures[f"{method}_within"] = (
            "fixed joints within one, two and three deviations [%]",
            [100.0 * float((ratio <= n).mean()) for n in (1, 2, 3)],
        )
        figures[f"{method}_error"] = (
            "error of fixed joints [deg]: median, 90th percentile, largest",
            np.quantile(off, [0.5, 0.9, 1.0]).tolist(),
        )
        figures[f"{method}_worst"] = "largest error in deviations", float(ratio.max())
    report(save, figures)


if __name__ == "__main__":
    run(main, __doc__)
