"""`draw`, pictures in memory; and `render_take`, pictures in files, resumable."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike

from gloves.fit import GloveFit
from gloves.layout import MarkerLayout
from gloves.takes.bodies import RigidBody
from gloves.takes.take import Take
from handsim._checks import check_choice, check_type
from handsim.app.output import (
    CHECKSUMS,
    Make,
    Output,
    Place,
    checked_list,
    checksums_name,
    open_output,
    place_of,
    save_checksums,
)
from handsim.app.workers import check_workers, run_jobs
from handsim.callbacks import Progress, no_progress
from handsim.errors import ArgumentError, HandSimError, HandSimWarning
from handsim.files.inputs import checksum, load_json
from handsim.files.outputs import check_free, save_json
from handsim.files.signals import Stopped, interrupts_bare
from handsim.space.camera import Camera
from handsim.space.rig import CameraRig, check_names
from render.captions import contact_sheet, write_png
from render.color_sensor import sample_exposure, sample_shutter
from render.config import RenderConfig, SpawnKey
from render.depth_sensor import sample_depth_noise
from render.formats.shards import INDEX
from render.formats.webdataset import TAR
from render.formats.writer import CONFIG, FORMATS, WITH_COLORS, open_writers, shard_files, whole_shards
from render.frames import Doubles, Footage, RenderedFrame
from render.painting.figures import sample_appearance
from render.scenery.backgrounds import photo_files
from render.scenery.lights import sample_surroundings
from render.studio import FrameChoices, Moment, Studio
from render.subject import Model, PoseFile, Source, Subject, load_subject, source_of
from render.user_body import UserBody
from render.viewpoints import ViewConfig, Viewpoints, check_hands_in_view

Cameras = Camera | CameraRig | Sequence[Camera] | str
"""A camera, a rig or several cameras of the user's own, used as they are; or the name of a preset, which is
placed."""


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

    A frame's picture is the same whatever other frames are asked for.

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
    config = configured(config, camera, settings).resolved()
    kept = source_of(source, model=model, glove=glove, seed=config.seed)
    drawing = Drawing(load_subject(kept, seed=config.seed), config)
    check_hands_in_view(config.view, drawing.viewpoints, drawing.take)
    if record is None:
        return drawing.frames(0, ((n, n) for n in drawing.chosen_frames(frames)))
    check_type("record", record, Mapping, "a picture's record, as formats of files have it")
    number, choices = record.get("number", record.get("frame")), record.get("choices", {})
    if frames is not None or number is None or not {"shard", "place"} <= set(choices):
        raise ArgumentError("expected frames or a picture's record, with shard and place in its choices")
    return drawing.frames(choices["shard"], [(choices["place"], *drawing.chosen_frames([number]))])


def configured(
    config: RenderConfig | None, camera: Cameras | None, settings: Mapping[str, Any]
) -> RenderConfig:
    """The configuration with the camera and the settings that were given beside it."""
    config = RenderConfig() if config is None else config
    check_type("config", config, RenderConfig, "a RenderConfig")
    config = RenderConfig.of(config, settings)
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
    """A subject and its cameras; draws any of its frames."""

    def __init__(self, subject: Subject, config: RenderConfig, *, light: bool = False) -> None:
        if config.shutter is not None and not subject.is_motion:
            raise ArgumentError("poses without times have no motion to blur; add the array times")
        bodies = subject.take.bodies
        for body in bodies:
            if body.shape is None and not len(body.positions):
                told = (
                    f"{body.name} has neither a surface nor markers and is not drawn; "
                    "RigidBody.of gives a body the surface of its object"
                )
                warnings.warn(told, HandSimWarning, stacklevel=3)
        self.subject, self.config = subject.upright(config.up), config
        self.take, rng = self.subject.take, SpawnKey.VIEWPOINTS.rng(config.seed)
        # Poses that are no motion may be of many people, but cameras at the eyes need one person.
        has_user = self.subject.is_motion or config.view.placement == "head"
        self._user = UserBody(self.take) if has_user else None
        self._open_studio = functools.partial(
            open_studio, config=config, bodies=bodies, has_user=has_user, footage=subject.footage, light=light
        )
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
        """Pictures of frames by all cameras; the frames are given with their places in the shard."""
        config, cast = self.config, self.subject.cast
        viewpoints = self.viewpoints
        enclosed = viewpoints.num_cameras > 1 or (viewpoints.moves and config.vary == "shard")
        enclosed |= viewpoints.cameras(0)[0].lens.kind != "pinhole"  # which bends what is behind the hands
        around = viewpoints.positions() if enclosed and self.subject.footage is None else None
        rng = SpawnKey.SHARD.rng(config.seed, shard, 0)
        if cast is None:  # a take has its own hands, whose looks change with the shard
            studio = self._open_studio(self.take.hands, rng=rng)
        kept: dict[int, FrameChoices] = {}
        for place, frame in numbered:
            person = shard if cast is None or cast.person is None else int(cast.person[frame])
            if cast is not None:
                studio = self._studio_of(person)
                rng = SpawnKey.SHARD.rng(config.seed, shard, 0)  # all people of a shard are in one place
            own = SpawnKey.SHARD.rng(config.seed, shard, 1 + place)
            if config.vary == "frame":
                chosen = sample_choices(config, viewpoints.viewer, viewpoints.size, around, rng=own)
            else:
                if person not in kept:
                    scene = sample_choices(config, viewpoints.viewer, viewpoints.size, around, rng=rng)
                    kept[person] = self._held(scene)
                chosen = kept[person]
            cameras, placed = viewpoints.cameras(frame), {"shard": shard, "place": place}
            moment = Moment(self.take, frame, None if cast is None else cast.person)
            moment = studio.reaching(moment, cameras, self._user)
            if leave_out is not None and not studio.is_clear(moment, cameras):
                leave_out(frame)
                continue
            for camera in cameras:
                fresh = dataclasses.replace(chosen, seed=int(own.integers(2**31)))
                drawn = studio.photograph(moment, camera, fresh)
                yield dataclasses.replace(drawn, choices={"person": person, **placed, **drawn.choices})

    def _held(self, scene: FrameChoices) -> FrameChoices:
        """The choices with a backdrop that stays where it is, behind the hands of all frames."""
        backdrop = scene.background.backdrop
        level, arms = (self.viewpoints.nearest(backdrop.normal, arms=arms) for arms in (False, True))
        held = dataclasses.replace(backdrop, level=level - backdrop.gap, arms=arms)
        return dataclasses.replace(scene, background=dataclasses.replace(scene.background, backdrop=held))

    def _studio_of_person(self, person: int) -> Studio:
        """The studio of one of the people of `subject.cast`."""
        cast = self.subject.cast
        assert cast is not None
        hands = cast.hands(person, self.take.hands)
        return self._open_studio(hands, rng=cast.rng(person))


def open_studio(
    hands: Sequence[GloveFit],
    config: RenderConfig,
    *,
    bodies: Sequence[RigidBody] = (),
    rng: np.random.Generator,
    has_user: bool = False,
    footage: Footage | None = None,
    light: bool = False,
) -> Studio:
    """A studio of one person with random looks, whose wrists a `UserBody` may bend."""
    look = sample_appearance(config.dress == "glove", tones=config.tones, rng=rng)
    if has_user:
        straight = dataclasses.replace(look.forearm, flexion=0.0, deviation=0.0)
        look = dataclasses.replace(look, forearm=straight)
    colors = [tuple(rng.uniform(0.05, 0.9, 3).tolist()) for _ in bodies]
    return Studio(hands, look, config, bodies, colors, light=light, footage=footage)


def sample_choices(
    config: RenderConfig,
    viewer: Doubles,
    size: tuple[int, int],
    around: Doubles | None = None,
    *,
    rng: np.random.Generator,
) -> FrameChoices:
    """Random choices of a picture, with light for a viewer with these axes (3, 3).

    Several places `around` (N, 3) of cameras and hands share an enclosure.
    """
    background, lighting, enclosure = sample_surroundings(config.background, viewer, size, around, rng=rng)
    sensor = config.depth_sensor
    assert sensor != "auto"
    return FrameChoices(
        lighting=lighting,
        background=background,
        exposure=None if config.color_sensor is None else sample_exposure(config.color_sensor, rng=rng),
        shutter=None if config.shutter is None else sample_shutter(config.shutter, rng=rng),
        depth_noise=None if sensor is None else sample_depth_noise(sensor, rng=rng),
        seed=0,
        enclosure=enclosure,
    )


SHEET: Final = "contact_sheet.png"
_MERGED: Final = "checksums.json"  # checksums of the files that all shards make together
_LEFT_OUT: Final = "left_out-{}.json"
_CUT_OFF: Final = "cut_off-{}.json"
_DRAWN: Final = ".drawn-{}"  # file of a shard in progress, which has one byte for each of its pictures
_SHOWN: Final = 0.5  # least share of a hand's keypoints in a picture that does not cut off the hand
_ON_SHEET: Final = 9  # pictures on a contact sheet


def render_take(
    source: Take | str | Path | PoseFile | ArrayLike,
    out: str | Place,
    formats: str | Sequence[str] = ("webdataset",),
    config: RenderConfig | None = None,
    *,
    model: Model | tuple[Model, Model] | None = None,
    times: ArrayLike | None = None,
    people: int | Sequence[Model] | None = None,
    person: ArrayLike | None = None,
    glove: MarkerLayout | str | None = None,
    camera: Cameras | None = None,
    workers: int | Executor | None = None,
    progress: Progress = no_progress,
    **settings: Any,
) -> int:
    """Draw a take or poses of your own into files; a second call resumes where the first was stopped.

    Args:
        source: What to draw, as in `draw`.
        out: Folder; or a folder of an object store, as `s3://bucket/prefix` or a `UPath`. Each of several
            formats has a folder of its own in it.
        formats: Some of webdataset, coco, yolo, exr, png (docs/formats.md).
        config: What to draw.
        model: The hand of your own poses, or both in the poses' order; drawn people when not given.
        times: Time of each pose (T,) [s]; poses are no motion without them.
        people: Who strikes your poses, instead of the model: a number of drawn people, or their hands.
        person: Which of the people is in each pose (T,); when not given, a number of people is distributed at
            random, and of hands there is one, or one for each pose.
        glove: Marker layout on the hands of your poses, where they wear gloves; dense19 when not given.
        camera: Camera of your own, as in `draw`.
        workers: Number of processes, all cores when not given; or an executor, as Dask's
            `Client.get_executor()`.
        progress: Called with the numbers of finished pictures and of all pictures: first with what is there
            already, then about every second, from a thread of its own.
        settings: Settings of `RenderConfig` that differ from `config`, as `seed=1` or `num_frames=100`.

    Returns:
        Number of pictures. Depth is in [m], pixels are in [px], as the format has them. Frames with a camera
        inside a hand or an object are left out; `left_out_frames` tells which, and `cut_off_pictures` which
        pictures lack a hand of their frame.

    Raises:
        HandSimError: The take or the settings cannot be drawn, or all frames would be left out; finished
            shards are kept.
    """
    check_type("formats", formats, (str, list, tuple), "names of formats", FORMATS)
    formats = (formats,) if isinstance(formats, str) else tuple(formats)
    config = configured(config, camera, settings).resolved()
    _check_formats(formats, config)
    place, workers = place_of(out), workers if isinstance(workers, Executor) else check_workers(workers)
    kept = source_of(
        source, model=model, times=times, people=people, person=person, glove=glove, seed=config.seed
    )
    drawing = Drawing(load_subject(kept, seed=config.seed), config)
    cameras = drawing.viewpoints.cameras(0)
    check_names("cameras", cameras)
    check_hands_in_view(config.view, drawing.viewpoints, drawing.take)
    absent = drawing.frames_without_hands()
    if absent and drawing.subject.footage is None:  # frames of a video are left out for reasons that are told
        told = f"frames without a hand are not drawn: {len(absent)} of {drawing.take.num_frames}"
        warnings.warn(f"{told} (the first: {absent[0]})", HandSimWarning, stacklevel=3)
    shards, views = drawing.shards(), drawing.viewpoints.num_cameras
    make = functools.partial(_render_shard, kept, formats, config)
    record = _settings(drawing, kept) | {"formats": list(formats)}
    with open_output(place) as output:
        output.claim(CONFIG, record, noun="rendering", error=HandSimError)
        counts = [views * len(shard) for shard in shards]
        drew = _draw_shards(output, formats, make, counts, workers, progress)
        output.fetch(INDEX, _LEFT_OUT.format("*"))
        lost = frozenset(left_out_frames(output.folder))
        if not drew and _is_complete(output):
            return views * sum(frame not in lost for shard in shards for frame in shard)
        merged = [path for one in open_writers(output.folder, formats) for path in one.finish()]
        drawn = [[frame for frame in shard if frame not in lost] for shard in shards]
        if not any(drawn):
            raise HandSimError(
                f"{out}: no pictures: in all {len(lost)} frames a camera would be inside a hand or an "
                "object; give another placement, distance or seed"
            )
        merged += _write_sheet(output.folder, drawing, drawn)
        files = {path.relative_to(output.folder).as_posix(): path for path in merged}
        save_checksums(output.folder / _MERGED, files)
        output.publish(SHEET)
    return views * sum(map(len, drawn))


def _draw_shards(
    output: Output,
    formats: Sequence[str],
    make: Make,
    counts: Sequence[int],
    workers: int | Executor,
    progress: Progress,
) -> bool:
    """Draw the missing shards and return whether there were any; `counts` are all shards' pictures."""
    output.fetch(INDEX, names_of=[f"*{TAR}"])
    done, changed = whole_shards(output.folder, formats)  # object stores check their own
    output.warn_of(changed, "are damaged (other checksums), and are drawn again")
    total = sum(counts)
    count = sum(counts[number] for number in done if number < len(counts))
    todo = [number for number in range(len(counts)) if number not in done]
    tell = _Counter(output.folder, count, total, progress)
    try:
        job = output.job(make, last=[INDEX, f"*{TAR}", CHECKSUMS])
        with tell, interrupts_bare():
            for drawn, number in enumerate(run_jobs(job, todo, workers)):
                count += counts[number]
                tell.finished(number, counts[number])
                if drawn == 0 and output.is_here:
                    _check_space(output.folder, len(done) + 1, len(todo) - 1)
    except KeyboardInterrupt as stop:
        drawn_so_far = f"{count} of {total} images are in {output}, and the same command goes on after them"
        raise Stopped.again(stop, drawn_so_far) from stop
    return bool(todo)


