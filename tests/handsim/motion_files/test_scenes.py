"""A reader of its own reads the .glb: chunks, accessors, samplers, nodes and skins as glTF states them."""

from __future__ import annotations

import json
import struct
import sys

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from gloves import RigidBody, Take, attach, load_layout
from gloves.takes.take import posed_motion
from handsim import HandModel, HandSimError, join_qpos
from handsim.motion_files.motion import write_bvh
from handsim.motion_files.scenes import write_glb, write_usd
from handsim.space.transforms import quaternion_matrix

TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Our axes to glTF's: z up to y up."""


class Glb:
    def __init__(self, path):
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON" and size % 4 == 0
        self.json = json.loads(data[20 : 20 + size])
        binary, kind = struct.unpack_from("<I4s", data, 20 + size)
        assert kind == b"BIN\0" and 28 + size + binary == length
        self.binary = data[28 + size :]

    def array(self, index):
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        width = WIDTHS[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        values = np.frombuffer(
            self.binary, TYPES[accessor["componentType"]], accessor["count"] * width, view["byteOffset"]
        ).reshape(-1, width)
        assert values.nbytes == view["byteLength"]
        if "min" in accessor:
            np.testing.assert_array_equal(values.min(axis=0), np.float32(accessor["min"]))
            np.testing.assert_array_equal(values.max(axis=0), np.float32(accessor["max"]))
        return values.astype(float) if values.dtype.kind == "f" else values.astype(int)

    def named(self, name):
        (number,) = (n for n, node in enumerate(self.json["nodes"]) if node["name"] == name)
        return number

    def locals(self, time):
        """Local transforms of all nodes at a time [s]."""
        state = [
            {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1], **node}
            for node in self.json["nodes"]
        ]
        for animation in self.json.get("animations", []):
            for channel in animation["channels"]:
                sampler = animation["samplers"][channel["sampler"]]
                times, values = self.array(sampler["input"])[:, 0], self.array(sampler["output"])
                path = channel["target"]["path"]
                if sampler["interpolation"] == "STEP":
                    value = values[max(0, np.searchsorted(times, time, side="right") - 1)]
                elif path == "rotation":
                    value = Slerp(times, Rotation.from_quat(values))(np.clip(time, *times[[0, -1]])).as_quat()
                else:
                    value = [np.interp(time, times, column) for column in values.T]
                state[channel["target"]["node"]][path] = value
        matrices = np.tile(np.eye(4), (len(state), 1, 1))
        for matrix, node in zip(matrices, state, strict=True):
            matrix[:3, :3] = Rotation.from_quat(node["rotation"]).as_matrix() * node["scale"]
            matrix[:3, 3] = node["translation"]
        return matrices

    def worlds(self, time):
        matrices, worlds = self.locals(time), {}

        def visit(number, above):
            worlds[number] = above @ matrices[number]
            for child in self.json["nodes"][number].get("children", []):
                visit(child, worlds[number])

        for top in self.json["scenes"][0]["nodes"]:
            visit(top, np.eye(4))
        assert len(worlds) == len(matrices)
        return worlds

    def skinned(self, name, time):
        node = self.json["nodes"][self.named(name)]
        (primitive,) = self.json["meshes"][node["mesh"]]["primitives"]
        parts = {key: self.array(index) for key, index in primitive["attributes"].items()}
        skin, worlds = self.json["skins"][node["skin"]], self.worlds(time)
        inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        joints = np.stack([worlds[joint] for joint in skin["joints"]]) @ inverse
        np.testing.assert_allclose(parts["WEIGHTS_0"].sum(axis=1), 1.0, atol=1e-6)
        blended = np.einsum("vk,vkij->vij", parts["WEIGHTS_0"], joints[parts["JOINTS_0"]])
        points = np.concatenate([parts["POSITION"], np.ones((len(parts["POSITION"]), 1))], axis=1)
        return np.einsum("vij,vj->vi", blended, points)[:, :3], parts, self.array(primitive["indices"])


