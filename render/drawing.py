"""`draw` yields pictures in memory; `Drawing` draws any frame of a subject as its cameras see it."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gloves.fit import GloveFit
from gloves.layout import MarkerLayout
from gloves.takes.take import Take
from handsim._checks import check_type
from handsim.errors import ArgumentError, HandSimWarning
from handsim.space.camera import Camera
from render.conditions import Conditions, sample_conditions
from render.config import Cameras, RenderConfig, SpawnKey, resolve
from render.frames import Doubles, RenderedFrame
from render.mano import load_mano
from render.studio import Moment, Studio
from render.subject import Model, Subject, subject_of
from render.user_body import UserBody
from render.viewpoints import Viewpoints, known_positions

_LEAST_HEAD_DISTANCE: Final = 0.35  # [m] least distance of cameras from the axis ends of a head that is drawn


def draw(
    source: Take | str | Path | ArrayLike,
    *,
    model: Model | tuple[Model, Model] | None = None,
    glove: MarkerLayout | str | None = None,
    camera: Cameras | None = None,
    frames: Iterable[int] | None = None,
    record: Mapping[str, Any] | None = None,
    config: RenderConfig | None = None,
    **settings: Any,
) -> Iterator[RenderedFrame]:
    """Draw frames of a take or poses of your own, in memory.

    A frame's picture is the same whatever other frames are requested.

    Args:
        source: A take or its path; the path of a .csv of `handsim export`; or poses (T, 27), joint angles
            (T, 20) with the wrist at the origin, or poses of two hands (T, 2, 27) [m, rad]. NaN is a hand
            that is not there.
        model: The hand of your own poses, or both in the poses' order; drawn people when not given.
        glove: Marker layout on the hands of your poses, where they wear gloves; dense19 when not given.
        camera: Camera of your own, fixed in the world and used as it is, or several; or the name of a preset.
            Without it, viewpoints are drawn as `RenderConfig.view` says.
        frames: Numbers of the frames; those that `RenderConfig` chooses when not given.
        record: A picture's record in files, whose frame is drawn again as it was, with the configuration that
            `RenderConfig.from_json` reads from their render.json.
        config: What to draw.
        settings: Settings of `RenderConfig` that differ from `config`, as `seed=1` or `background="room"`.

    Yields:
        Each frame once per camera: `rgb` (H, W, 3), `depth` (H, W) [m], `normals`, `ids`, and for each hand
        `keypoints` (21, 2) [px], `keypoints_world` (21, 3) [m] and more, see `RenderedFrame`.

    Raises:
        HandSimError: The source or the settings cannot be drawn, or a camera stands in a hand or an object.
    """
    config = resolve(config, settings, camera)
    subject = subject_of(source, model=model, glove=glove, seed=config.seed)
    requested = requested_pictures(subject, config, frames, record)
    return requested.drawing.frames(requested.shard, requested.numbered)


class RequestedPictures(NamedTuple):
    """Pictures that a call requests."""

    drawing: Drawing
    shard: int
    numbered: Iterable[tuple[int, int]]  # positions in the shard, and frames


def requested_pictures(
    subject: Subject, config: RenderConfig, frames: Iterable[int] | None, record: Mapping[str, Any] | None
) -> RequestedPictures:
    """The pictures of some frames of a subject, or the one of a picture's record; see `draw`."""
    drawing = Drawing(subject, config)
    drawing.viewpoints.check_hands_in_view()
    if record is None:
        return RequestedPictures(drawing, 0, ((n, n) for n in drawing.chosen_frames(frames)))
    check_type("record", record, Mapping, "a picture's record, as formats of files have it")
    number, choices = record.get("number", record.get("frame")), record.get("choices", {})
    if frames is not None or number is None or not {"shard", "place"} <= set(choices):
        raise ArgumentError("expected frames or a picture's record, with shard and place in its choices")
    numbered = [(choices["place"], *drawing.chosen_frames([number]))]
    return RequestedPictures(drawing, choices["shard"], numbered)


class Scene(NamedTuple):
    """What one picture shows."""

    studio: Studio
    moment: Moment
    camera: Camera
    conditions: Conditions
    about: dict[str, int]  # person, shard, and place in it


