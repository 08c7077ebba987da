"""Two hands that meet: one meeting played out as a motion, or single poses of many meetings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handsim.hand.model import HandModel, join_qpos
from poses.contact.contact_closing import NEAREST, close_fingers, first_contact, smooth_above
from poses.contact.interactions import Meeting, Sketch, draw_variant, meet, sketch_meeting
from poses.contact.passages import (
    APPROACH,
    MAX_ACCELERATION,
    MAX_SPEED,
    RATE,
    WRIST_SPEED,
    Passage,
    join_passages,
    placed_qpos,
    valid_frames,
)
from poses.motion.paths import minimum_jerk

_CONTACT_WINDOW: Final = 0.12  # over which backing off is smoothed [s]
_FINGER_WINDOW: Final = 0.35  # over which closing fingers are smoothed [s]
_PARTED: Final = (0.08, 0.16)  # how far the hands are moved apart along the axis before and after [m]
# Single poses: how many touch, how far the others are apart at most [m], how many fingers are half closed.
_TOUCHING, _GAP, _HALF_CLOSED = 0.7, 0.06, 0.3


class _Course(NamedTuple):
    """The course of a meeting, each array (T,)."""

    beats: NDArray[np.float64]
    """Position among the beats, which count from 0."""
    lift: NDArray[np.float64]
    """Distance of the hands from touching [m]."""
    grip: NDArray[np.float64]
    """Share of their strength with which fingers close."""


def play_meeting(right: HandModel, left: HandModel, name: str, *, rng: np.random.Generator) -> Passage | None:
    """One interaction from coming together to letting go; None when this draw is not valid.

    Args:
        name: One of `INTERACTIONS`.
    """
    still, moving = (right, left) if rng.random() < 0.5 else (left, right)
    variant = draw_variant(name, rng=rng)
    count = int(rng.integers(variant["beats"][0], variant["beats"][1] + 1))
    sketches = [
        sketch_meeting(variant, count, together=True, rng=rng) for _ in range(variant.get("tries", 1))
    ]
    draws = [meet([sketch], still, moving) for sketch in sketches]
    meeting = min(draws, key=lambda draw: float(_contact_distance(still, moving, draw, np.zeros(1))[0]))
    course = _course(variant, count, rng)
    distance = _contact_distance(still, moving, meeting, course.beats)
    if (distance <= NEAREST).any():
        return None
    passage = _close_contact(still, moving, meeting, course, distance=distance, rate=RATE)
    if _too_fast(passage) or not valid_frames(right, left, passage).all():
        return None
    return passage


def draw_poses(
    right: HandModel, left: HandModel, counts: Sequence[tuple[str, int]], *, rng: np.random.Generator
) -> Passage:
    """Valid single poses of several interactions, the roles drawn once for each.

    Args:
        counts: Names out of `INTERACTIONS`, each with a number of poses to draw; those that are not valid are
            left out.
    """
    draws = [_draw(name, count, rng) for name, count in counts]
    order = np.argsort([draw.left_still for draw in draws], kind="stable")
    passages, valid = [], []
    for left_still, still, moving in ((False, right, left), (True, left, right)):
        drawn = [draws[number] for number in order if draws[number].left_still == left_still]
        if not drawn:
            continue
        meeting = meet([draw.sketch for draw in drawn], still, moving)
        distance = _contact_distance(still, moving, meeting, np.arange(float(len(meeting.axis))))
        best = _nearest_tries(drawn, distance)
        course = _Course(
            best.astype(float), *(np.concatenate([draw[part] for draw in drawn]) for part in (2, 3))
        )
        passages.append(_close_contact(still, moving, meeting, course, distance=distance[best], rate=None))
        valid.append((distance[best] > NEAREST) & valid_frames(right, left, passages[-1]))
    sizes = [len(draws[number].lift) for number in order]
    as_drawn = np.argsort(np.repeat(order, sizes), kind="stable")
    return join_passages(passages).at(as_drawn[np.concatenate(valid)[as_drawn]])


class _Draw(NamedTuple):
    """Single poses of one interaction, before hands give them their size."""

    left_still: bool
    """Whether the left hand holds still."""
    sketch: Sketch
    """The poses, each tried a few times."""
    lift: NDArray[np.float64]
    """Distance of the hands from touching (N,) [m]."""
    grip: NDArray[np.float64]
    """Share of their strength with which fingers close (N,)."""


def _draw(name: str, count: int, rng: np.random.Generator) -> _Draw:
    left_still = not rng.random() < 0.5
    variant = draw_variant(name, rng=rng)
    sketch = sketch_meeting(variant, count * variant.get("tries", 1), together=False, rng=rng)
    lift = np.where(rng.random(count) < _TOUCHING, 0.0, _GAP * rng.random(count))
    grip = np.where(rng.random(count) < _HALF_CLOSED, rng.random(count), 1.0)
    return _Draw(left_still, sketch, lift, grip)


def _nearest_tries(draws: Sequence[_Draw], distance: NDArray[np.float64]) -> NDArray[np.int64]:
    """The beat of each pose's try whose hands come nearest to each other."""
    best, begin = [], 0
    for draw in draws:
        count, beats = len(draw.lift), len(draw.sketch.targets)
        tries = distance[begin : begin + beats].reshape(count, -1)
        best.append(begin + tries.shape[1] * np.arange(count) + tries.argmin(axis=1))
        begin += beats
    return np.concatenate(best)