@pytest.fixture
def glb(motion, tmp_path):
    write_glb(tmp_path / "hands.glb", posed_motion(motion))
    return Glb(tmp_path / "hands.glb")


def test_skins_move_as_ours(glb, motion):
    for hand in posed_motion(motion).hands:
        for frame in np.flatnonzero(hand.present):
            found, _, _ = glb.skinned(f"{hand.side}_hand", posed_motion(motion).seconds[frame])
            expected = hand.model.skin(hand.qpos[frame : frame + 1])[0] @ UP.T
            np.testing.assert_allclose(found, expected, atol=2e-6)


def test_a_hand_without_a_pose_is_a_point(glb, motion):
    left = posed_motion(motion).hands[1]
    for frame in np.flatnonzero(~left.present):
        found, _, _ = glb.skinned("left_hand", posed_motion(motion).seconds[frame])
        assert np.ptp(found, axis=0).max() < 1e-6
    assert np.ptp(glb.skinned("right_hand", posed_motion(motion).seconds[5])[0], axis=0).max() > 0.1


def test_things_move_as_ours(glb, motion):
    for thing in posed_motion(motion).bodies:
        for frame in range(motion.num_frames):
            pose = glb.worlds(posed_motion(motion).seconds[frame])[glb.named(thing.name)]
            expected = (
                np.zeros((3, 3)) if not thing.present[frame] else UP @ thing.T_world_body[frame, :3, :3]
            )
            np.testing.assert_allclose(pose[:3, :3], expected, atol=5e-6)
            if thing.present[frame]:
                np.testing.assert_allclose(pose[:3, 3], UP @ thing.T_world_body[frame, :3, 3], atol=5e-6)
    assert (
        "mesh" in glb.json["nodes"][glb.named("pen")]
        and "mesh" not in glb.json["nodes"][glb.named("my wand")]
    )


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_forearm_has_skin_from_the_wrist_to_its_farthest_marker(motion, tmp_path, side):
    places = np.array([[-0.05, 0.0, 0.03], [-0.2, 0.02, 0.03]])
    body = RigidBody("arm", ("A", "B"), places, None, side, has_axes=True)
    poses = motion.qpos[:, [motion.hand_index(side)], :7].copy()
    poses[:, 0, :3] += quaternion_matrix(poses[:, 0, 3:]) @ [0.0, 0.0, 0.03]  # a bar above the wrist
    armed = Take.of_poses(motion.hands, motion.qpos, rate=60.0, bodies=[body], body_poses=poses)
    thing = posed_motion(armed).bodies[0]
    mesh = trimesh.Trimesh(thing.shape.vertices, thing.shape.faces, process=False)
    skin = armed.hands[armed.hand_index(side)].model.surface.vertices
    begin = mesh.vertices[mesh.vertices[:, 0] > -0.1]
    below = np.linalg.norm(begin[:, None] + [0.0, 0.0, 0.03] - skin, axis=2)
    assert below.min(axis=1).max() < 1e-9, "the skin is that of the hand, not of the bar"
    assert mesh.is_watertight and mesh.volume > 0 and mesh.bounds[0, 0] == -0.2
    widest = np.ptp(mesh.vertices, axis=0)[1] / motion.hands[0].shape.breadth
    assert 0.6 < widest < 1.0 and abs(mesh.bounds[1, 0]) < 0.02, "it ends at the wrist, which is narrower"
    write_glb(tmp_path / "arm.glb", posed_motion(armed))
    glb = Glb(tmp_path / "arm.glb")
    node = glb.json["nodes"][glb.named("arm")]
    (part,) = glb.json["meshes"][node["mesh"]]["primitives"]
    assert glb.json["materials"][part["material"]]["name"] == "skin"
    write_bvh(tmp_path / "arm.bvh", posed_motion(armed))
    _, _, joint = (tmp_path / "arm.bvh").read_text().partition("JOINT arm")
    end = np.array(joint.split("End Site")[1].split("OFFSET")[1].split()[:3], dtype=float)
    np.testing.assert_allclose(end, UP @ [-20.0, 0.0, 0.0], atol=1e-6)


