"""Eleven gestures that NVIDIA's Isaac Capture judges hand devices by, tracked and sent as OpenXR's joints.

python -m benchmarks.hand_suite [--glove dense19] [--seed 0] [--hands measured true]

A simulated person in gloves sits at a table and does what the page "Hand Suite" of Isaac Capture's device
conformance tests asks (nvidia.github.io/IsaacCapture, conformance/hand): both hands flat on the table, fists,
four pinches, palms together, middle fingertips together, each hand turned about its middle finger, and flat
again. Sixteen cameras see the markers; the tracker's frames are encoded as `--send
"ws://...?joints=openxr&axes=openxr"` does it, and read back as a client reads them. The limits are those of
the page, of its checker's README and of the constants in the checker's source at the end of 2026, where they
are called provisional. This script shares no code with that checker, and a pass here is not one there: a take
for it is recorded through a headset.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.paper.take_evaluation import true_users
from benchmarks.record import describe, run
from gloves import Take, load_layout
from gloves.fit import GlovedHand, GloveFit
from handsim import HandModel, load_rig
from handsim.hand.model import KEYPOINT_NAMES, hand_keypoints, join_qpos
from poses.motion import minimum_jerk
from poses.shapes import gesture, resting_angles
from poses.touch import touching_angles
from track import StreamedFrame, Tracker, measure_hands
from track.live_message import Content, MessageEncoder, document_format
from train import load_labeler
from train.simulation.room import RoomConfig, record_take
from train.simulation.scenes import RATE, SceneMotion
from train.simulation.training_frames import move_skin, sample_adult_hands, wear_gloves

SLIP = 0.05, np.deg2rad(5.0)  # of a glove [bone lengths, rad]
FLAT = ("flat_on_table_open", "flat_on_table_close")
PINCHES = {f"pinch_{finger}": finger for finger in ("index", "middle", "ring", "little")}
ROLLS = {"right_tip_roll": "right", "left_tip_roll": "left"}
SCRIPT = {  # seconds that each step is held
    FLAT[0]: 4.0,
    "fist": 4.0,
    **dict.fromkeys(PINCHES, 3.0),
    "palms_together": 4.0,
    "tips_together": 3.0,
    **dict.fromkeys(ROLLS, 6.0),
    FLAT[1]: 4.0,
}
MOVE = 3.0  # [s] from one step to the next
SETTLED = 0.4  # share of a held step that is not judged
TABLE = 0.95  # [m] height of the table
APART = 0.15  # [m] of each hand from the middle
AWAY = 0.06  # [m] that hands leave each other between two steps
SIDES = ("right", "left")
UP, FORWARD, ACROSS = np.eye(3)[2], np.eye(3)[1], np.eye(3)[0]
FINGERS = ("index", "middle", "ring", "little")
WRIST = 1
CHAINS = {"thumb": (2, 3, 4, 5)} | {
    finger: tuple(range(7 + 5 * number, 11 + 5 * number)) for number, finger in enumerate(FINGERS)
}
OPTIONAL = (0, 6, 11, 16, 21)
JUDGED = [joint for joint in range(26) if joint not in OPTIONAL]


class Pose(NamedTuple):
    """One hand in one step: joint angles [rad], and the wrist."""

    angles: np.ndarray
    position: np.ndarray
    turn: np.ndarray


@dataclass(frozen=True)
class Hand:
    """One side of a take as a client has read it, in OpenXR's axes."""

    side: str
    places: np.ndarray
    """Positions (T, 26, 3) [m]; NaN without a pose."""
    turns: np.ndarray
    """Orientations of the 26 joints as quaternions (T, 26, 4) in the order w, x, y, z."""
    times: np.ndarray
    steps: dict[str, slice]

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors (T, 3, 3): to the middle knuckle, from index to little, and out of the palm."""
        knuckle = {finger: self.places[:, CHAINS[finger][0]] for finger in FINGERS}
        ahead = unit(knuckle["middle"] - self.places[:, WRIST])
        across = unit(knuckle["little"] - knuckle["index"])
        palm = unit(np.cross(ahead, across)) * (1.0 if self.side == "right" else -1.0)
        return np.stack([ahead, across, palm], axis=1)

    @property
    def straightness(self) -> np.ndarray:
        """Distance from root to tip over the length of the phalanges (T,), mean of the four fingers."""
        chains = np.stack([self.places[:, CHAINS[finger]] for finger in FINGERS], axis=1)
        lengths = np.linalg.norm(np.diff(chains, axis=2), axis=-1).sum(axis=-1)
        return np.asarray(
            (np.linalg.norm(chains[:, :, -1] - chains[:, :, 0], axis=-1) / lengths).mean(axis=1)
        )

    def tip(self, digit: str) -> np.ndarray:
        """Positions (T, 3) of a fingertip [m]."""
        return np.asarray(self.places[:, CHAINS[digit][-1]])

    def local(self) -> np.ndarray:
        """Positions (T, 26, 3) in the wrist's frame [m]."""
        turns = Rotation.from_quat(self.turns[:, WRIST], scalar_first=True).as_matrix()
        return np.einsum("tji,tkj->tki", turns, self.places - self.places[:, WRIST, None])


