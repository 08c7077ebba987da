"""ONNX models from files: a checksum detects damage, and limits keep a hostile model from filling the memory.

Runtimes crash on some damaged models, and allocate as much memory as a model demands. Therefore a model is
first read as a protobuf. Its checksum must be right, and it may hold one plain graph with a limited number of
parts, without subgraphs (loops), functions, sparse tensors and external files. The allocator of
`bounded_session` limits the memory of its computations.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

DIGEST: Final = "handsim.sha256"
"""Key of a model's own SHA-256, which is taken with 64 zeros in its place."""
MAX_MODEL_BYTES: Final = 1 << 27
"""Largest file of a model that is read; the paper's network has 87 MB."""
_MAX_PARTS: Final = 200_000  # fields of a model and its parts; that of dense19 has 11,000
_MAX_SESSION_BYTES: Final = 1 << 30  # bytes of weights and results of all sessions

# The fields of onnx.proto that a model may have, by number, and the message that each holds, if it is one.
_Message = Mapping[int, "_Message | None"]
_TENSOR: Final[_Message] = dict.fromkeys((1, 2, 4, 5, 7, 8, 9, 10, 11, 12))
_ATTRIBUTE: Final[_Message] = {**dict.fromkeys((1, 2, 3, 4, 7, 8, 9, 13, 20)), 5: _TENSOR}
_NODE: Final[_Message] = {**dict.fromkeys((2, 3, 4, 6, 9)), 1: None, 5: _ATTRIBUTE}
_GRAPH: Final[_Message] = {**dict.fromkeys((2, 10, 11, 12, 13, 16)), 1: _NODE, 5: _TENSOR}
_MODEL: Final[_Message] = {**dict.fromkeys((1, 2, 3, 4, 5, 6, 8, 14)), 7: _GRAPH}


def stamp_model(content: bytes) -> bytes:
    """The bytes of a model with its SHA-256 in the place of an old one: for finding damage, no signature."""
    key = DIGEST.encode() + b"\x12\x40"  # protobuf's tag of the value, and its length
    if content.count(key) != 1:
        raise ValueError("the file has no SHA-256")
    first = content.index(key) + len(key)
    place = slice(first, first + 64)
    blank = content[: place.start] + b"0" * 64 + content[place.stop :]
    return content[: place.start] + hashlib.sha256(blank).hexdigest().encode() + content[place.stop :]


def check_model(content: bytes) -> None:
    """Raise a `ValueError` unless a model has the right checksum, and one bounded graph alone."""
    if len(content) > MAX_MODEL_BYTES or stamp_model(content) != content:
        raise ValueError("the SHA-256 is another one")
    parts, waiting = 0, [(_MODEL, memoryview(content))]
    while waiting:
        message, part = waiting.pop()
        for field, value in _fields(part):
            parts += 1
            if field not in message or parts > _MAX_PARTS:
                raise ValueError(f"a model with the field {field}, or with more than {_MAX_PARTS} parts")
            inner = message[field]
            if inner is not None:
                waiting.append((inner, value))


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Number and bytes of each field of a protobuf message."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        match key & 7:
            case 0:
                size = _varint(message, at)[1] - at
            case 1:
                size = 8
            case 2:
                size, at = _varint(message, at)
            case 5:
                size = 4
            case _:
                raise ValueError("not a protobuf message")
        if size > len(message) - at:
            raise ValueError("a protobuf message that was cut off")
        yield key >> 3, message[at : at + size]
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """A number of protobuf, seven bits a byte, and where the next begins."""
    value = 0
    for count, byte in enumerate(message[at : at + 10], 1):
        value |= (byte & 127) << 7 * (count - 1)
        if byte < 128:
            return value, at + count
    raise ValueError("a protobuf message that was cut off")


def bounded_session(content: bytes) -> InferenceSession:
    """A checked model in onnxruntime, on one thread; all such sessions share at most 1 GiB of memory."""
    import onnxruntime

    check_model(content)
    _bound_memory()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # A frame is too small for more.
    options.log_severity_level = 4
    options.add_session_config_entry("session.set_denormal_as_zero", "1")  # distance bumps underflow
    options.add_session_config_entry("session.use_env_allocators", "1")
    return onnxruntime.InferenceSession(
        content,
        options,
        providers=["CPUExecutionProvider"],
        disabled_optimizers=["ConstantFolding"],  # which takes memory outside the bounded allocator
        enable_fallback=0,  # which prints on standard output
    )


@functools.cache
def _bound_memory() -> None:
    """Register an allocator of bounded size, for the sessions that ask for it."""
    import onnxruntime

    kind = onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR
    cpu = onnxruntime.OrtMemoryInfo("Cpu", kind, 0, onnxruntime.OrtMemType.DEFAULT)
    settings = {"max_mem": _MAX_SESSION_BYTES, "arena_extend_strategy": 1, "initial_chunk_size_bytes": -1}
    settings["max_dead_bytes_per_chunk"] = -1
    onnxruntime.create_and_register_allocator(cpu, onnxruntime.OrtArenaCfg(settings))
