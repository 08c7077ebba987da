"""`draw`, pictures in memory; and `Drawing`, which draws frames of a subject with its people and cameras."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from gloves.fit import GloveFit
from gloves.takes.take import RigidBody, Take
from handsim._checks import check_type, make_settings
from handsim.errors import ArgumentError
from handsim.space.camera import Camera
from handsim.space.rig import CameraRig
from render.cameras.viewpoints import ViewConfig, Viewpoints, check_hands_in_view
from render.config import RenderConfig, SpawnKey
from render.frames import RenderedFrame
from render.painting.figures import sample_people
from render.painting.painter import choose_painter
from render.scenery.enclosures import enclose
from render.scenery.lights import sample_surroundings
from render.sensors.depth_noise import sample_depth_noise
from render.sensors.exposure import sample_exposure
from render.sensors.shutter import sample_shutter
from render.skin.look import SkinLook
from render.studio import FrameChoices, Moment, Studio
from render.subject import Model, Subject, load_subject, source_of

_MOST_STUDIOS: Final = 32  # of people with painted skins that are kept, some 5 MB each

Cameras = Camera | CameraRig | Sequence[Camera] | str
"""A camera, a rig or several cameras of the user's own, used as they are; or the name of a preset, which is
placed."""


def draw(
    source: Take | str | Path | ArrayLike,
    *,
    model: Model | tuple[Model, Model] | None = None,
    camera: Cameras | None = None,
    frames: Iterable[int] | None = None,
    config: RenderConfig | None = None,
    **settings: Any,
) -> Iterator[RenderedFrame]:
    """Draw frames of a take or poses of your own, in memory.

    A frame's picture is the same whatever other frames are asked for.

    Args:
        source: A take or its path; the path of a .csv of `handsim export`; or poses (T, 27), joint angles
            (T, 20) with the wrist at the origin, or poses of two hands (T, 2, 27) [m, rad]. NaN is a hand
            that is not there.
        model: The hand of your own poses, or both in the poses' order; drawn people when not given.
        camera: Camera of your own, fixed in the world and used as it is, or several; or the name of a preset.
            Without it, viewpoints are drawn as `RenderConfig.view` says.
        frames: Numbers of the frames; all that have a hand, every `RenderConfig.every`, when not given.
        config: What to draw.
        settings: Settings of `RenderConfig` that differ from `config`, as `seed=1` or `background="room"`.

    Yields:
        Each frame once per camera: `rgb` (H, W, 3), `depth` (H, W) [m], `normals`, `ids`, and for each hand
        `keypoints` (21, 2) [px], `keypoints_world` (21, 3) [m] and more, see `RenderedFrame`.

    Raises:
        HandSimError: The source or the settings cannot be drawn, or a camera stands in a hand or an object.
    """
    config = configured(config, camera, settings)
    subject = load_subject(source_of(source, model=model, seed=config.seed), seed=config.seed)
    drawing = Drawing(subject, config)
    drawing.check_view()
    return drawing.frames(0, ((n, n) for n in drawing.chosen_frames(frames)))


def configured(
    config: RenderConfig | None, camera: Cameras | None, settings: Mapping[str, Any]
) -> RenderConfig:
    """A configuration with the camera and the settings that were named beside it."""
    config = RenderConfig() if config is None else config
    check_type("config", config, RenderConfig, "a RenderConfig")
    config = make_settings(RenderConfig, "setting of a rendering", settings, default=config)
    if camera is None:
        return config
    if isinstance(camera, str):
        return dataclasses.replace(config, view=dataclasses.replace(config.view, camera=camera))
    several = camera.cameras if isinstance(camera, CameraRig) else camera
    given = (several,) if isinstance(several, Camera) else several
    cameras = tuple(given) if isinstance(given, Iterable) else ()
    if not cameras or not all(isinstance(one, Camera) for one in cameras):
        raise ArgumentError(f"camera is {camera!r}, expected a Camera, several, or the name of a preset")
    return dataclasses.replace(config, view=ViewConfig(cameras=cameras))


class Drawing:
    """A subject before its cameras: draws any of its frames.

    Raises:
        HandSimError: The subject has no motion to blur, or no camera has a hand in its picture.
    """

    def __init__(self, subject: Subject, config: RenderConfig) -> None:
        if config.shutter is not None and not subject.is_motion:
            raise ArgumentError("poses without times have no motion to blur; add the array times")
        self.subject, self.take, self.config = subject, subject.take, config
        self.viewpoints = Viewpoints(config.view, subject.take, rng=SpawnKey.VIEWPOINTS.rng(config.seed))
        self._studio_of = functools.lru_cache(maxsize=_MOST_STUDIOS)(self._studio_of_person)

    def check_view(self) -> None:
        """Refuse the user's own cameras where none has a hand in its pictures.

        Raises:
            RigError: No camera has.
        """
        if self.config.view.cameras is not None:
            cameras = self.viewpoints.cameras(0)
            check_hands_in_view(self.config.view.own_cameras, cameras, self.take)

    def chosen_frames(self, frames: Iterable[int] | None = None) -> list[int]:
        """Numbers of frames as asked for; else those with a hand."""
        if frames is None:
            present = np.isfinite(self.take.qpos[..., 0]).any(axis=1)
            found = [n for n in range(0, self.take.num_frames, self.config.every) if present[n]]
            most = len(found) if self.config.num_frames is None else self.config.num_frames
            return [found[n * len(found) // most] for n in range(most)] if most < len(found) else found
        check_type("frames", frames, Iterable, "numbers of frames")
        numbers = list(frames)
        for number in numbers:
            check_type("a frame", number, (int, np.integer), "a whole number")
            if not 0 <= number < self.take.num_frames:
                raise ArgumentError(f"frame {number} was asked for, expected 0 to {self.take.num_frames - 1}")
        return [int(number) for number in numbers]

    def shards(self) -> list[list[int]]:
        """Frames of each shard."""
        frames, size = self.chosen_frames(), self.config.frames_per_shard
        return [frames[first : first + size] for first in range(0, len(frames), size)]

    def frames(
        self,
        shard: int,
        numbered: Iterable[tuple[int, int]],
        *,
        leave_out: Callable[[int], None] | None = None,
    ) -> Iterator[RenderedFrame]:
        """Some frames, seen by all cameras, with the people of a shard and all else that changes with it.

        Args:
            numbered: For each frame its place in the shard, which its random choices depend on, and its
                number in the take.
            leave_out: Told of a frame with a camera inside a hand or an object, which no camera draws then;
                without it such a frame is an error.
        """
        config, cast = self.config, self.subject.cast
        around = self.viewpoints.positions() if self.viewpoints.num_cameras > 1 else None
        size = self.viewpoints.size
        rng = SpawnKey.SHARD.rng(config.seed, shard, 0)
        studio = self._studio(self.take.hands, rng) if cast is None else None
        kept: dict[int, FrameChoices] = {}
        for place, frame in numbered:
            # A take has its own hands; their looks change with the shard.
            person = shard if cast is None else cast.person_in(frame, shard)
            if cast is not None:
                studio = self._studio_of(person)
                rng = SpawnKey.SHARD.rng(config.seed, shard, 0)  # all people of a shard are in one place
            assert studio is not None
            own = SpawnKey.SHARD.rng(config.seed, shard, 1 + place)
            if config.vary == "frame":
                chosen = sample_choices(config, studio.skin, own, size, around)
            else:
                if person not in kept:
                    kept[person] = sample_choices(config, studio.skin, rng, size, around)
                chosen = kept[person]
            cameras = self.viewpoints.cameras(frame)
            moment = Moment(self.take, frame, None if cast is None else cast.person)
            moment = studio.reaching(moment, cameras)
            if leave_out is not None and not studio.is_clear(moment, cameras):
                leave_out(frame)
                continue
            for camera in cameras:
                fresh = dataclasses.replace(chosen, seed=int(own.integers(2**31)))
                drawn = studio.photograph(moment, camera, fresh)
                yield dataclasses.replace(drawn, choices={"person": person, **drawn.choices})

    def _studio(self, hands: Sequence[GloveFit], rng: np.random.Generator) -> Studio:
        return open_studio(hands, self.config, bodies=self.take.bodies, rng=rng)

    def _studio_of_person(self, person: int) -> Studio:
        """The hands of one of the cast, with a skin of their own; cached, because they come back."""
        cast = self.subject.cast
        assert cast is not None
        return self._studio(cast.hands(person, self.take.hands), cast.rng(person))


def open_studio(
    hands: Sequence[GloveFit],
    config: RenderConfig,
    *,
    bodies: Sequence[RigidBody] = (),
    rng: np.random.Generator,
) -> Studio:
    """A studio of one person, whose looks are drawn."""
    people = sample_people(len(hands), config.dress == "glove", tones=config.tones, rng=rng)
    colors = [tuple(rng.uniform(0.05, 0.9, 3).tolist()) for _ in bodies]
    painter = choose_painter(config.with_chosen_painter().painter)
    return Studio(hands, people, bodies, colors, config.passes, painter)


def sample_choices(
    config: RenderConfig,
    skin: SkinLook | None,
    rng: np.random.Generator,
    size: tuple[int, int],
    around: Float[np.ndarray, "N 3"] | None = None,
) -> FrameChoices:
    """Random choices of a picture.

    Args:
        skin: See `sample_surroundings`.
        size: Of the picture [px].
        around: Positions that a background of several cameras is around [m].
    """
    background, lighting = sample_surroundings(config.background, skin, size, rng=rng)
    sensor = config.chosen_depth_sensor
    return FrameChoices(
        lighting=lighting,
        background=background,
        exposure=None if config.color_sensor is None else sample_exposure(config.color_sensor, rng=rng),
        shutter=None if config.shutter is None else sample_shutter(config.shutter, rng=rng),
        depth_noise=None if sensor is None else sample_depth_noise(sensor, rng=rng),
        seed=0,
        enclosure=None if around is None else enclose(around, background.seed),
    )
