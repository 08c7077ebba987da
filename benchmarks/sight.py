"""How right lines of sight past the skin are, and what each rig sees.

    python -m benchmarks.sight [--poses 500 --seed 0]

One hand with the dense19 glove, random valid poses, turns and places, hands of random people. The reference
for every line is embree (through trimesh, package embreex) on the same meshes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh

from benchmarks.record import Figures, describe, report, run
from gloves import load_layout
from gloves.fit import attach_markers
from gloves.optics.visibility import MAX_FACING, clear_of_mesh, hand_tree
from handsim import CameraRig, HandModel, join_qpos, load_rig, sample_shape
from handsim.hand.shape import Side
from handsim.space.rig import list_rigs
from handsim.space.transforms import random_quaternions
from poses.shapes import sample_valid_angles

CENTER = np.array([0.0, 0.0, 1.1])
POSES_A_HAND = 50


class Scene(NamedTuple):
    """One gloved hand in random poses."""

    model: HandModel
    skin: np.ndarray
    markers: np.ndarray
    normals: np.ndarray


def make_scene(model: HandModel, poses: int, center: np.ndarray, rng: np.random.Generator) -> Scene:
    qpos = join_qpos(
        sample_valid_angles(model, poses, rng=rng),
        position=center + rng.uniform(-0.3, 0.3, size=(poses, 3)),
        quaternion=random_quaternions(poses, rng=rng),
    )
    bones = model.forward_kinematics(qpos)
    markers, normals = attach_markers(load_layout("dense19"), model).markers(model, bones)
    return Scene(model, model.skin(qpos), markers, normals)


def in_view_and_facing(markers: np.ndarray, normals: np.ndarray, rig: CameraRig) -> np.ndarray:
    to_camera = rig.positions - markers[:, :, None]
    ahead = np.einsum("tmci,tmi->tmc", to_camera, normals)
    return rig.in_view(markers) & (ahead > np.cos(MAX_FACING) * np.linalg.norm(to_camera, axis=-1))


def embree_clear(scene: Scene, cameras: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    clear = np.zeros_like(wanted)
    for frame in range(len(wanted)):
        mesh = trimesh.Trimesh(scene.skin[frame], scene.model.surface.faces, process=False)
        marker, camera = np.nonzero(wanted[frame])
        starts = scene.markers[frame, marker]
        clear[frame, marker, camera] = ~mesh.ray.intersects_any(starts, cameras[camera] - starts)
    return clear


def agreement(poses: int, rng: np.random.Generator) -> Figures:
    rig, sides = load_rig("figure5"), ("right", "left")
    count = alike = 0
    for number in range(poses // POSES_A_HAND):
        side: Side = sides[number % 2]  # type: ignore[assignment]
        scene = make_scene(HandModel(sample_shape(side=side, rng=rng)), POSES_A_HAND, CENTER, rng)
        everything = np.ones((*scene.markers.shape[:2], len(rig.positions)), dtype=bool)
        clear = clear_of_mesh(hand_tree(), scene.skin, scene.markers, rig.positions, everything)
        alike += int((clear == embree_clear(scene, rig.positions, everything)).sum())
        count += clear.size
    return {
        "all": ("lines of sight past the skin, facing or not", count),
        "lines": ("lines of sight that agree with embree", alike),
    }


def rigs(poses: int, rng: np.random.Generator) -> None:
    scene = make_scene(HandModel.named("M"), poses, CENTER, rng)
    cube = CENTER + rng.uniform(-0.3, 0.3, size=(100_000, 3))
    print("\nrigs: cube of half side 0.3 m in >= 2, >= 3 views; markers seen by >= 2, >= 3; cameras a marker")
    for name in list_rigs():
        rig = load_rig(name)
        views = rig.in_view(cube).sum(axis=-1)
        wanted = in_view_and_facing(scene.markers, scene.normals, rig)
        seen = clear_of_mesh(hand_tree(), scene.skin, scene.markers, rig.positions, wanted).sum(axis=-1)
        print(f"  {name:8s} {(views >= 2).mean():.2%} {(views >= 3).mean():.2%}; "
              f"{(seen >= 2).mean():.1%} {(seen >= 3).mean():.1%}; {seen.mean():.2f}")  # fmt: skip


def main(poses: int = 500, seed: int = 0, save: str | None = None) -> None:
    print(describe("numba", "trimesh", "embreex"))
    rng = np.random.default_rng(seed)
    report(save, agreement(poses, rng))
    rigs(4 * poses, rng)


if __name__ == "__main__":
    run(main, __doc__)