def test_faces_look_outwards_once_and_normals_are_of_length_one(glb, motion):
    for hand in posed_motion(motion).hands:
        _, parts, indices = glb.skinned(f"{hand.side}_hand", 0.0)
        mesh = trimesh.Trimesh(parts["POSITION"], indices.reshape(-1, 3), process=False)
        assert mesh.is_watertight and mesh.volume > 0
        assert len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) == len(mesh.faces)
        np.testing.assert_allclose(np.linalg.norm(parts["NORMAL"], axis=1), 1.0, atol=1e-6)
        agreement = (parts["NORMAL"] * mesh.vertex_normals).sum(axis=1)  # theirs are weighted by angles
        assert (agreement > 0.9).mean() > 0.998 and agreement.min() > 0
    assert all(material["doubleSided"] is False for material in glb.json["materials"])


def test_each_hand_has_a_skeleton_of_its_own(glb, motion):
    """Programs take the nearest node over all bones of a skin for its skeleton: hands must not share it."""
    nodes, parents = glb.json["nodes"], {}
    for number, node in enumerate(nodes):
        for child in node.get("children", []):
            parents[child] = number
    for hand, skin in zip(motion.hands, glb.json["skins"], strict=True):
        root = glb.named(f"{hand.side}_skeleton")
        assert skin["skeleton"] == root in glb.json["scenes"][0]["nodes"]
        assert skin["name"] == nodes[root]["name"]
        for joint in skin["joints"]:
            assert nodes[joint]["name"].startswith(f"{hand.side}_")
            above = joint
            while above in parents:
                above = parents[above]
            assert above == root


def test_blender_makes_an_armature_of_each_hand(motion, tmp_path):
    bpy = pytest.importorskip("bpy")
    pytest.importorskip("pxr")
    for name in ("hands.glb", "hands.usdc"):
        motion.export(tmp_path / name)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        read = bpy.ops.import_scene.gltf if name.endswith("glb") else bpy.ops.wm.usd_import
        read(filepath=str(tmp_path / name))
        for side in ("right", "left"):
            armature, skin = bpy.data.objects[f"{side}_skeleton"], bpy.data.objects[f"{side}_hand"]
            assert armature.type == "ARMATURE" and len(armature.data.bones) == 16
            assert all(bone.name.startswith(f"{side}_") for bone in armature.data.bones)
            assert [modifier.object for modifier in skin.modifiers] == [armature]
            assert skin.data.materials[0].name.partition(".")[0] == "skin"


def test_keys_turn_the_short_way(glb):
    """Neighboring quaternions have one sign: readers that do not look for the shorter way turn right too."""
    for sampler in glb.json["animations"][0]["samplers"]:
        values = glb.array(sampler["output"])
        if values.shape[1] == 4:
            assert ((values[1:] * values[:-1]).sum(axis=1) >= 0).all()


def test_a_single_frame_is_a_pose_without_an_animation(tmp_path):
    model = HandModel.named("S", side="left")
    flat = join_qpos(np.zeros((1, 20)))[:, None]
    take = Take.of_poses([attach(load_layout("dense19"), model)], flat, rate=1.0)
    write_glb(tmp_path / "one.glb", posed_motion(take))
    glb = Glb(tmp_path / "one.glb")
    assert "animations" not in glb.json
    np.testing.assert_allclose(glb.skinned("left_hand", 0.0)[0], model.surface.vertices @ UP.T, atol=1e-6)


def test_a_take_with_y_up_keeps_its_axes(motion, tmp_path):
    write_glb(tmp_path / "y.glb", posed_motion(motion), up="y")
    found, _, _ = Glb(tmp_path / "y.glb").skinned("right_hand", 0.0)
    right = posed_motion(motion).hands[0]
    np.testing.assert_allclose(found, right.model.skin(right.qpos[:1])[0], atol=2e-6)
    assert trimesh.load(tmp_path / "y.glb").geometry  # another reader opens it


