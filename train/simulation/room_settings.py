"""The settings of a simulated capture room, and those fitted to the four test captures of Han et al. 2018.

How often cameras drop out and how many reflections flash is fitted to Table 3 and to the ghost ratios of
Table 4 (docs/room_numbers.md says what was fitted to what).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Final, Literal, get_args

from gloves.captures.capture import GapCounts
from gloves.optics.reconstruction import OpticsConfig
from gloves.optics.strays import StrayConfig

Kind = Literal["single-hand", "hand-hand", "hand-pen", "hand-controller"]
"""A kind of capture: what the hands do (section 5 of Han et al. 2018)."""
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
SimulatedKind = Literal[
    "single-hand", "hand-hand", "hand-pen", "hand-controller", "real-like", "calibration", "free"
]
"""These, hands that are like real ones (`train.simulation.real_like`), the exercises that a user is
calibrated by, and hands that move freely (`train.simulation.calibration_take`)."""
SIMULATED_KINDS: Final[tuple[SimulatedKind, ...]] = get_args(SimulatedKind)


@dataclass(frozen=True, slots=True)
class RoomConfig:
    """What the cameras and the surfaces of the room do to what is seen."""

    optics: OpticsConfig = field(default_factory=OpticsConfig)
    """Noise, losses and triangulation of the optical system."""
    strays: StrayConfig = field(default_factory=StrayConfig)
    """Stray reflections carried by every hand and by the object."""
    reflectance: float = 0.5
    """Share of the mirror images in shiny patches that are bright enough."""


@dataclass(frozen=True, slots=True)
class OpticsOptions:
    """The fields of `OpticsConfig`; those that are not given are the ones fitted to the kind of capture."""

    noise: float | None = None
    """Standard deviation of a blob's center per axis [px], for a sphere of 3.2 mm radius."""
    partial: float | None = None
    """Share of a marker's radius within which its visible spot lies, another one for each camera."""
    marker_radius: float | None = None
    """Radius of the glove's spheres [m]; the layout's when not given."""
    roundness: float | None = None
    """Share of the sum of their radii within which two blobs that touch count as one marker."""
    blob_loss: float | None = None
    """Chance that a camera misses a blob it should see."""
    dropout: float | None = None
    """Chance per frame that cameras begin to lose their pictures."""
    dropout_length: float | None = None
    """Mean number of pictures that they lose then."""
    dropout_cameras: int | None = None
    """Number of cameras that lose them together."""
    min_rays: int | None = None
    """Rays that must meet for a point to exist."""
    min_rays_to_start: int | None = None
    """Rays that must meet for a point that did not exist in the frame before."""
    max_residual: float | None = None
    """Largest distance of a ray from its point [m]."""
    min_angle: float | None = None
    """Two rays alone must cross at this angle at least [deg]."""
    min_distance: float | None = None
    """Points nearer to each other than this are one [m]."""

    def applied(self, optics: OpticsConfig) -> OpticsConfig:
        """An optical system with these options in the place of its own.

        Raises:
            ArgumentError: A number is out of range.
        """
        given = {name: value for name, value in dataclasses.asdict(self).items() if value is not None}
        return dataclasses.replace(optics, **given)


@dataclass(frozen=True, slots=True)
class TwinSettings:
    """One of the paper's captures, and the settings that make its simulated twin like it."""

    paper: GapCounts
    """Table 3."""
    ghost_ratio: float
    """Ghosts over expected labels; Table 4."""
    room: RoomConfig
    draw: int
    """Which of many random captures of this kind is the twin: the one nearest to the paper's figures."""


def _room(strays: float, **optics: Any) -> RoomConfig:
    return RoomConfig(
        optics=OpticsConfig(min_rays_to_start=2, **optics),
        strays=StrayConfig(number=strays),
    )


def _losses(blob_loss: float, dropout: float, length: float, cameras: int) -> dict[str, float]:
    return {
        "blob_loss": blob_loss,
        "dropout": dropout,
        "dropout_length": length,
        "dropout_cameras": cameras,
    }


TWINS: Final[dict[str, TwinSettings]] = {
    "single-hand": TwinSettings(
        GapCounts(4785, 44, 2.11, 1.35), 0.0001, _room(0.0, **_losses(0.01, 0.016, 2.2, 6)), draw=8
    ),
    "hand-hand": TwinSettings(
        GapCounts(3312, 331, 4.01, 3.30), 0.1063, _room(7.0, **_losses(0.002, 0.35, 1.5, 4)), draw=8
    ),
    "hand-pen": TwinSettings(
        GapCounts(4511, 481, 3.39, 2.31), 0.0755, _room(3.0, **_losses(0.002, 0.17, 1.4, 6)), draw=15
    ),
    "hand-controller": TwinSettings(
        GapCounts(2645, 382, 2.65, 1.62), 0.0450, _room(1.7, **_losses(0.115, 0.0, 1.0, 1)), draw=2
    ),
}
_ALIKE: Final[dict[str, str]] = {
    "real-like": "hand-hand",
    "free": "single-hand",
}  # kinds whose rooms are alike


def usual_room(kind: SimulatedKind) -> RoomConfig:
    """The room of the paper's capture of a kind, or of the one most like it."""
    return RoomConfig() if kind == "calibration" else TWINS[_ALIKE.get(kind, kind)].room
