"""`RenderConfig`: everything that determines the bytes of a rendering."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np

from handsim._checks import check_choice, check_type
from handsim.errors import ArgumentError
from handsim.settings import Expected, Limits, Settings, Spelled
from handsim.space.camera import Camera
from handsim.space.rig import CameraRig
from handsim.space.transforms import UpAxis
from render.color_sensor import ExposureConfig, ShutterConfig
from render.depth_sensor import OTHER_NAMES, SENSORS, DepthSensor
from render.frames import PASSES
from render.scenery.backgrounds import Backgrounds
from render.skin.look import ALL_TONES, TONES, check_tones, hyphened, named_tones
from render.viewpoints import ViewConfig

PainterChoice = Literal["auto", "compiled", "opengl"]
NEAR_SENSOR: Final = "d435"
"""Depth sensor of cameras that may be as near as 0.3 m to the hands: it measures from 0.2 m on."""
FAR_SENSOR: Final = "kinect2"
"""Depth sensor of rigs, and of others at a set distance of 0.6 m or more; it measures from 0.5 m on."""
_FAR_DISTANCE: Final = 0.6  # [m]


class SpawnKey(enum.IntEnum):
    """First number of the spawn key of a child of a seed, by what the child draws."""

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
class FrameConfig(Settings):
    """Settings that drawn pictures and those of a video have in common.

    Raises:
        ArgumentError: A pass is unknown, or a number is out of range.
    """

    noun: ClassVar[str] = "setting of pictures"

    passes: tuple[str, ...] = PASSES
    """Pictures to write: some of rgb, depth, normals, ids."""
    dress: Literal["skin", "glove"] = "skin"
    """What the hands wear: nothing, or the marker glove with its markers."""
    openxr: bool = False
    """Whether COCO's annotations have the 26 joints of OpenXR, too, with their poses."""
    frames: Annotated[tuple[int, ...] | None, Limits(0)] = None
    """Numbers of the frames that are written; all frames with a hand when not given."""
    every: Annotated[int, Limits(1)] = 1
    """Step between the frames that are written."""
    num_frames: Annotated[int | None, Limits(1)] = None
    """Number of these frames at most, spread evenly over all of them; all when not given."""
    frames_per_shard: Annotated[int, Limits(1)] = 64
    """Frames that are written together."""
    seed: Annotated[int, Limits(0)] = 0
    """Seed of all random choices."""
    up: UpAxis = "z"
    """The axis of the take, and of your own cameras, that points up; y for captures of Motive's default. The
    truth of pictures has z up."""

    def check(self) -> None:
        """Refuse unknown passes."""
        for name in self.passes:
            check_choice(name, PASSES, noun="pass")
        if not self.passes:
            raise ArgumentError(f"passes are none, expected some of {', '.join(PASSES)}")


