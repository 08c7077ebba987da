"""Stretches of a motion of two hands: one meeting played out, the way to the next, single poses of many."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from handsim._checks import check_number, check_span
from handsim.hand.contact import overlap_between
from handsim.hand.model import HandModel, join_qpos
from handsim.space.transforms import rotation_quaternions
from poses.contact.contact_closing import NEAREST, close_fingers, first_contact, smooth_above
from poses.contact.interactions import Meeting, draw_meeting, draw_variant
from poses.motion.minimum_jerk import PEAK_ACCELERATION, PEAK_SPEED, minimum_jerk
from poses.shapes.validity import is_valid, sample_valid_angles

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy.typing import NDArray

MAX_OVERLAP: Final = 0.001
"""How deep two hands may press into each other [m]."""
_TURNING: Final = 8.0  # fastest turn of one hand against the other [rad/s]
_CONTACT_WINDOW: Final = 0.12  # over which backing off is smoothed [s]
_FINGER_WINDOW: Final = 0.35  # over which closing fingers are smoothed [s]
_PARTED: Final = (0.08, 0.16)  # how far the hands are moved apart along the axis before and after [m]
_DISTANCE: Final = (0.25, 0.45)  # between the wrists of hands that are apart [m]
# Single poses: how many touch, how far the others are apart at most [m], how many fingers are half closed.
_TOUCHING, _GAP, _HALF_CLOSED = 0.7, 0.06, 0.3


@dataclass(frozen=True, slots=True)
class TwoHandConfig:
    """How fast two hands move, how far they part and where they go."""

    rate: float = 120.0
    """Frames a second [Hz]."""
    max_speed: float = 10.0
    """Fastest hinge [rad/s]."""
    max_acceleration: float = 200.0
    """Largest hinge acceleration [rad/s^2]."""
    wrist_speed: float = 1.0
    """Fastest travel of the pair, and of either hand against it between two meetings [m/s]."""
    approach: tuple[float, float] = (0.4, 0.8)
    """Shortest and longest time to come together or to let go [s]."""
    apart: tuple[float, float] = (0.0, 0.6)
    """Shortest and longest rest between two meetings [s]."""
    volume: float = 0.2
    """Half side of the cube in which the middle of the wrists travels [m], around 1.1 m above the floor."""

    def __post_init__(self) -> None:
        for name in ("rate", "max_speed", "max_acceleration", "wrist_speed"):
            check_number(name, getattr(self, name), 0.0, above=True)
        check_number("volume", self.volume, 0.0)
        check_span("approach", self.approach)
        check_span("apart", self.apart)


@dataclass(frozen=True, slots=True, eq=False)
class Passage:
    """Frames of two hands: the left wrist in the right one's frame, and the hinges of both."""

    rotation: Float[np.ndarray, "T 3 3"]
    position: Float[np.ndarray, "T 3"]
    right: Float[np.ndarray, "T 20"]
    left: Float[np.ndarray, "T 20"]

    def __len__(self) -> int:
        return len(self.right)

    def at(self, frames: Any) -> Passage:
        """Some of its frames."""
        return Passage(self.rotation[frames], self.position[frames], self.right[frames], self.left[frames])


class _Course(NamedTuple):
    """What a meeting's frames do, each (T,)."""

    beats: NDArray[np.float64]
    lift: NDArray[np.float64]
    """How far the hands are from touching [m]."""
    grip: NDArray[np.float64]
    """Share of their strength with which fingers close."""


def join_passages(passages: list[Passage]) -> Passage:
    """One after the other."""
    return Passage(
        np.concatenate([passage.rotation for passage in passages]),
        np.concatenate([passage.position for passage in passages]),
        np.concatenate([passage.right for passage in passages]),
        np.concatenate([passage.left for passage in passages]),
    )