def main(
    glove: str = "dense19",
    seed: int = 0,
    hands: tuple[Literal["measured", "true"], ...] = ("measured", "true"),
) -> None:
    print(describe("numba", "torch"))
    take, steps = perform(glove, seed)
    for name in hands:
        users = true_users(take) if name == "true" else list(measure_hands(take, glove=glove))
        print(f"{glove}, {name} hands, {take.num_frames / take.rate:.0f} s")
        seen = receive(take, users, glove, steps)
        failed = 0
        for what, values, limit, holds in checks(seen):
            failed += not holds
            shown = ", ".join(f"{value:.4g}" for value in np.ravel(values))
            print(f"  {'pass' if holds else 'FAIL'}  {what}: {shown}{f' ({limit})' if limit else ''}")
        print(f"  {failed} failed", flush=True)


def perform(glove: str, seed: int) -> tuple[Take, dict[str, slice]]:
    """A take of a random person who follows the script, and the frames of each step."""
    rng = np.random.default_rng(seed)
    fits = wear_gloves(
        load_layout(glove), sample_adult_hands(rng=rng), along=SLIP[0], around=SLIP[1], rng=rng
    )
    scripts = [list(script_poses(fit.model)) for fit in fits]
    moving, steps, number = [[], []], {}, 0
    for step, (name, seconds) in enumerate(SCRIPT.items()):
        held, moved = round(seconds * RATE), round(MOVE * RATE)
        for hand, poses in enumerate(scripts):
            away = (1.0 if hand == 0 else -1.0) * AWAY * ACROSS
            moving[hand].append(between(poses[step - 1 if step else 0], poses[step], moved, away))
            turned = 0.0 if ROLLS.get(name) != SIDES[hand] else np.pi
            moving[hand].append(roll(fits[hand].model, poses[step], held, turned))
        steps[name] = slice(number + moved, number + moved + held)
        number += moved + held
    worn = tuple(GlovedHand(fit, np.concatenate(parts)) for fit, parts in zip(fits, moving, strict=True))
    scene = SceneMotion(worn, skin=tuple(move_skin(hand, rng=rng) for hand in worn))
    return record_take(scene, load_rig("figure5"), RoomConfig(), {"glove": glove}, rng=rng), steps


def script_poses(model: HandModel) -> Iterator[Pose]:
    """The pose of one hand in each step of the script."""
    sign = 1.0 if model.shape.side == "right" else -1.0
    flat, fist = gesture("flat"), gesture("fist_thumb_beside")  # a tight fist presses flesh on flesh
    flat[4::4] = fist[4::4] = resting_angles(model)[4::4]  # as close to each other as girths allow
    thick = model.shape.palm_thickness
    for name in SCRIPT:
        angles, place = flat, sign * APART * ACROSS + (TABLE + 0.2) * UP
        ahead, back = FORWARD, UP
        if name in FLAT:
            place = sign * APART * ACROSS + TABLE * UP
        elif name == "fist":
            angles = fist
        elif name in PINCHES:
            angles = touching_angles(model, PINCHES[name])
        elif name == "palms_together":
            ahead, back, place = UP, sign * ACROSS, sign * 0.5 * thick * ACROSS + (TABLE + 0.1) * UP
        else:
            ahead, back = -sign * ACROSS, FORWARD
            place = sign * model.shape.radii[2, -1] * ACROSS + (TABLE + 0.3) * UP
        turn = np.stack([ahead, np.cross(back, ahead), back], axis=1)
        points = place_hand(model, Pose(angles, np.zeros(3), turn))
        if name in FLAT:  # the fingers' joints lie 8 mm above the table
            place = place + (0.008 - np.mean([points[key][2] for key in points if key[0] in FINGERS])) * UP
        elif name == "tips_together" or name in ROLLS:
            place = place - points["middle", "tip"]
        yield Pose(angles, place, turn)


