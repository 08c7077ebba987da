"""Single poses of one hand: named gestures, couplings of joints, random draws, and which poses are valid."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from functools import cache
from typing import Final, Protocol

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from handsim._checks import check_array, check_callable, check_choice, check_count, check_rng
from handsim._plugins import call_plugin, list_plugins, load_plugin, plugin_name
from handsim.errors import ArgumentError, PoseError
from handsim.files.inputs import package_data
from handsim.hand.model import HandModel, join_qpos, load_model
from handsim.hand.shape import JOINTS, NUM_JOINTS, NUM_QPOS, HandShape
from handsim.settings import Expected, Mixture

LIBRARIES: Final = ("gestures", "fingerspelling", "numbers", "counting", "grasps", "pinches", "keys")
"""Names of all libraries; no two libraries share a name of a gesture."""
_GESTURE_SPREAD_DEG: Final = np.array([12.0, 2.0, -8.0, -18.0])  # index to little, positive to the thumb

LOW: Final = np.deg2rad([joint.low_deg for joint in JOINTS])
HIGH: Final = np.deg2rad([joint.high_deg for joint in JOINTS])

# Couplings of joints in a relaxed hand, with sources in docs/angles.md: the DIP flexes two thirds as far as
# the PIP on average (Lin, Wu and Huang 2000); abduction decreases as the MCP flexes and its collateral
# ligaments tighten; a finger pulls its neighbors along, because they share tendons.
_TIGHT_FLEXION: Final = np.deg2rad(85.0)  # MCP flexion beyond which abduction has its smallest range
_TIGHT_SHARE: Final = 0.25  # share of the abduction range that remains beyond this flexion
_DIP_SHARE: Final = 2.0 / 3.0  # DIP flexion as a share of the PIP's
_MAX_DIP_BELOW: Final = np.deg2rad(32.0)  # largest deviation of the DIP below its share of the PIP
_MAX_DIP_ABOVE: Final = np.deg2rad(28.0)  # largest deviation of the DIP above its share of the PIP
# Largest difference of MCP flexion between neighbors [rad]: index-middle, middle-ring, ring-little.
_MAX_MCP_DIFFERENCE: Final = np.deg2rad([85.0, 70.0, 75.0])

_FLEXION_NOISE: Final = np.deg2rad(6.0)
_ABDUCTION_NOISE: Final = np.deg2rad(2.0)
_SWAY: Final = np.deg2rad(3.0)  # standard deviation of an abduction that all fingers share
# Chance that two neighbors curl independently: index-middle, middle-ring, ring-little.
_SPLIT_CHANCE: Final = np.array([0.3, 0.2, 0.25])
_NEIGHBOR_CORRELATION: Final = 0.993
# One standard deviation of the increase of curl from index to little finger, in units of the normals.
_CURL_SLOPE: Final = 0.15 * np.array([-1.5, -0.5, 0.5, 1.5])
_CURL_DIP_SHARE: Final = 0.68
_DIP_LAG: Final = np.deg2rad(6.0)
_DIP_NOISE: Final = np.deg2rad(9.0)
_MCP_OPEN, _MCP_CLOSED = np.deg2rad([-18.0, 92.0])
_PIP_OPEN, _PIP_CLOSED = np.deg2rad([-3.0, 112.0])
_FAN_SPREAD: Final = np.deg2rad([7.0, 1.5, -5.0, -11.0])  # one standard deviation of fanning, index to little

MAX_PENETRATION: Final = 0.001
"""Deepest self-penetration [m] of a valid pose: skin yields by about this much."""
_ANGLE_ROUNDING: Final = 1e-6  # larger than the rounding of angles in single precision [rad]
_MAX_FLAT_OVERLAP: Final = 0.0045  # Flat fingers with more overlap [m] hide skin that carries markers.
_IS_THUMB: Final = np.array([joint.name.startswith("thumb") for joint in JOINTS])
_IS_ABDUCTION: Final = np.array([joint.name.endswith("abduction") for joint in JOINTS])
_REST_FAN: Final = np.deg2rad([0.0, 1.0, 0.2, -0.6, -1.4])  # one degree of fanning at rest, thumb to little
# One degree of fanning for digits that converge: thumb and middle finger lean away from the index finger.
_WIDE_REST_FAN: Final = np.deg2rad([1.0, 1.0, -0.2, -1.0, -1.8])

SAMPLERS: Final = "handsim.pose_samplers"
"""Group of entry points of pose samplers."""
SAMPLER: Final = Expected(
    "a function (model, num_poses, *, rng), module:name of one, or its entry point",
    lambda: list_plugins(SAMPLERS),
)
"""Description of a sampler in errors on settings."""
_NOUN: Final = "pose sampler"
_MAX_ANGLE: Final = 2.0 * np.pi  # largest joint angle that a sampler may return [rad]
_MAX_WRIST_DISTANCE: Final = 100.0  # largest wrist coordinate that a sampler may return [m]


@cache
def _library(library: str) -> dict[str, NDArray[np.float64]]:
    check_choice(library, LIBRARIES, noun="library")
    digits = package_data("poses", "gestures")  # all libraries use its named digits
    gestures: dict[str, NDArray[np.float64]] = {}
    for name, entry in package_data("poses", library)["gestures"].items():
        fingers = np.array([_angles_of(finger, digits["fingers"]) for finger in entry["fingers"]])
        fingers[:, 0] += entry.get("spread", 0.0) * _GESTURE_SPREAD_DEG
        thumb = _angles_of(entry["thumb"], digits["thumbs"])
        gestures[name] = np.deg2rad(np.concatenate([thumb, fingers.ravel()]))
    return gestures


@cache
def _gestures() -> dict[str, NDArray[np.float64]]:
    return {name: angles for library in LIBRARIES for name, angles in _library(library).items()}


def _angles_of(digit: str | list[float], named: dict[str, list[float]]) -> NDArray[np.float64]:
    """Four angles [deg] of a digit, given by name or as numbers."""
    return np.array(named[digit] if isinstance(digit, str) else digit, dtype=np.float64)


def gesture_names(library: str = "gestures") -> tuple[str, ...]:
    """Names of all gestures of one library; an `ArgumentError` if there is no such library."""
    return tuple(_library(library))


def gesture(name: str) -> Float[np.ndarray, "20"]:
    """Joint angles [rad] of a gesture of any library, in the order of `JOINTS`."""
    check_choice(name, _gestures(), noun="gesture")
    return _gestures()[name].copy()


def gestures_of(library: str) -> Float[np.ndarray, "G 20"]:
    """Joint angles [rad] of every gesture of one library, in the order of `gesture_names(library)`."""
    return np.stack(list(_library(library).values()))


def load_gestures() -> dict[str, Float[np.ndarray, "20"]]:
    """Joint angles [rad] of every named gesture, in the order of `handsim.hand.shape.JOINTS`."""
    return {name: angles.copy() for name, angles in _gestures().items()}


def apply_couplings(angles: Float[np.ndarray, "T 20"]) -> Float[np.ndarray, "T 20"]:
    """Clamp angles [rad] to ranges and couplings."""
    coupled = np.clip(angles, LOW, HIGH)
    fingers = coupled.reshape(-1, 5, 4)[:, 1:]  # a view
    flexion = fingers[..., 1]
    for near, far, apart in ((1, 0, 0), (1, 2, 1), (2, 3, 2)):
        limit = _MAX_MCP_DIFFERENCE[apart]
        flexion[:, far] = np.clip(flexion[:, far], flexion[:, near] - limit, flexion[:, near] + limit)
    left = 1.0 - (1.0 - _TIGHT_SHARE) * np.clip(flexion / _TIGHT_FLEXION, 0.0, 1.0)
    low, high = LOW.reshape(5, 4)[1:, 0], HIGH.reshape(5, 4)[1:, 0]
    fingers[..., 0] = np.clip(fingers[..., 0], low * left, high * left)
    follow = _DIP_SHARE * np.maximum(fingers[..., 2], 0.0)
    fingers[..., 3] = np.clip(fingers[..., 3], follow - _MAX_DIP_BELOW, follow + _MAX_DIP_ABOVE)
    return np.asarray(np.clip(coupled, LOW, HIGH))


@dataclass(frozen=True, slots=True)
class PoseMix(Mixture):
    """Shares of the sources of poses; they are normalized. No recorded motion is used."""

    gestures: float = 0.45
    """Blends of two named gestures, each digit a little ahead or behind."""
    curls: float = 0.50
    """Correlated finger curls: neighbors mostly move together."""
    anywhere: float = 0.05
    """Uniform within the ranges."""


DEFAULT_MIX: Final = PoseMix()


def sample_angles(
    count: int, mix: PoseMix = DEFAULT_MIX, *, rng: np.random.Generator
) -> Float[np.ndarray, "T 20"]:
    """Random joint angles [rad] inside ranges and couplings; digits may still touch."""
    source = rng.choice(3, size=count, p=mix.shares)
    angles = np.empty((count, len(LOW)))
    for number, draw in enumerate((_blend_gestures, _curl_fingers, _uniform_angles)):
        chosen = source == number
        angles[chosen] = draw(int(chosen.sum()), rng)
    return apply_couplings(angles)


def _blend_gestures(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    library = gestures_of("gestures")
    first, second = library[rng.integers(len(library), size=(2, count))]
    progress = rng.uniform(-0.1, 1.1, size=(count, 1)) + 0.12 * rng.standard_normal((count, 5))
    weight = np.repeat(np.clip(progress, 0.0, 1.0), 4, axis=1)
    noise = np.stack([_shared_normals(count, rng, digits=5) for _ in range(4)], axis=2) * _FLEXION_NOISE
    noise[..., 0] *= _ABDUCTION_NOISE / _FLEXION_NOISE
    return np.asarray((1.0 - weight) * first + weight * second + noise.reshape(count, 20))


def _curl_fingers(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    from scipy.special import ndtr

    angles = _oppose_thumbs(count, rng)
    digits = angles.reshape(count, 5, 4)  # a view
    within = rng.uniform(0.3, 1.0, size=(count, 1))  # correlation of the joints of one finger
    splits = rng.random((count, 3)) < _SPLIT_CHANCE
    knuckles, others = (_neighbor_normals(splits, rng.standard_normal((count, 4))) for _ in range(2))
    middles = within * knuckles + np.sqrt(1 - within**2) * others
    knuckles += _CURL_SLOPE * rng.standard_normal((count, 1))
    middles += _CURL_SLOPE * rng.standard_normal((count, 1))
    digits[:, 1:, 1] = _MCP_OPEN + (_MCP_CLOSED - _MCP_OPEN) * ndtr(1.15 * knuckles)
    digits[:, 1:, 2] = _PIP_OPEN + (_PIP_CLOSED - _PIP_OPEN) * ndtr(1.3 * middles)
    digits[:, 1:, 3] = (
        _CURL_DIP_SHARE * digits[:, 1:, 2] - _DIP_LAG + _DIP_NOISE * _shared_normals(count, rng)
    )
    fan, sway = rng.standard_normal((2, count, 1))
    digits[:, 1:, 0] = fan * _FAN_SPREAD + sway * _SWAY + _ABDUCTION_NOISE * rng.standard_normal((count, 4))
    return angles


def _shared_normals(count: int, rng: np.random.Generator, *, digits: int = 4) -> NDArray[np.float64]:
    """Standard normals (T, digits), correlated over the digits of a pose."""
    common, own = rng.standard_normal((count, 1)), rng.standard_normal((count, digits))
    return np.asarray(np.sqrt(0.75) * common + np.sqrt(0.25) * own)


def _neighbor_normals(splits: NDArray[np.bool_], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard normals (T, 4), nearly equal for neighboring fingers without a split between them."""
    grouped = normals.copy()
    for finger in range(1, 4):
        along = (
            _NEIGHBOR_CORRELATION * grouped[:, finger - 1]
            + np.sqrt(1 - _NEIGHBOR_CORRELATION**2) * normals[:, finger]
        )
        grouped[:, finger] = np.where(splits[:, finger - 1], normals[:, finger], along)
    return grouped


