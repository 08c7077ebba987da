"""Hands and things as glTF 2.0 (.glb): skins, skeletons and their motion.

Axes: y up, meters. At the top stand a node for each hand, `right_skeleton`, with its palm and the other bones
below it, named `right_palm`, `right_index_proximal` ..., its skin `right_hand`, and the things. The node over
the palm lets programs see two skeletons in two hands: Blender puts bones with nothing above them into one.
Each bone has a key per frame. What has no pose in some frames has the scale 0 there, which every reader shows
as nothing; its other keys stay as they were. The file is a JSON chunk and a chunk of arrays.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from handsim._version import __version__
from handsim.errors import ArgumentError
from handsim.files.atomic import atomic_write
from handsim.hand.model import HandModel
from handsim.hand.skin.surface import vertex_normals
from handsim.hand.topology import BONE_NAMES, NUM_BONES, PALM
from handsim.motion_files.mesh_normals import corner_normals, split_vertices
from handsim.motion_files.motion import (
    CHILDREN,
    SKIN,
    THING,
    Material,
    Motion,
    PosedBody,
    PosedHand,
    changes,
    file_axes,
    local_rotations,
    posed_bodies,
    posed_hands,
    seconds_of,
    smooth_quaternions,
)
from handsim.space.transforms import UpAxis

_MATERIALS: Final = (SKIN, THING)
Target = Literal["vertices", "indices"]
_COMPONENTS: Final = {"|u1": 5121, "<u2": 5123, "<u4": 5125, "<f4": 5126}
_TYPES: Final = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_TARGETS: Final = {"vertices": 34962, "indices": 34963}
_HEADER: Final = struct.Struct("<4sII")
_CHUNK: Final = struct.Struct("<I4s")
_MOST: Final = (1 << 32) - 1  # bytes that the header can state


def write_glb(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write hands and things; a motion of one frame is written as a pose, without an animation.

    Raises:
        OSError: The file cannot be written.
        ArgumentError: The file would be larger than a .glb can be.
    """
    content = _Scene(motion, up).pack()
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


class _Scene:
    """The document while it grows."""

    def __init__(self, motion: Motion, up: UpAxis) -> None:
        self._times = seconds_of(motion)
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
        for hand in posed_hands(motion):
            self._add_hand(hand)
        for thing in posed_bodies(motion):
            self._add_thing(thing)

    def pack(self) -> bytes:
        """The whole file, of JSON without its arrays; an `ArgumentError` if a .glb cannot be so large."""
        document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": f"handsim {__version__}"},
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
        qpos = hand.qpos
        positions, rotations = qpos[:, :3] @ self._turn.T, hand.model.forward_kinematics(qpos)[..., :3, :3]
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
        # At the top, as the bones: readers ignore the transform of a skinned mesh, and warn where it has one.
        self._top += [root, len(self._nodes)]
        self._nodes.append(
            {"name": f"{hand.side}_hand", "mesh": len(self._meshes) - 1, "skin": len(self._skins) - 1}
        )

    def _skin_mesh(self, model: HandModel, name: str) -> dict[str, Any]:
        """The skin at rest, in the wrist's frame."""
        surface, add = model.surface, self._buffer.add
        attributes = {
            "POSITION": add(surface.vertices.astype("<f4"), target="vertices", bounds=True),
            "NORMAL": add(vertex_normals(surface.vertices, surface.faces).astype("<f4"), target="vertices"),
            # A bone without a share must be 0, or validators complain.
            "JOINTS_0": add(
                np.where(surface.bone_weights > 0.0, surface.bone_indices, 0).astype("u1"), target="vertices"
            ),
            "WEIGHTS_0": add(surface.bone_weights.astype("<f4"), target="vertices"),
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
                    thing.shape.vertices[vertices].astype("<f4"), target="vertices", bounds=True
                ),
                "NORMAL": self._buffer.add(outward.astype("<f4"), target="vertices"),
            }
            primitive = self._primitive(attributes, faces, THING)
            self._meshes.append({"name": thing.name, "primitives": [primitive]})
        self._nodes.append(node)
        self._top.append(number)
        self._animate(number, "rotation", quaternions)
        self._animate(number, "translation", positions)
        self._hide(number, thing.present)

    def _primitive(
        self, attributes: dict[str, int], faces: NDArray[Any], material: Material
    ) -> dict[str, Any]:
        indices = self._buffer.add(faces.ravel().astype("<u4"), target="indices")
        return {"attributes": attributes, "indices": indices, "material": _MATERIALS.index(material)}

    def _animate(self, node: int, path: str, values: NDArray[np.float64]) -> None:
        """A key in every frame, with straight motion between them."""
        if self._seconds is not None:
            self._channel(node, path, self._seconds, values, "LINEAR")

    def _hide(self, node: int, present: NDArray[np.bool_]) -> None:
        """Scale 0 where there is no pose, from half a frame before to half a frame after."""
        if present.all() or self._seconds is None:
            return
        frames = changes(present)
        seconds = self._times
        # Halfway: a reader that asks for a frame's time must not meet the other side of a rounded key.
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

    def add(self, array: NDArray[Any], *, target: Target | None = None, bounds: bool = False) -> int:
        """Add an array and return the index of its accessor.

        Args:
            array: Entries along the first axis: numbers, vectors or matrices (4, 4), of unsigned bytes or
                words, or of float32.
            target: What a graphics card uses it for.
            bounds: Whether its least and greatest values are stated, as for positions and times.
        """
        content = np.ascontiguousarray(np.swapaxes(array, 1, 2) if array.ndim == 3 else array)  # by columns
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self._size, "byteLength": content.nbytes}
        if target is not None:
            view["target"] = _TARGETS[target]
        accessor: dict[str, Any] = {
            "bufferView": len(self._views),
            "componentType": _COMPONENTS[content.dtype.str],
            "count": len(content),
            "type": _TYPES[content.shape[1:]],
        }
        if bounds:
            for name, values in (("min", content.min(axis=0)), ("max", content.max(axis=0))):
                accessor[name] = np.atleast_1d(values).tolist()
        self._append(content.tobytes())
        self._views.append(view)
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def pack(self, document: dict[str, Any]) -> bytes:
        """The whole file.

        Args:
            document: The JSON without buffers, views and accessors.
        """
        arrays = {"buffers": [{"byteLength": self._size}], "bufferViews": self._views}
        text = json.dumps(
            {**document, **arrays, "accessors": self._accessors}, separators=(",", ":"), allow_nan=False
        ).encode()
        text += b" " * (-len(text) % 4)
        size = _HEADER.size + 2 * _CHUNK.size + len(text) + self._size
        if size > _MOST:
            raise ArgumentError(f"a .glb of {size} bytes, expected at most {_MOST}; export at a lower rate")
        head = _HEADER.pack(b"glTF", 2, size) + _CHUNK.pack(len(text), b"JSON")
        return b"".join([head, text, _CHUNK.pack(self._size, b"BIN\0"), *self._parts])

    def _append(self, content: bytes) -> None:
        content += b"\0" * (-len(content) % 4)
        self._parts.append(content)
        self._size += len(content)