def play_meeting(
    right: HandModel, left: HandModel, name: str, config: TwoHandConfig, *, rng: np.random.Generator
) -> Passage | None:
    """One interaction from coming together to letting go; nothing when this draw breaks a rule."""
    still, moving = (right, left) if rng.random() < 0.5 else (left, right)
    variant = draw_variant(name, rng=rng)
    count = int(rng.integers(variant["beats"][0], variant["beats"][1] + 1))
    draws = [
        draw_meeting(variant, still, moving, count, together=True, rng=rng)
        for _ in range(variant.get("tries", 1))
    ]
    meeting = min(draws, key=lambda draw: float(_reach(still, moving, draw, np.zeros(1))[0]))
    course = _course(variant, count, config, rng)
    reach = _reach(still, moving, meeting, course.beats)
    if (reach <= NEAREST).any():
        return None
    passage = _brought_together(still, moving, meeting, course, reach=reach, rate=config.rate)
    if _too_fast(passage, config) or not valid_frames(right, left, passage).all():
        return None
    return passage


def draw_poses(
    right: HandModel, left: HandModel, name: str, count: int, *, rng: np.random.Generator
) -> Passage:
    """Up to `count` valid single poses of one interaction, with the roles drawn once."""
    still, moving = (right, left) if rng.random() < 0.5 else (left, right)
    variant = draw_variant(name, rng=rng)
    tries = variant.get("tries", 1)
    meeting = draw_meeting(variant, still, moving, count * tries, together=False, rng=rng)
    reach = _reach(still, moving, meeting, np.arange(float(count * tries)))
    best = tries * np.arange(count) + reach.reshape(count, tries).argmin(axis=1)
    lift = np.where(rng.random(count) < _TOUCHING, 0.0, _GAP * rng.random(count))
    grip = np.where(rng.random(count) < _HALF_CLOSED, rng.random(count), 1.0)
    passage = _brought_together(
        still, moving, meeting, _Course(best.astype(float), lift, grip), reach=reach[best], rate=None
    )
    return passage.at((reach[best] > NEAREST) & valid_frames(right, left, passage))


def way_between(
    right: HandModel,
    left: HandModel,
    start: Passage,
    end: Passage,
    config: TwoHandConfig,
    *,
    rng: np.random.Generator,
) -> Passage | None:
    """Frames from one pose to another over a place where the hands are apart; nothing when not valid."""
    apart = Passage(
        *_place_apart(rng), sample_valid_angles(right, 1, rng=rng), sample_valid_angles(left, 1, rng=rng)
    )
    rest = apart.at(np.zeros(int(rng.uniform(*config.apart) * config.rate), dtype=int))
    way = join_passages([_straight(start, apart, config, rng), rest, _straight(apart, end, config, rng)])
    return way if valid_frames(right, left, way).all() else None


def valid_frames(right: HandModel, left: HandModel, passage: Passage) -> Bool[np.ndarray, "T"]:
    """Which frames respect ranges, self-penetration and `MAX_OVERLAP`."""
    overlap = overlap_between(
        right.capsules,
        right.forward_kinematics(join_qpos(passage.right)),
        left.capsules,
        left.forward_kinematics(_placed(passage.left, passage.rotation, passage.position)),
    )
    valid: NDArray[np.bool_] = (
        is_valid(right, passage.right) & is_valid(left, passage.left) & (overlap <= MAX_OVERLAP)
    )
    return valid


