"""The settings of a training set: people, poses, scenes, cameras and losses."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from gloves.layout import MarkerLayout, list_layouts
from gloves.optics.ghosts import GhostConfig
from gloves.optics.reconstruction import OpticsConfig
from handsim._checks import check_count, check_number, check_span, check_type, fill_settings
from handsim.errors import DatasetError
from handsim.hand.shape import Population
from handsim.space.rig import CameraRig, list_rigs
from poses.shapes.samplers import PoseMix
from poses.shapes.sampling import PoseSampler, checked_sampler
from train.simulation.frame_scenes import SceneMix


@dataclass(frozen=True, slots=True)
class DatasetConfig:
    """Everything that decides the bytes of a training set.

    A group of settings, such as `scenes`, may be given as a mapping of those that differ from its default:
    `scenes={"together": 0.0, "holding": 0.0}`.
    """

    glove: MarkerLayout | str | Path = "dense19"
    """Marker layout: a shipped name or the path of a .toml file."""
    num_frames: int = 170_330
    """Frames; the default is the paper's number."""
    seed: int = 0
    rig: CameraRig | str | Path = "figure5"
    """Camera rig: a shipped name or the path of a .toml file."""
    min_cameras: int = 2
    """Cameras that must see a marker before it exists."""
    frames_per_hand: int = 128
    """Poses of one hand before the next person puts on the glove."""
    slip_along: float = 0.1
    """Standard deviation of the markers' slip along the bones [bone lengths]."""
    slip_around: float = 10.0
    """The same around the bones [deg]."""
    volume: float = 0.3
    """Half side of the cube the wrist moves in [m], around 1.1 m above the floor."""
    population: Population = dataclasses.field(default_factory=lambda: Population(children=0.2))
    poses: PoseMix = dataclasses.field(default_factory=PoseMix)
    sampler: PoseSampler | str | None = None
    """A pose sampler of your own for hands that are alone, instead of that mix: module:name, or the name of
    an entry point."""
    scenes: SceneMix = dataclasses.field(default_factory=SceneMix)
    ghosts: GhostConfig = dataclasses.field(default_factory=GhostConfig)
    optics: OpticsConfig = dataclasses.field(default_factory=OpticsConfig)
    blob_loss: tuple[float, float] = (0.0, 0.15)
    """Least and greatest chance that a camera misses a blob; every person draws another."""
    dropout: tuple[float, float] = (0.0, 0.4)
    """Least and greatest chance per frame that some cameras lose their pictures."""

    def __post_init__(self) -> None:
        wanted = "a MarkerLayout, or the name or path of one"
        check_type("glove", self.glove, (MarkerLayout, str, Path), wanted, list_layouts())
        wanted = "a CameraRig, or the name or path of one"
        check_type("rig", self.rig, (CameraRig, str, Path), wanted, list_rigs())
        if self.sampler is not None:
            checked_sampler(self.sampler)
        fill_settings(self)
        for name in ("num_frames", "min_cameras", "frames_per_hand"):
            check_count(name, getattr(self, name), 1, error=DatasetError)
        check_count("seed", self.seed, 0, error=DatasetError)
        check_number("slip_along", self.slip_along, 0.0, 1.0)
        check_number("slip_around", self.slip_around, 0.0, 90.0)
        check_number("volume", self.volume, 0.0, 10.0)
        for name in ("blob_loss", "dropout"):
            check_span(name, getattr(self, name))
            if getattr(self, name)[1] > 1.0:
                raise DatasetError(f"{name} is {getattr(self, name)}, expected chances from 0 to 1")
