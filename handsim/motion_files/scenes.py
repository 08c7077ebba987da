"""Writers of moving hands and things with skins: glTF 2.0 (.glb) and OpenUSD (.usda text, .usdc binary).

glTF has y up, in meters. The top level has a node for each hand, `right_skeleton`, its skin `right_hand`, and
the things. Below `right_skeleton` are the bones `right_palm`, `right_index_proximal` and so on; without this
node, Blender would merge the bones of two hands into one skeleton. Each bone has a key per frame. A hand or
thing without a pose in some frames has scale 0 there, so that nothing is shown; its other keys keep their
values. The file is a JSON chunk and a chunk of arrays.

OpenUSD is written with UsdSkel by the package usd-core. `/hands/right` is a SkelRoot with its skin
`right_hand`, `right_skeleton` and `right_motion`; `/hands/things/pen` an Xform with its mesh; each has its
material. Names contain the side, because programs show only the last part of a path. Lengths are meters, the
up axis is the take's, and a time code is a frame at the take's rate. A hand or thing without a pose in some
frames is invisible there.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._plugins import import_extra
from handsim._version import full_version
from handsim.errors import ArgumentError
from handsim.files.outputs import atomic_write, plain_path, unwritten
from handsim.hand.model import HandModel
from handsim.hand.shape import BONE_NAMES, BONES, NUM_BONES, PALM, Side
from handsim.hand.skin import vertex_normals
from handsim.motion_files.motion import (
    CHILDREN,
    SKIN,
    THING,
    Material,
    Motion,
    PosedBody,
    PosedHand,
    are_moved,
    changes,
    corner_normals,
    local_rotations,
    smooth_quaternions,
    split_vertices,
)
from handsim.space.transforms import UpAxis, file_axes, rigid

_MATERIALS: Final = (SKIN, THING)
_COMPONENT_TYPES: Final = {"|u1": 5121, "<u2": 5123, "<u4": 5125, "<f4": 5126}
_ELEMENT_TYPES: Final = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_VERTEX, _INDEX = 34962, 34963  # targets of buffer views in glTF
_HEADER: Final = struct.Struct("<4sII")
_CHUNK: Final = struct.Struct("<I4s")
_MAX_SIZE: Final = (1 << 32) - 1  # bytes that the header can state
_MARGIN: Final = 0.03  # thickness of skin around keypoints in a hand's extent [m]


def write_glb(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write hands and things; a motion of one frame is written as a pose, without an animation."""
    content = _Scene(motion, up).pack()
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


