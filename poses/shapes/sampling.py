"""Random valid poses of one hand, from our sampler of joint angles or from the user's own."""

from __future__ import annotations

import functools
from typing import Final, Protocol

import numpy as np
from jaxtyping import Float

from handsim._checks import check_array
from handsim._plugins import call_plugin, load_plugin
from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.topology import NUM_JOINTS
from poses.shapes.samplers import sample_angles
from poses.shapes.validity import make_valid

SAMPLERS: Final = "handsim.pose_samplers"
"""Group of entry points of pose samplers."""
_NOUN: Final = "pose sampler"


class PoseSampler(Protocol):
    """Draws joint angles for one hand; any function with this signature is one."""

    def __call__(
        self, model: HandModel, num_poses: int, *, rng: np.random.Generator
    ) -> Float[np.ndarray, "T 20"]:
        """Draw poses, which need not be valid.

        Args:
            model: The hand.
            num_poses: Number of poses, T.
            rng: Source of all randomness.

        Returns:
            Joint angles [rad], in the order of `handsim.hand.topology.JOINTS`.
        """


def mixed_angles(model: HandModel, num_poses: int, *, rng: np.random.Generator) -> Float[np.ndarray, "T 20"]:
    """The sampler that training sets use: gestures, finger curls and uniform angles in the default mix.

    Args:
        model: The hand; these angles are the same for every hand.
        num_poses: Number of poses, T.
        rng: Source of all randomness.

    Returns:
        Joint angles [rad], inside ranges and couplings; digits may still touch.
    """
    return sample_angles(num_poses, rng=rng)


def sample_poses(
    model: HandModel, num_poses: int, sampler: PoseSampler = mixed_angles, *, rng: np.random.Generator
) -> Float[np.ndarray, "T 27"]:
    """Random valid poses of one hand, with the wrist at the origin.

    Poses that leave a range or penetrate the hand deeper than 1 mm are moved towards rest until they are
    valid.

    Args:
        model: The hand.
        num_poses: Number of poses, T.
        sampler: Draws the joint angles; by default a mix of gestures, finger curls and uniform angles.
        rng: Source of all randomness.

    Returns:
        Wrist position [m], wrist orientation (wxyz) and joint angles [rad] of every pose.

    Raises:
        ArgumentError: `num_poses` is not positive, or the sampler returned another shape or numbers that are
            not finite.
        PoseError: This hand has no valid pose at rest: its fingers are too thick for its breadth.
    """
    if num_poses < 1:
        raise ArgumentError(f"num_poses is {num_poses}, expected a positive number")
    angles = check_array("the sampler's angles", sampler(model, num_poses, rng=rng), (num_poses, NUM_JOINTS))
    return join_qpos(make_valid(model, angles))


@functools.lru_cache(maxsize=8)
def load_sampler(name: str) -> PoseSampler:
    """A user's sampler by `module:name` or by its entry point; what it returns is checked.

    Args:
        name: A function like `PoseSampler`, or a class whose instances are; entry points are of the group
            `handsim.pose_samplers`.

    Returns:
        A sampler of finite joint angles (T, 20) [rad].

    Raises:
        ArgumentError: There is none of that name, it does not take a sampler's arguments, or what it returns
            for two poses of a hand of size M has another shape or is not finite.
        HandSimError: It raised an error.
    """
    sampler: PoseSampler = functools.partial(_drawn, name)
    sampler(HandModel.named("M"), 2, rng=np.random.default_rng(0))
    return sampler


def _drawn(
    name: str, model: HandModel, num_poses: int, *, rng: np.random.Generator
) -> Float[np.ndarray, "T 20"]:
    sampler = load_plugin(name, group=SAMPLERS, noun=_NOUN)
    drawn = call_plugin(sampler, name, _NOUN, model, num_poses, rng=rng)
    owner = f"what {_NOUN} '{name}' returns"
    try:
        angles = np.asarray(drawn, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{owner} is {type(drawn).__name__}, expected joint angles [rad]") from error
    if angles.shape != (num_poses, NUM_JOINTS):
        raise ArgumentError(f"{owner} has shape {angles.shape}, expected ({num_poses}, {NUM_JOINTS})")
    return check_array(owner, angles, (num_poses, NUM_JOINTS))
