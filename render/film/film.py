"""`annotate_film`: an ordinary video of a tracked take as labeled photographs, in all formats of `render`."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from gloves.takes.take import Take, load_take
from handsim._checks import check_type
from handsim.callbacks import Progress, no_progress
from handsim.errors import ArgumentError, CaptureError, HandSimError
from handsim.files.inputs import check_regular, checksum
from handsim.files.outputs import plain_path, save_json
from handsim.hand.model import between_poses
from handsim.hand.shape import NUM_KEYPOINTS
from handsim.space.camera import Camera
from handsim.space.rig_formats import load_cameras
from render.captions import draw_keypoints
from render.config import RenderConfig
from render.film.bundle import FoundFrame
from render.film.detector import FoundHand, HandDetector
from render.film.page import write_film_page
from render.film.registration import Registration, register
from render.formats.writer import WRITERS
from render.frames import Bytes
from render.illustrations import write_video
from render.session import render_take
from render.subject import subject_of_take
from render.viewpoints import ViewConfig

RECORD, VIDEO, PAGE = "film.json", "film.mp4", "film.html"
"""Files beside the pictures: the registration, the video with the hands drawn over it, and the page."""
_SEARCH: Final = 5  # every so many frames the whole picture is searched
_SURE: Final = 0.5  # least confidence of a hand that is followed
_SMALLEST: Final = 8.0  # [px] of the box of a hand that is followed
_USUAL_RATE: Final = 30.0  # [Hz] of a video that does not tell its own
_MOST_FRAMES: Final = 1 << 20
_FILMED: Final = RenderConfig(dress="glove", depth_sensor=None, color_sensor=None, painter="compiled")
_NOT_FILMED: Final = ("view", "tones", "background", "vary", "depth_sensor", "room_depth", "color_sensor",
                      "painter", "shutter")  # fmt: skip


class Film:
    """A video file, read frame by frame from its beginning.

    Raises:
        CaptureError: The file is missing, or no video that OpenCV reads.
    """

    def __init__(self, path: str | Path) -> None:
        check_type("video", path, (str, os.PathLike), "the path of a video")
        self.path = Path(path)
        check_regular(self.path, error=CaptureError)
        self._open()
        self._next = 0
        width, height, rate, count = (
            self._reader.get(which)
            for which in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS,
                          cv2.CAP_PROP_FRAME_COUNT)
        )  # fmt: skip
        self.size = int(width), int(height)
        self.rate = rate if 0.0 < rate < 1e4 else _USUAL_RATE
        self.num_frames = int(min(max(count, 0), _MOST_FRAMES))
        """As the file tells it, which may be wrong."""
        Camera("film", self.size, np.diag([1.0, 1.0, 1.0]))  # refuses pictures that are too large

    def _open(self) -> None:
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # The error below says enough.
        try:
            with plain_path(self.path) as plain:
                self._reader = cv2.VideoCapture(str(plain), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not self._reader.isOpened():
            raise CaptureError(
                f"{self.path}: not a video that can be read, expected an .mp4, .mov or .avi file"
            )

    def frames(self, step: int = 1) -> Iterator[tuple[int, float, Bytes]]:
        """Number, time [s] and picture (sRGB) of every `step`-th frame."""
        self._open()
        for number in range(_MOST_FRAMES):
            if not self._reader.grab():
                return
            if number % step == 0:
                time = 1e-3 * float(self._reader.get(cv2.CAP_PROP_POS_MSEC))
                yield number, time, self._picture()
        raise CaptureError(f"{self.path}: more than {_MOST_FRAMES} frames, expected a shorter video")

    def picture(self, number: int) -> Bytes:
        """The picture (sRGB) of a frame; reading forward is fast."""
        if number < self._next:
            self._open()
            self._next = 0
        while self._next <= number:
            if not self._reader.grab():
                raise CaptureError(f"{self.path}: frame {number} cannot be read; was the file changed?")
            self._next += 1
        return self._picture()

    def _picture(self) -> Bytes:
        done, picture = self._reader.retrieve()
        if not done or picture.shape[1::-1] != self.size:
            raise CaptureError(f"{self.path}: a frame is damaged, or of another size than {self.size}")
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


@dataclass(frozen=True, slots=True, eq=False)
class _Pictures:
    """The pictures of a video in the place of drawn ones, by the numbers of its frames."""

    path: Path
    poses: Float[np.ndarray, "T 4 4"]
    """Pose of the camera in each frame [m]."""
    straightened: tuple[Camera, Camera] | None = None
    """The camera and a pinhole camera, whose pictures are wanted; None for pictures as they are."""

    def open(self) -> _Reader:
        """A reader for one process."""
        return _Reader(self)


class _Reader:
    """Reads the pictures of `_Pictures`."""

    def __init__(self, pictures: _Pictures) -> None:
        self._film, self._maps = Film(pictures.path), None
        self.name = pictures.path.name
        if pictures.straightened is not None:
            camera, pinhole = pictures.straightened
            maps = camera.project(pinhole.at(camera.T_world_camera).rays() @ camera.T_world_camera[:3, :3].T
                                  + camera.T_world_camera[:3, 3]) - 0.5  # fmt: skip
            self._maps = maps.astype(np.float32)

    def picture(self, number: int) -> Bytes:
        """The picture (sRGB) of a frame."""
        found = self._film.picture(number)
        if self._maps is None:
            return found
        return np.asarray(cv2.remap(found, self._maps, None, cv2.INTER_LINEAR))


def register_camera(
    take: Take | str | Path,
    video: str | Path,
    *,
    camera: Camera | str | Path | None = None,
    detector: HandDetector | None = None,
    step: int = 1,
    progress: Progress = no_progress,
) -> Registration:
    """Find the pose, the lens and the clock of the camera that filmed a take, from its hands alone.

    Args:
        take: A tracked take or its path.
        video: The video: of one camera that stood still, and of one shot.
        camera: A camera with the lens of the video's, or a file of it; its pose does not count. The focal
            length, the center and two coefficients are found, too, when not given.
        detector: Finds the hands in the pictures; the shipped one when not given.
        step: Step between the frames that are looked at.
        progress: Called with the numbers of frames that were looked at, and of all.

    Returns:
        Pose [m], lens [px] and clock [s], with standard deviations, and what fits where.

    Raises:
        HandSimError: The take or the video cannot be read, or the hands do not move as those of the take.
    """
    taken, film = _taken(take), Film(video)
    given = _given(camera, film.size)
    found = find_hands(film, detector or HandDetector.load(), step, progress)
    return register(taken, found, film.size, given, lambda: film.frames(step))


def _taken(take: Take | str | Path) -> Take:
    check_type("take", take, (Take, str, os.PathLike), "a Take or its path")
    taken = take if isinstance(take, Take) else load_take(take)
    if not np.isfinite(taken.qpos[..., 0]).any():
        raise CaptureError("the take has no hand in any frame, expected hands that the video shows")
    return taken


def _given(camera: Camera | str | Path | None, size: tuple[int, int]) -> Camera | None:
    """The camera whose lens the video's has; of the cameras of a file, the one with its size."""
    if camera is None:
        return None
    check_type("camera", camera, (Camera, str, os.PathLike), "a Camera or a file of one")
    cameras = (camera,) if isinstance(camera, Camera) else load_cameras(camera)
    fitting = [one for one in cameras if one.size == size]
    if len(fitting) != 1:
        sizes = ", ".join(f"{one.name} {one.size[0]} x {one.size[1]}" for one in cameras)
        raise HandSimError(
            f"the video's pictures have {size[0]} x {size[1]} pixels and the cameras are {sizes}; expected "
            "one of this size, and no other"
        )
    return fitting[0]


