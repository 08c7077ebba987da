"""`render_take` writes pictures into files, and resumes a rendering that was stopped."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import threading
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike

from gloves.layout import MarkerLayout
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
from handsim.files.inputs import load_json
from handsim.files.outputs import check_free, save_json
from handsim.files.signals import Stopped, interrupts_bare
from handsim.space.rig import check_names
from render.captions import contact_sheet, write_png
from render.config import Cameras, RenderConfig, resolve
from render.drawing import Drawing
from render.formats.shards import INDEX
from render.formats.webdataset import TAR
from render.formats.writer import CONFIG, FORMATS, WITH_COLORS, open_writers, shard_files, whole_shards
from render.frames import RenderedFrame
from render.scenery.backgrounds import photo_files
from render.subject import Model, PoseFile, Subject, subject_of

SHEET: Final = "contact_sheet.png"
_MERGED: Final = "checksums.json"  # checksums of the files that all shards make together
_LEFT_OUT: Final = "left_out-{}.json"
_CUT_OFF: Final = "cut_off-{}.json"
_HIDDEN: Final = "hidden-{}.json"
_VISIBLE: Final = "visible-{}.json"
_DRAWN: Final = ".drawn-{}"  # file of a shard in progress, which has one byte for each of its pictures
_LEAST_SHOWN_SHARE: Final = 0.5  # of a hand's keypoints in a picture that does not cut off the hand
_MOST_ON_SHEET: Final = 9  # pictures on a contact sheet


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
        pictures lack a hand of their frame. So are pictures without a visible keypoint, unless the cameras
        are your own; `hidden_pictures` tells which, and `visible_hands` how many hands the pictures show.

    Raises:
        HandSimError: The take or the settings cannot be drawn, or all frames would be left out; finished
            shards are kept.
    """
    check_type("formats", formats, (str, list, tuple), "names of formats", FORMATS)
    formats = (formats,) if isinstance(formats, str) else tuple(formats)
    config = resolve(config, settings, camera)
    _check_formats(formats, config)
    place, workers = place_of(out), workers if isinstance(workers, Executor) else check_workers(workers)
    subject = subject_of(
        source, model=model, times=times, people=people, person=person, glove=glove, seed=config.seed
    )
    drawing = Drawing(subject, config)
    cameras = drawing.viewpoints.cameras(0)
    check_names("cameras", cameras)
    drawing.viewpoints.check_hands_in_view()
    absent = drawing.frames_without_hands()
    if absent and subject.footage is None:  # frames of a video are left out for reasons that are told
        message = f"frames without a hand are not drawn: {len(absent)} of {drawing.take.num_frames}"
        warnings.warn(f"{message} (the first: {absent[0]})", HandSimWarning, stacklevel=3)
    shards, views = drawing.shards(), drawing.viewpoints.num_cameras
    make = functools.partial(_render_shard, subject, formats, config)
    record = _record(drawing) | {"formats": list(formats)}
    with open_output(place) as output:
        output.claim(CONFIG, record, noun="rendering", error=HandSimError)
        counts = [views * len(shard) for shard in shards]
        drew = _draw_shards(output, formats, make, counts, workers, progress)
        output.fetch(INDEX, _LEFT_OUT.format("*"), _HIDDEN.format("*"))
        lost, hidden = frozenset(left_out_frames(output.folder)), hidden_pictures(output.folder)
        drawn = [[frame for frame in shard if frame not in lost] for shard in shards]
        count = views * sum(map(len, drawn)) - len(hidden)
        if not drew and _is_complete(output):
            return count
        merged = [path for one in open_writers(output.folder, formats) for path in one.finish()]
        if not count:
            raise HandSimError(
                f"{out}: no pictures: in all {len(lost)} frames a camera would be inside a hand or an "
                "object; give another placement, distance or seed"
                if lost and not hidden
                else f"{out}: no pictures: none would show a hand; give another placement or seed"
            )
        merged += _write_sheet(output.folder, drawing, drawn)
        files = {path.relative_to(output.folder).as_posix(): path for path in merged}
        save_checksums(output.folder / _MERGED, files)
        output.publish(SHEET)
    return count


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
    counter = _Counter(output.folder, count, total, progress)
    try:
        job = output.job(make, last=[INDEX, f"*{TAR}", CHECKSUMS])
        with counter, interrupts_bare():
            for drawn, number in enumerate(run_jobs(job, todo, workers)):
                count += counts[number]
                counter.finished(number, counts[number])
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
        self._reported = -1
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> None:
        self._clear()
        self._report()
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
        self._report()

    def _watch(self) -> None:
        while not self._ended.wait(1.0):
            self._report()

    def _report(self) -> None:
        with self._lock:
            parts = [file.stat().st_size for file in self._folder.glob(_DRAWN.format("*")) if file.is_file()]
            count = min(self._count + sum(parts), self._total)
            if count > self._reported:
                self._reported = count
                self._progress(count, self._total)


