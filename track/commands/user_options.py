"""The user's hands from the options of a command: a size or a calibrated user's file, and which hands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

from gloves.fit import GloveFit, nominal_fit
from gloves.layout import load_layout
from handsim.errors import ArgumentError, choices
from handsim.hand.topology import Side
from track.user import load_user

Size = Literal["XS", "S", "M", "L", "XL"]
BOTH: Final[tuple[Side, ...]] = ("right", "left")


def uncalibrated_users(glove: str, size: Size, hands: Sequence[Side]) -> tuple[GloveFit, ...]:
    """Hands of one size in a glove as designed.

    Args:
        glove: Marker layout: a shipped name or the path of a .toml file.
        size: Size of the hands.
        hands: Their sides.

    Raises:
        LayoutError: The glove is unknown or does not fit.
        ArgumentError: A hand is given twice, or none is.
    """
    _check_hands(hands)
    layout = load_layout(glove)
    return tuple(nominal_fit(layout, size, side) for side in hands)


def _check_hands(hands: Sequence[Side]) -> None:
    """Raise an `ArgumentError` unless there is at least one side, each at most once."""
    if not hands or len(set(hands)) < len(hands):
        raise ArgumentError(f"--hands is '{' '.join(hands)}', expected right, left, or one of each")


def calibrated_users(
    shape: Path, glove: str, size: Size | None, hands: tuple[Side, ...] | None
) -> tuple[GloveFit, ...]:
    """Hands of a user's file.

    Args:
        shape: The file.
        glove: Marker layout that the hands must have.
        size: The option --size, which must not be given.
        hands: Sides; all of the file when None.

    Raises:
        UserError: The file cannot be read.
        ArgumentError: It has no such hand or another glove, or a size is given as well.
    """
    if size is not None:
        raise ArgumentError(f"given --size {size} and --shape {shape}, expected one of them")
    known = {hand.side: hand for hand in load_user(shape)}
    sides = tuple(known) if hands is None else hands
    _check_hands(sides)
    for side in sides:
        if side not in known:
            raise ArgumentError(f"{shape}: {choices(side, known, noun='hand')}")
    names, expected = known[next(iter(known))].attachment.layout.names, load_layout(glove).names
    if names != expected:
        raise ArgumentError(
            f"{shape} is of a glove with the markers {', '.join(names)}, "
            f"but glove '{glove}' has {', '.join(expected)}"
        )
    return tuple(known[side] for side in sides)