class Drawing:
    """A subject and its cameras; draws any of its frames."""

    def __init__(self, subject: Subject, config: RenderConfig, *, light: bool = False) -> None:
        if config.shutter is not None and not subject.is_motion:
            raise ArgumentError("poses without times have no motion to blur; add the array times")
        if config.mano is not None:
            load_mano(config.mano)  # a file that is none is refused before anything is drawn
        for body in subject.take.bodies:
            if body.shape is None and not len(body.positions):
                nothing = f"{body.name} has neither a surface nor markers and is not drawn"
                remedy = "RigidBody.of gives a body the surface of its object"
                warnings.warn(f"{nothing}; {remedy}", HandSimWarning, stacklevel=3)
        self.subject, self.config, self._light = subject.upright(config.up), config, light
        self.take, rng = self.subject.take, SpawnKey.VIEWPOINTS.rng(config.seed)
        # Single poses may be of many people; only cameras at the eyes need one person nevertheless.
        has_user = subject.is_motion or config.view.placement == "head"
        known, sees = known_positions(config.view, config.up), config.view.placement == "head"
        self._user = UserBody(self.take, known, sees=sees) if has_user else None
        poses = None if subject.footage is None else subject.footage.poses
        self.viewpoints = Viewpoints(
            config.view, self.take, rng=rng, up=config.up, user=self._user, poses=poses
        )
        # A studio takes some 5 MB.
        self._studio_of = functools.lru_cache(maxsize=32)(self._studio_of_person)

    def frames_without_hands(self) -> list[int]:
        """Numbers of the frames whose hands are all NaN."""
        present = np.isfinite(self.take.qpos[..., 0]).any(axis=1)
        return [int(number) for number in np.flatnonzero(~present)]

    def chosen_frames(self, frames: Iterable[int] | None = None) -> list[int]:
        """Numbers of the requested frames, checked; without a request those that have a hand."""
        if frames is None:
            absent, chosen = set(self.frames_without_hands()), self.config.frames
            given = range(self.take.num_frames) if chosen is None else self.chosen_frames(chosen)
            found = [n for n in given[:: self.config.every] if n not in absent]
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
        """Draw frames for all cameras; the frames are given with their positions in the shard."""
        for studio, moment, camera, conditions, about in self.scenes(shard, numbered, leave_out=leave_out):
            drawn = studio.photograph(moment, camera, conditions)
            yield dataclasses.replace(drawn, choices=about | dict(drawn.choices))

    def scenes(
        self,
        shard: int,
        numbered: Iterable[tuple[int, int]],
        *,
        leave_out: Callable[[int], None] | None = None,
    ) -> Iterator[Scene]:
        """Set up what these pictures show."""
        config, cast, viewpoints = self.config, self.subject.cast, self.viewpoints
        rng = SpawnKey.SHARD.rng(config.seed, shard, 0)
        if cast is None:  # a take has its own hands, whose looks change with the shard
            worn = self.take.hands
            studio = self._studio(worn, rng)
        sample = functools.partial(
            sample_conditions, config, viewpoints.viewer, viewpoints.size, self._enclosed_positions()
        )
        common = self._with_fixed_backdrop(sample(rng=rng)) if config.vary == "shard" else None
        for place, frame in numbered:
            person = shard if cast is None or cast.person is None else int(cast.person[frame])
            if cast is not None:
                studio = self._studio_of(person)
            elif (hands := self.take.hands_at(frame)) is not worn:
                worn, studio = hands, self._studio(hands, SpawnKey.SHARD.rng(config.seed, shard, 0))
            own = SpawnKey.SHARD.rng(config.seed, shard, 1 + place)
            conditions = sample(rng=own) if common is None else common
            cameras = viewpoints.cameras(frame)
            moment = Moment(self.take, frame, None if cast is None else cast.person)
            if self._arms is None:
                moment = studio.with_arms(moment, cameras, self._user)
            else:
                fore, upper = (ways[frame] for ways in self._arms)
                moment = dataclasses.replace(moment, forearms=fore, upper_arms=upper)
            if leave_out is not None and not studio.is_clear(moment, cameras):
                leave_out(frame)
                continue
            about = {"person": person, "shard": shard, "place": place}
            for camera in cameras:
                yield Scene(studio, moment, camera, conditions.reseeded(own), about)

    @functools.cached_property
    def _arms(self) -> tuple[Doubles, Doubles] | None:
        """Directions (T, H, 3) of forearms and upper arms in a motion of somebody; None for single poses."""
        if self._user is None or not self.subject.is_motion:
            return None
        return self._user.moving_arms(self.take, self.viewpoints.cameras, whole=self._shows_person)

    def _enclosed_positions(self) -> Doubles | None:
        """Positions (N, 3) of cameras and hands that share a background [m]; None for one camera."""
        viewpoints = self.viewpoints
        enclosed = viewpoints.num_cameras > 1 or (viewpoints.moves and self.config.vary == "shard")
        enclosed |= viewpoints.cameras(0)[0].lens.kind != "pinhole"  # which bends what is behind the hands
        return viewpoints.positions() if enclosed and self.subject.footage is None else None

    def _with_fixed_backdrop(self, scene: Conditions) -> Conditions:
        """Fix the backdrop behind the hands of all frames, so that it does not move with them."""
        backdrop = scene.background.backdrop
        level, arms = (self.viewpoints.nearest(backdrop.normal, arms=arms) for arms in (False, True))
        held = dataclasses.replace(backdrop, level=level - backdrop.gap, arms=arms)
        return dataclasses.replace(scene, background=dataclasses.replace(scene.background, backdrop=held))

    def _studio_of_person(self, person: int) -> Studio:
        """The studio of one of the people of `subject.cast`."""
        cast = self.subject.cast
        assert cast is not None
        return self._studio(cast.hands(person, self.take.hands), cast.rng(person))

    def _studio(self, hands: Sequence[GloveFit], rng: np.random.Generator) -> Studio:
        """The studio of somebody with these hands."""
        return Studio(
            hands, self.config, self.take.bodies, rng=rng, user=self._user, shows_person=self._shows_person,
            light=self._light, footage=self.subject.footage,
        )  # fmt: skip

    @functools.cached_property
    def _shows_person(self) -> bool:
        """Whether pictures show the person of a motion; not if a camera is ever in or close to the head."""
        if self._user is None or not self.subject.is_motion or self.subject.footage is not None:
            return False
        offsets = self.viewpoints.eyes()[:, None] - self._user.trunk[-1]
        return bool(np.linalg.norm(offsets, axis=-1).min() > _LEAST_HEAD_DISTANCE)
