"""Hands and things as OpenUSD with UsdSkel, .usda (text) and .usdc (binary), by the package usd-core.

`/hands/right` is a SkelRoot with its skin `right_hand`, `right_skeleton` and `right_motion`;
`/hands/things/pen` an Xform with its mesh; each has its material. Names have the side in them, since programs
show the last part of a path alone. Lengths are meters, the up axis is the take's, a time code is a frame at
the take's rate. What has no pose in some frames is invisible there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.errors import HandSimError
from handsim.files.atomic import atomic_write, unwritten
from handsim.files.names import plain_path
from handsim.hand.keypoints import hand_keypoints
from handsim.hand.skin.surface import vertex_normals
from handsim.hand.topology import BONES, NUM_BONES, PALM, Side
from handsim.motion_files.mesh_normals import corner_normals
from handsim.motion_files.motion import (
    SKIN,
    THING,
    Material,
    Motion,
    PosedBody,
    PosedHand,
    changes,
    local_rotations,
    posed_bodies,
    posed_hands,
    seconds_of,
    smooth_quaternions,
)
from handsim.space.transforms import UpAxis

_AROUND: Final = 0.03  # [m] of skin around keypoints


def write_usd(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write hands and things.

    Raises:
        OSError: The file cannot be written.
        HandSimError: usd-core is not installed.
    """
    try:
        from pxr import Tf, Usd, UsdGeom
    except ImportError as error:
        raise HandSimError(f"{path.suffix} needs usd-core; run `pip install 'handsim[usd]'`") from error
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up.upper())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    codes = np.round(seconds_of(motion) * motion.rate, 6)  # whole ones at a steady rate
    stage.SetTimeCodesPerSecond(motion.rate)
    stage.SetFramesPerSecond(motion.rate)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(float(codes[-1]))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/hands").GetPrim())
    for hand in posed_hands(motion):
        _add_hand(stage, hand, codes)
    for number, thing in enumerate(posed_bodies(motion)):
        _add_thing(stage, thing, number, codes)
    with atomic_write(path) as temporary, plain_path(temporary) as plain:
        try:
            done = stage.GetRootLayer().Export(str(plain))
        except Tf.ErrorException as error:  # raised on a full disk
            raise unwritten(temporary) from error
        if not done:
            raise unwritten(temporary)


def joint_paths(side: Side) -> list[str]:
    """The bones as UsdSkel names them: each with its parents, `right_palm/right_index_proximal`."""
    paths: list[str] = []
    for bone in BONES:
        name = f"{side}_{bone.name}"
        paths.append(name if bone.parent < 0 else f"{paths[bone.parent]}/{name}")
    return paths


def _add_hand(stage: Any, hand: PosedHand, codes: NDArray[np.float64]) -> None:
    from pxr import Gf, UsdSkel, Vt

    path = f"/hands/{hand.side}"
    root = UsdSkel.Root.Define(stage, path)
    skeleton = UsdSkel.Skeleton.Define(stage, f"{path}/{hand.side}_skeleton")
    rest = hand.model.rest_transforms
    local = np.stack(
        [
            rest[n] if bone.parent < 0 else np.linalg.inv(rest[bone.parent]) @ rest[n]
            for n, bone in enumerate(BONES)
        ]
    )
    skeleton.CreateJointsAttr(joint_paths(hand.side))
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray([Gf.Matrix4d(one.T.tolist()) for one in rest]))
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray([Gf.Matrix4d(one.T.tolist()) for one in local]))
    motion = UsdSkel.Animation.Define(stage, f"{path}/{hand.side}_motion")
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([motion.GetPath()])
    _add_skin(stage, hand, f"{path}/{hand.side}_hand", skeleton)
    _add_motion(motion, hand, codes)
    _set_visibility(root, hand.present, codes)
    keypoints = hand_keypoints(hand.model, hand.qpos)
    extent = root.CreateExtentAttr()
    corners = np.stack([keypoints.min(axis=1) - _AROUND, keypoints.max(axis=1) + _AROUND], axis=1)
    for code, box in zip(codes.tolist(), corners.astype(np.float32), strict=True):
        extent.Set(Vt.Vec3fArray.FromNumpy(box), code)


