"""Motions and poses of two hands that meet, clasp, rub, point and part; a beat is a key pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handsim.errors import PoseError
from handsim.files.inputs import package_data
from handsim.hand.model import HandModel, HandMotion, join_qpos
from handsim.hand.shape import DIGITS, bones_of
from handsim.space.rig import ROOM_CENTER
from handsim.space.transforms import MIRROR, euler_matrix, random_quaternions, rotation_quaternions, unit
from poses.contact import (
    APPROACH_TIMES,
    NEAREST,
    PAIR_VOLUME,
    WRIST_SPEED,
    Passage,
    close_fingers,
    first_contact,
    join_passages,
    path_between,
    placed_qpos,
    smooth_above,
    valid_frames,
)
from poses.motion import MAX_ACCELERATION, MAX_SPEED, PEAK_SPEED, RATE, interpolate_path, minimum_jerk
from poses.shapes import HIGH, LOW, gesture, gesture_names, is_valid, make_valid, resting_angles

_FLEXION_NOISE: Final = np.deg2rad(4.0)
_ABDUCTION_NOISE: Final = np.deg2rad(1.5)
_NOISE: Final = np.tile([_ABDUCTION_NOISE, _FLEXION_NOISE, _FLEXION_NOISE, _FLEXION_NOISE], len(DIGITS))
_SNUG_DEPTH: Final = 0.0007  # largest self-penetration of wandering fingers [m]
_WANDER_SHARE: Final = 0.4  # ratio of the noise from beat to beat to that of the whole interaction

INTERACTIONS: Final[tuple[str, ...]] = tuple(package_data("poses", "interactions")["interactions"])
"""Names of all interactions."""

_CONTACT_WINDOW: Final = 0.12  # time over which backing off is smoothed [s]
_FINGER_WINDOW: Final = 0.35  # time over which closing fingers are smoothed [s]
_PARTED_DISTANCES: Final = (0.08, 0.16)  # distance of the hands before and after an interaction [m]
# Single poses: share of touching ones, largest distance of the others [m], share with half-closed fingers.
_TOUCHING_SHARE, _MAX_GAP, _HALF_CLOSED_SHARE = 0.7, 0.06, 0.3

_TRAVEL_TIMES: Final = (0.8, 2.5)  # shortest and longest time between two positions of the pair [s]
_ROTATION: Final = 0.5  # standard deviation of the rotation between two positions [rad]
_MAX_DRAWS: Final = 60


@dataclass(frozen=True, slots=True, eq=False)
class Fingers:
    """Joint angles of one hand, one row per beat."""

    opened: Float[np.ndarray, "K 20"]
    """Open fingers [rad]."""
    closed: Float[np.ndarray, "K 20"]
    """Fully closed fingers [rad]."""
    strength: Float[np.ndarray, "K 5"]
    """Share of the path to `closed` that each digit follows."""

    def at(self, beats: Float[np.ndarray, "T"]) -> Fingers:
        """Fingers at fractional beats."""
        return Fingers(*(at_beats(keys, beats) for keys in (self.opened, self.closed, self.strength)))


@dataclass(frozen=True, slots=True, eq=False)
class Meeting:
    """Beats (key poses) of interactions: the moving hand in the wrist frame of the still one."""

    still: Fingers
    moving: Fingers
    rotations: Float[np.ndarray, "K 3"]
    """Rotation vector of each beat [rad], applied after `rotation`."""
    rotation: Float[np.ndarray, "K 3 3"]
    """Rotation of each interaction, repeated for its beats."""
    targets: Float[np.ndarray, "K 3"]
    """Points of the still hand [m]."""
    anchors: Float[np.ndarray, "K 3"]
    """Points of the moving hand [m] that are placed on the targets."""
    axis: Float[np.ndarray, "K 3"]
    """Unit direction in which the moving hand backs off, repeated for the beats of an interaction."""

    def directions(self, beats: Float[np.ndarray, "T"]) -> NDArray[np.float64]:
        """Unit directions (T, 3) in which the moving hand backs off."""
        return np.asarray(self.axis[beats.astype(int)])

    def placement(self, beats: Float[np.ndarray, "T"]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Orientations (T, 3, 3) and positions (T, 3) [m] of the moving wrist, before it backs off."""
        tilts = Rotation.from_rotvec(at_beats(self.rotations, beats)).as_matrix()
        rotations = tilts @ self.rotation[beats.astype(int)]
        anchors = np.einsum("tij,tj->ti", rotations, at_beats(self.anchors, beats))
        return rotations, at_beats(self.targets, beats) - anchors


