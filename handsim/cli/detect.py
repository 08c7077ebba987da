"""The command `handsim detect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from handsim.app.messages import print_line, progress_bar


def detect(
    pictures: Annotated[tuple[Path, ...], tyro.conf.Positional], *, out: Path, detector: str = "handsim"
) -> None:
    """Find hands, gloved or bare, in photographs or a video, and write them as COCO keypoints.

    docs/how_to/detect.md tells how many it finds in photographs, and what to do where it finds few.

    Args:
        pictures: Photographs, folders of them, or one video, which is searched ten times a second.
        out: File (.json), which handsim film --detector reads; a contact sheet (.jpg) is written beside it.
        detector: handsim, mediapipe (for bare hands; pip install 'handsim[mediapipe]'), or the folder of a
            detector of your own.
    """
    from film.detection import detect_hands

    with progress_bar("pictures") as bar:
        found = detect_hands(pictures, out, detector=detector, progress=bar).frames
    counts = [len(hands) for hands in found.values()]
    print_line(
        f"{out}: {sum(counts)} hands in {sum(count > 0 for count in counts)} of {len(counts)} pictures; "
        f"{out.with_suffix('.jpg')} shows them"
    )
