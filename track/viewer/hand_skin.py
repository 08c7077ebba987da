"""A hand's skin in the page: sent once, and moved by its bones' poses from then on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.model import HandModel
from handsim.hand.shape import NUM_QPOS
from handsim.space.transforms import rotation_quaternions

if TYPE_CHECKING:
    from viser import MeshSkinnedHandle, ViserServer

    from handsim.hand.shape import Side


SKIN_COLORS: Final[dict[Side, tuple[int, int, int]]] = {"right": (214, 170, 140), "left": (150, 172, 200)}
"""A right and a left hand look different."""


class HandSkin:
    """The skin of one hand; the mesh stands in the wrist's frame, its bones in that mesh.

    So a hand that moves as a whole sends two small messages, and a bone that keeps its place none.

    Args:
        name: Of the node in the scene.
        color: Of the skin, 0 to 255; that of the hand's side when None.
        opacity: Less than 1 for skin that one sees through.
    """

    def __init__(
        self,
        server: ViserServer,
        name: str,
        *,
        color: tuple[int, int, int] | None = None,
        opacity: float | None = None,
    ) -> None:
        self._server, self._name, self._color, self._opacity = server, name, color, opacity
        self._model: HandModel | None = None
        self.mesh: MeshSkinnedHandle | None = None
        """The mesh in the page, once there is a hand."""

    def show(self, model: HandModel, qpos: Float[np.ndarray, "27"]) -> None:
        """Show a pose.

        Args:
            model: The hand; another one than before is sent anew.
            qpos: Wrist position [m], wrist orientation (wxyz), joint angles [rad]; hidden where NaN.
        """
        if not np.isfinite(qpos).all():
            if self.mesh is not None and self.mesh.visible:
                self.mesh.visible = False
            return
        if self.mesh is None or model is not self._model:
            self.mesh, self._model = self._send(model), model
        local = np.zeros((1, NUM_QPOS))
        local[0, 3], local[0, 7:] = 1.0, qpos[7:]
        positions, quaternions = _poses(model.forward_kinematics(local)[0])
        for bone, position, quaternion in zip(self.mesh.bones, positions, quaternions, strict=True):
            bone.position, bone.wxyz = position, quaternion
        self.mesh.position = qpos[:3]
        self.mesh.wxyz = qpos[3:7] / np.linalg.norm(qpos[3:7])
        if not self.mesh.visible:
            self.mesh.visible = True

    def _send(self, model: HandModel) -> MeshSkinnedHandle:
        surface = model.surface
        weights = np.zeros((len(surface.vertices), len(model.rest_transforms)))
        np.add.at(
            weights, (np.arange(len(weights))[:, None], surface.bone_indices), surface.bone_weights
        )  # at most four bones move a vertex, which is also the page's limit
        positions, quaternions = _poses(model.rest_transforms)
        return self._server.scene.add_mesh_skinned(
            self._name,
            surface.vertices,
            surface.faces,
            bone_wxyzs=quaternions,
            bone_positions=positions,
            skin_weights=weights,
            color=self._color or SKIN_COLORS[model.shape.side],
            opacity=self._opacity,
        )


def _poses(transforms: Float[np.ndarray, "L 4 4"]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions (L, 3) and quaternions (L, 4), wxyz."""
    return transforms[:, :3, 3], rotation_quaternions(transforms[:, :3, :3])
