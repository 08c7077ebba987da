"""Rigs that tests hang: of square pinhole cameras, and of cameras as unlike as laboratories mix."""

from __future__ import annotations

import numpy as np

from handsim import Camera, CameraRig, Lens, look_at
from handsim.space.camera import focal_of_angle, pinhole


def square_rig(name, poses, field_of_view=np.pi / 3, resolution=1280) -> CameraRig:
    """A camera at each pose, whose square picture holds the round cone of this angle [rad]."""
    size, focal = (resolution, resolution), focal_of_angle(resolution, field_of_view)
    return CameraRig(name, [pinhole(f"c{n}", size, focal).at(pose) for n, pose in enumerate(poses)])


def mixed_rig() -> CameraRig:
    """Six cameras around (0, 0, 1.1), of three makes: no two pictures and lenses are alike."""
    lenses = (
        Lens(),
        Lens("brown", (-0.2, 0.06, 0.001, -0.002, 0.0)),
        Lens("fisheye", (0.02, -0.006, 0.001, 0.0)),
    )
    cameras = []
    for number in range(6):
        angle, size = number * np.pi / 3, (1280 + 64 * number, 1024 - 32 * number)
        K = np.array([[1100.0 + 20 * number, 0, size[0] / 2 + 12], [0, 1150.0, size[1] / 2 - 9], [0, 0, 1]])
        eye = np.array([2 * np.cos(angle), 2 * np.sin(angle), 2.4 if number % 2 else 1.4])
        pose = look_at(eye, np.array([0.0, 0.0, 1.1]))
        cameras.append(Camera(f"c{number}", size, K, pose, lenses[number % 3]))
    return CameraRig("mixed", cameras)
