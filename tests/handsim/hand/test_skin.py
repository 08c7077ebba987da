from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from handsim import HandModel, HandShape, join_qpos, sample_shape
from handsim.hand.model import build_skeleton
from handsim.hand.shape import (
    ADULTS,
    BONES,
    DIGITS,
    EVERYBODY,
    JOINTS,
    NUM_BONES,
    NUM_JOINTS,
    SIZES,
    named_shape,
    shape_from_measures,
)
from handsim.hand.skin import (
    HandSurface,
    build_surface,
    catmull_clark,
    edge_table,
    load_cage,
    rest_vertices,
    skin_frames,
    strongest_weights,
    vertex_normals,
)
from handsim.space.transforms import axis_angle_matrix, euler_matrix, random_quaternions
from tests.meshes import blend_skin, winding

CUBE = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
FIST = [[20, 25, 40, 50]] + [[0, 90, 105, 65]] * 4
SPREAD = [[30, -30, -10, -10], [20, 0, 0, 0], [0, 0, 0, 0], [-14, 0, 0, 0], [-30, 0, 0, 0]]
OPPOSITION = [[10, 35, 35, 35], [0, 45, 45, 20], [0, 40, 45, 25], [-5, 30, 40, 20], [-10, 65, 50, 30]]
EXTREME_SHAPES = [
    *(named_shape(size) for size in SIZES),
    shape_from_measures(0.112, 0.054),
    *(sample_shape(EVERYBODY, rng=np.random.default_rng(seed)) for seed in range(12)),
]


def test_first_step_on_a_cube_has_the_known_points():
    matrix, quads = catmull_clark(CUBE, 8)
    points = matrix @ CORNERS
    assert quads.shape == (24, 4) and points.shape == (8 + 12 + 6, 3)
    assert_allclose(np.abs(points[:8]), 5.0 / 9.0)  # corner: (F + 2 R) / 3 with F = 1/3 and R = 2/3
    assert_allclose(np.sort(np.abs(points[8:20]), axis=1), np.tile([0.0, 0.75, 0.75], (12, 1)))
    assert_allclose(np.sort(np.abs(points[20:]), axis=1), np.tile([0.0, 0.0, 1.0], (6, 1)))


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_mesh_stays_closed_and_weights_are_averages(levels):
    quads, count = CUBE, 8
    for _ in range(levels):
        matrix, quads = catmull_clark(quads, count)
        count = matrix.shape[0]
        assert_allclose(matrix.sum(axis=1), 1.0)
        assert matrix.min() >= 0.0
    edges, _ = edge_table(quads)
    assert count - len(edges) + len(quads) == 2  # Euler: one sphere
    directed = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)  # every edge once in each direction


def test_affine_maps_commute_with_subdivision():
    rng = np.random.default_rng(3)
    matrix, _ = catmull_clark(CUBE, 8)
    linear, shift = rng.standard_normal((3, 3)), rng.standard_normal(3)
    assert_allclose(matrix @ (CORNERS @ linear + shift), (matrix @ CORNERS) @ linear + shift, atol=1e-12)


def forward(shape: HandShape, degrees: list[list[float]]) -> np.ndarray:
    """Bones (16, 4, 4) in the wrist frame: the local rest, then the bone's hinges in order."""
    skeleton, angles = build_skeleton(shape), np.deg2rad(np.ravel(degrees))
    transforms = np.tile(np.eye(4), (NUM_BONES, 1, 1))
    for number, bone in enumerate(BONES):
        if bone.parent < 0:
            continue
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = skeleton.rotations[number], skeleton.offsets[number]
        for place, joint in enumerate(JOINTS):
            if joint.bone == number:
                local[:3, :3] = local[:3, :3] @ axis_angle_matrix(skeleton.axes[place], angles[place])
        transforms[number] = transforms[bone.parent] @ local
    return transforms


def rest(shape: HandShape) -> np.ndarray:
    return build_skeleton(shape).rest_transforms()


def posed(shape: HandShape, degrees: list[list[float]]) -> np.ndarray:
    skin = build_surface(shape)
    bones = forward(shape, degrees)[None]
    return skin_frames(skin.vertices, skin.bone_indices, skin.bone_weights, rest(shape), bones)[0]


def digit_faces(skin: HandSurface, digit: int) -> np.ndarray:
    """Faces that mostly follow one digit's bones."""
    first = 1 + 3 * digit
    mine = (skin.bone_indices >= first) & (skin.bone_indices < first + 3)
    return skin.faces[((skin.bone_weights * mine).sum(axis=1) > 0.6)[skin.faces].all(axis=1)]