def _reach(
    still: HandModel, moving: HandModel, meeting: Meeting, beats: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far the moving hand must back off with open fingers [m]."""
    return first_contact(
        still,
        join_qpos(meeting.still.at(beats).opened),
        moving,
        _placed(meeting.moving.at(beats).opened, *meeting.placement(beats)),
        np.tile(meeting.axis, (len(beats), 1)),
    )


def _brought_together(
    still: HandModel,
    moving: HandModel,
    meeting: Meeting,
    course: _Course,
    *,
    reach: NDArray[np.float64],
    rate: float | None,
) -> Passage:
    """Hands brought to each other and their fingers closed; smoothed in time where there is a rate."""
    contact_window, finger_window = (
        1 if rate is None else 2 * int(window * rate / 2) + 1 for window in (_CONTACT_WINDOW, _FINGER_WINDOW)
    )
    rotation, position = meeting.placement(course.beats)
    position = position + (smooth_above(reach, contact_window) + course.lift)[:, None] * meeting.axis
    fingers = meeting.still.at(course.beats), meeting.moving.at(course.beats)
    still_qpos, moving_qpos = join_qpos(fingers[0].opened), _placed(fingers[1].opened, rotation, position)
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


def _course(variant: dict[str, Any], count: int, config: TwoHandConfig, rng: np.random.Generator) -> _Course:
    """Come together, stay and move `count` times, let go."""
    ends = [int(rng.uniform(*config.approach) * config.rate) + 1 for _ in range(2)]
    # Fingers close after the hands met, and open before they part.
    grips = [int(rng.uniform(*config.approach) * config.rate) + 1 for _ in range(2)]
    tempo = rng.random(2)
    beats, lift = [np.zeros(ends[0] + grips[0])], [1.0 - minimum_jerk(ends[0]), np.zeros(grips[0])]
    lift[0] = rng.uniform(*_PARTED) * lift[0]
    for beat in range(count):
        stay, move = (
            int((low + share * (high - low)) * rng.uniform(0.9, 1.1) * config.rate) + 1
            for (low, high), share in zip((variant["stay"], variant["move"]), tempo, strict=True)
        )
        beats.append(np.full(stay, float(beat)))
        lift.append(np.zeros(stay))
        if beat < count - 1:
            time = np.arange(1, move + 1) / move
            height = min(rng.uniform(*variant["lift"]), move / config.rate * config.wrist_speed)
            beats.append(beat + minimum_jerk(move))
            lift.append(height * 64.0 * (time * (1.0 - time)) ** 3)
    beats.append(np.full(ends[1] + grips[1], count - 1.0))
    lift += [np.zeros(grips[1]), rng.uniform(*_PARTED) * minimum_jerk(ends[1])]
    grip = np.ones(sum(map(len, beats)))
    grip[: sum(map(len, lift[:2]))] = np.concatenate([np.zeros(ends[0]), minimum_jerk(grips[0])])
    grip[len(grip) - ends[1] - grips[1] :] = np.concatenate([1.0 - minimum_jerk(grips[1]), np.zeros(ends[1])])
    return _Course(np.concatenate(beats), np.concatenate(lift), grip)


def _straight(start: Passage, end: Passage, config: TwoHandConfig, rng: np.random.Generator) -> Passage:
    """Minimum-jerk frames from a single pose to another, without the first."""
    turns = Rotation.from_matrix(np.concatenate([start.rotation, end.rotation]))
    bend = max(np.abs(end.right - start.right).max(), np.abs(end.left - start.left).max())
    seconds = max(
        rng.uniform(*config.approach),
        PEAK_SPEED * bend / config.max_speed,
        np.sqrt(PEAK_ACCELERATION * bend / config.max_acceleration),
        PEAK_SPEED * (turns[0].inv() * turns[1]).magnitude() / _TURNING,
        PEAK_SPEED * 0.5 * float(np.linalg.norm(end.position - start.position)) / config.wrist_speed,
    )
    share = minimum_jerk(int(np.ceil(seconds * config.rate)) + 1)
    along = share[:, None]
    return Passage(
        Slerp([0.0, 1.0], turns)(share).as_matrix(),
        start.position + along * (end.position - start.position),
        start.right + along * (end.right - start.right),
        start.left + along * (end.left - start.left),
    )


def _place_apart(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Orientation (1, 3, 3) and position (1, 3) of the left wrist: from side by side to palm facing palm."""
    roll = rng.uniform(0.0, np.pi)
    turn = Rotation.from_rotvec(rng.normal(scale=0.4, size=3)) * Rotation.from_rotvec([-roll, 0.0, 0.0])
    direction = np.array([rng.uniform(-0.3, 0.3), np.cos(roll / 2), -np.sin(roll / 2)])
    return turn.as_matrix()[None], rng.uniform(*_DISTANCE) * direction[None] / np.linalg.norm(direction)


def _placed(
    angles: NDArray[np.float64], rotation: NDArray[np.float64], position: NDArray[np.float64]
) -> NDArray[np.float64]:
    return join_qpos(angles, position=position, quaternion=rotation_quaternions(rotation))


def _too_fast(passage: Passage, config: TwoHandConfig) -> bool:
    """Whether some hinge is."""
    angles = np.concatenate([passage.right, passage.left], axis=1)
    speeds = np.diff(angles, axis=0) * config.rate
    accelerations = np.diff(speeds, axis=0) * config.rate
    return bool(
        np.abs(speeds).max() > config.max_speed or np.abs(accelerations).max() > config.max_acceleration
    )
