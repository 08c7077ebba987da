"""The command `handsim film`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from film.config import FILM_DEFAULTS
from handsim.app.messages import print_line, print_table, progress_bar
from handsim.cli.study import Step, StudyFile, run_study
from handsim.errors import ArgumentError
from handsim.files.inputs import load_json
from handsim.files.outputs import check_outputs
from handsim.space.camera import Camera
from render.config import FrameConfig


def film(
    take: Annotated[Path, tyro.conf.Positional],
    videos: Annotated[tuple[Path, ...], tyro.conf.Positional],
    *,
    out: Path,
    options: Annotated[FrameConfig, tyro.conf.arg(name="")] = FILM_DEFAULTS,
    camera: Path | None = None,
    detector: str = "handsim",
    format: tuple[str, ...] = ("webdataset",),
    workers: int | None = None,
) -> None:
    """Register an ordinary video to a tracked take, and write its frames as labeled photographs.

    Pose, lens and clock of the camera follow from the hands alone; docs/how_to/film.md tells how to film.
    Of several videos those that fail are reported and skipped, and what OUT has of the same videos and
    options stays.

    Args:
        take: A tracked take (.npz) with the hands that the video shows.
        videos: The video (.mp4, .mov, .avi): one shot of a camera that stands still; or several, each with a
            clock and a lens of its own.
        out: Folder for the pictures, their annotations, film.json, film.mp4 and film.html; of several videos
            each has a folder with the video's name in it.
        options: What to write.
        camera: File with this camera's lens, as of handsim rig import; the lens is fitted when not given.
            Several videos all have this lens.
        detector: What finds hands in the video: handsim, mediapipe (for bare hands; pip install
            'handsim[mediapipe]'), the folder of a detector of your own, or a .json file of handsim detect or
            of another program, of one video (docs/how_to/film.md).
        format: File formats: webdataset, coco, yolo, exr, png; several go into folders.
        workers: Processes that write; all cores when not given.
    """
    from film.annotation import PAGE, annotate_film

    if len(videos) != 1:
        if not videos:
            raise ArgumentError("no video is given, expected one or several")
        if detector.lower().endswith(".json"):
            raise ArgumentError(
                f"given --detector {detector} and {len(videos)} videos, expected the one whose hands it has"
            )
        given = {"options": options, "camera": camera, "detector": detector, "format": format}

        def plan(file: StudyFile) -> Step:
            return Step((out / file.name,), (take, camera, detector), given)

        files = [StudyFile(video, Path(video.stem), {}) for video in videos]
        run_study(files, out, partial(film, take, workers=workers), plan, "registered", _print_cameras)
        return
    (video,) = videos
    check_outputs((take, video, camera, detector), (out,))
    begin = time.perf_counter()
    with progress_bar("frames") as bar:
        found = annotate_film(
            take,
            video,
            out,
            format,
            options,
            camera=camera,
            detector=detector,
            workers=workers,
            progress=bar,
            on_step=bar.step,
        )
    print_table(found.figures(), left=1)
    print_line(*found.doubts(), *(f"Left out: {what}." for what in found.left_out()))
    counted, seconds = found.reasons.count(""), time.perf_counter() - begin
    print_line(
        f"{out}: {counted} of {len(found.reasons)} frames fit, {found.residual():.1f} px off in the median; "
        f"{seconds:.0f} s"
    )
    print_line(f"{out / PAGE}: residuals over time, camera and clock")


def _print_cameras(steps: Sequence[Step]) -> None:
    """Print a table of the cameras of several videos, each as it stood at first."""
    from film.annotation import RECORD

    rows = [("video", "place [m]", "SD [mm]", "focal length [px]", "clock [s]", "frames that count [%]")]
    for folder in (step.outputs[0] for step in steps):
        found = load_json(folder / RECORD)
        camera = Camera(**found["cameras"][0])
        place = " ".join(f"{one:.3f}" for one in camera.T_world_camera[:3, 3])
        known = f"{1e3 * found['deviations']['position']:.1f}"
        clock = f"{found['offset']:.4f}"
        share = f"{100 * found['frames_that_count'] / found['frames']:.0f}"
        rows.append((folder.name, place, known, f"{camera.focal_length:.1f}", clock, share))
    if len(rows) > 1:
        print_table(rows, left=1)
