"""The user: hands of somebody's size in somebody's gloves, which is all a tracker has to know of them."""

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
from handsim._checks import check_array
from handsim.errors import FileError, HandSimError
from handsim.files.atomic import atomic_write
from handsim.hand.model import HandModel
from handsim.hand.shape import HandShape
from handsim.hand.topology import NUM_BONES

SCHEMA: Final = 1
_ARRAYS: Final = {"points": (3,), "normals": (3,), "bone_indices": (4,), "bone_weights": (4,)}
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
        path: The file, by custom `user.json`.
        hands: One hand or two, all in the same glove.
        notes: Whatever a reader should know, such as how the hands were calibrated.

    Raises:
        UserError: There is no hand, two are of one side or wear different gloves, or the file cannot be
            written.
    """
    path = Path(path)
    sides = [hand.side for hand in hands]
    if not hands or len(set(sides)) < len(sides):
        raise UserError(f"hands are {sides}, expected a left hand, a right hand, or one of each")
    layout = hands[0].attachment.layout
    if any(hand.attachment.layout != layout for hand in hands):
        raise UserError("the hands wear different gloves, expected one layout for all")
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
    """Hands and gloves that `save_user` wrote.

    Raises:
        UserError: No such file, no user's file, one of another schema, or a damaged one.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not a user's file: it is no JSON text") from error
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
        raise UserError(f"{path}: a damaged user's file: {_told(error)}") from error
    return hands


def _told(error: Exception) -> str:
    return f"the key {error} is missing" if isinstance(error, KeyError) else str(error)


def _to_json(hand: GloveFit) -> dict[str, Any]:
    shape = hand.model.shape
    named = {field.name: getattr(shape, field.name) for field in dataclasses.fields(shape)}
    shown = {name: np.asarray(value).tolist() for name, value in named.items()}
    worn = {name: np.asarray(getattr(hand.attachment, name)).tolist() for name in _ARRAYS}
    return {"shape": shown, "markers": worn}


def _from_json(stored: dict[str, Any], layout: MarkerLayout) -> GloveFit:
    fields = {field.name for field in dataclasses.fields(HandShape)}
    shape: dict[str, Any] = stored["shape"]
    if set(shape) != fields:
        raise ValueError(f"a hand's shape has the keys {', '.join(map(str, shape))}")
    values: dict[str, Any] = {
        name: np.asarray(value, dtype=np.float64) if isinstance(value, list) else value
        for name, value in shape.items()
    }
    worn = {name: check_array(name, stored["markers"][name], tail) for name, tail in _ARRAYS.items()}
    for name, array in worn.items():
        if array.shape != (layout.num_markers, *_ARRAYS[name]):
            raise ValueError(
                f"{name} has shape {array.shape}, expected ({layout.num_markers}, {_ARRAYS[name][0]})"
            )
    bones = worn["bone_indices"].astype(np.int64)
    if (bones != worn["bone_indices"]).any() or bones.min() < 0 or bones.max() >= NUM_BONES:
        raise ValueError(f"bone_indices are not whole numbers from 0 to {NUM_BONES - 1}")
    shares = worn["bone_weights"]
    if shares.min() < 0.0 or np.abs(shares.sum(axis=1) - 1.0).max() > 1e-6:
        raise ValueError("bone_weights are not shares that sum to one")
    attachment = Attachment(layout, worn["points"], worn["normals"], bones, shares)
    return GloveFit(HandModel(HandShape(**values)), attachment)