def place_hand(model: HandModel, pose: Pose) -> dict[tuple[str, str], np.ndarray]:
    """Keypoints [m] of a pose by digit and joint."""
    quaternion = Rotation.from_matrix(pose.turn).as_quat(scalar_first=True)
    points = hand_keypoints(
        model, join_qpos(pose.angles[None], position=pose.position, quaternion=quaternion)
    )[0]
    return {
        (digit, joint): point
        for name, point in zip(KEYPOINT_NAMES, points, strict=True)
        for digit, _, joint in [name.partition("_")]
    }


def between(start: Pose, end: Pose, frames: int, away: np.ndarray) -> np.ndarray:
    """Frames (T, 27) from one pose to another; half way the hand is `away` [m] from the straight path."""
    share = minimum_jerk(frames)[:, None]
    both = Rotation.from_matrix(np.stack([start.turn, end.turn]))
    return join_qpos(
        start.angles + share * (end.angles - start.angles),
        position=start.position + share * (end.position - start.position) + np.sin(np.pi * share) * away,
        quaternion=Slerp([0.0, 1.0], both)(share[:, 0]).as_quat(scalar_first=True),
    )


def roll(model: HandModel, pose: Pose, frames: int, turned: float) -> np.ndarray:
    """Frames (T, 27) of a held pose, turned about the axis through the middle fingertip and back."""
    angle = turned * np.sin(np.pi * np.arange(frames) / frames) ** 2
    about = Rotation.from_rotvec(angle[:, None] * pose.turn[:, 0])
    tip = place_hand(model, pose)["middle", "tip"]
    return join_qpos(
        np.tile(pose.angles, (frames, 1)),
        position=tip + about.apply(pose.position - tip),
        quaternion=(about * Rotation.from_matrix(pose.turn)).as_quat(scalar_first=True),
    )


def receive(
    take: Take, users: Sequence[GloveFit], glove: str, steps: dict[str, slice]
) -> tuple[list[Hand], Any]:
    """Both hands as a client of the tracker's output reads them, and the header of the stream."""
    tracker, content = Tracker(users, load_labeler(glove)), Content(joints=True, axes="openxr")
    encoder, form = MessageEncoder(tracker.hands, ()), document_format("json", content)
    header, documents = json.loads(form.header(encoder.header)[0]), []
    for number in range(take.num_frames):
        there = np.isfinite(take.points[number, :, 0])
        points, ids = take.points[number, there], take.ids[number, there].astype(np.int64)
        frame = StreamedFrame(number, number / take.rate, points, ids)
        tracked = tracker.step(points, ids, frame.time)
        documents.append(json.loads(form.frame(encoder.encode(frame, tracked))[0]))
    times = np.array([one["time"] for one in documents])
    hands = []
    for number, side in enumerate(header["sides"]):
        lost = [[np.nan] * 7] * len(header["joints"])
        joints = np.array([one["hands"][number]["joints"] or lost for one in documents])
        hands.append(Hand(side, joints[..., :3], joints[..., 3:], times, steps))
    return hands, header


Check = tuple[str, Any, str, bool]
"""What was measured, its values for right and left, the limit, and whether it holds."""


def checks(seen: tuple[list[Hand], Any]) -> Iterator[Check]:
    """All checks, in the order of the page."""
    hands, header = seen
    yield from signal(hands)
    yield from shape(hands, header)
    yield from placement(hands)
    yield from windows(hands)
    yield from both_hands(*hands)


def each(hands: Sequence[Hand], value: Callable[[Hand], Any]) -> list[Any]:
    return [value(hand) for hand in hands]


