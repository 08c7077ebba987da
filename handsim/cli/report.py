"""The command `handsim report`: the page on a take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from handsim.app.messages import print_line
from handsim.files.outputs import check_outputs


def report(take: Annotated[Path, tyro.conf.Positional], out: Path) -> None:
    """Write a page on a take: joint angles, range of motion, gaps, residuals, doubtful frames.

    Beside it are its tables: OUT with the ending .frames.csv has a row per frame and hand, .joints.csv the
    ranges of motion and errors, .markers.csv what was seen of each marker, .doubts.csv the doubtful frames.

    Args:
        take: A take (.npz, of handsim track or the .truth.npz of handsim simulate).
        out: The page, an .html file, whole in itself.
    """
    from gloves.takes.take import load_take
    from track.takes.take_page import table_paths, write_take_page

    check_outputs([take], [out, *table_paths(out)])
    page, frames, *tables = write_take_page(out, load_take(take), source=str(take))
    print_line(f"{page}: page on {take}; tables in {', '.join(map(str, (frames, *tables)))}")