def at_beats(keys: Float[np.ndarray, "K *n"], beats: Float[np.ndarray, "T"]) -> NDArray[np.float64]:
    """Values interpolated linearly between keys, at fractional indices."""
    low = np.minimum(beats.astype(int), max(len(keys) - 2, 0))
    share = (beats - low)[:, None]
    return np.asarray(keys[low] + share * (keys[np.minimum(low + 1, len(keys) - 1)] - keys[low]))


def draw_variant(name: str, *, rng: np.random.Generator) -> dict[str, Any]:
    """One of the variants of an interaction, chosen at random."""
    variants = package_data("poses", "interactions")["interactions"][name]
    variant: dict[str, Any] = variants[rng.integers(len(variants))]
    return variant


class Sketch(NamedTuple):
    """The random part of an interaction's beats, for hands of any size."""

    variant: dict[str, Any]  # from `draw_variant`
    still: _FingerSketch
    moving: _FingerSketch
    targets: Float[np.ndarray, "K 3"]
    """Points of the still hand [hand lengths]."""
    tilts: Float[np.ndarray, "K 3"]
    """Rotation of the moving hand [rad]."""


class _FingerSketch(NamedTuple):
    """Random fingers of one hand (K, ...), before they are made valid."""

    opened: NDArray[np.float64]
    closed: NDArray[np.float64]
    wander: NDArray[np.float64]
    """Change of the open fingers from beat to beat [rad]."""
    strength: NDArray[np.float64]


def sketch_meeting(
    variant: dict[str, Any], count: int, *, together: bool, rng: np.random.Generator
) -> Sketch:
    """Random positions, orientations and fingers for beats; `together` makes the beats similar."""
    noise = _BeatNoise(count, together, rng)
    still, moving = (
        _sketch_fingers(variant[role], variant["relaxing"], noise, rng) for role in ("still", "moving")
    )
    targets = np.tile(variant["target"], (count, 1))
    jitter, reach = noise.around(np.array(variant["jitter"]), 0.0), np.array(variant["place"])
    if variant["pattern"] == "random":
        offsets = reach * rng.uniform(-1.0, 1.0, size=(count, 2))
    else:  # to one side and back
        direction = reach * np.array([1.0, rng.uniform(-1.0, 1.0)])
        side = (-1.0) ** np.arange(count)[:, None]
        offsets = side * direction * rng.uniform(0.6, 1.0, size=(count, 1))
    targets[:, :2] += jitter + offsets
    return Sketch(variant, still, moving, targets, noise.around(np.deg2rad(variant["tilt"]), 0.3))


def meet(sketches: Sequence[Sketch], still: HandModel, moving: HandModel) -> Meeting:
    """Beats of all sketches, one sketch after another, with valid fingers for these hands."""
    mirror = np.eye(3) if still.shape.side == "right" else MIRROR
    counts = [len(sketch.targets) for sketch in sketches]
    fingers = _valid_fingers(moving, [sketch.moving for sketch in sketches])
    opened = np.split(fingers.opened, np.cumsum(counts)[:-1])
    tilts = np.concatenate([sketch.tilts for sketch in sketches])[:, ::-1]
    rotation = [euler_matrix(np.deg2rad(sketch.variant["rotation"])) for sketch in sketches]
    axis = np.array([sketch.variant["axis"] for sketch in sketches], dtype=np.float64) @ mirror
    return Meeting(
        still=_valid_fingers(still, [sketch.still for sketch in sketches]),
        moving=fingers,
        rotations=-tilts @ mirror if still.shape.side == "left" else tilts,
        rotation=np.repeat(mirror @ np.array(rotation) @ mirror, counts, axis=0),
        targets=still.shape.length * np.concatenate([sketch.targets for sketch in sketches]) @ mirror,
        anchors=np.concatenate(
            [
                _anchors(sketch.variant["anchor"], moving, part)
                for sketch, part in zip(sketches, opened, strict=True)
            ]
        ),
        axis=np.repeat(unit(axis), counts, axis=0),
    )


