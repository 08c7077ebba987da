"""How near a calibration comes to the truth, on simulated users.

    python benchmarks/calibration.py [--users 6 --seed 0 --free 40 --rounds 3 --picture FILE.png]

Each user is one hand, right and left in turn: a size's mean hand made 8 % larger or smaller, with the
individual spreads of `handsim.shape.sample_shape`, in a dense19 glove whose markers sit 5 mm from where they
belong, along the skin, and 0.3 mm above or below it. It makes a capture of touches and free motion before
the 16 cameras of "figure5"; labels are the truth's. The calibration begins with the size's mean hand and the
glove as designed. Another capture of the same user holds the touches that the gaps are told for: of all
frames in which the true flesh of thumb and finger meets, how far the flesh of the tracked hand is from
touching, apart or dug in, and how far the distance of its skins is from that of the true hand's.
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import numpy as np
from machine import describe

from gloves.attach import attach
from gloves.layout import MarkerLayout, load_layout
from gloves.take import Take
from handsim.model import HandModel
from handsim.shape import SIZES, HandShape, sample_shape, shape_from_measures
from handsim.topology import SIDES
from handsim.transforms import MIRROR
from poses.touch import FINGERS, is_touching, thumb_contact
from track.calibration import calibrate
from track.calibration_picture import save_picture
from track.contacts import meet, place_contacts
from track.hand_errors import hand_errors
from track.inverse_kinematics import PoseSolver
from track.skin_walk import SkinPatch, slip
from track.user import UserHand, usual_hand
from train.calibration_take import CalibrationTakeConfig, simulate_calibration

OFF, SLIP, LIFT = 0.08, 0.005, 0.0003
EVERY = 5  # held-out frames


def draw_shape(size: str, factor: float, rng: np.random.Generator) -> HandShape:
    """A size's mean hand, scaled, with one person's own proportions."""
    person = sample_shape(rng=rng)
    mean = shape_from_measures(person.length, person.breadth)
    hand = shape_from_measures(*(1e-3 * factor * measure for measure in SIZES[size]))
    return dataclasses.replace(
        hand,
        bone_lengths=hand.bone_lengths * person.bone_lengths / mean.bone_lengths,
        knuckles=hand.knuckles + person.knuckles - mean.knuckles,
        base_angles=person.base_angles,
        radii=hand.radii * person.radii / mean.radii,
        palm_thickness=hand.palm_thickness * person.palm_thickness / mean.palm_thickness,
    )


def draw_user(number: int, layout: MarkerLayout, rng: np.random.Generator) -> tuple[UserHand, UserHand]:
    """Somebody's hand in its glove, and the hand that a calibration begins with."""
    size, side = list(SIZES)[1 + number % 3], SIDES[1 - number % 2]
    shape = draw_shape(size, 1.0 + OFF * (1.0 if number % 4 < 2 else -1.0), rng)
    worn = slip(attach(layout, HandModel(shape)), shape, SLIP, LIFT, rng=rng)
    if side == "left":
        worn = dataclasses.replace(worn, points=worn.points @ MIRROR, normals=worn.normals @ MIRROR)
    return UserHand(HandModel(shape.with_side(side)), worn), usual_hand(layout, size, side)


def held_out_gaps(hand: UserHand, true: UserHand, take: Take) -> np.ndarray:
    """Means over each finger's touches (4, 2) [m]: flesh from touching, skins from the true ones."""
    markers, qpos = take.observed(take.hand_labels[0]), take.hands[0].qpos
    gaps = np.full((len(FINGERS), 2), np.nan)
    for number, finger in enumerate(FINGERS):
        touching = is_touching(true.model, qpos[:, 7:], finger)
        enough = np.isfinite(markers[..., 0]).sum(axis=1) >= markers.shape[1] - 3
        frames = np.flatnonzero(touching & enough)[::EVERY]
        if len(frames):
            tracked = PoseSolver(hand.model, hand.attachment).solve(markers[frames]).qpos
            flesh = thumb_contact(hand.model, tracked[:, 7:], finger).overlap
            off = skin_gaps(hand.model, tracked, finger) - skin_gaps(true.model, qpos[frames], finger)
            gaps[number] = np.abs(flesh).mean(), np.abs(off).mean()
    return gaps


