"""The lamps of a picture in a pyrender scene, with shadows that suit a hand."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from render.scenery.lights import Lighting

_DISTANCE: Final = 300.0  # [m], so far that a lamp's rays are as good as parallel
_SHADOW_DEPTH: Final = 60.0  # [scene diagonals]


def add_lights(
    pyrender: Any,
    scene: Any,
    lighting: Lighting,
    T_world_camera: Float[np.ndarray, "4 4"],
    extent: float | None = None,
) -> None:
    """Light a pyrender scene that holds its meshes already.

    Args:
        pyrender: The module.
        scene: The scene; its ambient light is replaced.
        lighting: What to add.
        T_world_camera: Pose of the camera whose axes the lamps' directions are in.
        extent: How large the meshes are together, corner to corner [m]; measured unless given.
    """
    rotation = T_world_camera[:3, :3]
    scene.ambient_light = np.array(lighting.ambient)
    for number, lamp in enumerate(lighting.lamps):
        towards = rotation @ (np.array(lamp.direction) / np.linalg.norm(lamp.direction))
        pose = np.eye(4)
        color, intensity = np.array(lamp.color), np.pi * lamp.strength
        if number == 0:
            pose[:3, :3] = frame_with_z(towards)
            light = pyrender.DirectionalLight(color=color, intensity=intensity)
            _cast_shadows(pyrender, light, float(scene.scale) if extent is None else extent)
        else:
            pose[:3, 3] = T_world_camera[:3, 3] + towards * _DISTANCE
            light = pyrender.PointLight(color=color, intensity=intensity * _DISTANCE**2)
        scene.add(light, pose=pose)


def _cast_shadows(pyrender: Any, light: Any, extent: float) -> None:
    # pyrender's shadow bias is a fixed share of this camera's depth, too little for skin; depth adds bias.
    # Its light stands one scene diagonal away from the middle, so half a diagonal takes in everything.
    diagonal = max(extent, 1e-3)  # an empty scene has none
    light._get_shadow_camera = lambda _: pyrender.OrthographicCamera(
        xmag=0.52 * diagonal, ymag=0.52 * diagonal, znear=0.3 * diagonal, zfar=_SHADOW_DEPTH * diagonal
    )


def frame_with_z(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Any rotation whose z axis is `direction`."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