def _add_skin(stage: Any, hand: PosedHand, path: str, skeleton: Any) -> None:
    """The mesh at rest, bound to the skeleton."""
    from pxr import Gf, UsdGeom, UsdSkel, Vt

    surface = hand.model.surface
    mesh = _add_mesh(stage, path, surface.vertices, surface.faces, SKIN)
    normals = vertex_normals(surface.vertices, surface.faces)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    indices = np.where(surface.bone_weights > 0.0, surface.bone_indices, 0).astype(np.int32)
    binding.CreateJointIndicesPrimvar(False, 4).Set(Vt.IntArray.FromNumpy(indices.ravel()))
    weights = surface.bone_weights.astype(np.float32).ravel()
    binding.CreateJointWeightsPrimvar(False, 4).Set(Vt.FloatArray.FromNumpy(weights))


def _add_motion(motion: Any, hand: PosedHand, codes: NDArray[np.float64]) -> None:
    """Translations, rotations and scales of all bones in every frame."""
    from pxr import Vt

    qpos = hand.qpos
    rotations = smooth_quaternions(local_rotations(hand.model.forward_kinematics(qpos)[..., :3, :3]))
    translations = np.tile(hand.model.skeleton.offsets, (len(qpos), 1, 1))
    translations[:, PALM] = qpos[:, :3]
    motion.CreateJointsAttr(joint_paths(hand.side))
    motion.CreateScalesAttr(Vt.Vec3hArray.FromNumpy(np.ones((NUM_BONES, 3), dtype=np.float16)))
    # usd-core takes quaternions from arrays with the real part last.
    imaginary_first = np.roll(rotations, -1, axis=-1).astype(np.float32)
    places, turns = motion.CreateTranslationsAttr(), motion.CreateRotationsAttr()
    for code, place, turn in zip(
        codes.tolist(), translations.astype(np.float32), imaginary_first, strict=True
    ):
        places.Set(Vt.Vec3fArray.FromNumpy(place), code)
        turns.Set(Vt.QuatfArray.FromNumpy(turn), code)


def _add_thing(stage: Any, thing: PosedBody, number: int, codes: NDArray[np.float64]) -> None:
    from pxr import Gf, Tf, UsdGeom, Vt

    path = f"/hands/things/{Tf.MakeValidIdentifier(thing.name)}"
    if stage.GetPrimAtPath(path):
        path = f"{path}_{number}"
    UsdGeom.Xform.Define(stage, "/hands/things")
    body = UsdGeom.Xform.Define(stage, path)
    poses = thing.T_world_body
    move, turn = body.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble), body.AddOrientOp()
    for code, place, quaternion in zip(
        codes.tolist(), poses[:, :3, 3].tolist(), smooth_quaternions(poses[:, :3, :3]).tolist(), strict=True
    ):
        move.Set(Gf.Vec3d(place), code)
        turn.Set(Gf.Quatf(*quaternion), code)
    _set_visibility(body, thing.present, codes)
    if thing.shape is not None:
        mesh = _add_mesh(stage, f"{path}/mesh", thing.shape.vertices, thing.shape.faces, THING)
        normals = corner_normals(thing.shape.vertices, thing.shape.faces).reshape(-1, 3)
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)


def _add_mesh(
    stage: Any,
    path: str,
    vertices: Float[np.ndarray, "V 3"],
    faces: NDArray[Any],
    material: Material,
) -> Any:
    """Triangles of one material, not subdivided."""
    from pxr import Gf, UsdGeom, UsdShade, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    points = vertices.astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*material.color)])  # for programs that look at no material
    beside = f"{path.rpartition('/')[0]}/{material.name}"
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(_add_material(stage, beside, material))
    return mesh


def _add_material(stage: Any, path: str, material: Material) -> Any:
    """A material by USD's own shader."""
    from pxr import Gf, Sdf, UsdShade

    made, shader = UsdShade.Material.Define(stage, path), UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    kinds = Sdf.ValueTypeNames
    shader.CreateInput("diffuseColor", kinds.Color3f).Set(Gf.Vec3f(*material.color))
    shader.CreateInput("roughness", kinds.Float).Set(material.roughness)
    shader.CreateInput("metallic", kinds.Float).Set(0.0)
    made.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return made


def _set_visibility(prim: Any, present: NDArray[np.bool_], codes: NDArray[np.float64]) -> None:
    from pxr import UsdGeom

    if present.all():
        return
    visibility = prim.CreateVisibilityAttr()
    for frame in changes(present).tolist():
        token = UsdGeom.Tokens.inherited if present[frame] else UsdGeom.Tokens.invisible
        visibility.Set(token, float(codes[frame]))
