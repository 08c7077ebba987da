"""Messages of live output as bundles of Open Sound Control 1.0."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import numpy as np

from handsim._plugins import import_extra
from track.output.live_message import SCHEMA, Content, LiveHeader, LiveMessage, MessageFormat, in_axes

_RESERVED: Final = re.compile(r"[^!-~]|[#*,/?\[\]{}]")  # not allowed in a part of an OSC address
_LARGEST_BUNDLE: Final = 8000  # [bytes] Networks carry a larger bundle than a packet in several packets.
_BUNDLE_HEAD, _BUNDLE_ENTRY = 16, 4  # [bytes] overhead of an OSC bundle and of each message in it
_LARGEST_INTEGER: Final = 0x7FFFFFFF  # largest integer of an OSC message

_Message = tuple[str, str, Sequence[Any]]
"""Address, types and values of an OSC message."""


def osc_format(content: Content = Content()) -> MessageFormat:  # noqa: B008 (immutable)
    """The format of bundles of Open Sound Control 1.0, whose addresses docs/live_output.md lists."""
    program = content.program
    messages: Any = import_extra("pythonosc.osc_message_builder", "osc://", "send")
    bundles: Any = import_extra("pythonosc.osc_bundle_builder", "osc://", "send")

    def built(content: _Message) -> Any:
        address, types, values = content
        message = messages.OscMessageBuilder(address)
        for kind, value in zip(types, values, strict=True):
            message.add_arg(value, kind)
        return message.build()

    def divided(contents: Iterable[_Message]) -> list[bytes]:
        """Bundles that fit into packets; each begins with the first message."""
        first, *others = map(built, contents)
        made, room = [], 0
        for message in others or [first]:
            if message.size + _BUNDLE_ENTRY > room:
                made.append(bundles.OscBundleBuilder(bundles.IMMEDIATELY))
                room = _LARGEST_BUNDLE - _BUNDLE_HEAD
                if message is not first:
                    made[-1].add_content(first)
                    room -= first.size + _BUNDLE_ENTRY
            made[-1].add_content(message)
            room -= message.size + _BUNDLE_ENTRY
        return [one.build().dgram for one in made]

    def frame(message: LiveMessage) -> list[bytes]:
        return divided(_osc_frame(message if program is None else in_axes(message, program), content))

    return MessageFormat(
        lambda header: divided(_osc_header(header)), frame, lambda: divided([("/handsim/end", "", [])])
    )


def _osc_header(header: LiveHeader) -> Iterator[_Message]:
    """Messages of the header: names in the order of the numbers in frames."""
    yield "/handsim/schema", "i", [SCHEMA]
    for name in ("sides", "angles", "positions", "digits"):
        yield _strings(f"/handsim/{name}", getattr(header, name))
    if header.wrist_angles:
        yield _strings("/handsim/wrist_angles", header.wrist_angles)
    yield _strings("/handsim/bodies", [_address_part(name) for name in header.bodies])


def _osc_frame(message: LiveMessage, content: Content) -> Iterator[_Message]:
    """Messages of a frame; a hand or body without a pose has only a status."""
    yield "/handsim/frame", "idi", [message.number & _LARGEST_INTEGER, message.time, int(message.silent)]
    for name, seconds in (("lag", message.lag), ("latency", message.latency)):
        if not math.isnan(seconds):
            yield f"/handsim/{name}", "f", [seconds]
    if message.size_state:
        yield _strings("/handsim/size_state", [message.size_state])
    for hand in message.hands:
        address = f"/handsim/{hand.side}"
        yield _strings(f"{address}/status", [str(hand.status)])
        if hand.has_pose:
            yield _floats(f"{address}/seen", np.array([hand.seen]))
            yield _strings(f"{address}/digits", [str(status) for status in hand.digits])
            yield _floats(f"{address}/wrist", hand.position, hand.quaternion)
            yield _floats(f"{address}/angles", hand.angles)
            yield _floats(f"{address}/positions", hand.positions.ravel())
        if not np.isnan(hand.wrist_angles).all():
            yield _floats(f"{address}/wrist_angles", hand.wrist_angles)
        if not np.isnan(hand.angle_spread).any():
            yield _floats(f"{address}/angle_spread", hand.angle_spread)
            yield _floats(f"{address}/position_spread", hand.position_spread)
        if content.velocities and not np.isnan(hand.angle_velocities).any():
            yield _floats(f"{address}/angle_velocities", hand.angle_velocities)
            yield _floats(f"{address}/velocities", hand.find_velocities().ravel())
    for body in message.bodies:
        address = f"/handsim/body/{_address_part(body.name)}"
        yield _strings(f"{address}/status", [str(body.status)])
        if body.has_pose:
            yield _floats(f"{address}/pose", body.position, body.quaternion)


def _address_part(name: str) -> str:
    """Make a name valid as a part of an OSC address."""
    return _RESERVED.sub("_", name)


def _floats(address: str, *values: np.ndarray) -> _Message:
    numbers = np.concatenate(values).tolist()
    return address, "f" * len(numbers), numbers


def _strings(address: str, values: Sequence[str]) -> _Message:
    return address, "s" * len(values), values
