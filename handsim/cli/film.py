"""The command `handsim film`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import tyro

from film.config import USUAL
from handsim.app.messages import print_line, print_table, progress_bar
from handsim.files.outputs import check_outputs
from render.config import FrameConfig


def film(
    take: Annotated[Path, tyro.conf.Positional],
    video: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path,
    options: Annotated[FrameConfig, tyro.conf.arg(name="")] = USUAL,
    camera: Path | None = None,
    detector: str = "handsim",
    format: tuple[str, ...] = ("webdataset",),
    workers: int | None = None,
) -> None:
    """Register an ordinary video to a tracked take, and write its frames as labeled photographs.

    Pose, lens and clock of the camera follow from the hands alone; docs/how_to/film.md tells how to film.

    Args:
        take: A tracked take (.npz) with the hands that the video shows.
        video: The video (.mp4, .mov, .avi): one shot of a camera that stands still.
        out: Folder for the pictures, their annotations, film.json, film.mp4 and film.html.
        options: What to write.
        camera: File with this camera's lens, as of handsim rig import; the lens is fitted when not given.
        detector: What finds hands in the video: handsim, mediapipe (for bare hands; pip install
            'handsim[mediapipe]'), the folder of a detector of your own, or a .json file of handsim detect or
            of another program (docs/how_to/film.md).
        format: File formats: webdataset, coco, yolo, exr, png; several go into folders.
        workers: Processes that write; all cores when not given.
    """
    from film.annotation import PAGE, annotate_film

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
    print_line(*found.doubts(), *(f"Left out: {told}." for told in found.left_out()))
    counted, seconds = found.reasons.count(""), time.perf_counter() - begin
    print_line(
        f"{out}: {counted} of {len(found.reasons)} frames fit, {found.residual():.1f} px off in the median; "
        f"{seconds:.0f} s"
    )
    print_line(f"{out / PAGE}: residuals over time, camera and clock")