class _Scene:
    """A glTF document, built hand by hand and thing by thing."""

    def __init__(self, motion: Motion, up: UpAxis) -> None:
        self._times = motion.seconds
        self._buffer = GlbBuffer()
        self._meshes: list[dict[str, Any]] = []
        self._skins: list[dict[str, Any]] = []
        self._channels: list[dict[str, Any]] = []
        self._samplers: list[dict[str, Any]] = []
        self._turn = file_axes(up)
        self._nodes: list[dict[str, Any]] = []
        self._top: list[int] = []
        self._seconds = (
            self._buffer.add(self._times.astype("<f4"), bounds=True) if len(self._times) > 1 else None
        )
        for hand in motion.hands:
            self._add_hand(hand)
        for thing in motion.bodies:
            self._add_thing(thing)

    def pack(self) -> bytes:
        """The content of the file; an `ArgumentError` if it exceeds the size of a .glb."""
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": f"handsim {full_version()}"},
            "scene": 0,
            "scenes": [{"nodes": self._top}],
            "nodes": self._nodes,
            "meshes": self._meshes,
            "skins": self._skins,
            "materials": [
                {
                    "name": material.name,
                    "pbrMetallicRoughness": {
                        "baseColorFactor": [*material.color, 1.0],
                        "metallicFactor": 0.0,
                        "roughnessFactor": material.roughness,
                    },
                    "doubleSided": False,
                }
                for material in _MATERIALS
            ],
        }
        if self._channels:
            document["animations"] = [
                {"name": "motion", "channels": self._channels, "samplers": self._samplers}
            ]
        return self._buffer.pack(document)

    def _add_hand(self, hand: PosedHand) -> None:
        offsets, rotations, moved = hand.offsets(), hand.bones()[..., :3, :3], are_moved(hand.model)
        positions = offsets[:, PALM] @ self._turn.T
        quaternions = smooth_quaternions(local_rotations(self._turn @ rotations))
        root, first = len(self._nodes), len(self._nodes) + 1
        self._nodes.append({"name": f"{hand.side}_skeleton", "children": [first + PALM]})
        for bone in range(NUM_BONES):
            node: dict[str, Any] = {
                "name": f"{hand.side}_{BONE_NAMES[bone]}",
                "translation": (positions[0] if bone == PALM else hand.model.skeleton.offsets[bone]).tolist(),
                "rotation": _xyzw(quaternions[0, bone]).tolist(),
            }
            if CHILDREN[bone]:
                node["children"] = [first + child for child in CHILDREN[bone]]
            self._nodes.append(node)
            self._animate(first + bone, "rotation", _xyzw(quaternions[:, bone]))
            if bone != PALM and (hand.former or moved[bone]):
                self._animate(first + bone, "translation", offsets[:, bone])
        self._animate(first, "translation", positions)
        self._hide(first, hand.present)
        self._skins.append(
            {
                "name": f"{hand.side}_skeleton",
                "joints": list(range(first, first + NUM_BONES)),
                "skeleton": root,
                "inverseBindMatrices": self._buffer.add(
                    np.linalg.inv(hand.model.rest_transforms).astype("<f4")
                ),
            }
        )
        self._meshes.append(self._skin_mesh(hand.model, f"{hand.side}_hand"))
        # The mesh is at the top level, because readers ignore, and warn of, transforms of skinned meshes.
        self._top += [root, len(self._nodes)]
        self._nodes.append(
            {"name": f"{hand.side}_hand", "mesh": len(self._meshes) - 1, "skin": len(self._skins) - 1}
        )

    def _skin_mesh(self, model: HandModel, name: str) -> dict[str, Any]:
        """The skin at rest, in the wrist's frame."""
        surface, add = model.surface, self._buffer.add
        attributes = {
            "POSITION": add(surface.vertices.astype("<f4"), target=_VERTEX, bounds=True),
            "NORMAL": add(vertex_normals(surface.vertices, surface.faces).astype("<f4"), target=_VERTEX),
            # A bone without a share must be 0, or validators complain.
            "JOINTS_0": add(
                np.where(surface.bone_weights > 0.0, surface.bone_indices, 0).astype("u1"), target=_VERTEX
            ),
            "WEIGHTS_0": add(surface.bone_weights.astype("<f4"), target=_VERTEX),
        }
        return {"name": name, "primitives": [self._primitive(attributes, surface.faces, SKIN)]}

    def _add_thing(self, thing: PosedBody) -> None:
        poses = thing.T_world_body
        positions = poses[:, :3, 3] @ self._turn.T
        quaternions = _xyzw(smooth_quaternions(self._turn @ poses[:, :3, :3]))
        number = len(self._nodes)
        node: dict[str, Any] = {
            "name": thing.name,
            "translation": positions[0].tolist(),
            "rotation": quaternions[0].tolist(),
        }
        if thing.shape is not None:
            node["mesh"] = len(self._meshes)
            normals = corner_normals(thing.shape.vertices, thing.shape.faces)
            vertices, outward, faces = split_vertices(thing.shape.faces, normals)
            attributes = {
                "POSITION": self._buffer.add(
                    thing.shape.vertices[vertices].astype("<f4"), target=_VERTEX, bounds=True
                ),
                "NORMAL": self._buffer.add(outward.astype("<f4"), target=_VERTEX),
            }
            primitive = self._primitive(attributes, faces, thing.material)
            self._meshes.append({"name": thing.name, "primitives": [primitive]})
        self._nodes.append(node)
        self._top.append(number)
        self._animate(number, "rotation", quaternions)
        self._animate(number, "translation", positions)
        self._hide(number, thing.present)

    def _primitive(
        self, attributes: dict[str, int], faces: NDArray[Any], material: Material
    ) -> dict[str, Any]:
        indices = self._buffer.add(faces.ravel().astype("<u4"), target=_INDEX)
        return {"attributes": attributes, "indices": indices, "material": _MATERIALS.index(material)}

    def _animate(self, node: int, path: str, values: NDArray[np.float64]) -> None:
        """Add a key in every frame, with linear interpolation between them."""
        if self._seconds is not None:
            self._channel(node, path, self._seconds, values, "LINEAR")

    def _hide(self, node: int, present: NDArray[np.bool_]) -> None:
        """Scale 0 where there is no pose, from half a frame before to half a frame after."""
        if present.all() or self._seconds is None:
            return
        frames = changes(present)
        seconds = self._times
        # Halfway between frames, rounding cannot move a key past the time of a frame.
        halfway = 0.5 * (seconds[frames] + seconds[np.maximum(frames - 1, 0)])
        times = self._buffer.add(halfway.astype("<f4"), bounds=True)
        self._channel(node, "scale", times, np.repeat(present[frames, None], 3, axis=1), "STEP")

    def _channel(self, node: int, path: str, times: int, values: NDArray[Any], interpolation: str) -> None:
        output = self._buffer.add(values.astype("<f4"))
        self._channels.append({"sampler": len(self._samplers), "target": {"node": node, "path": path}})
        self._samplers.append({"input": times, "output": output, "interpolation": interpolation})