def at_least(what: str, values: Any, limit: float) -> Check:
    return what, values, f"at least {limit:g}", bool(np.min(values) >= limit)


def at_most(what: str, values: Any, limit: float) -> Check:
    return what, values, f"at most {limit:g}", bool(np.max(values) <= limit)


def told(what: str, values: Any) -> Check:
    return what, values, "", True


def signal(hands: Sequence[Hand]) -> Iterator[Check]:
    """Is the stream well formed and steady?"""
    intervals = np.diff(hands[0].times)
    usual = np.median(intervals)
    has_pose = each(hands, lambda hand: np.isfinite(hand.places[:, 0, 0]))
    yield at_least("frames with a pose [%]", [100 * one.mean() for one in has_pose], 95.0)
    odd = each(hands, lambda hand: np.nanmax(np.abs(np.linalg.norm(hand.turns, axis=-1) - 1.0)))
    yield at_most("quaternions' distance from length 1", odd, 1e-3)
    yield at_most(
        "joints at the origin", each(hands, lambda hand: (hand.places == 0.0).all(axis=-1).sum()), 0
    )
    yield at_least("shortest interval [ms]", 1e3 * intervals.min(), 1e-3)
    yield at_most(
        "median deviation of intervals, over the median", np.median(np.abs(intervals - usual)) / usual, 0.2
    )
    yield at_least("rate [Hz]", 1.0 / usual, 30.0)
    yield at_most("longest interval, over the median", intervals.max() / usual, 5.0)
    steps = each(hands, lambda hand: np.nanmax(np.linalg.norm(np.diff(hand.places, axis=0), axis=-1)))
    yield at_most("fastest joint [m/s]", np.array(steps) / usual, 20.0)


def shape(hands: Sequence[Hand], header: Any) -> Iterator[Check]:
    """Is it a hand, with its joints where their names say?"""
    valid = each(
        hands, lambda hand: [np.isfinite(hand.places[:, joints]).all() for joints in (JUDGED, OPTIONAL)]
    )
    poses = each(hands, lambda hand: np.isfinite(hand.places).all(axis=(1, 2)))
    partly = [np.isfinite(hand.places[~pose]).any() for hand, pose in zip(hands, poses, strict=True)]
    yield at_most("hands with some joints only", partly, 0)
    yield told("all 26 joints in every frame", valid)
    radii = 1e3 * np.array(header["radii"])
    yield at_least("smallest radius [mm]", radii.min(axis=1), 1.0)
    yield at_most("largest radius [mm]", radii.max(axis=1), 50.0)
    bones = each(hands, lambda hand: bone_lengths(hand.places))
    palm = [
        np.nanmedian(np.linalg.norm(h.places[:, CHAINS["middle"][0]] - h.places[:, WRIST], axis=-1))
        for h in hands
    ]
    digits = [{digit: np.nanmedian(one[digit][:, 1:].sum(axis=1)) for digit in CHAINS} for one in bones]
    whole = [one["middle"] + width for one, width in zip(digits, palm, strict=True)]
    yield at_least("hand's length [m]", whole, 0.1)
    yield at_most("hand's length [m]", whole, 0.3)
    varied = [
        max(np.nanmax(np.nanstd(b, axis=0) / np.nanmean(b, axis=0)) for b in one.values()) for one in bones
    ]
    yield at_most("variation of a bone's length, over its mean", varied, 0.2)
    for what, top, bottom, low, high in (
        ("middle finger over palm", "middle", None, 0.6, 1.5),
        ("little over middle finger", "little", "middle", 0.55, 1.0),
        ("thumb over middle finger", "thumb", "middle", 0.6, 1.5),
    ):
        ratios = [
            one[top] / (width if bottom is None else one[bottom])
            for one, width in zip(digits, palm, strict=True)
        ]
        yield at_least(what, ratios, low)
        yield at_most(what, ratios, high)
    yield at_least("frames with knuckles in their order, share", each(hands, knuckles_in_order), 0.9)
    yield at_least("frames with the thumb on the index half, share", each(hands, thumb_beside_index), 0.9)
    yield at_least("straight frames with digits from root to tip, share", each(hands, digits_outward), 0.9)
    yield at_least("x across the palm in the wrist's frame, left mirrored", each(hands, handedness), 0.3)
    yield at_least("tips go to the palm when curled [m]", each(hands, flexion), 0.01)
    yield at_most("frames with misplaced palm or metacarpals, share", each(hands, misplaced), 0.05)


