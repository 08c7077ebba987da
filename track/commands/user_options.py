"""Who is tracked, as options of a command say it: a size, a calibrated user's file, which hands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

from gloves.fit import GloveFit, nominal_fit
from gloves.layout import load_layout
from handsim.errors import HandSimError, choices
from handsim.hand.topology import Side
from track.user import load_user

Size = Literal["XS", "S", "M", "L", "XL"]
BOTH: Final[tuple[Side, ...]] = ("right", "left")


def users(glove: str, size: Size, hands: Sequence[Side]) -> tuple[GloveFit, ...]:
    """Hands of one size in a glove.

    Raises:
        LayoutError: The glove is unknown or does not fit.
        HandSimError: A hand is named twice, or none is.
    """
    _check_hands(hands)
    layout = load_layout(glove)
    return tuple(nominal_fit(layout, size, side) for side in hands)


def _check_hands(hands: Sequence[Side]) -> None:
    """Raise a `HandSimError` unless each side is there once at most, and one is."""
    if not hands or len(set(hands)) < len(hands):
        raise HandSimError(f"--hands is '{' '.join(hands)}', expected right, left, or one of each")


def calibrated_users(
    shape: Path, glove: str, size: Size | None, hands: tuple[Side, ...] | None
) -> tuple[GloveFit, ...]:
    """Hands of a user's file.

    Raises:
        UserError: The file cannot be read.
        HandSimError: It has no such hand, another glove, or a size is given beside it.
    """
    if size is not None:
        raise HandSimError(f"given --size {size} and --shape {shape}, expected one of them")
    known = {hand.side: hand for hand in load_user(shape)}
    wanted_hands = tuple(known) if hands is None else hands
    _check_hands(wanted_hands)
    for side in wanted_hands:
        if side not in known:
            raise HandSimError(f"{shape}: {choices(side, known, noun='hand')}")
    names, wanted = known[next(iter(known))].attachment.layout.names, load_layout(glove).names
    if names != wanted:
        raise HandSimError(
            f"{shape} is of a glove with the markers {', '.join(names)}, "
            f"but glove '{glove}' has {', '.join(wanted)}"
        )
    return tuple(known[side] for side in wanted_hands)
