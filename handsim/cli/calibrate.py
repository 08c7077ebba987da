"""The command `handsim calibrate`: the user's hands and gloves from a capture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from handsim.app.messages import print_line, progress_bar
from handsim.files.outputs import check_outputs
from handsim.hand.shape import Side
from track.config import BOTH, Size

if TYPE_CHECKING:
    from track.calibration.user_calibration import Calibration


def calibrate(
    capture: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path,
    glove: str = "dense19",
    size: Size = "auto",
    hands: tuple[Side, ...] = BOTH,
    labeler: str | None = None,
) -> None:
    """Fit hands and gloves to a user, from any capture; a minute in which all joints move tells most.

    The capture is labeled by the tracker. Each hand is solved on two thirds of the time and tried on the
    rest; a hand that is no better there stays as it was.

    Args:
        capture: A .trc, .c3d, .csv (Motive, Vicon) or .tsv (Qualisys) file; its names are not used.
        out: The user's file, .json, for handsim track --shape.
        glove: Marker layout: a shipped name or the path of a .toml file.
        size: The size nearest to the hands; auto measures it in the capture.
        hands: Which hands are in the capture.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
    """
    from track import captures
    from track.settings import CalibrateSettings

    check_outputs((capture, glove, labeler), [out], ".json")
    with progress_bar("") as bar:
        settings = CalibrateSettings(glove=glove, hands=hands, size=size, labeler=labeler)
        user = captures.calibrate(capture, settings, progress=bar, on_step=bar.step)
    user.save(out)
    print_line(f"{out}: {len(user)} hands in glove {glove}")
    found = {one.hand.side: _report(one) for one in user.calibrations}
    for side in hands:
        told = found.get(side, ["it is not in the capture and was left out"])
        print_line(*(f"{side} hand: {line}" for line in told))


def _report(done: Calibration) -> list[str]:
    """Lines on the held-out frames before and after, and suggestions for a better capture."""
    line = str(done)
    before, after = 1e3 * done.gaps()
    if done.is_better and np.isfinite(before):
        line += f"; thumb and fingers {before:.1f} mm from touching before, {after:.1f} mm after"
    if done.is_better:
        line += f"; hand length {1e3 * done.hand.model.shape.length:.0f} mm"
    return [line, *done.suggestions()]
