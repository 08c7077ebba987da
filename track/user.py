"""Files of a user: calibrated hands in their gloves, as JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from gloves.attachment import Attachment
from gloves.fit import GloveFit
from gloves.layout import MarkerLayout, stored_layout
from handsim.errors import ArgumentError, FileError, HandSimError
from handsim.files.atomic import atomic_write
from handsim.files.inputs import read_bytes
from handsim.hand.model import HandModel
from handsim.hand.shape import HandShape

SCHEMA: Final = 1
_MOST: Final = 1 << 24  # bytes; a user of two hands has 40,000
_ARRAYS: Final = {"points": "f8", "normals": "f8", "bone_indices": None, "bone_weights": "f8"}
"""The stored arrays of an attachment and their types; indices keep theirs, so that fractions are refused."""
_DAMAGE: Final = (
    KeyError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
    RecursionError,
    HandSimError,
)


class UserError(FileError):
    """A user's file that cannot be read or written."""


def save_user(path: str | Path, hands: Sequence[GloveFit], notes: str = "") -> None:
    """Write a user's hands and gloves as JSON; `load_user` gives the same numbers again.

    Args:
        path: The file, usually `user.json`.
        hands: One hand or two, all in the same glove.
        notes: Remarks for a reader, such as how the hands were calibrated.

    Raises:
        ArgumentError: There is no hand, or two are of one side or wear different gloves.
        UserError: The file cannot be written.
    """
    path = Path(path)
    sides = [hand.side for hand in hands]
    if not hands or len(set(sides)) < len(sides):
        raise ArgumentError(f"hands are {sides}, expected a left hand, a right hand, or one of each")
    layout = hands[0].attachment.layout
    if any(hand.attachment.layout != layout for hand in hands):
        raise ArgumentError("the hands wear different gloves, expected one layout for all")
    content = {
        "schema": SCHEMA,
        "units": "metres, radians; every hand is described as a right one, its markers as they are",
        "notes": notes,
        "glove": dataclasses.asdict(layout),
        "hands": [_to_json(hand) for hand in hands],
    }
    try:
        with atomic_write(path) as temporary:
            temporary.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", "utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from error


def load_user(path: str | Path) -> tuple[GloveFit, ...]:
    """Hands and gloves of a user, from the JSON file that `handsim calibrate` wrote.

    Args:
        path: The file, usually `user.json`; lengths are in [m], angles in [rad].

    Returns:
        One hand or two, each in its glove.

    Raises:
        UserError: The file does not exist, is not a user's file, has another schema, or is damaged.
    """
    path = Path(path)
    try:
        content = json.loads(read_bytes(path, error=UserError, most=_MOST))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not a user's file: it is not JSON text") from error
    if not isinstance(content, dict) or "schema" not in content:
        raise UserError(f"{path}: not a user's file: it has no schema number")
    if content["schema"] != SCHEMA:
        raise UserError(f"{path}: a user's file of schema {content['schema']!r}, expected {SCHEMA}")
    try:
        layout = stored_layout(content["glove"])
        hands = tuple(_from_json(hand, layout) for hand in content["hands"])
        if not hands or len({hand.side for hand in hands}) < len(hands):
            raise ValueError("no hand, or two of one side")
    except _DAMAGE as error:
        raise UserError(f"{path}: a damaged user's file: {_reason(error)}") from error
    return hands


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"the key {error} is missing"
    if isinstance(error, TypeError | AttributeError | OverflowError):  # in the words of Python
        return "a value is of another kind than handsim calibrate writes"
    return " ".join(str(error).splitlines())


def _to_json(hand: GloveFit) -> dict[str, Any]:
    shape = hand.model.shape
    named = {field.name: getattr(shape, field.name) for field in dataclasses.fields(shape)}
    values = {name: np.asarray(value).tolist() for name, value in named.items()}
    markers = {name: np.asarray(getattr(hand.attachment, name)).tolist() for name in _ARRAYS}
    return {"shape": values, "markers": markers}


def _from_json(stored: dict[str, Any], layout: MarkerLayout) -> GloveFit:
    fields = {field.name for field in dataclasses.fields(HandShape)}
    shape: dict[str, Any] = stored["shape"]
    if set(shape) != fields:
        raise ValueError(f"a hand's shape has the keys {', '.join(map(str, shape))}")
    values: dict[str, Any] = {
        name: np.asarray(value, dtype=np.float64) if isinstance(value, list) else value
        for name, value in shape.items()
    }
    markers = {name: np.asarray(stored["markers"][name], dtype) for name, dtype in _ARRAYS.items()}
    return GloveFit(HandModel(HandShape(**values)), Attachment(layout, **markers))