@pytest.fixture(params=["usda", "usdc"])
def stage(request, motion, tmp_path):
    pxr = pytest.importorskip("pxr", reason="usd-core is not installed")
    assert pxr
    from pxr import Usd

    write_usd(tmp_path / f"hands.{request.param}", posed_motion(motion))
    return Usd.Stage.Open(str(tmp_path / f"hands.{request.param}"))


def test_usd_skins_the_hands_as_we_do(stage, motion):
    from pxr import Usd, UsdGeom, UsdSkel

    for hand in posed_motion(motion).hands:
        cache = UsdSkel.Cache()
        cache.Populate(UsdSkel.Root(stage.GetPrimAtPath(f"/hands/{hand.side}")), Usd.PrimDefaultPredicate)
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/hands/{hand.side}/{hand.side}_hand"))
        skinning = cache.GetSkinningQuery(mesh.GetPrim())
        prim = stage.GetPrimAtPath(f"/hands/{hand.side}/{hand.side}_skeleton")
        skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(prim))
        expected = hand.model.skin(hand.qpos)
        for frame in range(motion.num_frames):
            points = mesh.GetPointsAttr().Get()
            assert skinning.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(frame), points, frame)
            np.testing.assert_allclose(np.array(points), expected[frame], atol=2e-6)
            shown = mesh.ComputeVisibility(frame) != UsdGeom.Tokens.invisible
            assert shown == hand.present[frame]


def test_things_units_and_axes(stage, motion):
    from pxr import UsdGeom

    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 60.0
    assert stage.GetStartTimeCode() == 0.0 and stage.GetEndTimeCode() == pytest.approx(12.0)
    for thing, name in zip(posed_motion(motion).bodies, ("pen", "my_wand"), strict=True):
        prim = UsdGeom.Xformable(stage.GetPrimAtPath(f"/hands/things/{name}"))
        for frame in range(motion.num_frames):
            found = np.array(prim.ComputeLocalToWorldTransform(frame)).T
            np.testing.assert_allclose(found, thing.T_world_body[frame], atol=1e-6)
            assert (prim.ComputeVisibility(frame) != UsdGeom.Tokens.invisible) == thing.present[frame]
    assert stage.GetPrimAtPath("/hands/things/pen/mesh") and not stage.GetPrimAtPath(
        "/hands/things/my_wand/mesh"
    )


def test_meshes_have_materials_and_skeletons_the_names_of_their_hands(stage, motion):
    from pxr import UsdGeom, UsdShade, UsdSkel

    prims = list(stage.Traverse())
    for prim in (prim for prim in prims if prim.IsA(UsdGeom.Mesh)):
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        shader, _, _ = material.ComputeSurfaceSource()
        assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
        color = UsdGeom.Mesh(prim).GetDisplayColorAttr().Get()[0]
        assert shader.GetInput("diffuseColor").Get() == color
    skeletons = {prim.GetName(): UsdSkel.Skeleton(prim) for prim in prims if prim.IsA(UsdSkel.Skeleton)}
    assert set(skeletons) == {"right_skeleton", "left_skeleton"}
    for name, skeleton in skeletons.items():
        side = name.partition("_")[0]
        for path in skeleton.GetJointsAttr().Get():
            assert all(part.startswith(f"{side}_") for part in path.split("/"))
    for hand in posed_motion(motion).hands:
        kinds = {str(prim.GetName()) for prim in stage.GetPrimAtPath(f"/hands/{hand.side}").GetChildren()}
        assert kinds == {f"{hand.side}_{kind}" for kind in ("hand", "skeleton", "motion")} | {"skin"}


def test_without_usd_core_the_extra_is_named(motion, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr.Tf", None)
    with pytest.raises(HandSimError, match=r"\.usdc needs the package pxr, .*`pip install 'handsim\[usd\]'`"):
        write_usd(tmp_path / "hands.usdc", posed_motion(motion))
    assert list(tmp_path.iterdir()) == []
