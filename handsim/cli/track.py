"""The command `handsim track`."""

from __future__ import annotations

import dataclasses
import warnings
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from handsim.app.messages import named_steps, print_line, progress_bar
from handsim.cli.options import TrackerOptions, check_live, check_source, check_take_file
from handsim.cli.study import Step, StudyFile, is_study, run_study, study_files
from handsim.errors import ArgumentError, HandSimWarning
from handsim.files.outputs import check_outputs, written_together

if TYPE_CHECKING:
    from gloves.takes.take import Take
    from track.captures import OnFrame
    from track.frames import StreamedFrame, TrackedFrame
    from track.live.live_tracking import LiveTake
    from track.output.sinks import SinkGroup
    from track.settings import TrackSettings


def track(
    captures: Annotated[tuple[Path, ...], tyro.conf.Positional] = (),
    *,
    out: Path | None = None,
    live: str | None = None,
    seconds: float | None = None,
    send: tuple[str, ...] = (),
    options: Annotated[TrackerOptions, tyro.conf.arg(name="")] = TrackerOptions(),  # noqa: B008 (frozen)
    calibrate: bool = False,
    smooth: bool = True,
    known: tuple[str, ...] = (),
    labeled: Annotated[Path | None, tyro.conf.arg(aliases=["--labelled"])] = None,
) -> None:
    """Track hands in a marker capture or a live stream; writes motion, labels and status.

    Corrections that handsim view saved beside OUT are applied again. Of several captures those that fail are
    reported and skipped, and what OUT has of the same captures and options stays.

    Args:
        captures: A .trc, .c3d, .csv (Motive, Vicon) or .tsv (Qualisys) file, whose names are not used;
            several of them, folders, or the table of a study (.csv), see docs/how_to/study.md.
        out: The tracked take, a .npz file; of several captures a folder of takes with the captures' names.
            With --live and --send nothing is recorded when not given.
        live: A stream instead of a capture: natnet://host or natnet://host:port (OptiTrack), qtm://host
            (Qualisys), or module:name, a frame source of your own. Ctrl-C or the end of the terminal ends it.
            Frames are written as they come, to OUT.part until then.
        seconds: How long to track a live stream [s], from its first frame, which is awaited as long, at least
            ten seconds.
        send: Where hands are sent as they are tracked, one or several of osc://host:port, udp://host:port,
            ws://host:port, which is a server, lsl:NAME, and module:name, a sink of your own.
            Without a host it is this machine. A capture is then played at its own rate.
        options: Which hands to track.
        calibrate: Track a capture twice: first to calibrate its hands, then with those that fit frames better
            which they were not calibrated on. For those who did not capture a minute for handsim calibrate.
        smooth: Solve the poses of a capture over all of its time, forward and backward, in place of frame by
            frame. A live stream is tracked frame by frame.
        known: Angles of joints that do not move, as a goniometer found them [deg], such as
            index_PIP_flexion=60, or right:index_PIP_flexion=60 of one hand.
        labeled: File for the labeled points, .trc, .c3d or Motive .csv; markers are called right:ThumbTip and
            so on, other points Unlabeled1, Unlabeled2, ...
    """
    from gloves.captures.formats import WRITABLE, check_suffix, write_capture
    from track.live.live_tracking import track_live
    from track.output.sinks import open_sinks
    from track.settings import TrackerSetup

    capture = captures[0] if captures else None
    check_source("capture", capture, live)
    check_live(live, seconds)
    if captures and is_study(captures, out):
        if labeled is not None or send:
            raise ArgumentError("given --labeled or --send and several captures, expected one capture")
        _track_study(captures, out, options, calibrate=calibrate, smooth=smooth, known=known)
        return
    if live is not None and (calibrate or known):
        option = "--calibrate" if calibrate else "--known"
        raise ArgumentError(f"given {option} and --live {live}, expected a capture, all of which is there")
    if out is not None:
        check_take_file(out, live=live is not None)
    elif capture is not None or labeled is not None or not send:
        given = f"the capture {capture}" if capture is not None else f"--live {live}"
        given += "" if labeled is None else f" and --labeled {labeled}"
        expected = "--out FILE.npz" + ", --send ADDRESS or both" * (capture is None and labeled is None)
        raise ArgumentError(f"given {given} without --out, expected {expected}")
    if labeled is not None:
        check_suffix(labeled, WRITABLE)
    check_outputs((capture, *options.files()), (out, labeled))
    settings = options.settings(calibrate=calibrate, smooth=smooth, known=_angles(known))
    times: deque[float] = deque(maxlen=100_000)  # [s]

    def on_frame(frame: StreamedFrame, tracked: TrackedFrame) -> None:
        times.append(tracked.seconds)

    with open_sinks(send) as sinks:
        if capture is not None and out is not None:
            tracked = _track_file(capture, out, labeled, settings, sinks, on_frame)
        else:
            with named_steps(""):  # a glove may have to be learned
                setup = TrackerSetup.of(settings)
            tracked = track_live(str(live), setup, [sinks], out=out, seconds=seconds, on_frame=on_frame)
            if labeled is not None and out is not None:  # last, because a failure must not cost the recording
                write_capture(labeled, tracked.whole_take(out).labeled_capture())
    speed = f"{1e3 * float(np.median(times or [0.0])):.2f} ms per frame"
    if out is None or tracked.take is None:
        print_line(f"{tracked.num_frames} frames, {tracked.duration:.1f} s", *tracked.notes, speed)
        return
    if options.shape is not None and options.glove is None:
        print_line(f"{options.shape}: hands in the glove '{tracked.take.settings['glove']}'")
    _print_take(out, tracked.take, tracked, speed, live=live is not None)


