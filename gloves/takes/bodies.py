"""The rigid bodies of takes, with their own markers and maybe a surface, and their form in files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.takes.archives import names_of
from gloves.takes.points import BODY_MARKERS
from handsim._checks import check_choice
from handsim.errors import ArgumentError
from handsim.hand.shape import SIDES, Side
from handsim.space.objects import Part, RigidObject, named_object, object_names

_VERTICES_ARRAY: Final = "body_vertices_{}"
_FACES_ARRAY: Final = "body_faces_{}"
"""Names of the arrays of a body's surface, with the number of the body."""


@dataclass(frozen=True, slots=True, eq=False)
class RigidBody:
    """A rigid body with markers of its own.

    Raises:
        ArgumentError: A name is no text, there is not one position per marker, a forearm or an elbow is that
            of no side, or the body is both.
    """

    name: str
    marker_names: tuple[str, ...]
    positions: Float[np.ndarray, "Q 3"]
    """Markers in the body's own frame [m]."""
    surface: RigidObject | None = None
    """The body's own surface; None if it has none, or is an object that comes with handsim."""
    forearm: Side | None = None
    """The hand whose forearm it is."""
    has_axes: bool = False
    """Whether its frame is that of a forearm: the frame of the hand's wrist when the wrist is straight."""
    elbow: Side | None = None
    """The hand whose elbow it is. An elbow does not turn when the forearm pronates. Its y axis goes through
    the epicondyles, and is parallel to the forearm's y axis in full supination."""
    is_nominal: bool = False
    """Whether a layout gives its axes, from which markers differ as they are glued."""

    @classmethod
    def of(cls, thing: RigidObject) -> RigidBody:
        """The body of an object."""
        shipped = thing.name in object_names() and thing is named_object(thing.name)
        return cls(thing.name, thing.marker_names, thing.markers, None if shipped else thing)

    def __post_init__(self) -> None:
        if self.positions.shape != (len(self.marker_names), 3):
            expected = f"({len(self.marker_names)}, 3)"
            raise ArgumentError(
                f"{self.name}: positions has shape {self.positions.shape}, expected {expected}"
            )
        if not all(isinstance(name, str) for name in (self.name, *self.marker_names)):
            raise ArgumentError(f"{self.name!r}: a name is no text, expected text for body and markers")
        for part, side in self.limb.items():
            check_choice(side, SIDES, noun=f"side of a {part}")
        if len(self.limb) > 1:
            raise ArgumentError(f"{self.name} is both forearm and elbow, expected a body for each")

    @property
    def shape(self) -> RigidObject | None:
        """Its own surface, or that of the object of this name that comes with handsim, or None."""
        if self.surface is not None:
            return self.surface
        return named_object(self.name) if self.name in object_names() else None

    @property
    def limb(self) -> dict[str, Side]:
        """The hand whose `forearm` or `elbow` it is; empty for other bodies."""
        parts = {"forearm": self.forearm, "elbow": self.elbow}
        return {part: side for part, side in parts.items() if side is not None}

    @property
    def markers(self) -> dict[str, Float[np.ndarray, "3"]]:
        """Each marker's position in the body's frame [m], by its name."""
        return dict(zip(self.marker_names, self.positions, strict=True))

    def record(self) -> dict[str, Any]:
        """The body in the header of a take's file, without its arrays."""
        named: dict[str, Any] = {"name": self.name, "marker_names": list(self.marker_names)}
        named |= {} if self.surface is None else {"surface": True}
        named |= {"nominal": True} if self.is_nominal else {}
        return named | self.limb | ({} if self.forearm is None else {"axes": self.has_axes})


def body_arrays(bodies: Sequence[RigidBody]) -> dict[str, NDArray[Any]]:
    """The arrays of bodies in a take's file: the markers of all, and surfaces."""
    markers = [np.zeros((0, 3)), *(body.positions for body in bodies)]
    arrays: dict[str, NDArray[Any]] = {BODY_MARKERS.name: np.concatenate(markers)}
    for number, body in enumerate(bodies):
        if body.surface is not None:
            arrays[_VERTICES_ARRAY.format(number)] = body.surface.vertices
            arrays[_FACES_ARRAY.format(number)] = body.surface.faces.astype(np.int64)
    return arrays


def stored_body(
    number: int, stored: Mapping[str, Any], markers: range, arrays: Mapping[str, NDArray[Any]]
) -> RigidBody:
    """A body of a file by its record; `RigidObject` checks the arrays of its surface."""
    name, marker_names = stored["name"], names_of(stored["marker_names"])
    has_axes, is_nominal = (bool(stored.get(key, False)) for key in ("axes", "nominal"))
    limb = stored.get("forearm"), has_axes, stored.get("elbow"), is_nominal
    positions = arrays[BODY_MARKERS.name][markers.start : markers.stop]
    if not stored.get("surface", False):
        return RigidBody(name, marker_names, positions, None, *limb)
    vertices, faces = (arrays[key.format(number)] for key in (_VERTICES_ARRAY, _FACES_ARRAY))
    hull = Part("mesh", np.zeros(3), np.eye(4), vertices)
    upright = np.tile([0.0, 0.0, 1.0], (len(positions), 1))  # a file has no normals under markers
    thing = RigidObject(name, vertices, faces, (hull,), marker_names, positions, upright)
    return RigidBody(name, marker_names, positions, thing, *limb)