def _contact_distance(
    still: HandModel, moving: HandModel, meeting: Meeting, beats: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance (T,) [m] that the moving hand must back off with open fingers."""
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
    """Hands brought into contact with their fingers closed; smoothed in time if there is a rate."""
    contact_window, finger_window = (
        1 if rate is None else 2 * int(window * rate / 2) + 1 for window in (_CONTACT_WINDOW, _FINGER_WINDOW)
    )
    rotation, position = meeting.placement(course.beats)
    back = smooth_above(distance, contact_window) + course.lift
    position = position + back[:, None] * meeting.directions(course.beats)
    fingers = meeting.still.at(course.beats), meeting.moving.at(course.beats)
    still_qpos, moving_qpos = join_qpos(fingers[0].opened), placed_qpos(fingers[1].opened, rotation, position)
    strength = [each.strength * course.grip[:, None] for each in fingers]
    still_qpos[:, 7:] = close_fingers(
        still,
        still_qpos,
        fingers[0].closed,
        strength[0],
        other=moving,
        other_qpos=moving_qpos,
        window=finger_window,
    )
    moving_qpos[:, 7:] = close_fingers(
        moving,
        moving_qpos,
        fingers[1].closed,
        strength[1],
        other=still,
        other_qpos=still_qpos,
        window=finger_window,
    )
    if still.shape.side == "right":
        return Passage(rotation, position, still_qpos[:, 7:], moving_qpos[:, 7:])
    back = np.swapaxes(rotation, 1, 2)
    return Passage(back, -np.einsum("tij,tj->ti", back, position), moving_qpos[:, 7:], still_qpos[:, 7:])


def _course(variant: dict[str, Any], count: int, rng: np.random.Generator) -> _Course:
    """The course of a meeting: come together, stay and move `count` times, let go."""
    ends = [int(rng.uniform(*APPROACH) * RATE) + 1 for _ in range(2)]
    # Fingers close after the hands met, and open before they part.
    grips = [int(rng.uniform(*APPROACH) * RATE) + 1 for _ in range(2)]
    tempo = rng.random(2)
    beats, lift = [np.zeros(ends[0] + grips[0])], [1.0 - minimum_jerk(ends[0]), np.zeros(grips[0])]
    lift[0] = rng.uniform(*_PARTED) * lift[0]
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
    lift += [np.zeros(grips[1]), rng.uniform(*_PARTED) * minimum_jerk(ends[1])]
    grip = np.ones(sum(map(len, beats)))
    grip[: sum(map(len, lift[:2]))] = np.concatenate([np.zeros(ends[0]), minimum_jerk(grips[0])])
    grip[len(grip) - ends[1] - grips[1] :] = np.concatenate([1.0 - minimum_jerk(grips[1]), np.zeros(ends[1])])
    return _Course(np.concatenate(beats), np.concatenate(lift), grip)


def _too_fast(passage: Passage) -> bool:
    """Whether a joint exceeds the limits of speed or acceleration."""
    angles = np.concatenate([passage.right, passage.left], axis=1)
    speeds = np.diff(angles, axis=0) * RATE
    accelerations = np.diff(speeds, axis=0) * RATE
    return bool(np.abs(speeds).max() > MAX_SPEED or np.abs(accelerations).max() > MAX_ACCELERATION)
