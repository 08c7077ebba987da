"""Settings of forecasts: scoring of gloves and rigs, and the search for better ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal, get_args

from gloves.layout import MAX_MARKERS, MIN_MARKERS, AnyLayout
from gloves.takes.take import Take
from handsim.errors import ArgumentError
from handsim.settings import Expected, Limits, Settings
from handsim.space.rig import MAX_SIDE, ROOM_CENTER, AnyRig, Center
from train.labelers.protocol import Labeler

Mount = Literal["walls", "truss", "tripods"]
MOUNTS: Final[tuple[Mount, ...]] = get_args(Mount)
POSES: Final = "poses"
TWINS: Final = "twins"
_Sides = Annotated[tuple[float, float, float], Limits(0.0, MAX_SIDE, above=True)]
_Seed = Annotated[int, Limits(0)]


@dataclass(frozen=True, slots=True)
class ScoreRigSettings(Settings):
    """What hands do in front of a rig: options of `handsim rig score`, arguments of `score_rig`."""

    volume: _Sides = (0.6, 0.6, 0.6)
    """Sides of the space in which hands work [m]."""
    center: Center | None = None
    """Center of that space [m]; (0, 0, 1.1) when not given, or the center of the take's hands."""
    take: Annotated[Take | str | Path | None, Expected("a Take, or the path of one")] = None
    """A take (.npz) of `handsim track` or `handsim simulate`, whose hands work where they are; simulated
    people when not given."""
    glove: AnyLayout | None = None
    """Marker layout: a shipped name or the path of a .toml file; dense19 or that of the take when not
    given."""
    num_frames: Annotated[int, Limits(60)] = 900
    """Frames of every person and kind of work, or of the take."""
    seed: _Seed = 0
    """Seed of people, motion and cameras' losses."""


@dataclass(frozen=True, slots=True)
class PlanRigSettings(Settings):
    """What a rig is planned for: options of `handsim rig plan`, arguments of `plan_rig`."""

    mounts: tuple[Mount, ...] = MOUNTS
    """What cameras can be mounted on: walls, a truss along the room's edges (four beams above, four posts),
    tripods."""
    volume: _Sides = (0.6, 0.6, 0.6)
    """Sides of the space in which hands work [m]."""
    center: Center = ROOM_CENTER
    """Center of that space [m]."""
    keep: AnyRig | None = None
    """A rig whose cameras stay where they are, a .toml file or a shipped name; the new ones are like its
    first."""
    size: Annotated[tuple[int, int], Limits(1)] = (1280, 1280)
    """Width and height of the new cameras' pictures [px]."""
    field_of_view: Annotated[float, Limits(1.0, 170.0)] = 60.0
    """Full angle across the shorter side of the new cameras' pictures [deg]."""
    glove: AnyLayout = "dense19"
    """Marker layout: a shipped name or the path of a .toml file."""
    seed: _Seed = 0
    """Seed of people and motion."""

    def check(self) -> None:
        """Refuse a plan without mounts, or with a picture size although new cameras copy a kept one."""
        if self.keep is not None and self.changed("size", "field_of_view"):
            raise ArgumentError(
                f"given keep {self.keep}, and size or field of view, expected none of them: new cameras are "
                "like the first one that is kept"
            )
        if not self.mounts:
            raise ArgumentError(f"mounts is empty, expected some of {', '.join(MOUNTS)}")


@dataclass(frozen=True, slots=True)
class ScoreGloveSettings(Settings):
    """How a layout is scored: options of `handsim glove score`, arguments of `score_glove`."""

    rig: AnyRig = "figure5"
    """Camera rig: a shipped name or the path of a .toml file."""
    motion: Annotated[Take | str | Path, Expected("a Take, or the path of one", lambda: (POSES, TWINS))] = (
        POSES
    )
    """What hands do: poses (random people and poses), twins (simulated motion of one hand and of two) or a
    take (.npz) of `handsim track` or `handsim simulate`."""
    num_frames: Annotated[int, Limits(100)] = 1500
    """Frames of hands; of a take, frames of each hand."""
    labeler: Annotated[Labeler | str | Path | None, Expected("a Labeler, or the path of one")] = None
    """Folder of a labeler trained on the layout, or an exported .onnx file; the network for any layout when
    not given."""
    captures: Annotated[int, Limits(0)] = 3
    """Captures of each kind of work that are tried, of different people; 0 for none."""
    seed: _Seed = 0
    """Seed of people, poses and cameras' losses; captures have their own."""

    def check(self) -> None:
        """Refuse a motion that is not a take."""
        motion = self.motion
        if not isinstance(motion, Take) and motion not in (POSES, TWINS) and Path(motion).suffix != ".npz":
            raise ArgumentError(f"motion is '{motion}', expected {POSES}, {TWINS} or a take (.npz)")


@dataclass(frozen=True, slots=True)
class ImproveGloveSettings(Settings):
    """How a better layout is searched: options of `handsim glove improve`, arguments of `improve_glove`."""

    markers: Annotated[int | None, Limits(MIN_MARKERS, MAX_MARKERS)] = None
    """Number of markers of the new layout; as many as before when not given."""
    keep: tuple[str, ...] = ()
    """Names of markers that stay where they are."""
    rig: AnyRig = "figure5"
    """Camera rig: a shipped name or the path of a .toml file."""
    minutes: Annotated[float, Limits(0.0)] = 3.0
    """Time for moving markers [min]."""
    captures: Annotated[int, Limits(0)] = 3
    """Captures of each kind of work on which both layouts are tried at the end; 0 for none."""
    seed: _Seed = 0
    """Seed of people, poses and tried places."""