def _record(drawing: Drawing) -> dict[str, Any]:
    """Everything that determines the pictures, as JSON, with digests of files and of photograph lists."""
    subject = drawing.subject
    settings: dict[str, Any] = {"take": subject.name, "take_frames": subject.take.num_frames}
    settings |= dataclasses.asdict(drawing.config)
    if drawing.config.background.shares["photo"] > 0.0:
        files, broken = photo_files(Path(str(drawing.config.background.photos)))
        if broken:
            more = f" and {len(broken) - 1} more" if len(broken) > 1 else ""
            warnings.warn(f"left out: {broken[0]}{more}", HandSimWarning, stacklevel=3)
        listed = "\n".join(f"{file} {file.stat().st_size}" for file in files)
        names = listed.encode("utf-8", "surrogateescape")  # names of files need not be valid text
        settings["photos"] = f"sha256:{hashlib.sha256(names).hexdigest()}"
    if drawing.config.view.cameras is None:
        del settings["view"]["cameras"]
    else:
        # The cameras are recorded as given, because `up` rotates them when they are drawn again.
        settings["view"]["cameras"] = [one.record() for one in drawing.config.view.own_cameras()]
    return settings if subject.poses is None else settings | {"poses": subject.poses}


def left_out_frames(out: str | Place) -> list[int]:
    """Numbers of the frames that a rendering left out: a camera would be inside a hand or an object."""
    return _notes_of_shards(out, _LEFT_OUT, "frames")


def cut_off_pictures(out: str | Place) -> list[str]:
    """Pictures of a rendering that show less than half of a hand's keypoints."""
    return _notes_of_shards(out, _CUT_OFF, "pictures")


def hidden_pictures(out: str | Place) -> list[str]:
    """Pictures that a rendering left out: no keypoint of a hand would be visible."""
    return _notes_of_shards(out, _HIDDEN, "pictures")


def visible_hands(out: str | Place) -> list[int]:
    """How many hands each picture of a rendering shows by a visible keypoint, in ascending order."""
    return _notes_of_shards(out, _VISIBLE, "hands")


def _notes_of_shards(out: str | Place, name: str, key: str) -> list[Any]:
    """Collect the notes that workers wrote about all shards."""
    with open_output(out) as output:
        output.fetch(name.format("*"))
        files = sorted(output.folder.glob(name.format("*")))
        return sorted(one for file in files for one in load_json(file)[key])