class _BeatNoise:
    """Gaussian noise with a part common to all beats, clipped at two standard deviations."""

    def __init__(self, count: int, together: bool, rng: np.random.Generator) -> None:
        self.count, self.together, self.rng = count, together, rng

    def around(
        self, scale: NDArray[np.float64], wander: float, *, common: float = 1.0
    ) -> NDArray[np.float64]:
        """Noise (K, n) of scale (n,): `common` times a lasting part plus `wander` times a part per beat."""
        size = (self.count, len(scale))
        lasting = self.rng.standard_normal((1, size[1]) if self.together else size)
        new = self.rng.standard_normal(size)
        return scale * (common * lasting.clip(-2.0, 2.0) + wander * new.clip(-2.0, 2.0))


def _sketch_fingers(
    role: dict[str, str], relaxing: float, noise: _BeatNoise, rng: np.random.Generator
) -> _FingerSketch:
    weaker = rng.random((noise.count, len(DIGITS))) < relaxing
    strength = np.where(weaker, rng.uniform(0.4, 1.0, size=weaker.shape), 1.0)
    opened = _angles(role["open"]) + noise.around(_NOISE, 0.0)
    closed = _angles(role["closed"]) + noise.around(_NOISE, 0.0)
    return _FingerSketch(opened, closed, _WANDER_SHARE * noise.around(_NOISE, 1.0, common=0.0), strength)


def _valid_fingers(model: HandModel, sketches: Sequence[_FingerSketch]) -> Fingers:
    """Valid fingers of all sketches, one after another."""
    opened, closed, wander, strength = (np.concatenate(parts) for parts in zip(*sketches, strict=True))
    # Poses with deep contact move towards rest, because fingers need room to wander.
    lasting = make_valid(model, np.clip(opened, LOW, HIGH))
    hard = ~is_valid(model, lasting, max_penetration=_SNUG_DEPTH)
    lasting[hard] += 0.1 * (resting_angles(model) - lasting[hard])
    wandering = np.clip(lasting + wander, LOW, HIGH)
    valid = is_valid(model, wandering, max_penetration=_SNUG_DEPTH)
    return Fingers(np.where(valid[:, None], wandering, lasting), np.clip(closed, LOW, HIGH), strength)


def _angles(name: str) -> NDArray[np.float64]:
    """Joint angles [rad] of a gesture, or of a hand pose of this data file alone."""
    if name in gesture_names():
        return gesture(name)
    return np.deg2rad(np.ravel(package_data("poses", "interactions")["hands"][name]))


