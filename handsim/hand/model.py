"""One person's hand, ready to move: skeleton, flesh, skin and the compiled MuJoCo model."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from handsim._checks import check_array, check_type
from handsim.hand.capsules import Capsules, build_capsules
from handsim.hand.contact import penetration_depth
from handsim.hand.mjcf import build_spec
from handsim.hand.shape import SIZES, HandShape, named_shape
from handsim.hand.skeleton import Skeleton, bone_transforms, build_skeleton
from handsim.hand.skin.surface import HandSurface, build_surface, skin_frames
from handsim.hand.topology import NUM_JOINTS, NUM_QPOS, Side

if TYPE_CHECKING:
    import mujoco


class HandModel:
    """A hand of one shape. Everything but the skeleton is built on first use.

    Args:
        shape: The person's hand; its `side` decides which hand this is.
    """

    def __init__(self, shape: HandShape) -> None:
        check_type("shape", shape, HandShape, "a HandShape; HandModel.named takes the name of a size")
        self.shape = shape
        self.skeleton: Skeleton = build_skeleton(shape)

    @classmethod
    def named(cls, size: str, *, side: Side = "right") -> HandModel:
        """Hand of one of the five sizes XS, S, M, L, XL.

        Raises:
            ArgumentError: There is no such size or side.
        """
        return cls(named_shape(size, side=side))

    @cached_property
    def capsules(self) -> Capsules:
        """Flesh for contact and occlusion."""
        return build_capsules(self.shape)

    @cached_property
    def surface(self) -> HandSurface:
        """Skin in the rest pose, with its weights."""
        return build_surface(self.shape)

    @cached_property
    def mj_model(self) -> mujoco.MjModel:
        """Compiled MuJoCo model (nq 27, nv 26)."""
        return build_spec(self.skeleton, self.capsules).compile()

    @cached_property
    def rest_transforms(self) -> Float[np.ndarray, "L 4 4"]:
        """`T_wrist_bone` at zero angles."""
        return self.skeleton.rest_transforms()

    def forward_kinematics(self, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T L 4 4"]:
        """`T_world_bone` of every bone in every frame, with positions in [m].

        Args:
            qpos: Wrist position [m], wrist orientation (wxyz), twenty joint angles [rad].

        Raises:
            ArgumentError: `qpos` is not (T, 27) or not finite.
        """
        values = check_array("qpos", qpos, (None, NUM_QPOS))
        return bone_transforms(self.skeleton, values)

    def skin(self, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T V 3"]:
        """Skin vertices [m] in the world, by linear blend skinning.

        Args:
            qpos: As for `forward_kinematics`.

        Raises:
            ArgumentError: `qpos` is not (T, 27) or not finite.
        """
        surface = self.surface
        return skin_frames(
            surface.vertices,
            surface.bone_indices,
            surface.bone_weights,
            self.rest_transforms,
            self.forward_kinematics(qpos),
        )

    def penetration(self, qpos: Float[np.ndarray, "T 27"]) -> Float[np.ndarray, "T"]:
        """Deepest self-penetration [m] in every frame.

        Args:
            qpos: As for `forward_kinematics`.

        Raises:
            ArgumentError: `qpos` is not (T, 27) or not finite.
        """
        values = check_array("qpos", qpos, (None, NUM_QPOS))
        return penetration_depth(self.capsules, bone_transforms(self.skeleton, values))


def load_model(model: HandModel | HandShape | str) -> HandModel:
    """A hand as it is, of measures, or a right one of size XS, S, M, L or XL; else an `ArgumentError`."""
    if isinstance(model, HandModel):
        return model
    if isinstance(model, HandShape):
        return HandModel(model)
    check_type("model", model, str, "a HandModel, a HandShape or the name of a size", SIZES)
    return HandModel.named(model)


def join_qpos(
    angles: Float[np.ndarray, "T 20"],
    *,
    position: Float[np.ndarray, "*T 3"] | None = None,
    quaternion: Float[np.ndarray, "*T 4"] | None = None,
) -> Float[np.ndarray, "T 27"]:
    """Full qpos of joint angles, with the wrist at the origin by default.

    Args:
        angles: Joint angles [rad], in the order of `topology.JOINTS`.
        position: Wrist position in the world [m], one per frame or one for all.
        quaternion: Wrist orientation in the world (wxyz), one per frame or one for all.

    Returns:
        MuJoCo's qpos, which is wrist position [m], wrist orientation (wxyz) and joint angles [rad].

    Raises:
        ArgumentError: `angles` is not (T, 20) or not finite.
    """
    angles = check_array("angles", angles, (None, NUM_JOINTS))
    qpos = np.zeros((len(angles), NUM_QPOS))
    qpos[:, :3] = 0.0 if position is None else position
    qpos[:, 3:7] = (1.0, 0.0, 0.0, 0.0) if quaternion is None else quaternion
    qpos[:, 7:] = angles
    return qpos