def _track_study(
    captures: tuple[Path, ...], out: Path | None, options: TrackerOptions, **other: object
) -> None:
    """Track several captures, each with the options that a table has for it."""
    from gloves.takes.corrections import corrections_path

    def plan(file: StudyFile) -> Step:
        take = Path(out or "") / file.name.with_suffix(".npz")
        own = file.options(glove=options.glove, shape=options.shape, hands=options.hands)
        chosen = dataclasses.replace(options, **own)
        return Step((take,), (*chosen.files(), corrections_path(take)), {"options": chosen, **other})

    run_study(study_files(captures, out, [".npz"]), Path(out or ""), track, plan, "tracked")


def _angles(given: tuple[str, ...]) -> dict[str, float]:
    """Angles [deg] by the joint's name, from words as NAME=ANGLE."""
    angles = {}
    for word in given:
        name, _, angle = word.partition("=")
        try:
            angles[name] = float(angle)
        except ValueError:
            expected = "NAME=ANGLE, such as index_PIP_flexion=60"
            raise ArgumentError(f"--known is '{word}', expected {expected}") from None
    return angles


def _track_file(
    capture: Path,
    out: Path,
    labeled: Path | None,
    settings: TrackSettings,
    sinks: SinkGroup,
    on_frame: OnFrame,
) -> LiveTake:
    """Track a capture with the corrections beside OUT; write the take and the labeled points."""
    from gloves.captures.formats import write_capture
    from gloves.takes.corrections import corrections_path
    from track.captures import track_capture
    from track.live.live_tracking import LiveTake

    corrections = corrections_path(out)
    with progress_bar("") as bar:
        take = track_capture(
            capture,
            settings,
            corrections=corrections if corrections.exists() else None,
            sinks=sinks,
            progress=bar,
            on_step=bar.step,
            on_frame=on_frame,
        )
    with written_together():
        take.save(out)
        if labeled is not None:
            write_capture(labeled, take.labeled_capture(), source=capture)
    applied = len(take.settings.get("corrections", ()))
    notes = [f"{corrections}: {applied} correction{'s' * (applied != 1)} applied"] if applied else []
    return LiveTake(take, take.num_frames, take.duration, (*notes, *sinks.notes()))


def _print_take(out: Path, take: Take, tracked: LiveTake, speed: str, *, live: bool) -> None:
    """Print a summary of a take; of a stream, warn of signs of mistakes, too."""
    from track.takes.take_summary import summarize, suspicions
    from track.user import MEASURED

    user = take.settings["user"]
    lines = [f"size of the hands: {user.removeprefix(MEASURED)}"] if user.startswith(MEASURED) else []
    if user.startswith("calibrated on"):
        lines = user.split("; ")
    lines.append(f"{out}: {tracked.num_frames} frames, {tracked.duration:.1f} s at {take.rate:.4g} Hz")
    print_line(*lines, *tracked.notes)  # The take is written; to judge it takes seconds.
    print_line(*summarize(take), speed)
    for suspicion in suspicions(take) if live else ():
        warnings.warn(suspicion, HandSimWarning, stacklevel=3)