class _Counter:
    """Reports finished pictures from a thread, also those of shards in progress, which take minutes."""

    def __init__(self, folder: Path, count: int, total: int, progress: Progress) -> None:
        self._folder, self._count, self._total, self._progress = folder, count, total, progress
        self._told = -1
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> None:
        self._clear()
        self._tell()
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._clear()

    def _clear(self) -> None:
        for left in self._folder.glob(_DRAWN.format("*")):
            left.unlink(missing_ok=True)

    def finished(self, shard: int, count: int) -> None:
        """Count the pictures of a finished shard."""
        with self._lock:
            (self._folder / _DRAWN.format(shard)).unlink(missing_ok=True)
            self._count += count
        self._tell()

    def _watch(self) -> None:
        while not self._ended.wait(1.0):
            self._tell()

    def _tell(self) -> None:
        with self._lock:
            parts = [file.stat().st_size for file in self._folder.glob(_DRAWN.format("*")) if file.is_file()]
            count = min(self._count + sum(parts), self._total)
            if count > self._told:
                self._told = count
                self._progress(count, self._total)


def _settings(drawing: Drawing, source: Source) -> dict[str, Any]:
    """What decides the pictures, as JSON: digests of files, and of the names and sizes of photographs."""
    subject = drawing.subject
    name = f"{subject.name}, sha256:{checksum(source)}" if isinstance(source, Path) else subject.name
    settings: dict[str, Any] = {"take": name, "take_frames": subject.take.num_frames}
    settings |= dataclasses.asdict(drawing.config)
    if drawing.config.background.shares["photo"] > 0.0:
        files, broken = photo_files(Path(str(drawing.config.background.photos)))
        if broken:
            more = f" and {len(broken) - 1} more" if len(broken) > 1 else ""
            told = f"left out: {broken[0]}{more}"
            warnings.warn(told, HandSimWarning, stacklevel=3)
        listed = "\n".join(f"{file} {file.stat().st_size}" for file in files)
        names = listed.encode("utf-8", "surrogateescape")  # names of files need not be valid text
        settings["photos"] = f"sha256:{hashlib.sha256(names).hexdigest()}"
    if drawing.config.view.cameras is None:
        del settings["view"]["cameras"]
    else:
        # as given: `up` turns them when they are drawn again, too
        settings["view"]["cameras"] = [one.record() for one in drawing.config.view.own_cameras()]
    return settings if subject.poses is None else settings | {"poses": subject.poses}


