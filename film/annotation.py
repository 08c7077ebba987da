"""`annotate_film`: an ordinary video of a tracked take as labeled photographs, in all formats of `render`."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np

from film.config import FILM_DEFAULTS
from film.detection import find_hands, resolve_detector
from film.detector import HandDetector
from film.outlines import poses_at, shutter_times
from film.page import write_film_page
from film.registration import Registration, register
from film.stored_hands import StoredHands
from film.video import Film, FilmFootage
from gloves.takes.take import Take, load_take
from handsim._checks import check_type
from handsim.callbacks import OnStep, Progress, no_progress, no_step
from handsim.errors import CaptureError, HandSimError
from handsim.files.inputs import checksum
from handsim.files.outputs import save_json
from handsim.hand.model import between_poses
from handsim.hand.shape import NUM_KEYPOINTS
from handsim.space.camera import Camera
from handsim.space.rig_formats import load_cameras
from render.captions import draw_keypoints
from render.config import FrameConfig, RenderConfig
from render.frames import Bytes
from render.illustrations import write_video
from render.session import render_take
from render.subject import subject_of_take
from render.viewpoints import ViewConfig

_AnyCamera = Camera | str | Path | None
_AnyDetector = HandDetector | StoredHands | str | Path | None
RECORD, VIDEO, PAGE = "film.json", "film.mp4", "film.html"
"""Files beside the pictures: the registration, the video with the hands drawn over it, and the page."""


def register_camera(
    take: Take | str | Path,
    video: str | Path,
    *,
    camera: Camera | str | Path | None = None,
    detector: HandDetector | StoredHands | str | Path | None = None,
    progress: Progress = no_progress,
    on_step: OnStep = no_step,
) -> Registration:
    """Find the pose, the lens and the clock of the camera that filmed a take, from its hands alone.

    Args:
        take: A tracked take or its path.
        video: The video: of one camera that stood still, and of one shot.
        camera: A camera with the lens of the video's, or a file of it; its pose is not used. When not given,
            the focal length and two coefficients are estimated, too, and the center as far as the motion
            determines it: otherwise it stays near the middle of the picture.
        detector: Finds the hands in the pictures: `handsim` for the shipped one, `mediapipe`, a folder of
            weights, or hands that were found before and their file (.json); the shipped one when not given.
        progress: Called with the numbers of done and of all frames, first of finding hands, then of the fit.
        on_step: Called with the name of each step.

    Returns:
        Pose [m], lens [px] and clock [s], with standard deviations, and which frames fit.

    Raises:
        HandSimError: The take or the video cannot be read, or the hands do not move as those of the take.
    """
    return _register(_load_take_with_hands(take), Film(video), camera, detector, progress, on_step)


def _register(
    take: Take, film: Film, camera: _AnyCamera, detector: _AnyDetector, progress: Progress, on_step: OnStep
) -> Registration:
    """Find the hands in a video, and register it to a take."""
    known_camera = _resolve_camera(camera, film.size)
    on_step("finding hands")
    frames = find_hands(film, resolve_detector(detector), progress)
    on_step("fitting the camera")

    def pictures() -> Iterator[Bytes]:
        return (picture for _, picture in film.frames())

    return register(take, frames, film.size, known_camera, pictures, progress)


def _load_take_with_hands(take: Take | str | Path) -> Take:
    """Load a take unless it is given as an object, and refuse one without hands."""
    check_type("take", take, (Take, str, os.PathLike), "a Take or its path")
    loaded = take if isinstance(take, Take) else load_take(take)
    if not np.isfinite(loaded.qpos[..., 0]).any():
        raise CaptureError("the take has no hand in any frame, expected hands that the video shows")
    return loaded


def _resolve_camera(camera: _AnyCamera, size: tuple[int, int]) -> Camera | None:
    """The camera with the lens of the video's: of the cameras in a file, the one with the video's size."""
    if camera is None:
        return None
    check_type("camera", camera, (Camera, str, os.PathLike), "a Camera or a file of one")
    cameras = (camera,) if isinstance(camera, Camera) else load_cameras(camera)
    of_size = [one for one in cameras if one.size == size]
    if len(of_size) != 1:
        sizes = ", ".join(f"{one.name} {one.size[0]} x {one.size[1]}" for one in cameras)
        raise HandSimError(
            f"the video's pictures have {size[0]} x {size[1]} pixels and the cameras are {sizes}; expected "
            "one of this size, and no other"
        )
    return of_size[0]


def annotate_film(
    take: Take | str | Path,
    video: str | Path,
    out: str | Path,
    formats: str | Sequence[str] = ("webdataset",),
    config: FrameConfig | None = None,
    *,
    camera: Camera | str | Path | None = None,
    detector: HandDetector | StoredHands | str | Path | None = None,
    workers: int | Executor | None = None,
    progress: Progress = no_progress,
    on_step: OnStep = no_step,
    **settings: Any,
) -> Registration:
    """Register a video to a take, and write its frames as photographs labeled with the take's hands.

    The folder has the files of `render_take`, and beside them `film.json` (the registration), `film.mp4` (the
    hands' skeletons over the video) and the page `film.html`. Frames that do not fit are left out.

    Args:
        take: A tracked take or its path.
        video: The video.
        out: Folder.
        formats: As in `render_take`.
        config: What is written; of hands in gloves when not given.
        camera: As in `register_camera`.
        detector: As in `register_camera`.
        workers: As in `render_take`.
        progress: Called with numbers of done and of all frames, of finding hands, of the fit, and of writing.
        on_step: As in `register_camera`.
        settings: Settings of `FrameConfig` that differ from `config`, as `dress="skin"` or `num_frames=100`.

    Returns:
        The registration: pose [m], lens [px], clock [s], and which frames fit.

    Raises:
        HandSimError: As in `register_camera` and `render_take`, or no frame fits.
    """
    config = FrameConfig.of(FILM_DEFAULTS if config is None else config, settings)
    loaded, film = _load_take_with_hands(take), Film(video)
    registration = _register(loaded, film, camera, detector, progress, on_step)
    posed = filmed_take(loaded, registration)
    if not np.isfinite(posed.qpos[..., 0]).any():
        raise HandSimError(f"{film.path}: no frame can be labeled: {'; '.join(registration.left_out())}")
    poses = np.stack([registration.camera_of(n).T_world_camera for n in range(posed.num_frames)])
    record = {"film": {"sha256": checksum(film.path), **registration.record()}}
    shared = {one.name: getattr(config, one.name) for one in dataclasses.fields(FrameConfig)}
    view = ViewConfig(cameras=(registration.cameras[0],))
    drawn = RenderConfig(**shared, view=view, depth_sensor=None, color_sensor=None, painter="compiled")
    footage = FilmFootage(film, poses)
    # `render_take` accepts a Subject, but its public signature does not name this type.
    source: Any = dataclasses.replace(subject_of_take(posed), footage=footage, poses=record)
    on_step("writing pictures")
    render_take(source, out, formats, drawn, workers=workers, progress=progress)
    on_step(f"writing {VIDEO} and {PAGE}")
    folder = Path(out)
    save_json(folder / RECORD, registration.record())
    write_video(folder / VIDEO, _with_skeletons(film, loaded, registration), rate=film.rate, size=film.size)
    write_film_page(folder / PAGE, registration)
    return registration


def filmed_take(take: Take, registration: Registration, *, every: bool = False) -> Take:
    """Resample a take at the frames of the video; poses in frames that do not fit are NaN, unless `every`.

    Each hand has its pose at the time when a rolling shutter reads the rows that show it.
    """
    times = registration.offset + (1.0 + registration.drift) * registration.times
    cameras = [registration.camera_of(number) for number in range(len(times))]
    qpos = poses_at(take, shutter_times(take, times, cameras, np.array(registration.readout)))
    if not every:
        qpos[[bool(reason) for reason in registration.reasons]] = np.nan
    bodies = between_poses(take.times, times, take.body_poses, take.rate)
    hands, former = take.worn_at(times)
    filmed = Take.of_poses(
        hands, qpos, rate=take.rate, times=times, bodies=take.bodies, body_poses=bodies,
        settings=take.settings,
    )  # fmt: skip
    return dataclasses.replace(filmed, former=tuple(former))


def _with_skeletons(film: Film, take: Take, registration: Registration) -> Iterator[Bytes]:
    """The frames of a video with the skeletons of the take's hands, hollow in frames that do not fit."""
    whole = filmed_take(take, registration, every=True).keypoints()
    for number, (_, picture) in zip(range(len(whole)), film.frames(), strict=False):
        fits = np.full(NUM_KEYPOINTS, not registration.reasons[number])
        camera = registration.camera_of(number)
        there = [hand for hand in whole[number] if np.isfinite(hand[0, 0])]
        yield draw_keypoints(picture, [(camera.project(hand), fits) for hand in there])
