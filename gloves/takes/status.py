"""How far a pose can be relied on."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """How far the pose of a hand or a rigid body can be relied on; `str` gives its word."""

    LOST = 0
    """There is no pose."""
    COASTING = 1
    """Too few markers are visible: the pose is the predicted one; it is given for a few frames only."""
    INITIALIZED = 2
    """The pose was initialized from the points, without history; its word is "found"."""
    TRACKED = 3
    """The pose continues that of the frame before."""

    def __str__(self) -> str:
        return "found" if self is Status.INITIALIZED else self.name.lower()