def placement(hands: Sequence[Hand]) -> Iterator[Check]:
    """Are positions and orientations in one frame, in the room?"""
    near = each(hands, lambda hand: np.nanmean(np.linalg.norm(hand.places[:, WRIST], axis=-1) < 0.25))
    yield at_most("frames with the wrist within 0.25 m of the origin, share", near, 0.5)
    yield at_most("wrist repeats while fingertips move, share", each(hands, frozen), 0.2)
    yield at_least("cosine of -z and the bones", each(hands, alignment), 0.7)
    yield at_most("wrist's turn from that of its positions, p95 [deg]", each(hands, deviation), 30.0)


def windows(hands: Sequence[Hand]) -> Iterator[Check]:
    """Does each step show what its name asks for?"""
    yield at_most("steps that were not performed", each(hands, lambda hand: len(list(missed(hand)))), 0)
    yield at_most("fist, over the less straight flat hand", each(hands, fist_over_flat), 1.0)
    rolls = [
        [rotation(hand, step) for step in sorted(ROLLS, key=lambda step: ROLLS[step] != hand.side)]
        for hand in hands
    ]
    yield at_most("the other hand's roll over one's own", [other / own for own, other in rolls], 1.0)
    yield at_least(
        "straightness, flat", [[median(h.straightness, h, step) for step in FLAT] for h in hands], 0.8
    )
    yield at_most(
        "straightness, fist", each(hands, lambda hand: median(hand.straightness, hand, "fist")), 0.6
    )
    yield at_least("pinching frames with the named finger nearest, share", each(hands, named_finger), 0.6)
    gaps = [
        [1e3 * median(pinch(hand)[finger], hand, step) for step, finger in PINCHES.items()] for hand in hands
    ]
    yield told("pinch, thumb tip to fingertip: index to little [mm]", gaps)
    planes = each(hands, lambda hand: [table(hand, step) for step in FLAT])
    yield at_most(
        "finger joints off the table's plane [mm]", [[1e3 * off for off, _ in one] for one in planes], 15.0
    )
    yield at_most("tilt of that plane [deg]", [[tilt for _, tilt in one] for one in planes], 10.0)
    yield told("drift of the flat hand between first and last step, mean joint [mm]", each(hands, drift))


def both_hands(right: Hand, left: Hand) -> Iterator[Check]:
    """Do the hands meet where the person feels it?"""
    fingers = [joint for finger in FINGERS for joint in CHAINS[finger]]
    height = right.places[:, fingers, 1].mean(axis=1) - left.places[:, fingers, 1].mean(axis=1)
    yield at_most(
        "right hand above left on the table [mm]",
        [abs(1e3 * median(height, right, step)) for step in FLAT],
        30.0,
    )
    tips = {finger: np.linalg.norm(right.tip(finger) - left.tip(finger), axis=1) for finger in FINGERS}
    gaps = [1e3 * median(tips[finger], right, "palms_together") for finger in FINGERS]
    yield at_most("fingertips with palms together: index to little [mm]", gaps, 50.0)
    apart = right.tip("middle") - left.tip("middle")
    touch = np.nanmedian(apart[settled(right, "tips_together")], axis=0)
    yield at_most("middle tips together [mm]", 1e3 * np.linalg.norm(touch), 80.0)
    moved = [np.nanpercentile(np.linalg.norm(apart[right.steps[step]] - touch, axis=1), 95) for step in ROLLS]
    yield at_most("turning tip leaves the other, p95: right, left [mm]", 1e3 * np.array(moved), 30.0)
    turned = [rotation(right, "right_tip_roll"), rotation(left, "left_tip_roll")]
    yield at_least("turned [deg]", turned, 90.0)


def unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def settled(hand: Hand, step: str) -> slice:
    """The judged frames of a step."""
    whole = hand.steps[step]
    return slice(whole.start + round(SETTLED * (whole.stop - whole.start)), whole.stop)


