"""The command `handsim calibrate`: the user's hands and gloves from a capture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
import tyro

from gloves.layout import load_layout
from handsim.app.messages import named_steps, print_line, progress_bar
from handsim.cli.options import TrackerOptions, check_live, check_source, check_take_file
from handsim.cli.study import Step, StudyFile, is_study, run_study, study_files
from handsim.files.outputs import check_outputs
from handsim.hand.shape import Side
from track.config import SizeChoice

if TYPE_CHECKING:
    from track.calibration.user_calibration import Calibration

_MAX_SECONDS: Final = 180.0  # longest recording of a stream by default [s]


def calibrate(
    captures: Annotated[tuple[Path, ...], tyro.conf.Positional] = (),
    *,
    out: Path,
    live: str | None = None,
    seconds: float | None = None,
    glove: str = "dense19",
    size: SizeChoice = "auto",
    hands: tuple[Side, ...] | None = None,
    labeler: str | None = None,
) -> None:
    """Fit hands and gloves to a user, from a capture or stream; best is a minute in which all joints move.

    The capture is labeled by the tracker. Each hand is solved on two thirds of the time and tried on the
    rest; a hand that is no better there stays as it was.

    Args:
        captures: A .trc, .c3d, .csv (Motive, Vicon) or .tsv (Qualisys) file, whose names are not used;
            several of them, folders, or the table of a study (.csv), see docs/how_to/study.md.
        out: The user's file, .json, for handsim track --shape; of several captures a folder of such files
            with the captures' names.
        live: A stream instead of a capture, as of handsim track. What is still to be moved is shown until
            every joint has covered its range; Ctrl-C ends it before. The recording stays beside OUT, as
            NAME.calibration.npz.
        seconds: How long to record a live stream at most [s]; three minutes when not given.
        glove: Marker layout: a shipped name or the path of a .toml file.
        size: The size nearest to the hands; auto measures it in the capture.
        hands: Which hands are in the capture; all that the glove is made for when not given.
        labeler: Folder of a trained labeler, an exported .onnx file, or module:name; the shipped one when
            not given.
    """
    from track.captures import calibrate as fit_user
    from track.settings import CalibrateSettings

    capture = captures[0] if captures else None
    check_source("capture", capture, live)
    check_live(live, seconds)
    if captures and is_study(captures, out):

        def plan(file: StudyFile) -> Step:
            own = {**file.options(glove=glove, hands=hands), "size": size, "labeler": labeler}
            return Step((out / file.name.with_suffix(".json"),), (own["glove"], labeler), own)

        run_study(study_files(captures, out, [".json"]), out, calibrate, plan, "calibrated")
        return
    check_outputs((capture, glove, labeler), [out], ".json")
    if live is not None:
        capture = out.with_suffix(".calibration.npz")
        check_take_file(capture, live=True)
        options = TrackerOptions(glove, size, hands=hands, labeler=labeler)
        _record(live, options, capture, _MAX_SECONDS if seconds is None else seconds)
    assert capture is not None  # `check_source` refused a call with neither source
    with progress_bar("") as bar:
        settings = CalibrateSettings(glove=glove, hands=hands, size=size, labeler=labeler)
        user = fit_user(capture, settings, progress=bar, on_step=bar.step)
    user.save(out)
    sides = " and ".join(hand.side for hand in user)
    print_line(f"{out}: {sides} hand in glove {glove}")
    found = {one.hand.side: _report(one) for one in user.calibrations}
    for side in hands or load_layout(glove).sides[::-1]:
        lines = found.get(side, ["it is not in the capture and was left out"])
        print_line(*(f"{side} hand: {line}" for line in lines))


def _record(live: str, options: TrackerOptions, out: Path, seconds: float) -> None:
    """Record a stream until every joint has covered its range, or the time is over."""
    from track.calibration.user_calibration import MotionGuide
    from track.live.live_tracking import track_live
    from track.settings import TrackerSetup

    with named_steps(""):  # a glove may have to be learned
        setup = TrackerSetup.of(options.settings())
    recorded = track_live(live, setup, out=out, seconds=seconds, guide=MotionGuide(setup.user.hands))
    print_line(f"{out}: {recorded.num_frames} frames, {recorded.duration:.1f} s", *recorded.notes)


def _report(done: Calibration) -> list[str]:
    """Lines on the held-out frames before and after, and suggestions for a better capture."""
    line = str(done)
    before, after = 1e3 * done.gaps()
    if done.is_better and np.isfinite(before):
        line += f"; thumb and fingers {before:.1f} mm from touching before, {after:.1f} mm after"
    if done.is_better:
        line += f"; hand length {1e3 * done.hand.model.shape.length:.0f} mm"
    return [line, *done.suggestions()]
