"""What joints make of the skin around them: knuckles where fingers bend, alike on both sides."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.hand.model import HandModel
from handsim.hand.shape import JOINT_NAMES, SIDES, Side
from handsim.hand.skin import vertex_normals
from handsim.space.transforms import MIRROR
from render.skin.flexion import Flexion
from render.skin.mesh import PosableSkin


def rises(side: Side, **degrees: float) -> tuple[PosableSkin, np.ndarray]:
    """How far each vertex at rest moves outwards [m], the ulna's head aside."""
    mesh = PosableSkin(HandModel.named("M", side=side))
    normals = vertex_normals(mesh.rest, mesh.faces)
    flexion = Flexion(mesh.model, mesh.rest, normals, 1.0)
    angles = np.zeros(20)
    for name, angle in degrees.items():
        angles[JOINT_NAMES.index(name)] = np.deg2rad(angle)
    moved = flexion.shaped(mesh.rest, angles) - flexion.shaped(mesh.rest, np.zeros(20))
    return mesh, (moved * normals).sum(axis=1)


def test_no_bones_are_the_models_own_skin() -> None:
    mesh = PosableSkin(HandModel.named("M"))
    flexion = Flexion(mesh.model, mesh.rest, vertex_normals(mesh.rest, mesh.faces), 0.0)
    np.testing.assert_array_equal(flexion.shaped(mesh.rest, np.full(20, 0.5)), mesh.rest)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(("digit", "bone"), [("index", 4), ("middle", 7), ("ring", 10), ("little", 13)])
def test_a_bent_finger_has_a_knuckle(side: Side, digit: str, bone: int) -> None:
    mesh, rise = rises(side, **{f"{digit}_MCP_flexion": 80.0})
    top = mesh.rest[rise.argmax()] - mesh.model.rest_transforms[bone][:3, 3]
    assert 0.0025 < rise.max() < 0.006
    assert np.linalg.norm(top[:2]) < 0.006 and top[2] > 0.006  # over the joint, on the back
    far = np.linalg.norm(mesh.rest - mesh.rest[rise.argmax()], axis=1) > 0.03
    palm = vertex_normals(mesh.rest, mesh.faces)[:, 2] < -0.3
    assert np.abs(rise[far & ~palm]).max() < 0.0025


def test_shapes_grow_with_the_angle_and_never_jump() -> None:
    heights = [rises("right", index_MCP_flexion=angle)[1].max() for angle in np.arange(0.0, 96.0, 4.0)]
    assert (np.diff(heights) > -1e-4).all()
    assert np.abs(np.diff(heights)).max() < 6e-4


def test_both_hands_are_mirror_images(rng: np.random.Generator) -> None:
    angles = rng.uniform(0.0, 1.2, 20)
    right, left = (PosableSkin(HandModel.named("M", side=side), bony=1.3) for side in SIDES[::-1])
    shaped = [one._flexion.shaped(one.rest, angles) for one in (right, left)]
    np.testing.assert_allclose(shaped[1], shaped[0] @ MIRROR, atol=1e-9)


def test_a_spread_hand_shows_tendons_between_wrist_and_knuckles() -> None:
    mesh, rise = rises("right", middle_MCP_flexion=-20.0)
    ridge = mesh.rest[rise > 0.0006]
    assert len(ridge) > 10
    assert (ridge[:, 0] > 0.02).all() and (ridge[:, 0] < 0.11).all() and np.ptp(ridge[:, 1]) < 0.012