@dataclass(frozen=True, slots=True)
class RenderConfig(FrameConfig):
    """Everything that determines the bytes of a rendering; it is saved beside the pictures.

    Raises:
        ArgumentError: A pass is unknown, or a number is out of range.
    """

    noun: ClassVar[str] = "setting of a rendering"

    view: Annotated[ViewConfig, Spelled(name="")] = field(default_factory=ViewConfig)
    """Cameras, and where they stand; a mapping holds what differs from the usual ones."""
    tones: Annotated[tuple[float, ...], Spelled(tuple[str, ...], ())] = ALL_TONES
    """Classes of skin tone to draw from: very-light, light, intermediate, tan, brown, dark; all when not
    given. In Python also ranges of individual typology angles [deg], the ends of each one after the other."""
    background: Annotated[Backgrounds, Spelled(name="")] = field(default_factory=Backgrounds)
    """Kinds of background and their shares, as `{"room": 3, "plain": 1}`, and beside them the folder `photos`
    of photographs; names of kinds have equal shares, and what is not named has none."""
    vary: Literal["shard", "frame"] = "shard"
    """Whether light and background change with every shard or every frame; people change with every shard."""
    depth_sensor: Annotated[
        DepthSensor | Literal["auto"] | None,
        Expected("a DepthSensor, its name, or auto, or None", lambda: SENSORS),
        Spelled(tuple[str, ...], ("auto",)),
    ] = "auto"
    """Sensor that adds noise to depth, or several, one of which is drawn each time: kinect1, d435, kinect2,
    azure_kinect; or none for perfect depth only, or auto: d435, and kinect2, which needs half a meter, for
    the placement rig and distances from 0.6 m on."""
    room_depth: bool = True
    """Whether depth and normals show the room or the wall behind hands and objects. Otherwise both are 0
    there, as they are before an environment map, which has no depth."""
    color_sensor: Annotated[ExposureConfig | None, Spelled(bool, True)] = field(
        default_factory=ExposureConfig
    )
    """Whether noisy colors are written beside perfect ones. In Python also their exposure and noise; None
    stands for perfect colors alone."""
    painter: PainterChoice = "auto"
    """What paints colors: our own compiled code, opengl, or auto: opengl where there is hardware for it."""
    shutter: Annotated[ShutterConfig | None, Spelled(bool, False, "motion-blur")] = None
    """Shutters that blur motion, some of which roll, in eight drawings a picture. In Python, None stands for
    pictures of an instant."""

    mano: str | None = None
    """Your own MANO_RIGHT as .npz, whose pose and shape annotations then have beside keypoints."""

    def __post_init__(self) -> None:
        given, named = self.background, dict[str, Any]()
        named["background"] = given if isinstance(given, Backgrounds) else Backgrounds(given)
        check_type("tones", self.tones, (str, tuple, list), "names of skin tones", map(hyphened, TONES))
        tones = (self.tones,) if isinstance(self.tones, str) else tuple(self.tones)
        if any(isinstance(tone, str) for tone in tones):
            named["tones"] = named_tones(tones)  # type: ignore[arg-type]  # names
        elif not tones:
            named["tones"] = ALL_TONES
        if isinstance(self.depth_sensor, str | tuple | list):
            named["depth_sensor"] = _sensor_of(self.depth_sensor)
        for name, usual in (("color_sensor", ExposureConfig), ("shutter", ShutterConfig)):
            if isinstance(getattr(self, name), bool):
                named[name] = usual() if getattr(self, name) else None
        for name, value in named.items():
            object.__setattr__(self, name, value)
        Settings.__post_init__(self)

    def check(self) -> None:
        """Refuse unknown passes, ranges of tones that fall, and settings of pictures that are not drawn."""
        check_tones(self.tones)
        FrameConfig.check(self)
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


def _sensor_of(given: str | Sequence[str]) -> DepthSensor | Literal["auto"] | None:
    """The depth sensor of names, as the command line has them."""
    names = (given,) if isinstance(given, str) else tuple(given)
    if names == ("auto",):
        return "auto"
    for name in names:
        check_choice(OTHER_NAMES.get(name, name), (*SENSORS, "none"), noun="depth sensor")
    return None if names == ("none",) else DepthSensor(names)


Cameras = Camera | CameraRig | Sequence[Camera] | str
"""A camera, a rig or several cameras of the user's own, used as they are; or the name of a preset, which is
placed."""


def resolve(
    config: RenderConfig | None = None,
    settings: Mapping[str, Any] = MappingProxyType({}),
    camera: Cameras | None = None,
    *,
    near: bool = False,
) -> RenderConfig:
    """Apply the settings and the camera of a call, and replace "auto".

    "auto" becomes the best painter of this machine, and the depth sensor for the placement of the cameras, or
    for cameras `near` the hands.
    """
    config = RenderConfig() if config is None else config
    check_type("config", config, RenderConfig, "a RenderConfig")
    if "view" in settings and camera is not None and not isinstance(camera, str):
        raise ArgumentError("given view and camera, expected one of them")
    config = RenderConfig.of(config, settings)
    view, painter, sensor = _resolve_view(config.view, camera), config.painter, config.depth_sensor
    if painter == "auto":  # without colors there is no need to look
        from render.painting.painter import choose_painter  # not for the help of commands

        painter = choose_painter() if "rgb" in config.passes else "compiled"
    if sensor == "auto" and "depth" not in config.passes:
        sensor = None
    elif sensor == "auto":
        set_far = view.distance is not None and view.distance[0] >= _FAR_DISTANCE
        far = not near and view.cameras is None and (view.placement == "rig" or set_far)
        sensor = DepthSensor((FAR_SENSOR if far else NEAR_SENSOR,))
    return dataclasses.replace(config, view=view, painter=painter, depth_sensor=sensor)


def _resolve_view(view: ViewConfig, camera: Cameras | None) -> ViewConfig:
    """Replace the cameras of the configuration by those of a call, if there are any."""
    if camera is None:
        return view
    if isinstance(camera, str):
        return dataclasses.replace(view, camera=camera)
    several = camera.cameras if isinstance(camera, CameraRig) else camera
    given = (several,) if isinstance(several, Camera) else several
    cameras = tuple(given) if isinstance(given, Iterable) else ()
    if not cameras or not all(isinstance(one, Camera) for one in cameras):
        raise ArgumentError(f"camera is {camera!r}, expected a Camera, several, or the name of a preset")
    return ViewConfig(cameras=cameras)