def _oppose_thumbs(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Thumbs that oppose (abduction with flexion) and fold (MCP with IP); fingers are zero."""
    angles = np.zeros((count, 20))
    reach, sweep, fold, tip = rng.standard_normal((4, count))
    angles[:, 0] = np.deg2rad(14.0) * reach
    angles[:, 1] = np.deg2rad(6.0) + np.deg2rad(15.0) * (0.6 * reach + 0.8 * sweep)
    angles[:, 2] = np.deg2rad(22.0) + np.deg2rad(16.0) * (0.3 * sweep + 0.95 * fold)
    angles[:, 3] = np.deg2rad(24.0) + np.deg2rad(22.0) * (0.4 * fold + 0.3 * sweep + 0.87 * tip)
    return angles


def _uniform_angles(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    return rng.uniform(LOW, HIGH, size=(count, len(LOW)))


def is_valid(
    model: HandModel, angles: Float[np.ndarray, "T 20"], *, max_penetration: float = MAX_PENETRATION
) -> Bool[np.ndarray, "T"]:
    """Whether each pose is in range, with a self-penetration of at most `max_penetration` [m]."""
    inside = ((angles >= LOW - _ANGLE_ROUNDING) & (angles <= HIGH + _ANGLE_ROUNDING)).all(axis=1)
    free: NDArray[np.bool_] = model.penetration(join_qpos(angles)) <= max_penetration
    return inside & free


def validate(model: HandModel | HandShape | str, qpos: Float[np.ndarray, "T 27"]) -> Bool[np.ndarray, "T"]:
    """Whether this hand can strike each pose: in range, with a self-penetration of at most 1 mm.

    Args:
        model: The hand, its shape, or one of the sizes XS, S, M, L, XL.
        qpos: Wrist position [m], wrist orientation (wxyz), joint angles [rad]; the wrist may be anywhere.

    Raises:
        ArgumentError: `model` has another type, or `qpos` is not (T, 27) or not finite.
    """
    return is_valid(load_model(model), check_array("qpos", qpos, (None, NUM_QPOS))[:, 7:])


@functools.lru_cache(maxsize=16)
def resting_angles(model: HandModel) -> Float[np.ndarray, "20"]:
    """A valid relaxed pose of this hand, with digits fanned as little as their girth allows; read-only."""
    # The first try leaves room between the digits, which thick digits lack.
    for share, fan in ((0.8, _REST_FAN), (1.0, _REST_FAN), (1.0, _WIDE_REST_FAN)):
        tries = _fanned(fan, 40.0)
        valid = is_valid(model, tries, max_penetration=share * MAX_PENETRATION)
        if valid.any():
            break
    else:
        raise PoseError("this hand's digits overlap at rest: its girths are too large for its breadth")
    resting: NDArray[np.float64] = tries[valid.argmax()]
    resting.setflags(write=False)
    return resting


def rests_easily(model: HandModel) -> bool:
    """Whether fingers fit at rest with at most 12 degrees of fanning, and do not cross when flat."""
    rests = is_valid(model, _fanned(_REST_FAN, 12.0), max_penetration=0.8 * MAX_PENETRATION).any()
    return bool(rests and model.penetration(join_qpos(np.zeros((1, NUM_JOINTS))))[0] <= _MAX_FLAT_OVERLAP)


def _fanned(fan: Float[np.ndarray, "5"], most: float) -> Float[np.ndarray, "K 20"]:
    """The relaxed gesture with digits fanned by 0 to `most` degrees, within their ranges."""
    degrees = np.arange(0.0, most + 1.0, 2.0)
    angles = np.tile(gesture("relaxed"), (len(degrees), 1))
    angles[:, ::4] += degrees[:, None] * fan
    return np.asarray(np.clip(angles, LOW, HIGH))


def make_valid(model: HandModel, angles: Float[np.ndarray, "T 20"]) -> Float[np.ndarray, "T 20"]:
    """Move invalid poses [rad] towards rest until they are valid; valid poses stay unchanged.

    First the thumb moves, then the thumb and all abductions; the whole hand opens only if that is not enough.
    """
    resting = resting_angles(model)
    result = np.array(angles, dtype=np.float64)
    todo = np.flatnonzero(~is_valid(model, result))
    for moving in (_IS_THUMB, _IS_THUMB | _IS_ABDUCTION, np.ones_like(_IS_THUMB)):
        if not len(todo):
            break
        end = np.where(moving, resting, result[todo])
        helps = is_valid(model, end)
        end, target = end[helps], result[todo[helps]]
        low, high = np.zeros(len(target)), np.ones(len(target))  # shares of the target: valid, invalid
        for _ in range(4):
            middle = (low + high) / 2
            valid = is_valid(model, end + middle[:, None] * (target - end))
            low, high = np.where(valid, middle, low), np.where(valid, high, middle)
        result[todo[helps]] = end + low[:, None] * (target - end)
        todo = todo[~helps]
    return result


def sample_valid_angles(
    model: HandModel, count: int, mix: PoseMix = DEFAULT_MIX, *, rng: np.random.Generator
) -> Float[np.ndarray, "T 20"]:
    """Random valid poses [rad] of one hand, inside ranges, couplings and `MAX_PENETRATION`."""
    return make_valid(model, sample_angles(count, mix, rng=rng))


class PoseSampler(Protocol):
    """Draws joint angles for one hand; any function with this signature is one."""

    def __call__(
        self, model: HandModel, num_poses: int, *, rng: np.random.Generator
    ) -> Float[np.ndarray, "T 20"] | Float[np.ndarray, "T 27"]:
        """Draw poses, which need not be valid.

        Args:
            model: The hand.
            num_poses: Number of poses, T.
            rng: Source of all randomness.

        Returns:
            Joint angles [rad], in the order of `handsim.hand.shape.JOINTS`; or whole poses: wrist position
            [m], wrist orientation (wxyz) and these angles.
        """


def mixed_angles(model: HandModel, num_poses: int, *, rng: np.random.Generator) -> Float[np.ndarray, "T 20"]:
    """The sampler of training sets: gestures, finger curls and uniform angles in the default mix [rad]."""
    return sample_angles(num_poses, rng=rng)


def sample_poses(
    model: HandModel | HandShape | str,
    num_poses: int,
    sampler: PoseSampler | str = mixed_angles,
    *,
    rng: np.random.Generator,
) -> Float[np.ndarray, "T 27"]:
    """Random valid poses of one hand, with the wrist at the origin unless the sampler draws whole poses.

    Poses that leave a range or penetrate the hand deeper than 1 mm are moved towards rest until they are
    valid.

    Args:
        model: The hand, its shape, or one of the sizes XS, S, M, L, XL.
        num_poses: Number of poses, T.
        sampler: Draws joint angles or whole poses; by default a mix of gestures, finger curls and uniform
            angles. A function, `module:name` of one, or its entry point.
        rng: Source of all randomness.

    Returns:
        Wrist position [m], wrist orientation (wxyz) and joint angles [rad] of every pose.

    Raises:
        ArgumentError: An argument is of another type, `num_poses` is not positive, or the sampler returned
            another shape or numbers that are not finite.
        PoseError: This hand has no valid pose at rest: its fingers are too thick for its breadth.
    """
    hand = load_model(model)
    check_count("num_poses", num_poses, 1)
    check_rng(rng)
    drawn = load_sampler(sampler, is_tried=False)(hand, num_poses, rng=rng)
    qpos = join_qpos(make_valid(hand, drawn[:, -NUM_JOINTS:]))
    if drawn.shape[1] == NUM_QPOS:
        qpos[:, :-NUM_JOINTS] = drawn[:, :-NUM_JOINTS]
    return qpos


def load_sampler(sampler: PoseSampler | str, *, is_tried: bool = True) -> PoseSampler:
    """Load a sampler and add checks of its output; if `is_tried`, draw two poses to test it."""
    if not isinstance(sampler, str):
        check_callable("sampler", sampler, SAMPLER.words, SAMPLER.names())
    checked = functools.partial(_checked_draw, sampler)
    if is_tried:
        checked(HandModel.named("M"), 2, rng=np.random.default_rng(0))
    return checked


def _checked_draw(
    sampler: PoseSampler | str, model: HandModel, num_poses: int, *, rng: np.random.Generator
) -> NDArray[np.float64]:
    name = plugin_name(sampler)
    function = load_plugin(sampler, group=SAMPLERS, noun=_NOUN) if isinstance(sampler, str) else sampler
    owner = f"what {_NOUN} '{name}' returns"
    values = check_array(owner, call_plugin(function, name, _NOUN, model, num_poses, rng=rng), (None,))
    if values.shape not in ((num_poses, NUM_JOINTS), (num_poses, NUM_QPOS)):
        raise ArgumentError(
            f"{owner} has shape {values.shape}, expected ({num_poses}, {NUM_JOINTS}) joint angles or "
            f"({num_poses}, {NUM_QPOS}) whole poses"
        )
    widest = np.abs(values[:, -NUM_JOINTS:]).max()
    if widest > _MAX_ANGLE:
        raise ArgumentError(f"{owner} holds an angle of {widest:.4g} rad; are these degrees?")
    if values.shape[1] == NUM_JOINTS:
        return values
    lengths = np.linalg.norm(values[:, 3:7], axis=1, keepdims=True)
    if lengths.min() < 1e-6:
        raise ArgumentError(f"{owner} holds a quaternion of zeros (numbers 3 to 6, wxyz), expected length 1")
    farthest = np.abs(values[:, :3]).max()
    if farthest > _MAX_WRIST_DISTANCE:
        raise ArgumentError(f"{owner} holds a wrist {farthest:.4g} m away; are these millimeters?")
    return np.concatenate([values[:, :3], values[:, 3:7] / lengths, values[:, 7:]], axis=1)