def _anchors(
    anchor: str | list[float], moving: HandModel, opened: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points (K, 3) of the moving hand in its wrist frame [m]."""
    if isinstance(anchor, str):
        bone = bones_of(anchor)[-1]
        frames = moving.forward_kinematics(join_qpos(opened))[:, bone]
        return np.asarray(frames[:, :3, 3] + moving.skeleton.lengths[bone] * frames[:, :3, 0])
    mirror = MIRROR if moving.shape.side == "left" else np.eye(3)
    return np.tile(moving.shape.length * np.array(anchor) @ mirror, (len(opened), 1))


class _Course(NamedTuple):
    """The course of a meeting, each array (T,)."""

    beats: NDArray[np.float64]
    """Fractional beat."""
    lift: NDArray[np.float64]
    """Distance of the hands from contact [m]."""
    grip: NDArray[np.float64]
    """Factor on the strength of closing fingers."""


def play_meeting(right: HandModel, left: HandModel, name: str, *, rng: np.random.Generator) -> Passage | None:
    """Draw one interaction, from approach to release; None if the draw is not valid."""
    still, moving = (right, left) if rng.random() < 0.5 else (left, right)
    variant = draw_variant(name, rng=rng)
    count = int(rng.integers(variant["beats"][0], variant["beats"][1] + 1))
    sketches = [
        sketch_meeting(variant, count, together=True, rng=rng) for _ in range(variant.get("tries", 1))
    ]
    draws = [meet([sketch], still, moving) for sketch in sketches]
    meeting = min(draws, key=lambda draw: float(_contact_distance(still, moving, draw, np.zeros(1))[0]))
    course = _meeting_course(variant, count, rng)
    distance = _contact_distance(still, moving, meeting, course.beats)
    if (distance <= NEAREST).any():
        return None
    passage = _close_contact(still, moving, meeting, course, distance=distance, rate=RATE)
    speeds = np.diff(np.concatenate([passage.right, passage.left], axis=1), axis=0) * RATE
    if np.abs(speeds).max() > MAX_SPEED or np.abs(np.diff(speeds, axis=0) * RATE).max() > MAX_ACCELERATION:
        return None
    return passage if valid_frames(right, left, passage).all() else None


def draw_poses(
    right: HandModel, left: HandModel, counts: Sequence[tuple[str, int]], *, rng: np.random.Generator
) -> Passage:
    """Draw single poses of interactions and keep the valid ones; roles are drawn once per interaction."""
    draws = [_draw_single(name, count, rng) for name, count in counts]
    order = np.argsort([draw.left_still for draw in draws], kind="stable")
    passages, valid = [], []
    for left_still, still, moving in ((False, right, left), (True, left, right)):
        drawn = [draws[number] for number in order if draws[number].left_still == left_still]
        if not drawn:
            continue
        meeting = meet([draw.sketch for draw in drawn], still, moving)
        distance = _contact_distance(still, moving, meeting, np.arange(float(len(meeting.axis))))
        best = np.empty(0, dtype=np.int64)  # the try of each pose whose hands come nearest to each other
        begin = 0
        for draw in drawn:
            count, beats = len(draw.lift), len(draw.sketch.targets)
            tries = distance[begin : begin + beats].reshape(count, -1)
            nearest = begin + tries.shape[1] * np.arange(count) + tries.argmin(axis=1)
            best, begin = np.concatenate([best, nearest]), begin + beats
        lift, grip = (
            np.concatenate(parts) for parts in zip(*((draw.lift, draw.grip) for draw in drawn), strict=True)
        )
        course = _Course(best.astype(float), lift, grip)
        passages.append(_close_contact(still, moving, meeting, course, distance=distance[best], rate=None))
        valid.append((distance[best] > NEAREST) & valid_frames(right, left, passages[-1]))
    sizes = [len(draws[number].lift) for number in order]
    as_drawn = np.argsort(np.repeat(order, sizes), kind="stable")
    return join_passages(passages).at(as_drawn[np.concatenate(valid)[as_drawn]])


class _PoseDraw(NamedTuple):
    """Single poses of one interaction, for hands of any size."""

    left_still: bool
    """Whether the left hand is the still one."""
    sketch: Sketch
    """The poses, with several tries for each."""
    lift: NDArray[np.float64]
    """Distance of the hands from contact (N,) [m]."""
    grip: NDArray[np.float64]
    """Factor on the strength of closing fingers (N,)."""


def _draw_single(name: str, count: int, rng: np.random.Generator) -> _PoseDraw:
    left_still = not rng.random() < 0.5
    variant = draw_variant(name, rng=rng)
    sketch = sketch_meeting(variant, count * variant.get("tries", 1), together=False, rng=rng)
    lift = np.where(rng.random(count) < _TOUCHING_SHARE, 0.0, _MAX_GAP * rng.random(count))
    grip = np.where(rng.random(count) < _HALF_CLOSED_SHARE, rng.random(count), 1.0)
    return _PoseDraw(left_still, sketch, lift, grip)


def _contact_distance(
    still: HandModel, moving: HandModel, meeting: Meeting, beats: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance (T,) [m] by which the moving hand must back off with open fingers."""
    return first_contact(
        still,
        join_qpos(meeting.still.at(beats).opened),
        moving,
        placed_qpos(meeting.moving.at(beats).opened, *meeting.placement(beats)),
        meeting.directions(beats),
    )


def _close_contact(
    still: HandModel,
    moving: HandModel,
    meeting: Meeting,
    course: _Course,
    *,
    distance: NDArray[np.float64],
    rate: float | None,
) -> Passage:
    """Bring hands into contact and close their fingers; smooth over time if there is a rate."""
    contact_window, finger_window = (
        1 if rate is None else 2 * int(window * rate / 2) + 1 for window in (_CONTACT_WINDOW, _FINGER_WINDOW)
    )
    rotation, position = meeting.placement(course.beats)
    back = smooth_above(distance, contact_window) + course.lift
    position = position + back[:, None] * meeting.directions(course.beats)
    fingers = meeting.still.at(course.beats), meeting.moving.at(course.beats)
    hands = still, moving
    qpos = join_qpos(fingers[0].opened), placed_qpos(fingers[1].opened, rotation, position)
    for own, other in ((0, 1), (1, 0)):
        qpos[own][:, 7:] = close_fingers(
            hands[own],
            qpos[own],
            fingers[own].closed,
            fingers[own].strength * course.grip[:, None],
            other=hands[other],
            other_qpos=qpos[other],
            window=finger_window,
        )
    angles = qpos[0][:, 7:], qpos[1][:, 7:]
    if still.shape.side == "right":
        return Passage(rotation, position, *angles)
    back = np.swapaxes(rotation, 1, 2)
    return Passage(back, -np.einsum("tij,tj->ti", back, position), *angles[::-1])


def _meeting_course(variant: dict[str, Any], count: int, rng: np.random.Generator) -> _Course:
    """The course of a meeting: approach, stay and move `count` times, release."""
    ends = [int(rng.uniform(*APPROACH_TIMES) * RATE) + 1 for _ in range(2)]
    # Fingers close after the hands meet, and open before the hands part.
    grips = [int(rng.uniform(*APPROACH_TIMES) * RATE) + 1 for _ in range(2)]
    tempo = rng.random(2)
    beats, lift = [np.zeros(ends[0] + grips[0])], [1.0 - minimum_jerk(ends[0]), np.zeros(grips[0])]
    lift[0] = rng.uniform(*_PARTED_DISTANCES) * lift[0]
    for beat in range(count):
        stay, move = (
            int((low + share * (high - low)) * rng.uniform(0.9, 1.1) * RATE) + 1
            for (low, high), share in zip((variant["stay"], variant["move"]), tempo, strict=True)
        )
        beats.append(np.full(stay, float(beat)))
        lift.append(np.zeros(stay))
        if beat < count - 1:
            time = np.arange(1, move + 1) / move
            height = min(rng.uniform(*variant["lift"]), move / RATE * WRIST_SPEED)
            beats.append(beat + minimum_jerk(move))
            lift.append(height * 64.0 * (time * (1.0 - time)) ** 3)
    beats.append(np.full(ends[1] + grips[1], count - 1.0))
    lift += [np.zeros(grips[1]), rng.uniform(*_PARTED_DISTANCES) * minimum_jerk(ends[1])]
    grip = np.ones(sum(map(len, beats)))
    grip[: sum(map(len, lift[:2]))] = np.concatenate([np.zeros(ends[0]), minimum_jerk(grips[0])])
    grip[len(grip) - ends[1] - grips[1] :] = np.concatenate([1.0 - minimum_jerk(grips[1]), np.zeros(ends[1])])
    return _Course(np.concatenate(beats), np.concatenate(lift), grip)


def sample_two_hand_motion(
    right: HandModel, left: HandModel, duration: float, *, rng: np.random.Generator
) -> tuple[HandMotion, HandMotion]:
    """Random smooth motion of two hands through a series of interactions, valid at every frame.

    It has `round(duration * RATE) + 1` frames. The left hand may be another person's.
    """
    frames = round(duration * RATE) + 1
    passages = _next_passages(right, left, None, rng=rng)
    while sum(map(len, passages)) < frames:
        passages += _next_passages(right, left, passages[-1].at([-1]), rng=rng)
    whole = join_passages(passages).at(slice(frames))
    right_qpos, left_qpos = _in_world(whole, *_travel_path(frames, rng))
    return HandMotion(right_qpos, RATE), HandMotion(left_qpos, RATE)


def sample_two_hand_poses(
    right: HandModel, left: HandModel, count: int, *, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "T 27"], Float[np.ndarray, "T 27"]]:
    """Independent valid poses of a right and a left hand that touch or nearly do."""
    passages: list[Passage] = []
    missing = count
    for _ in range(_MAX_DRAWS):
        # Each name occurs twice, because roles are drawn once per batch; extra poses replace invalid ones.
        batches = rng.multinomial(
            missing + missing // 8 + 2, np.full(2 * len(INTERACTIONS), 0.5 / len(INTERACTIONS))
        )
        counts = [(name, int(n)) for name, n in zip(2 * INTERACTIONS, batches, strict=True) if n]
        passages.append(draw_poses(right, left, counts, rng=rng))
        missing = count - sum(map(len, passages))
        if missing <= 0:
            whole = join_passages(passages)
            whole = whole.at(rng.permutation(len(whole))[:count])
            positions = ROOM_CENTER + rng.uniform(-PAIR_VOLUME, PAIR_VOLUME, size=(count, 3))
            return _in_world(whole, positions, Rotation.from_quat(random_quaternions(count, rng=rng)))
    raise PoseError(f"no valid pose of these two hands was found in {_MAX_DRAWS} tries")


