"""Label, track, measure and calibrate the hands of a capture.

Each function reads frames from its capture, and hands and a labeler from its settings. It measures the hands
in some of the frames unless the settings give them, and then labels or tracks all frames.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Final

import numpy as np

from gloves.captures.capture import Capture
from gloves.layout import load_layout
from gloves.optics.reconstruction import number_runs
from gloves.takes.corrections import Correction, find_pins, load_corrections, unfitting_sentences
from gloves.takes.points import PointList
from gloves.takes.take import Take, label_names
from handsim.app.workers import LocalProcesses, second_process
from handsim.callbacks import OnStep, Progress, no_progress, no_step
from handsim.errors import CalibrationError, CaptureError, HandSimWarning, errors_of
from handsim.files.inputs import checksum
from handsim.hand.shape import NUM_QPOS, Side
from track.alternatives.alternatives import doubts_of, judge_take, with_doubt
from track.alternatives.hands import other_hands_of, with_other_hands
from track.association.frame_state import change_of_distances
from track.association.initialization import label_alone
from track.bodies.forearm import find_forearms
from track.bodies.rigid_body import load_bodies
from track.frames import AnyCapture, StreamedFrame, TrackedFrame, capture_of, checked_frames
from track.hand_size import measured_user, sample_frames
from track.kinematics.pose_solver import FEWEST_MARKERS
from track.output.recorder import frame_values, take_of_rows
from track.output.sinks import SinkGroup
from track.settings import USUAL_SIZE, CalibrateSettings, LabelSettings, TrackerSetup, TrackSettings
from track.takes.bidirectional_labeling import label_both_ways
from track.takes.corrected_take import correct_take
from track.takes.label_confidence import label_confidence
from track.takes.smoothed_take import smooth_take
from track.takes.take_calibration import OnPart, calibrate_take, kept_user, leaves_markers
from track.takes.take_summary import misfits, no_points, suspicions
from track.tracker import Tracker
from track.user import AnyGlove, AnyLabeler, User, labeler_of, nominal_user

OnFrame = Callable[[StreamedFrame, TrackedFrame], None]
_COMPARED_PAIRS: Final = 200  # pairs of successive frames compared to see whether frames are continuous
_MOST_CHANGE: Final = 0.005  # [m] A pair is continuous if distances within a hand change less.
_MOST_CORRECTIONS: Final = 2  # A take is labeled again this often at most, because other labels are likelier.
_ANY_RATE: Final = 120.0  # [Hz] Poses and labels do not depend on the rate of a take.
_WORTH_A_PROCESS: Final = 1500  # Labeling this many frames one way takes as long as starting a process.
_LEAST_CONTINUOUS_SHARE: Final = 0.5  # least share of continuous pairs for frames to be tracked


def label_capture(
    capture: AnyCapture,
    settings: LabelSettings | None = None,
    *,
    progress: Progress = no_progress,
    **options: Any,
) -> Take:
    """Label the hands in every frame of a capture: none, one or two, as `handsim label` does.

    Frames that follow from each other are labeled by tracking them in both directions, other frames alone.
    The take holds labels alone; `track_capture` gives poses.

    Args:
        capture: Points [m], or the path of a marker file or a take; names of markers are not used.
        settings: How to label; as `LabelSettings()` when not given.
        progress: Called with the number of frames that are done, and of all frames.
        options: Fields of `LabelSettings` that differ from `settings`, as `glove="dense19"`.

    Returns:
        A take whose `labels` (T, N) are indices into its `label_names`, -1 for none, and whose `confidence`
        (T, N) is from 0 to 1. The names are those of both hands: `right:ThumbTip`, `left:ThumbTip`.

    Raises:
        ArgumentError: The points are not in meters, or a frame holds more than 512.
        CaptureError: The capture cannot be read, or most of its points are far from any room.
        LayoutError: The glove is unknown.
        WeightsError: The labeler is unknown, or knows other markers.

    Warns:
        HandSimWarning: There is no hand in any frame, another hand or glove fits clearly better, other labels
            fit as well, or a marker is not where the layout has it.
    """
    chosen, source = LabelSettings.of(settings, options), capture_of(capture)
    frames = checked_frames(source)
    with second_process(len(frames) >= _WORTH_A_PROCESS, label_both_ways.__module__) as helper:
        setup = _setup(chosen, frames)
        labeled, setup, _ = _judged(
            lambda now: _labeled_take(capture, source, frames, now, progress, helper), setup
        )
    labeled = _with_other_hands(labeled, setup)
    warned = [*map(str, other_hands_of(labeled)), *label_faults(labeled)]
    if (labeled.point_list.labels < 0).all():
        none = f"no hand found, expected hands in glove '{labeled.settings['glove']}' (--glove names another)"
        warned.append(none if len(labeled.point_list.points) else no_points(labeled))
    _warn(warned)
    return labeled


def _labeled_take(
    capture: AnyCapture,
    source: Capture,
    frames: Sequence[StreamedFrame],
    setup: TrackerSetup,
    progress: Progress,
    helper: LocalProcesses | None,
) -> Take:
    """Label all frames of a capture, in part in a helper process if there is one."""
    present, glove = np.isfinite(source.positions[..., 0]), setup.settings["glove"]
    take = Take.of_truth(
        setup.user.hands,
        np.full((source.num_frames, len(setup.user), NUM_QPOS), np.nan),
        source.positions,
        number_runs(present),
        np.full(present.shape, -1, dtype=np.int16),
        rate=source.rate,
        bodies=setup.bodies,
        settings={**_capture_record(capture, source), "glove": glove},
    )

    def on_count(count: int) -> None:
        progress(count, len(frames))

    if _is_continuous(frames):
        return label_both_ways(take, frames, setup.tracker, on_count, helper)
    clouds = [frame.points for frame in frames]
    labels, confidence = label_alone(clouds, setup.user.hands, setup.labeler, on_count)
    points = dataclasses.replace(take.point_list, labels=labels, confidence=confidence)
    return dataclasses.replace(take, point_list=points)


def _judged(
    label: Callable[[TrackerSetup], Take], setup: TrackerSetup, *, is_final: bool = False
) -> tuple[Take, TrackerSetup, list[str]]:
    """Label a take, and label it again with other marker places while an alternative is likelier.

    Given and calibrated hands stay as they are, as does a take that `is_final`. The last result lists the
    changes in words.
    """
    take, changes = label(setup), list[str]()
    judged = judge_take(take)
    for _ in range(_MOST_CORRECTIONS if setup.is_auto and not is_final else 0):
        changed = [one for one in judged if one.is_changed]
        if not changed:
            break
        changes += [f"the {one.side} hand: {one.alternatives[0].words}" for one in changed]
        setup = setup.with_user(setup.user, [one.hand for one in changed])
        take = label(setup)
        judged = judge_take(take)
    return with_doubt(take, judged), setup, changes


def judged_setup(frames: Sequence[StreamedFrame], setup: TrackerSetup) -> tuple[TrackerSetup, list[str]]:
    """Judge the labels of some frames of a stream.

    Returns the setup with the likeliest marker places, and sentences on labels that change or may be wrong.
    """
    positions = np.full((len(frames), max(len(frame.points) for frame in frames), 3), np.nan)
    for row, frame in zip(positions, frames, strict=True):
        row[: len(frame.points)] = frame.points
    source = Capture(tuple(map(str, range(positions.shape[1]))), positions, _ANY_RATE)
    take, setup, changes = _judged(lambda now: tracked_take(source, frames, now.tracker()), setup)
    return setup, [*(f"the labels change for {one}" for one in changes), *label_faults(take)]


def label_faults(take: Take) -> list[str]:
    """What may be wrong with the labels of a whole take, in sentences with their remedies."""
    names = take.hands[0].layout.names
    found = [one for side, doubt in doubts_of(take).items() for one in doubt.faults(side, names)]
    return [f"{one.of} {one.why}; {one.remedy}" for one in found]


def _with_other_hands(take: Take, setup: TrackerSetup) -> Take:
    """The take with the alternatives to its hands."""
    given = {} if setup.is_auto else {side: setup.user.origin(side) for side in setup.user.sides}
    return with_other_hands(take, given, setup.labeler)


def _warn(sentences: Iterable[str]) -> None:
    """Warn the caller of a public function of this module."""
    for sentence in sentences:
        warnings.warn(sentence, HandSimWarning, stacklevel=3)


def track_capture(
    capture: AnyCapture,
    settings: TrackSettings | None = None,
    *,
    corrections: str | Path | None = None,
    sinks: SinkGroup | None = None,
    progress: Progress = no_progress,
    on_step: OnStep = no_step,
    on_frame: OnFrame | None = None,
    **options: Any,
) -> Take:
    """Track the hands of a capture, as `handsim track` does.

    Args:
        capture: Points [m], or the path of a marker file or a take; names of markers are not used.
        settings: How to track; as `TrackSettings()` when not given.
        corrections: A file of labels that a person corrected, as `handsim view` saves it beside a take.
        sinks: Receives every frame as it is tracked, from `open_sinks`; the capture is then played at its own
            rate.
        progress: Called with what is done of a step, and all there is to do in it.
        on_step: Called with the name of each step, such as "frames".
        on_frame: Called with each frame and its `TrackedFrame`.
        options: Fields of `TrackSettings` that differ from `settings`, as `glove="dense19"`, `size="M"`,
            `hands="user.json"`, `bodies=["mug"]` or `calibrate=True`.

    Returns:
        Poses (T, H, 27) [m, rad], labels (T, N) and status of every frame.

    Raises:
        ArgumentError: The capture is not in meters, or arguments do not go together.
        CaptureError: The capture cannot be read, most of its points are far from any room, or corrections do
            not fit it.
        UserError: A user's file cannot be read.
        LayoutError: The glove is unknown, or does not fit a hand.
        WeightsError: The labeler is unknown, or knows other markers.

    Warns:
        HandSimWarning: Signs that the glove, the hands or the file are not what they should be, as the page
            on the take lists them: hands of another person or of two, markers that fell off, slipped or were
            never seen, joints at their limits, frames that repeat.
    """
    chosen = TrackSettings.of(settings, options)
    source, frames, setup = _open_capture(capture, chosen, warns=True)
    pins = () if corrections is None else _checked_corrections(Path(corrections), source, setup)
    on_step("frames")
    if chosen.calibrate:
        first, setup, _ = _judged(
            lambda now: tracked_take(source, frames, now.tracker(), progress=progress), setup
        )
        setup = _calibrate_setup(first, setup, _step_progress(progress, on_step))
        on_step("frames")
    take, setup, _ = _judged(
        lambda now: tracked_take(source, frames, now.tracker(), sinks, on_frame, progress),
        setup,
        is_final=chosen.calibrate or bool(sinks),
    )
    take = _with_other_hands(take, setup)
    points = dataclasses.replace(take.point_list, confidence=label_confidence(take))
    record = {**take.settings, **_capture_record(capture, source), **setup.settings}
    take = dataclasses.replace(take, point_list=points, settings=record)
    if corrections is None and chosen.smooth:
        on_step("smoothing")
        take = smooth_take(take)
    elif corrections is not None:
        corrected = correct_take(take, pins)
        take = corrected.take
        _warn(unfitting_sentences(Path(corrections), corrected.unfitting))
    _warn(suspicions(take))
    return take


def calibrate(
    capture: AnyCapture,
    settings: CalibrateSettings | None = None,
    *,
    progress: Progress = no_progress,
    on_step: OnStep = no_step,
    **options: Any,
) -> User:
    """Fit hands and gloves to their user, from any capture; best from one in which every joint moves.

    The capture is labeled by the tracker. If some markers stay unlabeled, it is labeled once more with the
    calibrated hands. Each hand is solved on two thirds of the frames and tested on the rest. If it does no
    better there than the hand before, that one is kept, with a warning; else it is solved on all frames.

    Args:
        capture: Points [m], or the path of a marker file or a take; names of markers are not used.
        settings: Which hands to begin with; as `CalibrateSettings()` when not given.
        progress: Called with what is done of a step, and all there is to do in it.
        on_step: Called with the name of each step, such as "frames".
        options: Fields of `CalibrateSettings` that differ from `settings`, as `glove="dense19"`.

    Returns:
        The hands in the capture. Its `calibrations` hold for each hand the `held_out` comparison, standard
        errors and `suggestions()` for a better capture; `str()` of a calibration is what `notes` keep.

    Raises:
        CalibrationError: No hand is in the capture, or a hand is observed too poorly.
        ArgumentError: The capture is not in meters, or arguments do not go together.
        CaptureError: The capture cannot be read, or most of its points are far from any room.
        LayoutError: The glove is unknown, or does not fit a hand.
        WeightsError: The labeler is unknown, or knows other markers.

    Warns:
        HandSimWarning: The points do not fit the hands or the glove, or a hand is kept as it was.
    """
    on_part = _step_progress(progress, on_step)
    source, frames, setup = _open_capture(capture, CalibrateSettings.of(settings, options))
    report = partial(on_part, "frames")
    take, setup, _ = _judged(lambda now: tracked_take(source, frames, now.tracker(), progress=report), setup)
    _warn(map(str, other_hands_of(_with_other_hands(take, setup))))
    done = calibrate_take(take, setup.start, setup.user, on_part)
    if leaves_markers(take, done):
        tracker = Tracker([one.hand for one in done], setup.labeler)
        take = tracked_take(source, frames, tracker, progress=report)
        done = calibrate_take(take, setup.start, setup.user, on_part)
    _warn(misfits(take, calibrates=True))
    name = _capture_record(capture, source).get("capture", "a capture")
    found = kept_user(take, done, setup.user, f"from {name}", on_part)
    _warn(f"{one.hand.side} hand: {one}" for one in found.calibrations if not one.is_better)
    return found


def measure_hands(
    capture: AnyCapture,
    glove: AnyGlove = "dense19",
    *,
    labeler: AnyLabeler = None,
    hands: Side | Sequence[Side] | None = None,
) -> User:
    """The hands of a capture with their size and proportions measured; a `Tracker` takes them.

    Args:
        capture: Points [m], or the path of a marker file or a take; names of markers are not used.
        glove: Marker layout, or its shipped name or the path of its .toml file.
        labeler: A labeler, or what `load_labeler` reads; that of the glove when not given.
        hands: Which hands; all that the glove is made for when not given.

    Returns:
        The hands, all of one shape, each with the places of its own markers; `str()` gives their length
        and breadth. If no hand is found that shows most of its markers, hands of size M, with a warning.

    Raises:
        ArgumentError: The capture is not in meters, or a hand is named twice.
        CaptureError: The capture cannot be read, or most of its points are far from any room.
        LayoutError: The glove is unknown, or does not fit a hand.
        WeightsError: The labeler is unknown, or knows other markers.
    """
    user = nominal_user(load_layout(glove), USUAL_SIZE, hands)
    frames = checked_frames(capture_of(capture))
    return measured_user(sample_frames(frames), user, labeler_of(user.layout, labeler))


def tracked_take(
    source: Capture,
    frames: Sequence[StreamedFrame],
    tracker: Tracker,
    sinks: SinkGroup | None = None,
    on_frame: OnFrame | None = None,
    progress: Progress = no_progress,
) -> Take:
    """Track all frames of a capture; with sinks, at its own rate."""
    rows = []
    if sinks:
        sinks.start(tracker.hands, tracker.bodies)
    began = monotonic()
    for frame in frames:
        tracked = tracker.step(frame.points, frame.ids, frame.time)
        if sinks:
            sleep(max(0.0, began + frame.time - monotonic()))
            sinks.send(frame, tracked)
        if on_frame is not None:
            on_frame(frame, tracked)
        rows.append(frame_values(frame, tracked))
        progress(len(rows), len(frames))
    return take_of_rows(rows, tracker, source)


def _open_capture(
    capture: AnyCapture, settings: LabelSettings, *, warns: bool = False
) -> tuple[Capture, list[StreamedFrame], TrackerSetup]:
    """A capture, its frames, and the setup that tracks them; hands are measured unless settings give them."""
    source = capture_of(capture)
    frames = checked_frames(source)
    return source, frames, _setup(settings, frames, warns=warns)  # last: a glove may have to be learned


def _setup(settings: LabelSettings, frames: Sequence[StreamedFrame], *, warns: bool = False) -> TrackerSetup:
    """The setup that labels frames; hands are measured unless settings give them."""
    some = sample_frames(frames)
    return _with_forearms(TrackerSetup.of(settings).measured(some, warns=warns), some)


def _with_forearms(setup: TrackerSetup, frames: Sequence[StreamedFrame]) -> TrackerSetup:
    """The setup with the forearms of a layout where some frames show them and no file of one was given."""
    given, layout = {body.forearm for body in setup.bodies}, setup.user.layout
    if not layout.forearm or given.issuperset(setup.user.sides):
        return setup
    bodies = [*setup.bodies]
    found = find_forearms([one.points for one in frames], setup.user.hands, setup.labeler)
    for side, body in found.items():
        if side in given:
            continue
        if body is not None:
            bodies.append(body)
        else:
            names = ", ".join(one.name for one in layout.forearm)
            told = (
                f"the {side} forearm is not found, expected {names} to keep their distances beside the hand"
            )
            warnings.warn(told, HandSimWarning, stacklevel=5)
    return dataclasses.replace(setup, bodies=load_bodies(bodies))


def _capture_record(capture: AnyCapture, source: Capture) -> dict[str, Any]:
    """Entries of a take's settings: name and checksum of the capture's file, and the reader's findings."""
    name: dict[str, Any] = {}
    if isinstance(capture, str | Path):
        name = {"capture": Path(capture).name, "capture_sha256": checksum(Path(capture))}
    return {**name, **({"findings": dict(source.findings)} if source.findings else {})}


