"""Messages as a stream of the Lab Streaming Layer (LSL): one channel a number, described in its XML."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from gloves.takes.points import Status
from handsim._plugins import import_extra
from track.sinks.message import SCHEMA, LiveHeader, LiveMessage

STATUSES: Final = tuple(reversed(Status))
"""The value of a status channel is an index into these."""
_AXES: Final = ("x", "y", "z")
_POSE: Final = (*[(f"position_{axis}", "meters") for axis in _AXES], *[(f"rotation_{c}", "") for c in "wxyz"])


class Channel(NamedTuple):
    """One number of a sample."""

    label: str
    unit: str
    kind: str


class LabStreamingSink:
    """Pushes a sample per frame; a number that is missing is NaN.

    Raises:
        ArgumentError: The package pylsl or its library is missing.
    """

    def __init__(self, name: str) -> None:
        self._lsl: Any = import_extra("pylsl", "lsl:", "send")
        self._name = name
        self._outlet: Any = None

    def send(self, message: LiveMessage) -> None:
        """Push a sample; the first one opens the stream, whose channels depend on the hands."""
        if self._outlet is None:
            self._outlet = self._open(message.header)
        self._outlet.push_sample(sample_of(message).tolist())

    def close(self) -> None:
        """End the stream."""
        self._outlet = None

    def _open(self, header: LiveHeader) -> Any:
        channels = list(channels_of(header))
        info = self._lsl.StreamInfo(
            self._name,
            "MoCap",
            len(channels),
            self._lsl.IRREGULAR_RATE,
            self._lsl.cf_double64,
            f"handsim:{self._name}",  # a client finds the stream again after a restart
        )
        description = info.desc()
        description.append_child_value("manufacturer", "handsim")
        description.append_child_value("schema", str(SCHEMA))
        description.append_child_value("statuses", " ".join(str(status) for status in STATUSES))
        listed = description.append_child("channels")
        for channel in channels:
            one = listed.append_child("channel")
            one.append_child_value("label", channel.label)
            one.append_child_value("unit", channel.unit)
            one.append_child_value("type", channel.kind)
        return self._lsl.StreamOutlet(info)


def channels_of(header: LiveHeader) -> Iterator[Channel]:
    """The channels of a stream, in the order of `sample_of`."""
    yield Channel("frame", "", "FrameNumber")
    yield Channel("time", "seconds", "Time")
    for side in header.sides:
        yield Channel(f"{side}_status", "", "Status")
        for label, unit in _POSE:
            yield Channel(f"{side}_wrist_{label}", unit, _kind(label))
        for joint in header.angles:
            yield Channel(f"{side}_{joint}", "radians", "JointAngle")
        for place in header.positions:
            for axis in _AXES:
                yield Channel(f"{side}_{place}_{axis}", "meters", f"Position{axis.upper()}")
    for body in header.bodies:
        yield Channel(f"{body}_status", "", "Status")
        for label, unit in _POSE:
            yield Channel(f"{body}_{label}", unit, _kind(label))
    yield Channel("lag", "seconds", "Lag")


def sample_of(message: LiveMessage) -> np.ndarray:
    """The numbers of a message, one per channel."""
    parts: list[Any] = [[message.number, message.time]]
    for hand in message.hands:
        parts.append([STATUSES.index(hand.status)])
        parts += [hand.position, hand.quaternion, hand.angles, hand.positions.ravel()]
    for body in message.bodies:
        parts += [[STATUSES.index(body.status)], body.position, body.quaternion]
    parts.append([message.lag])
    return np.concatenate(parts)


def _kind(label: str) -> str:
    """The channel type of XDF's motion capture: PositionX, OrientationW."""
    what, _, axis = label.partition("_")
    return ("Position" if what == "position" else "Orientation") + axis.upper()