def _xyzw(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions in glTF's order."""
    return np.roll(quaternions, -1, axis=-1)


class GlbBuffer:
    """Collects arrays and writes them with the JSON that names them."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray[Any], *, target: int | None = None, bounds: bool = False) -> int:
        """Add an array and return the index of its accessor."""
        content = np.ascontiguousarray(np.swapaxes(array, 1, 2) if array.ndim == 3 else array)  # column-major
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self._size, "byteLength": content.nbytes}
        if target is not None:
            view["target"] = target
        accessor: dict[str, Any] = {
            "bufferView": len(self._views),
            "componentType": _COMPONENT_TYPES[content.dtype.str],
            "count": len(content),
            "type": _ELEMENT_TYPES[content.shape[1:]],
        }
        if bounds:
            for name, values in (("min", content.min(axis=0)), ("max", content.max(axis=0))):
                accessor[name] = np.atleast_1d(values).tolist()
        self._parts.append(content.tobytes() + bytes(-content.nbytes % 4))
        self._size += len(self._parts[-1])
        self._views.append(view)
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def pack(self, document: dict[str, Any]) -> bytes:
        """The content of a file: this JSON, with what it needs to find the arrays, and the arrays."""
        arrays = {"buffers": [{"byteLength": self._size}], "bufferViews": self._views}
        text = json.dumps(
            {**document, **arrays, "accessors": self._accessors}, separators=(",", ":"), allow_nan=False
        ).encode()
        text += b" " * (-len(text) % 4)
        size = _HEADER.size + 2 * _CHUNK.size + len(text) + self._size
        if size > _MAX_SIZE:
            raise ArgumentError(
                f"a .glb of {size} bytes, expected at most {_MAX_SIZE}; export at a lower rate"
            )
        head = _HEADER.pack(b"glTF", 2, size) + _CHUNK.pack(len(text), b"JSON")
        return b"".join([head, text, _CHUNK.pack(self._size, b"BIN\0"), *self._parts])


def write_usd(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write hands and things."""
    Usd, UsdGeom = (import_extra(f"pxr.{one}", path.suffix, "usd") for one in ("Usd", "UsdGeom"))
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up.upper())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    codes = np.round(motion.seconds * motion.rate, 6)  # whole ones at a steady rate
    stage.SetTimeCodesPerSecond(motion.rate)
    stage.SetFramesPerSecond(motion.rate)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(float(codes[-1]))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/hands").GetPrim())
    for hand in motion.hands:
        _add_hand(stage, hand, codes)
    for number, thing in enumerate(motion.bodies):
        _add_thing(stage, thing, number, codes)
    save_stage(stage, path)


