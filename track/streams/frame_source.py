"""The frames of a live stream, and what delivers them: NatNet, Qualisys, or a class of the user's own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from jaxtyping import Float, Int

SILENCE: Final = 2.0
"""Time without a frame [s] after which a stream yields a silent frame."""


@dataclass(frozen=True, slots=True, eq=False)
class StreamedFrame:
    """The points of one frame."""

    number: int
    """The server's number of the frame."""
    time: float
    """The server's time [s]."""
    points: Float[np.ndarray, "N 3"]
    """[m], in the server's axes."""
    ids: Int[np.ndarray, "N"]
    """The server's ID of each point, -1 where it gives none."""
    silent: bool = False
    """No frame arrived for a while: there are no points, and number and time are those of the last frame."""
    restarted: bool = False
    """The server's time began anew: it does not continue that of the frame before."""


class FrameSource(Protocol):
    """Delivers the frames of a system of the user's own, for `handsim track --live module:name`.

    The points of a frame are in [m], times in [s]. It is iterated in a thread of its own, once; waiting for
    the next frame is its own affair, and so is an end: after the last frame the take is written. An exception
    ends the stream in the same way, and is told.
    """

    def __iter__(self) -> Iterator[StreamedFrame]:
        """The frames in the order of their times."""
        ...

    def close(self) -> None:
        """No further frame is wanted; called once, from another thread, while a frame may be waited for."""
        ...