def _is_continuous(frames: Sequence[StreamedFrame]) -> bool:
    """Whether successive frames of a capture mostly show hands that hardly changed."""
    clouds = [(one.points, other.points) for one, other in pairwise(frames)]
    pairs = [pair for pair in clouds if min(map(len, pair)) >= FEWEST_MARKERS]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(_COMPARED_PAIRS, len(pairs))).astype(int))
    changes = [change_of_distances(*pairs[number]) for number in chosen]
    return bool(changes and np.mean([change < _MOST_CHANGE for change in changes]) >= _LEAST_CONTINUOUS_SHARE)


def _step_progress(progress: Progress, on_step: OnStep) -> OnPart:
    """Combine the callbacks of steps and progress."""

    def on_part(step: str, done: int, total: int) -> None:
        on_step(step)
        progress(done, total)

    return on_part


def _calibrate_setup(take: Take, setup: TrackerSetup, on_part: OnPart) -> TrackerSetup:
    """Replace the hands of a setup by hands calibrated on a take, where these fit held-out frames better."""
    try:
        done = calibrate_take(take, setup.start, setup.user, on_part)
    except CalibrationError as error:
        warnings.warn(f"not calibrated: {error}", HandSimWarning, stacklevel=4)
        return setup
    found = kept_user(take, done, setup.user, "on the take itself", on_part)
    return setup.with_user(found, found)


def _checked_corrections(path: Path, source: Capture, setup: TrackerSetup) -> tuple[Correction, ...]:
    """The corrections of a file, checked against the capture before the long work."""
    corrections = load_corrections(path)
    ids = number_runs(np.isfinite(source.positions[..., 0]))
    points = PointList.of_tables(source.positions, ids, np.full_like(ids, -1), np.ones(ids.shape))
    with errors_of(path, CaptureError):
        find_pins(corrections, points, label_names(setup.user, setup.bodies))
    return corrections
