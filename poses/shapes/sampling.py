"""Random valid poses of one hand, from our sampler of joint angles or from the user's own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from handsim._checks import check_array
from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.topology import NUM_JOINTS
from poses.shapes.samplers import sample_angles
from poses.shapes.validity import make_valid

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float


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
