"""Rendering of takes in shards: on all cores, resumable, with the same bytes for any number of workers."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from gloves.takes.take import Take
from handsim.app.interrupts import Stopped
from handsim.app.output import Make, Output, Place, open_output, place_of
from handsim.app.workers import check_workers, run_jobs
from handsim.errors import HandSimError, HandSimWarning, choices
from handsim.files.capacity import check_free
from handsim.files.inputs import checksum
from handsim.files.json_files import load_json, save_json
from render.cameras.own_cameras import check_hands_in_view
from render.cameras.viewpoints import Viewpoints
from render.config import RenderConfig
from render.formats.annotations.common import without_colors
from render.formats.clip_writer import TAR
from render.formats.merging import CONFIG
from render.formats.shards import INDEX
from render.formats.writer import FORMATS, NEED_COLORS, open_writer
from render.frames.frame import RenderedFrame
from render.illustrations.captions import write_png
from render.illustrations.contact_sheet import contact_sheet
from render.own_poses import PoseFile, load_poses
from render.painting.figures import sample_people
from render.painting.painter import choose_painter
from render.scenery.enclosures import enclose
from render.scenery.photographs import photo_files
from render.scenery.surroundings import sample_surroundings
from render.sensors.depth_noise import sample_depth_noise
from render.sensors.exposure import sample_exposure
from render.sensors.shutter import sample_shutter
from render.shown_take import ShownTake, load_shown_take, show_take
from render.skin.look import SkinLook
from render.studio.studio import FrameChoices, Studio

Progress = Callable[[int, int], None]
"""Called with the numbers of finished pictures and of all pictures."""
SHEET: Final = "contact_sheet.png"
_RENAMES: Final = "freihand"
_LEFT_OUT: Final = "left_out-{}.json"
_ON_SHEET: Final = 9
_PATHS: Final = 1  # spawn keys of choices for the whole take, and for one shard
_SHARDS: Final = 2
_MOST_STUDIOS: Final = 32  # of people with painted skins that are kept, some 5 MB each


def render_take(
    path: Path | PoseFile,
    out: str | Place,
    formats: Sequence[str],
    config: RenderConfig,
    *,
    workers: int | Executor | None = None,
    progress: Progress | None = None,
) -> int:
    """Draw a take; a second call resumes where the first was stopped.

    Args:
        path: A tracked take (`.npz`), the truth of a simulated one (`.truth.npz`), or poses of your own.
        out: Folder; or a folder of an object store, as `s3://bucket/prefix` or a `UPath`. Each of several
            formats has a folder of its own in it.
        formats: Some of webdataset, coco, freihand, interhand, exr, png (docs/formats.md).
        config: What to draw.
        workers: Number of processes, all cores when not given; or an executor, as Dask's
            `Client.get_executor()`.
        progress: Called after every shard.

    Returns:
        Number of pictures. Depth is in [m], pixels are in [px], as the format has them. Frames with a camera
        inside a hand or an object are left out; `left_out_frames` tells which.

    Raises:
        HandSimError: The take or the settings cannot be drawn, or all frames would be left out; finished
            shards are kept.
    """
    _check_formats(formats, config)
    place, workers = place_of(out), workers if isinstance(workers, Executor) else check_workers(workers)
    if not isinstance(place, Path) and _RENAMES in formats:
        raise HandSimError(
            f"{out}: {_RENAMES} renames its pictures at the end, which no object store can; render into a "
            "folder and copy it"
        )
    config = config.settled()
    take = _load(path, config)
    if config.background.photo > 0.0:
        photo_files(Path(str(config.background.photos)))
    shards = _shards(take, config)
    viewpoints = _viewpoints(take, config)
    views = viewpoints.num_cameras
    if config.view.cameras is not None:
        check_hands_in_view(config.view.cameras, viewpoints.cameras(0), take)
    settings = _settings(path, take, viewpoints, config) | {"formats": list(formats)}
    make = functools.partial(_render_shard, path, tuple(formats), config)
    with open_output(place) as output:
        output.claim(CONFIG, settings, noun="rendering", error=HandSimError)
        _draw_shards(output, formats, make, [views * len(shard) for shard in shards], workers, progress)
        output.fetch(INDEX, _LEFT_OUT.format("*"))
        for name in formats:
            open_writer(name, _folder(output.folder, formats, name)).finish()
        lost = frozenset(left_out_frames(output.folder))
        kept = [[frame for frame in shard if frame not in lost] for shard in shards]
        if not any(kept):
            raise HandSimError(
                f"{out}: no pictures: in all {len(lost)} frames a camera would be inside a hand or an "
                "object; give another placement, distance or seed"
            )
        _write_sheet(output.folder, take, config, kept)
        output.publish(SHEET)
    return views * sum(map(len, kept))


def _draw_shards(
    output: Output,
    formats: Sequence[str],
    make: Make,
    counts: Sequence[int],
    workers: int | Executor,
    progress: Progress | None,
) -> None:
    """Have the shards drawn that are not there; each has a count of pictures."""
    output.fetch(INDEX, names_of=[f"*{TAR}"])
    done, total = _finished(output.folder, formats), sum(counts)
    count = sum(counts[number] for number in done if number < len(counts))
    todo = [number for number in range(len(counts)) if number not in done]
    try:
        job = output.job(make, last=[INDEX, f"*{TAR}"])
        for drawn, number in enumerate(run_jobs(job, todo, workers)):
            count += counts[number]
            if progress is not None:
                progress(count, total)
            if drawn == 0 and output.is_here:
                _check_space(output.folder, len(done) + 1, len(todo) - 1)
    except KeyboardInterrupt as stop:
        drawn_so_far = f"{count} of {total} images are in {output}, and the same command goes on after them"
        raise Stopped.again(stop, drawn_so_far) from stop


def _load(path: Path | PoseFile, config: RenderConfig) -> ShownTake:
    """A take, or poses that are drawn like one."""
    if not isinstance(path, PoseFile):
        return load_shown_take(path)
    take = load_poses(path, seed=config.seed)
    if config.shutter is not None and not take.is_motion:
        raise HandSimError(f"{path.path}: poses without times have no motion to blur; add the array times")
    return take


def _settings(
    path: Path | PoseFile, take: ShownTake, viewpoints: Viewpoints, config: RenderConfig
) -> dict[str, Any]:
    """What decides the pictures, as JSON; files that others write count by their content."""
    name = path.path.name if isinstance(path, PoseFile) else path.name
    settings: dict[str, Any] = {"take": name, "frames": take.num_frames} | dataclasses.asdict(config)
    if config.view.cameras is None:
        del settings["view"]["cameras"]
    else:
        settings["view"]["cameras"] = [camera.record() for camera in viewpoints.cameras(0)]
    if isinstance(path, PoseFile):
        settings["poses"] = {
            "sha256": checksum(path.path),
            "sides": list(path.sides),
            "people": path.people,
            "glove": path.glove,
        }
    return settings


def left_out_frames(out: str | Place) -> list[int]:
    """Numbers of the frames that a rendering left out: a camera would be inside a hand or an object."""
    with open_output(out) as output:
        output.fetch(_LEFT_OUT.format("*"))
        files = sorted(output.folder.glob(_LEFT_OUT.format("*")))
        return sorted(frame for file in files for frame in load_json(file)["frames"])


def _check_formats(formats: Sequence[str], config: RenderConfig) -> None:
    for name in formats:
        if name not in FORMATS:
            raise HandSimError(choices(name, FORMATS, noun="format"))
        if name in NEED_COLORS and "rgb" not in config.passes:
            raise without_colors(name)
    if not formats or len(set(formats)) < len(formats):
        raise HandSimError(f"formats are {', '.join(formats) or 'none'}, expected at least one, each once")


def _check_space(out: Path, drawn: int, left: int) -> None:
    """Refuse the other shards if the disk has no space for them; those that are drawn show what they need."""
    needed = left * sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) // drawn
    check_free(out, needed, f"the other {left} shards", "draw fewer frames (--every)", error=HandSimError)


def _folder(out: Path, formats: Sequence[str], name: str) -> Path:
    return out if len(formats) == 1 else out / name


def _finished(folder: Path, formats: Sequence[str]) -> frozenset[int]:
    done = [open_writer(name, _folder(folder, formats, name)).done() for name in formats]
    return frozenset.intersection(*done)


def _shards(take: ShownTake, config: RenderConfig) -> list[list[int]]:
    """Frames of each shard; frames without a hand are left out."""
    present = np.isfinite(take.wrists()[..., 0]).any(axis=1)
    frames = [frame for frame in range(0, take.num_frames, config.every) if present[frame]]
    size = config.frames_per_shard
    return [frames[first : first + size] for first in range(0, len(frames), size)]


def _viewpoints(take: ShownTake, config: RenderConfig) -> Viewpoints:
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(_PATHS,)))
    return Viewpoints(config.view, take, rng=rng)


@functools.lru_cache(maxsize=1)
def _opened(path: Path | PoseFile, config: RenderConfig) -> tuple[ShownTake, Viewpoints]:
    """A take and its cameras; cached, because a worker draws many of its shards."""
    cv2.setNumThreads(1)  # there is one process per core
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HandSimWarning)  # told once, before the work
        take = _load(path, config)
    return take, _viewpoints(take, config)


def _render_shard(
    path: Path | PoseFile, formats: tuple[str, ...], config: RenderConfig, out: Path, shard: int
) -> int:
    take, viewpoints = _opened(path, config)
    lost: list[int] = []

    def leave_out(frame: int) -> None:
        lost.append(frame)  # on the disk before the shard is, so that no kill loses it
        save_json(out / _LEFT_OUT.format(f"{shard:05d}"), {"frames": lost})

    frames = draw_shard(take, viewpoints, config, shard, _shards(take, config)[shard], leave_out=leave_out)
    kept = list(frames) if len(formats) > 1 else frames
    for name in formats:
        writer = open_writer(name, _folder(out, formats, name))
        if shard not in writer.done():
            writer.write(shard, kept)
    return shard


def draw_frames(
    take: Take | ShownTake, config: RenderConfig, frames: Sequence[int], *, shard: int = 0
) -> Iterator[RenderedFrame]:
    """Some frames of a take, seen by all its cameras.

    Args:
        take: A simulated take, whose truth is drawn, or a tracked one.
        config: What to draw.
        frames: Numbers of frames in the take.
        shard: Number of the shard; people change with it, as does all else that does not vary by frame.

    Yields:
        Each frame once per camera, with pictures (H, W, 3), depth (H, W) [m], and the truth of every hand in
        the world [m] and in the picture [px].

    Raises:
        HandSimError: A camera stands in a hand or an object.
    """
    shown = take if isinstance(take, ShownTake) else show_take(take)
    return draw_shard(shown, _viewpoints(shown, config), config, shard, frames)


def draw_shard(
    take: ShownTake,
    viewpoints: Viewpoints,
    config: RenderConfig,
    shard: int,
    frames: Sequence[int],
    *,
    leave_out: Callable[[int], None] | None = None,
) -> Iterator[RenderedFrame]:
    """Some frames of a take, seen by all its cameras, with the people of this shard.

    Args:
        take: The take.
        viewpoints: Its cameras.
        config: What to draw.
        shard: Number of the shard.
        frames: Numbers of the frames.
        leave_out: Told of a frame with a camera inside a hand or an object, which no camera draws then;
            without it such a frame is an error.
    """
    seeds = np.random.SeedSequence(config.seed, spawn_key=(_SHARDS, shard)).spawn(1 + len(frames))
    around = viewpoints.positions() if viewpoints.num_cameras > 1 else None
    rng = np.random.default_rng(seeds[0])
    studio = _studio(take, config, rng) if take.cast is None else None
    kept: dict[int, FrameChoices] = {}
    for frame, seed in zip(frames, seeds[1:], strict=True):
        person = 0 if take.cast is None else take.cast.person_in(frame, shard)
        if take.cast is not None:
            studio = _studio_of(take, config, person)
            rng = np.random.default_rng(seeds[0])  # all people of a shard are in one place
        assert studio is not None
        own = np.random.default_rng(seed)
        if config.vary == "frame":
            chosen = _choices(config, studio.skin, around, own)
        else:
            if person not in kept:
                kept[person] = _choices(config, studio.skin, around, rng)
            chosen = kept[person]
        cameras = viewpoints.cameras(frame)
        if leave_out is not None and not studio.is_clear(frame, cameras):
            leave_out(frame)
            continue
        for camera in cameras:
            fresh = dataclasses.replace(chosen, seed=int(own.integers(2**31)))
            yield studio.photograph(frame, camera, fresh)


def _studio(take: ShownTake, config: RenderConfig, rng: np.random.Generator) -> Studio:
    """The hands and bodies of a take, on people drawn by a generator."""
    people = sample_people(len(take.hands), config.dress == "glove", tones=config.tones, rng=rng)
    colors = [tuple(rng.uniform(0.05, 0.9, 3).tolist()) for _ in take.bodies]
    painter = choose_painter(config.with_chosen_painter().painter)
    return Studio(take, people, colors, config.passes, painter=painter)


@functools.lru_cache(maxsize=_MOST_STUDIOS)
def _studio_of(take: ShownTake, config: RenderConfig, person: int) -> Studio:
    """The hands of one of the cast, with a skin of their own; cached, because they come back."""
    assert take.cast is not None
    return _studio(take.of_person(person), config, take.cast.rng(person))


def _choices(
    config: RenderConfig, skin: SkinLook | None, around: NDArray[np.float64] | None, rng: np.random.Generator
) -> FrameChoices:
    """Random choices; a background that several cameras share is around these positions (N, 3) [m]."""
    background, lighting = sample_surroundings(config.background, skin, rng=rng)
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


def _write_sheet(out: Path, take: ShownTake, config: RenderConfig, shards: list[list[int]]) -> None:
    """Write a few of the pictures on one sheet."""
    if not {"rgb", "depth"} & set(config.passes):
        return
    viewpoints, frames = _viewpoints(take, config), []
    filled = [number for number, shard in enumerate(shards) if shard]
    for shard in np.array(filled)[np.unique(np.linspace(0, len(filled) - 1, _ON_SHEET).round().astype(int))]:
        chosen_frames = (
            shards[shard][:1]
            if len(filled) >= _ON_SHEET
            else shards[shard][:: max(1, len(shards[shard]) // 3)][:3]
        )
        frames += list(draw_shard(take, viewpoints, config, int(shard), chosen_frames))
    write_png(out / SHEET, contact_sheet(frames[:_ON_SHEET]))
