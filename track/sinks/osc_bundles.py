"""Messages as bundles of Open Sound Control 1.0. docs/live_output.md lists the addresses."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from track.sinks.message import SCHEMA, LiveHeader, LiveMessage

if TYPE_CHECKING:
    from jaxtyping import Float

_AT_ONCE: Final = 1  # the time tag of what holds when it arrives
_RESERVED: Final = re.compile(r"[^!-~]|[#*,/?\[\]{}]")  # not allowed in a part of an address
_MOST_NUMBER: Final = 0x7FFFFFFF


def header_bundle(header: LiveHeader) -> bytes:
    """The names in the order of the numbers."""
    return _bundle(
        [
            _packed("/handsim/schema", "i", struct.pack(">i", SCHEMA)),
            _strings("/handsim/sides", header.sides),
            _strings("/handsim/angles", header.angles),
            _strings("/handsim/positions", header.positions),
            _strings("/handsim/bodies", [_part(name) for name in header.bodies]),
        ]
    )


def frame_bundle(message: LiveMessage) -> bytes:
    """A frame; of a hand or a body without a pose only the status."""
    number = message.number & _MOST_NUMBER
    frame = struct.pack(">idi", number, message.time, message.silent)
    packets = [_packed("/handsim/frame", "idi", frame)]
    for hand in message.hands:
        packets.append(_strings(f"/handsim/{hand.side}/status", [hand.status.value]))
        if hand.has_pose:
            wrist = np.concatenate([hand.position, hand.quaternion])
            packets.append(_floats(f"/handsim/{hand.side}/wrist", wrist))
            packets.append(_floats(f"/handsim/{hand.side}/angles", hand.angles))
            packets.append(_floats(f"/handsim/{hand.side}/positions", hand.positions.ravel()))
    for body in message.bodies:
        address = f"/handsim/body/{_part(body.name)}"
        packets.append(_strings(f"{address}/status", [body.status.value]))
        if body.has_pose:
            packets.append(_floats(f"{address}/pose", np.concatenate([body.position, body.quaternion])))
    return _bundle(packets)


def _part(name: str) -> str:
    """A name as a part of an address."""
    return _RESERVED.sub("_", name)


def _bundle(packets: Iterable[bytes]) -> bytes:
    sized = b"".join(struct.pack(">i", len(packet)) + packet for packet in packets)
    return b"#bundle\0" + struct.pack(">Q", _AT_ONCE) + sized


def _packed(address: str, types: str, content: bytes) -> bytes:
    return _string(address) + _string("," + types) + content


def _floats(address: str, values: Float[np.ndarray, "N"]) -> bytes:
    return _packed(address, "f" * len(values), values.astype(">f4").tobytes())


def _strings(address: str, values: Sequence[str]) -> bytes:
    return _packed(address, "s" * len(values), b"".join(map(_string, values)))


def _string(text: str) -> bytes:
    """A text, ended and filled up to four bytes by zeros."""
    encoded = text.encode("ascii", "replace")
    return encoded + bytes(4 - len(encoded) % 4)
