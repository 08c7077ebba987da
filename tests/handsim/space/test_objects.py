"""Things to hold: closed, of the right size, markers on their skin, and bad meshes told in a sentence."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from handsim import RigidObject
from handsim.errors import ArgumentError, ObjectError
from handsim.hand.model import BodyMotion
from handsim.space.objects import MARKER_RADIUS, load_object, named_object, object_names
from tests.meshes import winding
from tests.sentences import error_names


def mesh_of(obj: RigidObject) -> trimesh.Trimesh:
    return trimesh.Trimesh(obj.vertices, obj.faces, process=False)


def solids_of(obj: RigidObject) -> list[trimesh.Trimesh]:
    return list(mesh_of(obj).split(only_watertight=False))


def distance_outside(obj: RigidObject, points: np.ndarray) -> np.ndarray:
    """Signed distance to the union of an object's closed meshes, positive outside."""
    signed = []
    for solid in solids_of(obj):
        distance = trimesh.proximity.closest_point_naive(solid, points)[1]
        signed.append(np.where(winding(solid, points) > 0.5, -distance, distance))
    return np.min(signed, axis=0)


@pytest.mark.parametrize("name", object_names())
def test_surfaces_are_closed_and_small(name):
    obj = named_object(name)
    assert len(obj.faces) <= 1500
    for solid in solids_of(obj):
        assert solid.is_watertight
        assert solid.volume > 0.0
    extents = np.ptp(obj.vertices, axis=0)
    assert 0.05 < extents.max() < 0.2


@pytest.mark.parametrize("name", object_names())
def test_what_fingers_touch_is_what_cameras_see(name):
    """Points are inside a part when they are inside the mesh, but for facets and a cup's hollow."""
    import mujoco

    obj = named_object(name)
    spec = mujoco.MjSpec()
    kinds = {kind: getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}") for kind in ("sphere", "capsule", "box")}
    kinds |= {"cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER, "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID}
    for part in obj.parts:
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, part.T_object_part[:3, :3].ravel())
        spec.worldbody.add_geom(
            type=kinds[part.kind], size=part.size, pos=part.T_object_part[:3, 3], quat=quaternion
        )
    probe = spec.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-5, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    points = np.random.default_rng(0).uniform(
        obj.vertices.min(0) - 0.01, obj.vertices.max(0) + 0.01, (150, 3)
    )
    gaps = np.empty(len(points))
    for number, point in enumerate(points):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        last = model.ngeom - 1
        gaps[number] = min(mujoco.mj_geomDistance(model, data, g, last, 1.0, None) for g in range(last))
    outside = distance_outside(obj, points)
    beyond = (gaps > 0.0) if name == "mug" else np.ones(len(points), dtype=bool)
    near = beyond & (np.abs(gaps) < 0.03)
    # A mesh of few triangles lies inside the round part by its sagitta, at most 0.8 mm here.
    assert ((gaps > 0.001) <= (outside > 0.0))[near].all()
    assert ((outside > 0.001) <= (gaps > -0.0001))[near].all()


@pytest.mark.parametrize("name", object_names())
def test_markers_lie_a_radius_above_the_surface(name):
    obj = named_object(name)
    np.testing.assert_allclose(distance_outside(obj, obj.markers), MARKER_RADIUS, atol=0.0005)
    np.testing.assert_allclose(np.linalg.norm(obj.marker_normals, axis=1), 1.0)
    feet = obj.markers - MARKER_RADIUS * obj.marker_normals
    assert (np.abs(distance_outside(obj, feet)) < 0.0005).all(), "normals must point out of the surface"
    apart = np.linalg.norm(obj.markers[:, None] - obj.markers, axis=-1)
    assert (apart[np.triu_indices(len(apart), 1)] > 4 * MARKER_RADIUS).all()


@pytest.mark.parametrize("name", object_names())
def test_rigid_bodies_cannot_be_mistaken_for_themselves_turned(name):
    """The distances between three or more markers are all told apart by 2 mm at some marker."""
    obj = named_object(name)
    if len(obj.markers) < 3:
        return
    apart = np.sort(np.linalg.norm(obj.markers[:, None] - obj.markers, axis=-1), axis=1)
    differs = np.abs(apart[:, None] - apart).max(axis=-1)
    assert differs[np.triu_indices(len(apart), 1)].min() > 0.002


def test_the_pen_has_one_marker_at_its_tip():
    pen = named_object("pen")
    assert pen.marker_names == ("pen_tip",)
    assert pen.markers[0, 2] < pen.vertices[:, 2].min()
    width = np.ptp(pen.vertices, axis=0)
    assert 0.011 < width[0] < 0.015
    assert 0.13 < width[2] < 0.15


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb"])
def test_a_mesh_of_ones_own(tmp_path, suffix):
    mesh = trimesh.creation.torus(0.03, 0.01, major_sections=24, minor_sections=12)
    path = tmp_path / f"ring.{suffix}"
    mesh.export(path)
    obj = load_object(path, mass=0.2)
    assert obj.name == f"ring.{suffix}"
    assert mesh_of(obj).is_watertight
    np.testing.assert_allclose(mesh_of(obj).volume, mesh.volume, rtol=1e-4)
    assert len(obj.markers) == 0
    assert len(obj.parts) == 1
    np.testing.assert_allclose(
        np.ptp(obj.parts[0].vertices, axis=0), np.ptp(mesh.vertices, axis=0), rtol=1e-4
    )


def test_bad_meshes_are_told_in_a_sentence(tmp_path):
    box = trimesh.creation.box(extents=[0.05, 0.05, 0.05])
    holed = trimesh.Trimesh(box.vertices, box.faces[:-1], process=False)
    holed.export(tmp_path / "holed.stl")
    box.copy().apply_scale(1000.0).export(tmp_path / "large.ply")
    box.copy().apply_scale(1e-3).export(tmp_path / "tiny.ply")
    (tmp_path / "empty.obj").write_text("# nothing\n")
    text = "v 0 0 0\nv nan 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"
    (tmp_path / "nan.obj").write_text(text)
    (tmp_path / "noise.glb").write_bytes(b"\x00\x01 noise")
    (tmp_path / "box.step").write_text("")
    for name, message in {
        "holed.stl": "the mesh is not watertight",
        "large.ply": "is 50 m large, expected at most 1 m; is it in millimeters",
        "tiny.ply": "expected at least 2 mm",
        "empty.obj": "empty|not a readable",
        "nan.obj": "NaN or infinite",
        "noise.glb": "not a readable",
        "box.step": "expected a mesh file that ends in .stl, .obj, .ply, .glb",
        "missing.stl": "no such file",
    }.items():
        with pytest.raises(ObjectError, match=message) as caught:
            load_object(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_unknown_names_are_told():
    with error_names(ArgumentError, "unknown object 'penn' (did you mean 'pen'?); valid names: pen,"):
        named_object("penn")


def test_bad_body_motions_are_told():
    with pytest.raises(ArgumentError, match="a motion needs frames"):
        BodyMotion(np.zeros((0, 4, 4)), 120.0)
    with pytest.raises(ArgumentError, match=r"the rate \[Hz\] is 0"):
        BodyMotion(np.eye(4)[None], 0.0)
    with pytest.raises(ArgumentError, match="is not rigid transforms"):
        BodyMotion(2 * np.eye(4)[None], 120.0)
    assert BodyMotion(np.tile(np.eye(4), (121, 1, 1)), 120.0).duration == pytest.approx(1.0)