def outline(vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Distance [m] of the outermost skin from `origin` in 72 directions in a plane."""
    section = trimesh.Trimesh(vertices, faces, process=False).section(
        plane_origin=origin, plane_normal=normal
    )
    across = np.linalg.svd(normal[None])[2][1:]
    ends = (section.vertices[np.concatenate([e.nodes for e in section.entities])] - origin) @ across.T
    along = np.linspace(0.0, 1.0, 20)[:, None, None]
    points = ((1.0 - along) * ends[:, 0] + along * ends[:, 1]).reshape(-1, 2)
    points = points[np.linalg.norm(points, axis=1) < 0.03]
    bins = (np.floor(np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) * 72) % 72).astype(int)
    radii = np.zeros(72)
    np.maximum.at(radii, bins, np.linalg.norm(points, axis=1))
    return radii


def mean_radius(vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, normal: np.ndarray) -> float:
    """Girth over 2 pi [m]."""
    radii, angles = outline(vertices, faces, origin, normal), np.arange(72) * (2 * np.pi / 72)
    points = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return float(np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum() / (2 * np.pi))


@pytest.mark.parametrize("shape", EXTREME_SHAPES)
def test_watertight_single_body_of_a_hands_volume(shape):
    skin = build_surface(shape)
    mesh = trimesh.Trimesh(skin.vertices, skin.faces, process=False)
    assert 3000 <= len(skin.vertices) <= 6000
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.body_count == 1 and mesh.euler_number == 2
    # A hand displaces about a quarter to a half of the box of its length, breadth and thickness.
    box = shape.length * shape.breadth * shape.palm_thickness
    assert 0.6 * box < mesh.volume < 1.2 * box
    areas = np.linalg.norm(np.cross(*np.diff(skin.vertices[skin.faces], axis=1).transpose(1, 0, 2)), axis=1)
    assert areas.min() > 0.0


def test_faces_and_weights_are_shared_by_all_shapes():
    first, second = build_surface(EXTREME_SHAPES[0]), build_surface(EXTREME_SHAPES[-1])
    assert_array_equal(first.faces, second.faces)
    assert_array_equal(first.bone_indices, second.bone_indices)
    assert_array_equal(first.bone_weights, second.bone_weights)


@pytest.mark.parametrize("size", ["S", "M"])
def test_weights_are_a_partition_of_one_and_end_at_the_first_zero(size):
    skin = build_surface(named_shape(size))
    assert skin.bone_indices.shape == skin.bone_weights.shape == (len(skin.vertices), 4)
    assert skin.bone_weights.min() >= 0.0
    assert_allclose(skin.bone_weights.sum(axis=1), 1.0, atol=1e-12)
    assert (np.sort(skin.bone_indices, axis=1)[:, 1:] > np.sort(skin.bone_indices, axis=1)[:, :-1]).all()
    assert 0 <= skin.bone_indices.min() and skin.bone_indices.max() < NUM_BONES
    ended = np.cumsum(skin.bone_weights == 0.0, axis=1) > 0  # where the compiled loop ends a vertex's list
    assert ended.any() and (skin.bone_weights[ended] == 0.0).all()


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_left_hand_is_the_exact_mirror_image(seed):
    shape = sample_shape(ADULTS, rng=np.random.default_rng(seed))
    right, left = build_surface(shape), build_surface(shape.with_side("left"))
    assert_array_equal(left.vertices, right.vertices * [1.0, -1.0, 1.0])
    assert_array_equal(left.faces, right.faces[:, ::-1])
    assert_allclose(posed(shape.with_side("left"), FIST), posed(shape, FIST) * [1.0, -1.0, 1.0], atol=1e-12)


def test_skin_scales_with_the_hand():
    small, large = (
        build_surface(shape_from_measures(0.187 * scale, 0.083 * scale)).vertices for scale in (0.7, 1.0)
    )
    assert_allclose(small, 0.7 * large, atol=1e-9)


@pytest.mark.parametrize("shape", EXTREME_SHAPES)
@pytest.mark.parametrize("digit", range(5))
def test_girths_agree_with_the_shape(shape, digit):
    skin, first = build_surface(shape), rest(shape)[1 + 3 * digit]
    faces = digit_faces(skin, digit)
    lengths, radii = shape.bone_lengths[digit], shape.radii[digit]
    joints = np.array([0.0, lengths[0], lengths[0] + lengths[1], lengths.sum() - radii[3]])
    for place, tolerance in ((joints[1], 0.05), (joints[1:3].mean(), 0.05), (joints[2], 0.06)):
        measured = mean_radius(skin.vertices, faces, first[:3, 3] + place * first[:3, 0], first[:3, 0])
        assert measured == pytest.approx(np.interp(place, joints, radii), rel=tolerance), DIGITS[digit]


@pytest.mark.parametrize("shape", EXTREME_SHAPES)
def test_fingertips_reach_the_bones_ends(shape):
    skin, transforms = build_surface(shape), rest(shape)
    for digit in range(5):
        mine = np.unique(digit_faces(skin, digit))
        reach = (skin.vertices[mine] - transforms[1 + 3 * digit, :3, 3]) @ transforms[1 + 3 * digit, :3, 0]
        assert reach.max() == pytest.approx(shape.bone_lengths[digit].sum(), abs=2e-4)


@pytest.mark.parametrize("shape", EXTREME_SHAPES)
def test_palm_has_the_shapes_breadth_and_thickness(shape):
    skin = build_surface(shape)
    on_thumb = (skin.bone_weights * np.isin(skin.bone_indices, (1, 2, 3))).sum(axis=1)
    x, y, z = skin.vertices.T
    middle = shape.knuckles[2]
    heads = (on_thumb < 0.02) & (x > 0.8 * middle[0]) & (x < middle[0])
    assert np.ptp(y[heads]) == pytest.approx(shape.breadth, rel=0.08)
    ray = (np.abs(y - 0.75 * middle[1]) < 0.002) & (x > 0.65 * middle[0]) & (x < 0.85 * middle[0])
    thickness = z[ray & (z > 0)].mean() - z[ray & (z < 0)].mean()
    assert thickness == pytest.approx(shape.palm_thickness, rel=0.08)


def test_webs_lie_near_the_middle_of_the_first_phalanx():
    shape = named_shape("M")
    skin, transforms = build_surface(shape), rest(shape)
    mesh = trimesh.Trimesh(skin.vertices, skin.faces, process=False)
    for digit in range(1, 4):
        first, second = transforms[1 + 3 * digit], transforms[4 + 3 * digit]
        places = np.linspace(0.2, 0.9, 71)
        lengths = shape.bone_lengths[[digit, digit + 1], 0]
        between = 0.5 * (
            first[:3, 3] + places[:, None] * lengths[0] * first[:3, 0]
            + second[:3, 3] + places[:, None] * lengths[1] * second[:3, 0]
        )  # fmt: skip
        crotch = places[np.argmin(winding(mesh, between) > 0.5)]
        assert 0.4 < crotch < 0.6, DIGITS[digit]


@pytest.mark.parametrize("size", ["XS", "M", "XL"])
@pytest.mark.parametrize("pose", [FIST, SPREAD, OPPOSITION], ids=["fist", "spread", "opposition"])
def test_posed_digits_keep_their_sections(size, pose):
    shape = named_shape(size)
    skin, before, after = build_surface(shape), rest(shape), forward(shape, pose)
    moved = posed(shape, pose)
    for digit in range(5):
        faces = digit_faces(skin, digit)

        def section_area(vertices, transform, along, normal, faces=faces):
            radii = outline(vertices, faces, transform[:3, 3] + along * transform[:3, 0], normal)
            return (radii**2).sum()

        for bone in (2 + 3 * digit, 3 + 3 * digit):
            bisectors = [t[bone, :3, 0] + t[bone - 1, :3, 0] for t in (before, after)]
            areas = [
                section_area(v, t[bone], 0.0, n / np.linalg.norm(n))
                for v, t, n in zip((skin.vertices, moved), (before, after), bisectors, strict=True)
            ]
            assert areas[1] > 0.6 * areas[0], BONES[bone].name
        bone = 2 + 3 * digit
        half = shape.bone_lengths[digit, 1] / 2
        areas = [
            section_area(v, t[bone], half, t[bone, :3, 0])
            for v, t in ((skin.vertices, before), (moved, after))
        ]
        assert areas[1] > 0.9 * areas[0], BONES[bone].name


@pytest.mark.parametrize("shape", EXTREME_SHAPES)
@pytest.mark.parametrize("pose", [FIST, SPREAD, OPPOSITION], ids=["fist", "spread", "opposition"])
def test_posed_skin_has_no_spikes_and_few_folds(shape, pose):
    skin, moved = build_surface(shape), posed(shape, pose)

    def normals(vertices):
        return np.cross(*np.diff(vertices[skin.faces], axis=1).transpose(1, 0, 2))

    blended = np.zeros((len(skin.vertices), NUM_BONES))
    np.put_along_axis(blended, skin.bone_indices, skin.bone_weights, axis=1)
    motion = (forward(shape, pose) @ np.linalg.inv(rest(shape)))[:, :3, :3]
    turned = np.einsum("fb,bij,fj->fi", blended[skin.faces].mean(axis=1), motion, normals(skin.vertices))
    assert ((turned * normals(moved)).sum(axis=1) < 0.0).mean() < 0.03

    def edges(vertices):
        return np.linalg.norm(vertices[skin.faces] - vertices[np.roll(skin.faces, 1, axis=1)], axis=-1)

    assert (edges(moved) - edges(skin.vertices)).max() < 0.03 * shape.length
    ratio = trimesh.Trimesh(moved, skin.faces).volume / trimesh.Trimesh(skin.vertices, skin.faces).volume
    assert 0.85 < ratio < 1.1


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_skinning_is_rigid_for_a_rigid_hand_and_takes_batches(seed):
    rng = np.random.default_rng(seed)
    shape = named_shape("L")
    skin, transforms = build_surface(shape), rest(shape)
    moves = np.tile(np.eye(4), (3, 1, 1))
    moves[:, :3, :3] = [euler_matrix(angles) for angles in rng.uniform(-3, 3, (3, 3))]
    moves[:, :3, 3] = rng.standard_normal((3, 3))
    result = skin_frames(
        skin.vertices[:50],
        skin.bone_indices[:50],
        skin.bone_weights[:50],
        transforms,
        moves[:, None] @ transforms,
    )
    wanted = np.einsum("bij,nj->bni", moves[:, :3, :3], skin.vertices[:50]) + moves[:, None, :3, 3]
    assert result.shape == (3, 50, 3)
    assert_allclose(result, wanted, atol=1e-10)


def test_vertex_normals_are_the_area_weighted_means_of_their_faces():
    surface = build_surface(named_shape("M"))
    sums = np.zeros_like(surface.vertices)
    for face in surface.faces:
        a, b, c = surface.vertices[face]
        sums[face] += np.cross(b - a, c - a)  # twice the area along the normal
    expected = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(surface.vertices, surface.faces), expected, atol=1e-9)


def test_many_skins_at_once_are_those_of_each_alone():
    together = rest_vertices(EXTREME_SHAPES)
    for shape, vertices in zip(EXTREME_SHAPES, together, strict=True):
        assert_array_equal(vertices, build_surface(shape.with_side("right")).vertices)


def test_cage_shares_sum_to_one_and_every_bone_moves_something():
    weights = load_cage().weights
    assert weights.shape == (load_cage().quads.max() + 1, NUM_BONES)
    assert weights.min() >= 0.0
    assert_allclose(weights.sum(axis=1), 1.0)
    assert (weights.max(axis=0) > 0.9).all()


def test_strongest_keeps_the_four_largest_in_order():
    weights = np.zeros((2, NUM_BONES))
    weights[0, [3, 5, 7, 9, 11]] = [0.1, 0.4, 0.2, 0.25, 0.05]
    weights[1, 2] = 1.0
    indices, shares = strongest_weights(weights)
    assert indices[0].tolist() == [5, 9, 7, 3]
    assert_allclose(shares[0], np.array([0.4, 0.25, 0.2, 0.1]) / 0.95)
    assert indices[1, 0] == 2
    assert_allclose(shares[1], [1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("side", ["right", "left"])
def test_every_vertex_agrees_with_plain_skinning(side, rng):
    model = HandModel(sample_shape(side=side, rng=rng))
    low, high = model.skeleton.ranges.T
    qpos = join_qpos(
        rng.uniform(low, high, size=(7, NUM_JOINTS)),
        position=rng.uniform(-1.0, 1.0, size=(7, 3)),
        quaternion=random_quaternions(7, rng=rng),
    )
    surface = model.surface
    rest = (surface.vertices, surface.bone_indices, surface.bone_weights, model.rest_transforms)
    plain = blend_skin(*rest, model.forward_kinematics(qpos))
    np.testing.assert_allclose(skin_frames(*rest, model.forward_kinematics(qpos)), plain, atol=1e-14)
    np.testing.assert_array_equal(model.skin(qpos), skin_frames(*rest, model.forward_kinematics(qpos)))


def test_no_frames():
    model = HandModel.named("S")
    assert model.skin(join_qpos(np.zeros((0, NUM_JOINTS)))).shape == (0, len(model.surface.vertices), 3)