def _check_formats(formats: Sequence[str], config: RenderConfig) -> None:
    for name in formats:
        check_type("a format", name, str, "its name", FORMATS)
        check_choice(name, FORMATS, noun="format")
        if name in WITH_COLORS and "rgb" not in config.passes:
            raise ArgumentError(f"the format {name} needs color pictures; add rgb to the passes")
    if config.openxr and not set(WITH_COLORS) & set(formats):
        raise ArgumentError(f"formats are {', '.join(formats)}, expected coco or yolo for openxr's joints")
    if config.mano is not None and not set(WITH_COLORS) & set(formats):
        raise ArgumentError(f"formats are {', '.join(formats)}, expected coco or yolo for MANO's parameters")
    if not formats or len(set(formats)) < len(formats):
        raise ArgumentError(f"formats are {', '.join(formats) or 'none'}, expected at least one, each once")


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
def _cached_drawing(subject: Subject, config: RenderConfig, light: bool) -> Drawing:
    """The drawing of a subject; cached, because a worker draws many of its shards."""
    cv2.setNumThreads(1)  # there is one process per core
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HandSimWarning)  # the main process has warned already
        return Drawing(subject, config, light=light)


def _render_shard(
    subject: Subject, formats: tuple[str, ...], config: RenderConfig, out: Path, shard: int
) -> int:
    """Draw and write one shard, with notes on its pictures and a dot for each that is drawn."""
    drawing, dots = _cached_drawing(subject, config, "exr" in formats), out / _DRAWN.format(shard)
    notes = {name: out / name.format(f"{shard:05d}") for name in (_LEFT_OUT, _CUT_OFF, _HIDDEN, _VISIBLE)}
    lost, cut, hidden, visible = list[int](), list[str](), list[str](), list[int]()
    is_placed = config.view.cameras is None and subject.footage is None

    def leave_out(frame: int) -> None:
        lost.append(frame)  # written before the shard, so that no kill loses it
        save_json(notes[_LEFT_OUT], {"frames": lost})

    def counted() -> Iterator[RenderedFrame]:
        with dots.open("ab", buffering=0) as drawn:
            for frame in drawing.frames(shard, enumerate(drawing.shards()[shard]), leave_out=leave_out):
                count = sum(bool(hand.visible.any()) for hand in frame.hands)
                if is_placed and not count:
                    hidden.append(frame.key)
                else:
                    visible.append(count)
                    if _is_cut_off(frame):
                        cut.append(frame.key)
                    yield frame
                drawn.write(b".")
        dots.unlink(missing_ok=True)
        contents: dict[str, dict[str, list[Any]]] = {
            _CUT_OFF: {"pictures": cut},
            _HIDDEN: {"pictures": hidden},
            _VISIBLE: {"hands": visible},
        }
        for name, content in contents.items():
            if any(content.values()):
                save_json(notes[name], content)

    kept = list(counted()) if len(formats) > 1 else counted()
    record = out / checksums_name(shard)
    record.unlink(missing_ok=True)
    for writer in open_writers(out, formats):
        writer.write(shard, kept)
    there = {path.name: path for path in notes.values() if path.is_file()}
    save_checksums(record, shard_files(out, formats, shard) | there)
    return shard


def _is_cut_off(frame: RenderedFrame) -> bool:
    """Whether a picture cuts off a hand: too few of its keypoints are inside."""
    inside = (((hand.keypoints >= 0.0) & (hand.keypoints < frame.camera.size)).all(1) for hand in frame.hands)
    return any(float(shown.mean()) < _LEAST_SHOWN_SHARE for shown in inside)


def _write_sheet(out: Path, drawing: Drawing, shards: list[list[int]]) -> list[Path]:
    """Write a contact sheet of a few pictures, if they have any to show."""
    if not {"rgb", "depth"} & set(drawing.config.passes):
        return []
    frames: list[RenderedFrame] = []
    filled = [number for number, shard in enumerate(shards) if shard]
    # Few shards are read, because each has a scene of its own to set up.
    each = 1 if len(filled) >= _MOST_ON_SHEET else 3
    spread = np.linspace(0, len(filled) - 1, min(len(filled), _MOST_ON_SHEET // each)).round().astype(int)
    for shard in np.array(filled)[spread]:
        mine = shards[shard]
        frames += drawing.frames(int(shard), enumerate(mine[:: max(1, len(mine) // each)][:each]))
    write_png(out / SHEET, contact_sheet(frames[:_MOST_ON_SHEET]))
    return [out / SHEET]
