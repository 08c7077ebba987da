"""Options that several commands share: whose hands are tracked."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from handsim.errors import ArgumentError
from handsim.hand.topology import Side
from track.config import BOTH, Size

if TYPE_CHECKING:
    from track.setup import AnyHands


def chosen_hands(
    shape: Path | None, hands: tuple[Side, ...] | None, size: Size | None
) -> tuple[AnyHands, Size]:
    """The hands and the size that options name, as `track_capture` takes them.

    Args:
        shape: The option --shape, a user's file.
        hands: The option --hands; both, or all of the file, when None.
        size: The option --size, which must not be given with a file.

    Raises:
        UserError: The file cannot be read.
        ArgumentError: Size and file are both given, or the file has no such hand.
    """
    from track.user import load_user

    if shape is None:
        return BOTH if hands is None else hands, size or "auto"
    if size is not None:
        raise ArgumentError(f"given --size {size} and --shape {shape}, expected one of them")
    if hands is None:
        return shape, "auto"
    return dataclasses.replace(load_user(shape).of_sides(hands), notes=shape.name), "auto"
