"""Random valid poses of one hand, from our sampler of joint angles or from the user's own."""

from __future__ import annotations

import functools
from typing import Final, Protocol

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_array, check_callable, check_rng, check_type
from handsim._plugins import call_plugin, list_plugins, load_plugin, plugin_name
from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, join_qpos, load_model
from handsim.hand.shape import NUM_JOINTS, NUM_QPOS, HandShape
from poses.shapes.samplers import sample_angles
from poses.shapes.validity import make_valid

SAMPLERS: Final = "handsim.pose_samplers"
"""Group of entry points of pose samplers."""
_NOUN: Final = "pose sampler"
_EXPECTED: Final = "a function (model, num_poses, *, rng), module:name of one, or its entry point"
_WIDEST: Final = 2.0 * np.pi  # [rad], no joint turns so far
_FARTHEST: Final = 100.0  # [m] of a wrist from the origin


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
    """The sampler that training sets use: gestures, finger curls and uniform angles in the default mix.

    Joint angles [rad] are inside ranges and couplings, the same for every hand; digits may still touch.
    """
    return sample_angles(num_poses, rng=rng)


def sample_poses(
    model: HandModel | HandShape | str,
    num_poses: int,
    sampler: PoseSampler | str = mixed_angles,
    *,
    rng: np.random.Generator,
) -> Float[np.ndarray, "T 27"]:
    """Random valid poses of one hand, with the wrist at the origin unless the sampler says where it is.

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
    check_type("num_poses", num_poses, (int, np.integer), "a number of poses")
    check_rng(rng)
    if num_poses < 1:
        raise ArgumentError(f"num_poses is {num_poses}, expected a positive number")
    drawn = checked_sampler(sampler)(hand, num_poses, rng=rng)
    qpos = join_qpos(make_valid(hand, drawn[:, -NUM_JOINTS:]))
    qpos[:, :-NUM_JOINTS] = qpos[:, :-NUM_JOINTS] if drawn.shape[1] == NUM_JOINTS else drawn[:, :-NUM_JOINTS]
    return qpos


def load_sampler(sampler: PoseSampler | str) -> PoseSampler:
    """A user's sampler, or the one of a name, behind checks of what it returns; it is tried once.

    Args:
        sampler: A function like `PoseSampler`; `module:name` of one or of a class whose instances are; or an
            entry point of the group `handsim.pose_samplers`.

    Returns:
        A sampler of finite joint angles (T, 20) [rad] or whole poses (T, 27).

    Raises:
        ArgumentError: There is none of that name, it does not take a sampler's arguments, or what it returns
            for two poses of a hand of size M has another shape or is not finite.
        HandSimError: It raised an error.
    """
    checked = checked_sampler(sampler)
    checked(HandModel.named("M"), 2, rng=np.random.default_rng(0))
    return checked


def checked_sampler(sampler: PoseSampler | str) -> PoseSampler:
    """As `load_sampler`, but not tried."""
    if not isinstance(sampler, str):
        names = ", ".join(list_plugins(SAMPLERS))
        check_callable("sampler", sampler, _EXPECTED + (f"; valid names: {names}" if names else ""))
    return functools.partial(_drawn, sampler)


def _drawn(
    sampler: PoseSampler | str, model: HandModel, num_poses: int, *, rng: np.random.Generator
) -> NDArray[np.float64]:
    name = plugin_name(sampler)
    function = load_plugin(sampler, group=SAMPLERS, noun=_NOUN) if isinstance(sampler, str) else sampler
    owner = f"what {_NOUN} '{name}' returns"
    drawn = call_plugin(function, name, _NOUN, model, num_poses, rng=rng)
    try:
        values = np.asarray(drawn, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{owner} is {type(drawn).__name__}, expected joint angles [rad]") from error
    if values.shape not in ((num_poses, NUM_JOINTS), (num_poses, NUM_QPOS)):
        raise ArgumentError(
            f"{owner} has shape {values.shape}, expected ({num_poses}, {NUM_JOINTS}) joint angles or "
            f"({num_poses}, {NUM_QPOS}) whole poses"
        )
    check_array(owner, values, values.shape)
    widest = np.abs(values[:, -NUM_JOINTS:]).max()
    if widest > _WIDEST:
        raise ArgumentError(f"{owner} holds an angle of {widest:.4g} rad; are these degrees?")
    return values if values.shape[1] == NUM_JOINTS else _unit_wrists(owner, values)


def _unit_wrists(owner: str, qpos: NDArray[np.float64]) -> NDArray[np.float64]:
    """Whole poses with quaternions of length one."""
    lengths = np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    if lengths.min() < 1e-6:
        raise ArgumentError(f"{owner} holds a quaternion of zeros (numbers 3 to 6, wxyz), expected length 1")
    farthest = np.abs(qpos[:, :3]).max()
    if farthest > _FARTHEST:
        raise ArgumentError(f"{owner} holds a wrist {farthest:.4g} m away; are these millimeters?")
    return np.concatenate([qpos[:, :3], qpos[:, 3:7] / lengths, qpos[:, 7:]], axis=1)