def find_hands(film: Film, detector: HandDetector, step: int, progress: Progress) -> list[FoundFrame]:
    """The hands in every `step`-th frame of a video: searched now and then, followed in between."""
    found: list[FoundFrame] = []
    known: list[FoundHand] = []
    for number, time, picture in film.frames(step):
        if len(found) % _SEARCH == 0 or not known:
            known = detector.detect(picture)
        else:
            boxes, sides = np.array([hand.box for hand in known]), [hand.side for hand in known]
            known = [hand for hand in detector.refine(picture, boxes, sides) if hand.confidence >= _SURE]
        known = [hand for hand in known if np.isfinite(hand.box).all() and hand.box[2:].min() >= _SMALLEST]
        found.append(FoundFrame(number, time, known))
        progress(number + 1, max(film.num_frames, number + 1))
    if not found:
        raise CaptureError(f"{film.path}: no frame can be read, expected a video")
    return found


def annotate_film(
    take: Take | str | Path,
    video: str | Path,
    out: str | Path,
    formats: str | Sequence[str] = ("webdataset",),
    *,
    camera: Camera | str | Path | None = None,
    detector: HandDetector | None = None,
    workers: int | Executor | None = None,
    progress: Progress = no_progress,
    **settings: Any,
) -> Registration:
    """Register a video to a take, and write its frames as photographs with the truth of the take's hands.

    The folder has the files of `render_take`, and beside them `film.json` (the registration), `film.mp4` (the
    hands' skeletons over the video) and the page `film.html`. Frames that do not fit are left out.

    Args:
        take: A tracked take or its path.
        video: The video.
        out: Folder.
        formats: Formats as in `render_take`; freihand and interhand get pictures without distortion.
        camera: As in `register_camera`.
        detector: As in `register_camera`.
        workers: As in `render_take`.
        progress: Called with numbers of done and of all frames, first of finding hands, then of writing.
        settings: Settings of `RenderConfig` that a film has: passes, dress (a glove when not given), every,
            num_frames, frames_per_shard, seed and up.

    Returns:
        The registration: pose [m], lens [px], clock [s], and which frames fit.

    Raises:
        HandSimError: As in `register_camera` and `render_take`, or no frame fits.
    """
    for name in settings:
        if name in _NOT_FILMED:
            raise ArgumentError(f"{name} is a setting of drawn pictures, which a video has not")
    config = RenderConfig.of(_FILMED, settings)
    taken, film = _taken(take), Film(video)
    step = config.every if config.every <= 3 else next(n for n in (3, 2, 1) if config.every % n == 0)
    registration = register_camera(
        taken, video, camera=camera, detector=detector, step=step, progress=progress
    )
    posed = filmed_take(taken, registration)
    if not np.isfinite(posed.qpos[..., 0]).any():
        told = "; ".join(registration.left_out())
        raise HandSimError(f"{film.path}: no frame can be told: {told}")
    names = (formats,) if isinstance(formats, str) else tuple(formats)
    first = registration.cameras[0]
    straight = (
        any(name in WRITERS and not WRITERS[name].any_lens for name in names) and first.lens.kind != "pinhole"
    )
    shown = Camera(first.name, first.size, first.K, first.T_world_camera) if straight else first
    spans = [registration.span(number) for number in range(posed.num_frames)]
    pictures = _Pictures(
        film.path.absolute(),
        np.stack([one.T_world_camera for one in registration.cameras])[spans],
        (first, shown) if straight else None,
    )
    record = {"film": {"sha256": checksum(film.path), **registration.record()}}
    subject = dataclasses.replace(subject_of_take(posed), film=pictures, poses=record)
    config = dataclasses.replace(config, view=ViewConfig(cameras=(shown,)))
    source: Any = subject  # only this module gives a subject
    render_take(source, out, formats, config, workers=workers, progress=progress)
    folder = Path(out)
    save_json(folder / RECORD, registration.record())
    write_video(folder / VIDEO, _drawn_over(film, taken, registration), rate=film.rate, size=film.size)
    write_film_page(folder / PAGE, registration)
    return registration


