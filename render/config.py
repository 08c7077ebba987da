"""`RenderConfig`: everything that decides the bytes of a rendering."""

from __future__ import annotations

import dataclasses
import enum
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np

from handsim._checks import check_choice, check_type
from handsim.errors import ArgumentError
from handsim.settings import Expected, Limits, Settings
from handsim.space.transforms import UpAxis
from render.color_sensor import ExposureConfig, ShutterConfig
from render.depth_sensor import SENSORS, DepthSensor
from render.frames import PASSES
from render.painting.painter import PainterChoice, choose_painter
from render.scenery.backgrounds import Backgrounds
from render.skin.look import ALL_TONES, TONES, check_tones, hyphened, named_tones
from render.viewpoints import ViewConfig

NEAR_SENSOR: Final = "d435"
"""Depth sensor of cameras that may be as near as 0.3 m to the hands: it measures from 0.2 m on."""
FAR_SENSOR: Final = "kinect2"
"""Depth sensor of rigs, and of others at a set distance of 0.6 m or more; it measures from 0.5 m on."""
_FAR: Final = 0.6  # [m]


class SpawnKey(enum.IntEnum):
    """What a child of a seed draws: the first number of its spawn key."""

    VIEWPOINTS = 1
    SHARD = 2
    """The number of the shard follows, and that of one of its frames."""
    PEOPLE_OF_FRAMES = 3
    PERSON = 4
    """The number of the person follows, and 0 for the hand or 1 for the skin."""
    STREAM = 5
    """The kind and the number of what a stream draws follow."""

    def rng(self, seed: int, *numbers: int) -> np.random.Generator:
        """The generator of the child with these further numbers."""
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(self, *numbers)))


@dataclass(frozen=True, slots=True)
class RenderConfig(Settings):
    """Everything that decides the bytes of a rendering; it is saved beside the pictures.

    Raises:
        ArgumentError: A pass is unknown, or a number is out of range.
    """

    noun: ClassVar[str] = "setting of a rendering"

    passes: tuple[str, ...] = PASSES
    """Pictures to draw: some of rgb, depth, normals, ids."""
    view: ViewConfig = field(default_factory=ViewConfig)
    """Cameras, and where they stand; a mapping holds what differs from the usual ones."""
    dress: Literal["skin", "glove"] = "skin"
    """Bare skin, or the marker glove with its markers."""
    tones: tuple[float, ...] = ALL_TONES
    """Ranges of individual typology angles that skins are drawn from [deg], the ends of each one after the
    other; names of classes, as very-light, brown, stand for those of `render.skin.look.TONES`."""
    background: Backgrounds = field(default_factory=Backgrounds)
    """Kinds of background and their shares, as `{"room": 3, "plain": 1}`, and beside them the folder `photos`
    of photographs; names of kinds have equal shares, and what is not named has none."""
    vary: Literal["shard", "frame"] = "shard"
    """Whether light and background change with every shard or every frame; people change with every shard."""
    depth_sensor: Annotated[
        DepthSensor | Literal["auto"] | None,
        Expected("a DepthSensor, its name, or auto, or None", lambda: SENSORS),
    ] = "auto"
    """Sensor that adds noise to depth, or its name; auto: one whose range fits the placement, see
    `NEAR_SENSOR`; None: perfect depth alone."""
    room_depth: bool = True
    """Whether depth and normals show the room or the wall behind hands and objects. Otherwise both are 0
    there, as they are before an environment map, which has no depth."""
    openxr: bool = False
    """Whether COCO's annotations have the 26 joints of OpenXR, too, with their poses."""
    color_sensor: ExposureConfig | None = field(default_factory=ExposureConfig)
    """Exposure and noise of colors; None: perfect colors alone."""
    painter: PainterChoice = "auto"
    """What paints colors: our own compiled code, opengl, or auto: opengl where there is hardware for it."""
    shutter: ShutterConfig | None = None
    """Motion blur and rolling shutters, which take a drawing per sub-frame; None: pictures of an instant."""
    frames: Annotated[tuple[int, ...] | None, Limits(0)] = None
    """Numbers of the frames that are drawn; all frames with a hand when not given."""
    every: Annotated[int, Limits(1)] = 1
    """Step between the frames that are drawn."""
    num_frames: Annotated[int | None, Limits(1)] = None
    """Number of these frames at most, spread evenly over the take; all when not given."""
    frames_per_shard: Annotated[int, Limits(1)] = 64
    """Frames that are written together."""
    seed: Annotated[int, Limits(0)] = 0
    """Seed of all random choices."""
    up: UpAxis = "z"
    """The axis of the take, and of your own cameras, that points up; y for captures of Motive's default. The
    truth of pictures has z up."""

    def __post_init__(self) -> None:
        given, named = self.background, dict[str, Any]()
        named["background"] = given if isinstance(given, Backgrounds) else Backgrounds(given)
        check_type("tones", self.tones, (str, tuple, list), "names of skin tones", map(hyphened, TONES))
        tones = (self.tones,) if isinstance(self.tones, str) else tuple(self.tones)
        if any(isinstance(tone, str) for tone in tones):
            named["tones"] = named_tones(tones)  # type: ignore[arg-type]  # names
        if isinstance(self.depth_sensor, str) and self.depth_sensor != "auto":
            named["depth_sensor"] = DepthSensor((self.depth_sensor,))
        for name, value in named.items():
            object.__setattr__(self, name, value)
        Settings.__post_init__(self)

    def check(self) -> None:
        """Refuse unknown passes, ranges of tones that fall, and settings of pictures that are not drawn."""
        check_tones(self.tones)
        for name in self.passes:
            check_choice(name, PASSES, noun="pass")
        if not self.passes:
            raise ArgumentError(f"passes are none, expected some of {', '.join(PASSES)}")
        used = {
            "rgb": {
                "tones": self.tones != ALL_TONES,
                "background": self.background != Backgrounds(),
                "color_sensor": self.color_sensor not in (None, ExposureConfig()),
                "painter": self.painter == "opengl",
                "shutter": self.shutter is not None,
            },
            "depth": {"depth_sensor": self.depth_sensor not in ("auto", None)},
        }
        for name, fields in used.items():
            given = [field for field, is_given in fields.items() if is_given and name not in self.passes]
            if given:
                passes = ", ".join(self.passes)
                raise ArgumentError(
                    f"given {', '.join(given)} and the passes {passes}, expected {name} among them"
                )

    def resolved(self) -> RenderConfig:
        """The same without auto: the painter of this machine, and the depth sensor of the placement."""
        painter, sensor, view = self.painter, self.depth_sensor, self.view
        if painter == "auto":  # without colors there is no need to look
            painter = choose_painter() if "rgb" in self.passes else "compiled"
        if sensor == "auto" and "depth" not in self.passes:
            sensor = None
        elif sensor == "auto":
            set_far = view.distance is not None and view.distance[0] >= _FAR
            far = view.cameras is None and (view.placement == "rig" or set_far)
            sensor = DepthSensor((FAR_SENSOR if far else NEAR_SENSOR,))
        return dataclasses.replace(self, painter=painter, depth_sensor=sensor)