def save_stage(stage: Any, path: Path) -> None:
    """Write a stage of OpenUSD."""
    Tf = import_extra("pxr.Tf", path.suffix, "usd")
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
    rest, bones = hand.model.rest_transforms, hand.model.skeleton
    local = rigid(bones.rotations, bones.offsets)
    skeleton.CreateJointsAttr(joint_paths(hand.side))
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray([Gf.Matrix4d(one.T.tolist()) for one in rest]))
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray([Gf.Matrix4d(one.T.tolist()) for one in local]))
    motion = UsdSkel.Animation.Define(stage, f"{path}/{hand.side}_motion")
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([motion.GetPath()])
    _add_skin(stage, hand, f"{path}/{hand.side}_hand", skeleton)
    _add_motion(motion, hand, codes)
    _set_visibility(root, hand.present, codes)
    keypoints = hand.keypoints()
    extent = root.CreateExtentAttr()
    corners = np.stack([keypoints.min(axis=1) - _MARGIN, keypoints.max(axis=1) + _MARGIN], axis=1)
    for code, box in zip(codes.tolist(), corners.astype(np.float32), strict=True):
        extent.Set(Vt.Vec3fArray.FromNumpy(box), code)


def _add_skin(stage: Any, hand: PosedHand, path: str, skeleton: Any) -> None:
    """The mesh at rest, bound to the skeleton."""
    from pxr import Gf, UsdGeom, UsdSkel, Vt

    surface = hand.model.surface
    mesh = add_mesh(stage, path, surface.vertices, surface.faces, SKIN)
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

    rotations = smooth_quaternions(local_rotations(hand.bones()[..., :3, :3]))
    translations = hand.offsets()
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
        mesh = add_mesh(stage, f"{path}/mesh", thing.shape.vertices, thing.shape.faces, thing.material)
        normals = corner_normals(thing.shape.vertices, thing.shape.faces).reshape(-1, 3)
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)


def add_mesh(
    stage: Any,
    path: str,
    vertices: Float[np.ndarray, "V 3"],
    faces: NDArray[Any],
    material: Material,
) -> Any:
    """Add triangles, not subdivided, and their material beside them, whose shader is `surface`."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    points = vertices.astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*material.color)])  # for programs that ignore materials
    beside, kinds = f"{path.rpartition('/')[0]}/{material.name}", Sdf.ValueTypeNames
    made = UsdShade.Material.Define(stage, beside)
    shader = UsdShade.Shader.Define(stage, f"{beside}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")  # USD's standard shader
    shader.CreateInput("diffuseColor", kinds.Color3f).Set(Gf.Vec3f(*material.color))
    shader.CreateInput("roughness", kinds.Float).Set(material.roughness)
    shader.CreateInput("metallic", kinds.Float).Set(0.0)
    made.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(made)
    return mesh


def _set_visibility(prim: Any, present: NDArray[np.bool_], codes: NDArray[np.float64]) -> None:
    from pxr import UsdGeom

    if present.all():
        return
    visibility = prim.CreateVisibilityAttr()
    for frame in changes(present).tolist():
        token = UsdGeom.Tokens.inherited if present[frame] else UsdGeom.Tokens.invisible
        visibility.Set(token, float(codes[frame]))