def median(values: np.ndarray, hand: Hand, step: str) -> float:
    return float(np.nanmedian(values[settled(hand, step)]))


def bone_lengths(places: np.ndarray) -> dict[str, np.ndarray]:
    """Lengths of each digit's bones, the one from the wrist first."""
    chains = {digit: places[:, (WRIST, *joints)] for digit, joints in CHAINS.items()}
    return {digit: np.linalg.norm(np.diff(points, axis=1), axis=-1) for digit, points in chains.items()}


def across_palm(hand: Hand, joint: int) -> np.ndarray:
    """Where a joint is between the index knuckle, 0, and the little one, 1."""
    index, little = (hand.places[:, CHAINS[finger][0]] for finger in ("index", "little"))
    across = little - index
    return np.asarray(((hand.places[:, joint] - index) * across).sum(axis=1) / (across**2).sum(axis=1))


def knuckles_in_order(hand: Hand) -> float:
    middle, ring = (across_palm(hand, CHAINS[finger][0]) for finger in ("middle", "ring"))
    return float(np.mean((0.0 < middle) & (middle < ring) & (ring < 1.0)))


def thumb_beside_index(hand: Hand) -> float:
    return float(np.mean(across_palm(hand, CHAINS["thumb"][0]) < 0.5))


def digits_outward(hand: Hand) -> float:
    reach = np.linalg.norm(hand.places - hand.places[:, WRIST, None], axis=-1)
    outward = np.all(
        [(np.diff(reach[:, joints], axis=1) > 0.0).all(axis=1) for joints in CHAINS.values()], axis=0
    )
    straight = hand.straightness
    return float(outward[straight >= np.nanquantile(straight, 0.75)].mean())


def handedness(hand: Hand) -> float:
    local = hand.local()
    across = unit(local[:, CHAINS["little"][0]] - local[:, CHAINS["index"][0]])[:, 0]
    return float(np.nanmedian(across)) * (1.0 if hand.side == "right" else -1.0)


def flexion(hand: Hand) -> float:
    """How far the tips leave their first phalanx's line towards the palm in the most curled frames [m]."""
    local, straight = hand.local(), hand.straightness
    offsets = []
    for finger in FINGERS:
        root, second, _, tip = (local[:, joint] for joint in CHAINS[finger])
        back = unit(np.cross([1.0, 0.0, 0.0], second - root))
        offsets.append(((tip - root) * back).sum(axis=1))
    mean = np.mean(offsets, axis=0)
    curled, extended = (straight <= np.nanquantile(straight, 0.03)), straight >= np.nanquantile(straight, 0.8)
    return float(mean[extended].mean() - mean[curled].mean())


def misplaced(hand: Hand) -> float:
    """Largest share of frames in which the palm or a metacarpal is a quarter of the palm from its place."""
    wrist, shares = hand.places[:, WRIST], []
    length = np.linalg.norm(hand.places[:, CHAINS["middle"][0]] - wrist, axis=1)
    for joint in OPTIONAL:
        if joint == 0:
            wanted = hand.places[:, [11, 12]].mean(axis=1)
        else:
            bone = hand.places[:, joint + 1] - wrist
            along = ((hand.places[:, joint] - wrist) * bone).sum(axis=1) / (bone**2).sum(axis=1)
            wanted = wrist + np.clip(along, 0.0, 1.0)[:, None] * bone
        shares.append(np.mean(np.linalg.norm(hand.places[:, joint] - wanted, axis=1) > 0.25 * length))
    return float(max(shares))


def frozen(hand: Hand) -> float:
    tips = np.stack([hand.tip(finger) for finger in FINGERS], axis=1)
    moved = np.linalg.norm(np.diff(tips, axis=0), axis=-1).max(axis=1) >= 1e-3
    pose = np.concatenate([hand.places[:, WRIST], hand.turns[:, WRIST]], axis=1)
    return float((np.diff(pose, axis=0) == 0.0).all(axis=1)[moved].mean())


def alignment(hand: Hand) -> float:
    cosines = []
    for joints in CHAINS.values():
        bones = unit(np.diff(hand.places[:, joints], axis=1))
        turns = Rotation.from_quat(hand.turns[:, joints[:-1]].reshape(-1, 4), scalar_first=True)
        cosines.append((turns.apply([0.0, 0.0, -1.0]) * bones.reshape(-1, 3)).sum(axis=1))
    return float(np.nanmean(np.concatenate(cosines)))


