"""The user's hands from the options of a command: a size or a calibrated user's file, and which hands."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

from gloves.fit import GloveFit, nominal_fit
from gloves.layout import load_layout
from handsim.errors import ArgumentError, choices
from handsim.hand.topology import Side
from track.calibration.hand_size import fit_size
from track.streams.frame_source import StreamedFrame
from track.user import load_user
from train.labelers.protocol import Labeler

Size = Literal["auto", "XS", "S", "M", "L", "XL"]
USUAL_SIZE: Final = "M"
"""The size of hands that could not be measured."""
BOTH: Final[tuple[Side, ...]] = ("right", "left")


def users_of(
    glove: str, size: Size | None, shape: Path | None, hands: tuple[Side, ...] | None
) -> tuple[GloveFit, ...]:
    """Hands as a command's options name them; of the usual size where it is to be measured.

    Args:
        glove: Marker layout: a shipped name or the path of a .toml file.
        size: The option --size.
        shape: The option --shape, a user's file.
        hands: Sides; both, or all of the file, when None.

    Raises:
        UserError: The file cannot be read.
        LayoutError: The glove is unknown or does not fit.
        ArgumentError: Size and file are both given, or the file has no such hand or another glove.
    """
    if shape is not None:
        return calibrated_users(shape, glove, size, hands)
    named = USUAL_SIZE if size is None or size == "auto" else size
    return uncalibrated_users(glove, named, BOTH if hands is None else hands)


def measured_users(
    glove: str, hands: Sequence[Side], frames: Sequence[StreamedFrame], labeler: Labeler
) -> tuple[tuple[GloveFit, ...], str | None]:
    """Hands as measured in some frames.

    Args:
        glove: Marker layout: a shipped name or the path of a .toml file.
        hands: Their sides.
        frames: Frames of unlabeled points.
        labeler: Labeler of the glove.

    Returns:
        The hands, and their size in words. Hands that are not found have the usual size, and no words.

    Raises:
        LayoutError: The glove is unknown or does not fit.
        ArgumentError: A hand is given twice, or none is.
    """
    _check_hands(hands)
    layout = load_layout(glove)
    size = fit_size(frames, layout, hands, labeler)
    if size is None:
        return uncalibrated_users(glove, USUAL_SIZE, hands), None
    return size.hands(hands), str(size)


def uncalibrated_users(glove: str, size: str, hands: Sequence[Side]) -> tuple[GloveFit, ...]:
    """Hands of one size in a glove as designed.

    Args:
        glove: Marker layout: a shipped name or the path of a .toml file.
        size: Size of the hands: XS, S, M, L or XL.
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