def skin_gaps(model: HandModel, qpos: np.ndarray, finger: str) -> np.ndarray:
    """Distance [m] of the skins of thumb and finger."""
    model = HandModel(
        model.shape.with_side("right")
    )  # angles alone decide, and skins are walked on right hands
    bones = model.forward_kinematics(
        np.column_stack([np.tile([0, 0, 0, 1.0, 0, 0, 0], (len(qpos), 1)), qpos[:, 7:]])
    )
    contacts = place_contacts(model, [(frame, finger) for frame in range(len(qpos))], bones)
    faces = np.concatenate([contacts.thumb_places.faces, contacts.finger_places.faces])
    return meet(contacts, SkinPatch(faces).corners(model.shape), model, bones).gaps


def tell(name: str, hand: UserHand, true: UserHand, held_out: Take) -> list[float]:
    """Print how far a hand is from the truth; returns what is averaged over users."""
    errors, gaps = hand_errors(hand, true), 1e3 * held_out_gaps(hand, true, held_out)
    places, lengths = 1e3 * errors.places, 100.0 * np.abs(errors.lengths)
    tips = 100.0 * np.abs(errors.tips)
    flesh = " ".join(f"{gap:.2f}" for gap in gaps[:, 0])
    print(f"  {name}: places {places.mean():.2f} mm (worst {places.max():.2f}; palm's in the wrist's frame: "
          f"{1e3 * errors.wrist_places.mean():.2f}), bones {lengths.mean():.2f} % "
          f"(worst {lengths.max():.1f}), tips {tips.mean():.1f} %, touches off by {flesh} mm, "
          f"skins by {np.nanmean(gaps[:, 1]):.2f}")  # fmt: skip
    return [places.mean(), places.max(), 1e3 * errors.wrist_places.mean(), lengths.mean(), lengths.max(),
            tips.mean(), *np.nanmean(gaps, axis=0), np.nanmax(gaps[:, 0])]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--users", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--free", type=float, default=40.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--picture")
    arguments = parser.parse_args()
    print(describe("scipy", "numba"))
    layout, before, after = load_layout("dense19"), [], []
    for number in range(arguments.users):
        rng = np.random.default_rng((arguments.seed, number))
        true, start = draw_user(number, layout, rng)
        worn = ((true.model, true.attachment),)
        made = CalibrationTakeConfig(free=arguments.free, rounds=arguments.rounds)
        take = simulate_calibration(worn, made, rng=rng)
        held_out = simulate_calibration(worn, CalibrationTakeConfig(free=3.0, rounds=4), rng=rng)
        began = time.perf_counter()
        result = calibrate(take.observed(take.hand_labels[0]), start, take.rate)
        took = time.perf_counter() - began
        errors = 1e3 * hand_errors(result.hand, true).wrist_places
        within = (errors < 2e3 * result.place_errors).mean()
        print(f"user {number}, {true.side}: {take.num_frames} frames in {took:.1f} s, markers off by "
              f"{1e3 * result.rms_before:.2f} mm, then {1e3 * result.rms_after:.2f}; "
              f"{len(result.touches)} touches found; {within:.0%} of places within two standard errors; "
              f"{result.advice() or 'no advice'}", flush=True)  # fmt: skip
        before.append(tell("before", start, true, held_out))
        after.append(tell("after", result.hand, true, held_out))
        if arguments.picture and number == 0:
            save_picture(arguments.picture, result)
    for name, rows in (("before", before), ("after", after)):
        mean, worst = np.mean(rows, axis=0), np.max(rows, axis=0)
        print(f"{name}: places {mean[0]:.2f} mm (worst {worst[1]:.2f}; in the wrist's frame {mean[2]:.2f}), "
              f"bones {mean[3]:.2f} % (worst {worst[4]:.1f}), tips {mean[5]:.1f} %, touches off by "
              f"{mean[6]:.2f} mm (worst finger {worst[8]:.2f}), skins by {mean[7]:.2f} mm")  # fmt: skip


if __name__ == "__main__":
    main()
