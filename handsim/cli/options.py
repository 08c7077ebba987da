"""Options that several commands share: whose hands are tracked, and into which file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from handsim.errors import ArgumentError
from handsim.hand.shape import Side
from track.config import BOTH, Size

if TYPE_CHECKING:
    from track.settings import AnyHands


def check_take_file(out: Path, *, live: bool) -> None:
    """Refuse a file for a take that is named otherwise, or whose take a recording would replace.

    Args:
        out: The option --out.
        live: Whether a stream is recorded; corrections would fit no other recording.
    """
    from gloves.takes.corrections import corrections_path
    from gloves.takes.take import SUFFIX

    if out.suffix.lower() != ".npz" or out.name.endswith(SUFFIX):
        raise ArgumentError(f"--out is {out}, expected a file name that ends in .npz and not in {SUFFIX}")
    corrections = corrections_path(out)
    if live and corrections.exists():
        raise ArgumentError(
            f"{corrections} corrects the take that --live would replace, expected another --out than {out}"
        )


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
