"""Messages as documents: JSON, or the same objects as MessagePack. docs/live_output.md describes them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from handsim import __version__
from handsim._plugins import import_extra
from track.sinks.message import SCHEMA, LiveBody, LiveHand, LiveHeader, LiveMessage

Encode = Callable[[dict[str, Any]], bytes]
FORMATS: Final = ("json", "msgpack")
_DECIMALS: Final = 6  # micrometers and microradians


def header_document(header: LiveHeader) -> dict[str, Any]:
    """The header: names and units of everything that the frames hold."""
    return {
        "type": "header",
        "schema": SCHEMA,
        "source": f"handsim {__version__}",
        "units": {"length": "m", "angle": "rad", "time": "s", "quaternion": "wxyz"},
        "sides": list(header.sides),
        "angles": list(header.angles),
        "positions": list(header.positions),
        "bodies": list(header.bodies),
        "markers": list(header.markers),
    }


def frame_document(message: LiveMessage, *, points: bool = False) -> dict[str, Any]:
    """A frame: what is NaN in the message is null here.

    Args:
        points: Whether all points and their labels are in it.
    """
    document = {
        "type": "frame",
        "schema": SCHEMA,
        "number": int(message.number),
        "time": float(message.time),
        "silent": message.silent,
        "lag": None if math.isnan(message.lag) else round(message.lag, _DECIMALS),
        "hands": [_hand(hand) for hand in message.hands],
        "bodies": [_body(body) for body in message.bodies],
    }
    if points:
        document["points"] = np.round(message.points, _DECIMALS).tolist()
        document["labels"] = message.labels.tolist()
    return document


def encoder_of(name: str) -> Encode:
    """The function that makes bytes of a document.

    Args:
        name: One of `FORMATS`.

    Raises:
        ArgumentError: The format needs a package that is not installed.
    """
    if name == "json":
        return _encode_json
    packer: Callable[[], Any] = import_extra("msgpack", f"format={name}", "send").Packer
    pack: Encode = packer().pack
    return pack


def _encode_json(document: dict[str, Any]) -> bytes:
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


def _hand(hand: LiveHand) -> dict[str, Any]:
    there = hand.has_pose
    return {
        "side": hand.side,
        "status": str(hand.status),
        "wrist": _pose(hand.position, hand.quaternion) if there else None,
        "angles": np.round(hand.angles, _DECIMALS).tolist() if there else None,
        "positions": np.round(hand.positions, _DECIMALS).tolist() if there else None,
        "angle_spread": _numbers(hand.angle_spread),
        "position_spread": _numbers(hand.position_spread),
    }


def _numbers(values: Float[np.ndarray, "N"]) -> list[float] | None:
    """Rounded numbers; None where they are not known."""
    return None if np.isnan(values).any() else np.round(values, _DECIMALS).tolist()


def _body(body: LiveBody) -> dict[str, Any]:
    pose = _pose(body.position, body.quaternion) if body.has_pose else None
    return {"name": body.name, "status": str(body.status), "pose": pose}


def _pose(position: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]) -> dict[str, list[float]]:
    return {
        "position": np.round(position, _DECIMALS).tolist(),
        "quaternion": np.round(quaternion, _DECIMALS).tolist(),
    }