def left_out_frames(out: str | Place) -> list[int]:
    """Numbers of the frames that a rendering left out: a camera would be inside a hand or an object."""
    return _noted(out, _LEFT_OUT, "frames")


def cut_off_pictures(out: str | Place) -> list[str]:
    """Pictures of a rendering that show less than half of a hand's keypoints."""
    return _noted(out, _CUT_OFF, "pictures")


def _noted(out: str | Place, name: str, key: str) -> list[Any]:
    """What the workers wrote about all shards."""
    with open_output(out) as output:
        output.fetch(name.format("*"))
        files = sorted(output.folder.glob(name.format("*")))
        return sorted(one for file in files for one in load_json(file)[key])


def _check_formats(formats: Sequence[str], config: RenderConfig) -> None:
    for name in formats:
        check_type("a format", name, str, "its name", FORMATS)
        check_choice(name, FORMATS, noun="format", error=HandSimError)
        if name in WITH_COLORS and "rgb" not in config.passes:
            raise HandSimError(f"the format {name} needs color pictures; add rgb to the passes")
    if config.openxr and not set(WITH_COLORS) & set(formats):
        raise HandSimError(f"formats are {', '.join(formats)}, expected coco or yolo for openxr's joints")
    if not formats or len(set(formats)) < len(formats):
        raise HandSimError(f"formats are {', '.join(formats) or 'none'}, expected at least one, each once")


