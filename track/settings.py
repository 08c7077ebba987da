"""`TrackSettings`: how the hands of a capture or a stream are tracked."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from gloves.fit import GloveFit
from handsim._checks import check_type, make_settings
from handsim.hand.shape import Side
from track.bodies.body_file import AnyBody
from track.config import BOTH, Size, TrackerConfig
from track.given import AnyGlove, AnyLabeler
from track.user import User

AnyHands = User | Sequence[GloveFit] | Sequence[Side] | str | Path
"""A user, hands in their gloves, or the path of a user's file; or sides, whose hands are to be measured."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackSettings:
    """How hands are tracked: keyword arguments of `track_capture`, recorded in the `settings` of a take."""

    glove: AnyGlove | None = None
    """Marker layout, or its shipped name or the path of its .toml file; when None that of `hands`, or dense19
    for hands that are measured."""
    hands: AnyHands = BOTH
    """A user, hands in their gloves or the path of a user's file; or sides."""
    size: Size = "auto"
    """Size of hands of which only the sides are given: XS, S, M, L, XL, or auto, which measures it, and the
    proportions, in the capture."""
    labeler: AnyLabeler = None
    """A labeler, or what `load_labeler` reads; that of the glove when None."""
    bodies: Sequence[AnyBody] = ()
    """Rigid bodies beside the hands: templates, names of handsim's objects, or .toml files."""
    calibrate: bool = False
    """Whether to track twice: hands are calibrated on the first take, as `track.calibrate` does it, and the
    second is made with those that fit better so."""
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    """Settings of the tracker itself, distances in [m] and times in [s]."""

    @classmethod
    def of(cls, settings: Self | None, options: Mapping[str, Any]) -> Self:
        """Settings with some that are given by name.

        Raises:
            ArgumentError: It is something else, or a name is unknown.
        """
        if settings is not None:
            check_type("settings", settings, cls, f"a {cls.__name__}; its fields can be given by name")
        return make_settings(cls, "setting of tracking", options, default=settings)

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> Self:
        """The settings that the `settings` of a take record.

        What was given as an object is recorded by its name, and is the thing of that name here.
        """
        known = {one.name for one in dataclasses.fields(cls)}
        values = {name: value for name, value in record.items() if name in known}
        if "tracker" in values:
            values["tracker"] = make_settings(TrackerConfig, "setting of the tracker", values["tracker"])
        return cls(**values)

    def record(self) -> dict[str, Any]:
        """Itself as JSON; objects by their names."""
        return {
            "glove": _name_of(self.glove),
            "hands": _hands_of(self.hands),
            "size": self.size,
            "labeler": _name_of(self.labeler),
            "bodies": [_name_of(body) for body in self.bodies],
            "calibrate": self.calibrate,
            "tracker": dataclasses.asdict(self.tracker),
        }


def _name_of(thing: Any) -> str | None:
    """What settings call a thing that has a name, or a path, or only a type."""
    if thing is None:
        return None
    return str(thing) if isinstance(thing, str | Path) else str(getattr(thing, "name", type(thing).__name__))


def _hands_of(hands: AnyHands) -> str | list[str]:
    """Sides, or the path of a user's file; sides alone of hands that were given as objects."""
    if isinstance(hands, str | Path):
        return str(hands)
    return [hand.side if isinstance(hand, GloveFit) else str(hand) for hand in hands]