def _next_passages(
    right: HandModel, left: HandModel, last: Passage | None, *, rng: np.random.Generator
) -> list[Passage]:
    """The next meeting, after the path to it from the last frame, if any."""
    name = INTERACTIONS[rng.integers(len(INTERACTIONS))]
    for _ in range(_MAX_DRAWS):
        meeting = play_meeting(right, left, name, rng=rng)
        if meeting is None:
            continue
        if last is None:
            return [meeting]
        for _ in range(10):
            path = path_between(right, left, last, meeting.at([0]), rng=rng)
            if path is not None:
                return [path, meeting]
    raise PoseError(f"no valid path was found in {_MAX_DRAWS} tries to bring these hands to '{name}'")


def _travel_path(frames: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], Rotation]:
    """Positions (T, 3) and orientations of a traveling pair of hands."""
    positions = [ROOM_CENTER + rng.uniform(-PAIR_VOLUME, PAIR_VOLUME, size=3)]
    orientations, shares = [Rotation.from_quat(random_quaternions(1, rng=rng)[0])], [np.zeros(1)]
    while sum(map(len, shares)) < frames:
        positions.append(ROOM_CENTER + rng.uniform(-PAIR_VOLUME, PAIR_VOLUME, size=3))
        orientations.append(orientations[-1] * Rotation.from_rotvec(rng.normal(scale=_ROTATION, size=3)))
        distance = float(np.linalg.norm(positions[-1] - positions[-2]))
        seconds = max(rng.uniform(*_TRAVEL_TIMES), PEAK_SPEED * distance / WRIST_SPEED)
        shares.append(len(positions) - 2 + minimum_jerk(int(np.ceil(seconds * RATE))))
    keys = np.array(positions), Rotation.concatenate(orientations)
    return interpolate_path(*keys, np.concatenate(shares)[:frames])


def _in_world(
    whole: Passage, middle: NDArray[np.float64], orientations: Rotation
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both hands' qpos from the middle of their wrists and the right one's orientation."""
    across = orientations.apply(whole.position) / 2
    rotations = orientations.as_matrix()
    return (
        join_qpos(whole.right, position=middle - across, quaternion=rotation_quaternions(rotations)),
        join_qpos(
            whole.left, position=middle + across, quaternion=rotation_quaternions(rotations @ whole.rotation)
        ),
    )