def _check_space(out: Path, drawn: int, left: int) -> None:
    """Refuse to go on if the disk has no space for the other shards, at the size of those that are drawn."""
    needed = left * sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) // drawn
    check_free(out, needed, f"the other {left} shards", "draw fewer frames (--every)", error=HandSimError)


def _is_complete(output: Output) -> bool:
    """Whether the files of all shards together are there as they were written."""
    if not output.is_here:
        return SHEET in output.sizes()
    record, changed = checked_list(output.folder / _MERGED, {})
    output.warn_of(changed, "are damaged (other checksums), and are written again")
    return bool(record) and not changed


@functools.lru_cache(maxsize=1)
def _opened(source: Source, config: RenderConfig, light: bool) -> Drawing:
    """The drawing of a source; cached, because a worker draws many of its shards."""
    cv2.setNumThreads(1)  # there is one process per core
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HandSimWarning)  # the main process has warned already
        return Drawing(load_subject(source, seed=config.seed), config, light=light)


def _render_shard(
    source: Source, formats: tuple[str, ...], config: RenderConfig, out: Path, shard: int
) -> int:
    drawing = _opened(source, config, "exr" in formats)
    lost: list[int] = []

    def leave_out(frame: int) -> None:
        lost.append(frame)  # written before the shard, so that no kill loses it
        save_json(out / _LEFT_OUT.format(f"{shard:05d}"), {"frames": lost})

    cut: list[str] = []

    def counted() -> Iterator[RenderedFrame]:
        with (out / _DRAWN.format(shard)).open("ab", buffering=0) as drawn:
            for frame in drawing.frames(shard, enumerate(drawing.shards()[shard]), leave_out=leave_out):
                inside = [
                    ((hand.keypoints >= 0.0) & (hand.keypoints < frame.camera.size)).all(axis=1)
                    for hand in frame.hands
                ]
                if any(float(shown.mean()) < _SHOWN for shown in inside):
                    cut.append(frame.key)
                yield frame
                drawn.write(b".")
        (out / _DRAWN.format(shard)).unlink(missing_ok=True)
        if cut:
            save_json(out / _CUT_OFF.format(f"{shard:05d}"), {"pictures": cut})

    kept = list(counted()) if len(formats) > 1 else counted()
    record = out / checksums_name(shard)
    record.unlink(missing_ok=True)
    for writer in open_writers(out, formats):
        writer.write(shard, kept)
    notes = [out / name.format(f"{shard:05d}") for name in (_LEFT_OUT, _CUT_OFF)]
    there = {path.name: path for path in notes if path.is_file()}
    save_checksums(record, shard_files(out, formats, shard) | there)
    return shard


def _write_sheet(out: Path, drawing: Drawing, shards: list[list[int]]) -> list[Path]:
    """Write a contact sheet of a few pictures, if they have any to show."""
    if not {"rgb", "depth"} & set(drawing.config.passes):
        return []
    frames: list[RenderedFrame] = []
    filled = [number for number, shard in enumerate(shards) if shard]
    for shard in np.array(filled)[np.unique(np.linspace(0, len(filled) - 1, _ON_SHEET).round().astype(int))]:
        mine = shards[shard]
        chosen = mine[:1] if len(filled) >= _ON_SHEET else mine[:: max(1, len(mine) // 3)][:3]
        frames += drawing.frames(int(shard), enumerate(chosen))
    write_png(out / SHEET, contact_sheet(frames[:_ON_SHEET]))
    return [out / SHEET]
