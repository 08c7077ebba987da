"""The binary container of glTF 2.0: a JSON chunk and a chunk of arrays."""

from __future__ import annotations

import json
import struct
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from handsim.errors import ArgumentError

Target = Literal["vertices", "indices"]
_COMPONENTS: Final = {"|u1": 5121, "<u2": 5123, "<u4": 5125, "<f4": 5126}
_TYPES: Final = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_TARGETS: Final = {"vertices": 34962, "indices": 34963}
_HEADER: Final = struct.Struct("<4sII")
_CHUNK: Final = struct.Struct("<I4s")
_MOST: Final = (1 << 32) - 1  # bytes that the header can state


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

        Raises:
            ArgumentError: It would be larger than a .glb can be.
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
