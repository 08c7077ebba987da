"""The hands of a take in files: those of the last frames, and those of earlier frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gloves.fit import Attachment, GloveFit
from gloves.layout import MarkerLayout
from gloves.takes.points import ARCH, ATTACHMENT, spans
from handsim.hand.model import HandModel
from handsim.hand.shape import HAND_DTYPE, pack_hand, unpack_hand

FORMER: Final = "former_hands"
"""The array of the earlier hands in a file; files without any lack it."""
_NOTES: Final = "S256"


class FormerHands(NamedTuple):
    """The hands of some frames of a take, before other people's or another size."""

    stop: int
    """The first frame after theirs."""
    hands: tuple[GloveFit, ...]
    """The hands with their gloves as worn, in the order of the take's."""
    notes: str
    """The origin of these hands in words, such as their size and how it was measured."""


def check_former(former: Sequence[FormerHands], hands: Sequence[GloveFit], num_frames: int) -> None:
    """Raise a `ValueError` unless earlier hands end in order, before the last frame, and are like `hands`."""
    stops = [one.stop for one in former]
    kinds = {tuple((one.side, one.layout.num_markers) for one in worn.hands) for worn in former}
    if stops != sorted(stops) or not all(0 <= stop < num_frames for stop in stops):
        raise ValueError(f"former hands end at frames {stops} of {num_frames}")
    if kinds - {tuple((one.side, one.layout.num_markers) for one in hands)}:
        raise ValueError("former hands have other sides or gloves than the last ones")


def hand_arrays(hands: Sequence[GloveFit]) -> dict[str, NDArray[Any]]:
    """The arrays of a file for some hands and their gloves."""
    arrays: dict[str, NDArray[Any]] = {
        "hands": np.array([pack_hand(hand.shape) for hand in hands], dtype=HAND_DTYPE)
    }
    for column in ATTACHMENT:
        parts = [getattr(hand.attachment, column.name.removeprefix("attachment_")) for hand in hands]
        arrays[column.name] = np.concatenate(parts).astype(column.dtype)
    if any(hand.shape.arch.any() for hand in hands):
        arrays[ARCH.name] = np.array([hand.shape.arch for hand in hands])
    return arrays


def unpack_hands(
    arrays: Mapping[str, Any] | np.void, layouts: Sequence[MarkerLayout]
) -> tuple[GloveFit, ...]:
    """The hands of a file's arrays, one for each layout."""
    fits = []
    parts = spans([layout.num_markers for layout in layouts])
    stored = arrays.dtype.names or () if isinstance(arrays, np.void) else arrays
    arches = arrays[ARCH.name] if ARCH.name in stored else np.zeros((len(layouts), 2))
    for record, arch, layout, span in zip(arrays["hands"], arches, layouts, parts, strict=True):
        attached = (arrays[column.name][span.start : span.stop] for column in ATTACHMENT)
        shape = dataclasses.replace(unpack_hand(record), arch=arch)
        fits.append(GloveFit(HandModel(shape), Attachment(layout, *attached)))
    return tuple(fits)


def former_array(former: Sequence[FormerHands], layouts: Sequence[MarkerLayout]) -> NDArray[Any]:
    """The array of a file for earlier hands in gloves of these layouts."""
    arched = any(hand.shape.arch.any() for one in former for hand in one.hands)
    records = np.zeros(len(former), _former_dtype(layouts, arched=arched))
    for record, one in zip(records, former, strict=True):
        record["stop"], record["notes"] = one.stop, one.notes.encode()[: records.dtype["notes"].itemsize]
        for name, array in hand_arrays(one.hands).items():
            record[name] = array
    return records


def unpack_former(records: NDArray[Any], layouts: Sequence[MarkerLayout]) -> tuple[FormerHands, ...]:
    """The earlier hands of a file's array; raises a `ValueError` if it is of another type."""
    valid = [_former_dtype(layouts, arched=arched) for arched in (False, True)]
    if records.ndim != 1 or records.dtype not in valid:
        raise ValueError("former hands of another type")
    return tuple(
        FormerHands(int(one["stop"]), unpack_hands(one, layouts), one["notes"].decode(errors="ignore"))
        for one in records
    )


def _former_dtype(layouts: Sequence[MarkerLayout], *, arched: bool) -> np.dtype[Any]:
    """The type of the array of earlier hands; with `arched`, of hands with a `HandShape.arch`."""
    """The type of the array of earlier hands; with `arched`, of hands with a `HandShape.arch`."""
    num_markers = sum(layout.num_markers for layout in layouts)
    columns = [(column.name, column.dtype, (num_markers, *column.entry)) for column in ATTACHMENT]
    columns += [(ARCH.name, ARCH.dtype, (len(layouts), *ARCH.entry))] if arched else []
    return np.dtype([("stop", "<i8"), ("notes", _NOTES), ("hands", HAND_DTYPE, (len(layouts),)), *columns])
