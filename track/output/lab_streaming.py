"""A stream of the Lab Streaming Layer with a sample of numbers for each tracked frame."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from gloves.takes.points import Status
from handsim._plugins import import_extra
from track.output.live_message import SCHEMA, LiveHeader, LiveMessage

_CONFIGS: Final = ("lsl_api.cfg", "~/lsl_api/lsl_api.cfg", "/etc/lsl_api/lsl_api.cfg")
_QUIET_CONFIG: Final = "[log]\nlevel = -1\n"  # makes LSL write warnings only, unless the user configured it
STATUSES: Final = tuple(reversed(Status))
"""A status channel of LSL holds an index into these."""
_XYZ: Final = ("x", "y", "z")
_POSE: Final = (*[(f"position_{axis}", "meters") for axis in _XYZ], *[(f"rotation_{c}", "") for c in "wxyz"])

_Channel = tuple[str, str, str]
"""Label, unit and kind of one channel of an LSL stream."""


class LabStreamingSink:
    """Pushes a sample per frame into a stream of the Lab Streaming Layer; missing numbers are NaN."""

    def __init__(self, name: str) -> None:
        self._lsl: Any = import_extra("pylsl", "lsl:", "send")
        configured = "LSLAPICFG" in os.environ or any(Path(one).expanduser().exists() for one in _CONFIGS)
        if not configured:
            with suppress(AttributeError, NotImplementedError):  # old versions cannot be told
                self._lsl.set_config_content(_QUIET_CONFIG)
        self._name = name
        self._outlet: Any = None

    def send(self, message: LiveMessage) -> None:
        """Push a sample; the first one opens the stream, whose channels depend on the header."""
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
            f"handsim:{self._name}",  # Clients find the stream again by this ID.
        )
        description = info.desc()
        description.append_child_value("manufacturer", "handsim")
        description.append_child_value("schema", str(SCHEMA))
        description.append_child_value("statuses", " ".join(str(status) for status in STATUSES))
        listed = description.append_child("channels")
        for channel in channels:
            one = listed.append_child("channel")
            for name, value in zip(("label", "unit", "type"), channel, strict=True):
                one.append_child_value(name, value)
        return self._lsl.StreamOutlet(info)


def channels_of(header: LiveHeader) -> Iterator[_Channel]:
    """The channels of a stream, in the order of `sample_of`."""
    yield ("frame", "", "FrameNumber")
    yield ("time", "seconds", "Time")
    for side in header.sides:
        yield from _pose_channels(f"{side}_status", f"{side}_wrist")
        for joint in header.angles:
            yield (f"{side}_{joint}", "radians", "JointAngle")
        for place in header.positions:
            for axis in _XYZ:
                yield (f"{side}_{place}_{axis}", "meters", f"Position{axis.upper()}")
    for body in header.bodies:
        yield from _pose_channels(f"{body}_status", body)
    yield ("lag", "seconds", "Lag")
    for side in header.sides:
        yield (f"{side}_seen", "", "Share")
        yield from ((f"{side}_{digit}_status", "", "Status") for digit in header.digits)
        yield from ((f"{side}_{joint}_spread", "radians", "Spread") for joint in header.angles)
        yield from ((f"{side}_{place}_spread", "meters", "Spread") for place in header.positions)
    yield ("measured", "", "Status")
    for side in header.sides:
        yield from ((f"{side}_{angle}", "radians", "JointAngle") for angle in header.wrist_angles)


def _pose_channels(status: str, name: str) -> Iterator[_Channel]:
    """Channels of status, position and orientation, with XDF's kinds of motion capture, as PositionX."""
    yield (status, "", "Status")
    for label, unit in _POSE:
        what, _, axis = label.partition("_")
        kind = ("Position" if what == "position" else "Orientation") + axis.upper()
        yield (f"{name}_{label}", unit, kind)


def sample_of(message: LiveMessage) -> np.ndarray:
    """The numbers of a message, one per channel."""
    parts: list[Any] = [[message.number, message.time]]
    for hand in message.hands:
        parts.append([STATUSES.index(hand.status)])
        parts += [hand.position, hand.quaternion, hand.angles, hand.positions.ravel()]
    for body in message.bodies:
        parts += [[STATUSES.index(body.status)], body.position, body.quaternion]
    parts.append([message.lag])
    for hand in message.hands:
        parts += [[hand.seen if hand.has_pose else math.nan], [STATUSES.index(one) for one in hand.digits]]
        parts += [hand.angle_spread, hand.position_spread]
    parts += [[not message.size_state], *(hand.wrist_angles for hand in message.hands)]
    return np.concatenate(parts)