def filmed_take(take: Take, registration: Registration) -> Take:
    """A take with one frame for each frame of the video; poses are NaN in frames that do not fit.

    A hand has the pose of the time at which a rolling shutter reads the rows that it is in.
    """
    numbers, count = registration.numbers, int(registration.numbers[-1]) + 1
    times = registration.take_times(np.interp(np.arange(count), numbers, registration.times))
    fits = np.zeros(count, dtype=bool)
    fits[numbers] = [not reason for reason in registration.reasons]
    fits &= (times >= take.times[0]) & (times <= take.times[-1])
    qpos = between_poses(take.times, times, take.qpos, take.rate)
    for hand in range(qpos.shape[1]):
        rows = np.array([registration.camera_of(n).project(qpos[n, hand, :3])[1] for n in range(count)])
        late = np.clip(np.nan_to_num(rows / registration.cameras[0].size[1] - 0.5), -0.5, 0.5)
        own = between_poses(take.times, times + registration.readout * late, take.qpos[:, [hand]], take.rate)
        qpos[:, hand] = own[:, 0]
    poses = between_poses(take.times, times, take.body_poses, take.rate)
    qpos[~fits] = np.nan
    return Take.of_poses(
        take.hands,
        qpos,
        rate=take.rate,
        times=times,
        bodies=take.bodies,
        body_poses=poses,
        settings=take.settings,
    )


class _Skeleton(NamedTuple):
    """A hand that `draw_keypoints` draws."""

    keypoints: Float[np.ndarray, "21 2"]
    visible: Bool[np.ndarray, "21"]


def _drawn_over(film: Film, take: Take, registration: Registration) -> Iterator[Bytes]:
    """The frames of a video with the skeletons of the take's hands, hollow where the frame does not count."""
    reasons = dict(zip(registration.numbers.tolist(), registration.reasons, strict=True))
    everywhere = dataclasses.replace(registration, reasons=("",) * len(registration.reasons))
    whole = filmed_take(take, everywhere).keypoints()
    for number, _, picture in film.frames():
        if number >= len(whole):
            return
        fits = np.full(NUM_KEYPOINTS, not reasons.get(number, ""))
        camera = registration.camera_of(number)
        there = [hand for hand in whole[number] if np.isfinite(hand[0, 0])]
        yield draw_keypoints(picture, [_Skeleton(camera.project(hand), fits) for hand in there])