def deviation(hand: Hand) -> float:
    """How far the palm's axes turn in the wrist's frame while the hand rolls, 95th percentile [deg]."""
    own = hand.steps[f"{hand.side}_tip_roll"]
    wrist = Rotation.from_quat(hand.turns[own, WRIST], scalar_first=True).as_matrix()
    local = np.einsum("tji,tkj->tki", wrist, hand.axes[own])
    return float(np.nanpercentile(degrees((local * local[0]).sum(axis=-1)).max(axis=1), 95))


def degrees(cosines: np.ndarray) -> np.ndarray:
    return np.asarray(np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0))))


def rotation(hand: Hand, step: str) -> float:
    """Largest turn of an axis of the palm from the step's first frame [deg]."""
    axes = hand.axes[hand.steps[step]]
    return float(np.nanmax(degrees((axes * axes[0]).sum(axis=-1))))


def fist_over_flat(hand: Hand) -> float:
    return median(hand.straightness, hand, "fist") / min(
        median(hand.straightness, hand, step) for step in FLAT
    )


def pinch(hand: Hand) -> dict[str, np.ndarray]:
    """Distances (T,) of each finger's tip from the thumb's tip [m]."""
    return {finger: np.linalg.norm(hand.tip(finger) - hand.tip("thumb"), axis=1) for finger in FINGERS}


def named_finger(hand: Hand) -> float:
    """Smallest share, over the pinches, of touching frames in which the named finger is nearest."""
    gaps = np.stack(list(pinch(hand).values()))
    shares = []
    for step, finger in PINCHES.items():
        judged = gaps[:, settled(hand, step)]
        touching = judged.min(axis=0) <= 0.04
        shares.append(
            np.mean(judged.argmin(axis=0)[touching] == FINGERS.index(finger)) if touching.any() else 0.0
        )
    return float(min(shares))


def missed(hand: Hand) -> Iterator[str]:
    """Steps that do not show at least the gross motion that their names ask for."""
    straight, axes, nearest = hand.straightness, hand.axes, np.min(list(pinch(hand).values()), axis=0)
    flat = median(straight, hand, FLAT[0])
    for step in SCRIPT:
        stretched, up = median(straight, hand, step), median(axes[:, 0, 1], hand, step)
        if step in FLAT:
            performed = stretched >= 0.6 and median(axes[:, 2, 1], hand, step) <= -np.sqrt(0.5)
        elif step == "fist":
            performed = stretched <= min(0.75, flat - 0.15)
        elif step in PINCHES:
            performed = median(nearest, hand, step) <= 0.04
        elif step == "palms_together":
            performed = stretched >= 0.6 and up >= np.sqrt(0.5)
        elif step == "tips_together":
            performed = stretched >= 0.6 and abs(up) <= np.sqrt(0.5)
        else:
            performed = ROLLS[step] != hand.side or rotation(hand, step) >= 60.0
        if not performed:
            yield step


def table(hand: Hand, step: str) -> tuple[float, float]:
    """Medians: distance of the farthest finger joint from their plane [m], tilt of that plane [deg]."""
    joints = [joint for finger in FINGERS for joint in CHAINS[finger]]
    points = hand.places[settled(hand, step)][:, joints]
    points = points[np.isfinite(points).all(axis=(1, 2))]
    centered = points - points.mean(axis=1, keepdims=True)
    normals = np.linalg.svd(centered, full_matrices=False)[2][:, 2]
    off = np.abs(np.einsum("tkj,tj->tk", centered, normals)).max(axis=1)
    return float(np.median(off)), float(np.median(degrees(np.abs(normals[:, 1]))))


def drift(hand: Hand) -> float:
    """Mean shift of the joints in the wrist's frame from the first flat step to the last [mm]."""
    first, last = (np.nanmean(hand.local()[settled(hand, step)][:, JUDGED], axis=0) for step in FLAT)
    return float(1e3 * np.linalg.norm(last - first, axis=1).mean())


if __name__ == "__main__":
    run(main, __doc__)
