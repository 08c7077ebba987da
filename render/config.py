"""`RenderConfig`: everything that decides the bytes of a rendering."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from handsim._checks import check_choice, check_count, check_type, fill_settings
from handsim.errors import ArgumentError
from render.color_sensor import ExposureConfig, ShutterConfig
from render.depth_sensor import DepthSensor
from render.frames import PASSES
from render.painting.painter import PainterChoice, choose_painter
from render.scenery.backgrounds import KINDS, Backgrounds
from render.skin.look import ALL_TONES, TONES, check_tones, hyphened, named_tones
from render.viewpoints import ViewConfig

NEAR_SENSOR: Final = "d435"
"""Depth sensor of cameras that may be as near as 0.3 m to the hands: it measures from 0.2 m on."""
FAR_SENSOR: Final = "kinect2"
"""Depth sensor of rigs, and of others at a set distance of 0.6 m or more; it measures from 0.5 m on."""
_AUTO: Final = "auto"  # chooses the depth sensor by the placement of the camera
_FAR: Final = 0.6  # [m] from the center of the hands


class SpawnKey(enum.IntEnum):
    """What a child of a seed draws: the first number of its spawn key."""

    VIEWPOINTS = 1
    SHARD = 2
    """Then the number of the shard, and of one of its frames."""
    PEOPLE_OF_FRAMES = 3
    PERSON = 4
    """Then the number of the person, and 0 for the hand or 1 for the skin."""
    STREAM = 5
    """Then the kind and the number of what a stream draws."""

    def rng(self, seed: int, *numbers: int) -> np.random.Generator:
        """The generator of the child with these further numbers."""
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(self, *numbers)))


@dataclass(frozen=True, slots=True)
class RenderConfig:
    """Everything that decides the bytes of a rendering; it is saved beside the pictures.

    Raises:
        ArgumentError: A pass is unknown, or a number is out of range.
    """

    passes: tuple[str, ...] = PASSES
    """Pictures to draw: some of rgb, depth, normals, ids."""
    view: ViewConfig = field(default_factory=ViewConfig)
    """Cameras, and where they stand; a mapping holds what differs from the usual ones."""
    dress: Literal["skin", "glove"] = "skin"
    """Bare hands, or the marker glove with its markers."""
    tones: tuple[float, ...] = ALL_TONES
    """Ranges of individual typology angles that skins are drawn from [deg], the ends of each one after the
    other; names of classes, as very-light, brown, stand for those of `render.skin.look.TONES`."""
    background: Backgrounds = field(default_factory=Backgrounds)
    """Kinds of background and their shares, as `{"room": 3, "plain": 1}`, and beside them the folder `photos`
    of photographs; names of kinds have equal shares, and what is not named has none."""
    vary: Literal["shard", "frame"] = "shard"
    """Whether light and background change with every shard or every frame; people change with every shard."""
    depth_sensor: DepthSensor | str | None = _AUTO
    """Sensor that adds noise to depth, or its name; auto: one whose range fits the placement, see
    `NEAR_SENSOR`; None: perfect depth alone."""
    color_sensor: ExposureConfig | None = field(default_factory=ExposureConfig)
    """Exposure and noise of colors; None: perfect colors alone."""
    painter: PainterChoice = "auto"
    """What paints colors: opengl, compiled, or auto: opengl where there is hardware for it."""
    shutter: ShutterConfig | None = None
    """Motion blur and rolling shutters, which take a drawing per sub-frame; None: pictures of an instant."""
    every: int = 1
    """Step between the frames that are drawn."""
    num_frames: int | None = None
    """Number of these frames at most, spread evenly over the take; all when None."""
    frames_per_shard: int = 64
    """Frames that are written together."""
    seed: int = 0
    """Seed of all random choices."""

    def __post_init__(self) -> None:
        check_type("passes", self.passes, (str, tuple, list), "names of passes", PASSES)
        if isinstance(self.passes, str):
            object.__setattr__(self, "passes", (self.passes,))
        check_type("tones", self.tones, (str, tuple, list), "names of skin tones", map(hyphened, TONES))
        kinds = (Backgrounds, Mapping, str, tuple, list)
        check_type("background", self.background, kinds, "kinds of background or their shares", KINDS)
        object.__setattr__(self, "background", Backgrounds.of(self.background))
        if isinstance(self.depth_sensor, str) and self.depth_sensor != _AUTO:
            object.__setattr__(self, "depth_sensor", DepthSensor((self.depth_sensor,)))
        fill_settings(self)
        tones = (self.tones,) if isinstance(self.tones, str) else tuple(self.tones)
        if any(isinstance(tone, str) for tone in tones):
            object.__setattr__(self, "tones", named_tones(tones))  # type: ignore[arg-type]  # names
        check_tones(self.tones)
        for name in self.passes:
            check_choice(name, PASSES, noun="pass")
        if not self.passes:
            raise ArgumentError(f"passes are none, expected some of {', '.join(PASSES)}")
        check_count("every", self.every, 1)
        if self.num_frames is not None:
            check_count("num_frames", self.num_frames, 1)
        check_count("frames_per_shard", self.frames_per_shard, 1)
        check_count("seed", self.seed, 0)

    @property
    def chosen_depth_sensor(self) -> DepthSensor | None:
        """`depth_sensor`, or in the place of auto the one that fits the placement."""
        if not isinstance(self.depth_sensor, str):
            return self.depth_sensor
        view = self.view
        set_far = view.distance is not None and view.distance[0] >= _FAR and view.placement != "head"
        far = view.cameras is None and (view.placement == "rig" or set_far)
        return DepthSensor((FAR_SENSOR if far else NEAR_SENSOR,))

    def settled(self) -> RenderConfig:
        """The same without auto: the painter of this machine, and the depth sensor of the placement."""
        return dataclasses.replace(self.with_chosen_painter(), depth_sensor=self.chosen_depth_sensor)

    def with_chosen_painter(self) -> RenderConfig:
        """The same with compiled or opengl in the place of auto; without colors there is no need to look."""
        if self.painter != "auto":
            return self
        painter = choose_painter("auto") if "rgb" in self.passes else "compiled"
        return dataclasses.replace(self, painter=painter)
