"""The score of a marker layout from simulation: labels, joints, simulated captures, and advice.

Captures are short: simulated people wear the glove, and each capture is labeled and tracked by the calls of
`handsim label` and `handsim track`. Nothing is calibrated.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import beta

from gloves.fit import GloveFit, attach_markers
from gloves.layout import MIN_MARKERS, MarkerLayout, MarkerPlace, load_layout
from gloves.takes.take import Take, load_take
from handsim.callbacks import OnStep, no_step
from handsim.errors import HandSimWarning
from handsim.hand.model import HandModel
from handsim.hand.shape import BONE_NAMES, BONES, DIGITS, JOINTS, NUM_JOINTS, PALM
from handsim.space.rig import CameraRig, load_rig
from track.alternatives.alternatives import Alternative, doubts_of
from track.captures import label_capture, track_capture
from track.kinematics import pose_solver
from track.kinematics.marker_kinematics import hand_arrays
from track.kinematics.pose_spread import NOT_SMOOTHED, known_hand, pose_spreads, with_keypoints
from track.user import AnyGlove
from train.data.batches import Corruption, corrupt, paper_corruption
from train.evaluation import LabelingReport, cloud_frames, count_labels, evaluate_frames, evaluate_labeler
from train.forecast.rig_forecast import ObservedHand, observe_motion, observe_poses
from train.forecast.settings import POSES, TWINS, ScoreGloveSettings
from train.labelers.layout_labeler import LayoutLabeler
from train.labelers.protocol import Labeler
from train.labelers.storage import load_labeler, untrained_labeler
from train.reports.hand_plot import mistakes
from train.simulation.scenes import SimulatedKind
from train.simulation.takes import simulate_take

METHODS: Final = {"label": label_capture, "track": track_capture}
CAPTURES: Final = 3
"""Number of captures of each kind of work; the same number means the same people and motions for every
layout."""
FRAMES: Final = 240
"""Frames of a capture: two seconds."""
WORK: Final[Mapping[str, SimulatedKind]] = {
    "two apart": "single-hand", "two touching": "hand-hand", "real-like": "real-like",
}  # fmt: skip
"""What hands do in simulated captures. A glove that fits one side only is tried with `ONE_HAND` alone."""
ONE_HAND: Final[Mapping[str, SimulatedKind]] = {"one hand": "single-hand"}
SIDES_EXCHANGED: Final = "left and right are exchanged"
"""Words of labels that are those of the other hand."""
NOISE: Final = 0.0015
"""Standard deviation of markers around a calibrated hand [m], from optics and moving skin."""
_TWIN_FRAMES: Final = 600  # frames of each simulated motion
_JUDGED_FRAMES: Final = 600  # frames from which joints and sides are judged
_LINE_INFORMATION: Final = 1e-8  # [m^2] Markers with less information about a rotation are in a line.

# Figures beyond these thresholds get a sentence of advice.
_POOR_RATIO: Final = 0.6  # ratio of a joint's spread to that of an unseen joint
_MISTAKE_SHARE: Final = 0.02  # share of points or captures with a wrong label
_HIDDEN_SHARE: Final = 0.1  # share of frames in which a marker is hidden, or too few markers are seen
_AT_ONCE: Final = 0.75  # With a smaller share of its markers a hand is seldom found in the first frame.
_MOST_SENTENCES: Final = 4  # largest number of sentences of one kind


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Results on one simulated capture, or their means over the captures of a kind of work."""

    slots: dict[str, Float[np.ndarray, "M"]]
    """Share of the frames in which each marker is labeled right, by method: `label` and `track`."""
    frames: dict[str, float]
    """Share of the frames without any error, by method."""
    joints: Float[np.ndarray, "20"]
    """Root mean square error of each joint angle from `track` [rad]; NaN if no hand was found."""
    size_error: float
    """Mean absolute error of the measured length of the hands [m]."""
    wrong: float = 0.0
    """Probability that some labels are wrong throughout a capture, as mean of both methods. It is 1 for
    labels that are wrong in most frames, otherwise the probability of other labels that the take itself
    states."""
    alternatives: tuple[Alternative, ...] = ()
    """What is wrong throughout a capture, each with its probability, the likeliest first."""
    captures: tuple[Trial, ...] = ()
    """The captures behind the means; empty for one capture."""

    @property
    def right(self) -> Float[np.ndarray, "M"]:
        """Share of each marker's slots that are right, averaged over both methods."""
        return np.asarray(np.mean([self.slots[name] for name in METHODS], axis=0))

    @property
    def worst(self) -> int:
        """The marker with the most wrong slots."""
        return int(self.right.argmin())

    @property
    def joint_error(self) -> float:
        """Root mean square error over all joints [deg]."""
        return float(np.rad2deg(np.sqrt(np.mean(self.joints**2))))

    def share(self, method: str) -> float:
        """Share of all slots that are right."""
        return float(self.slots[method].mean())

    def least(self, method: str) -> float:
        """Share of right slots of the worst capture."""
        return min(one.share(method) for one in self.captures or (self,))


@dataclass(frozen=True, slots=True, eq=False)
class LayoutScore:
    """How well a layout can be labeled, and how well it determines each joint."""

    layout: MarkerLayout
    observed: LabelingReport
    """Labels of the frames as the rig sees them, averaged over both hands."""
    clean: LabelingReport
    """Labels with every marker seen."""
    corrupted: LabelingReport
    """Labels with the drops and ghosts of the paper's recipe."""
    seen: Float[np.ndarray, "M"]
    """Share of the frames in which each marker is seen by two cameras and becomes a point."""
    few_seen: float
    """Share of the frames in which fewer than three quarters of the markers are seen."""
    joints: Float[np.ndarray, "20"]
    """Standard deviation of each joint of a calibrated hand, given the markers [rad]."""
    trials: Mapping[str, Trial] = field(default_factory=dict)
    """Results on simulated captures by kind of work; empty if none was tried."""
    is_trained: bool = False
    """Whether the labeler was trained on the layout; else it is the network for any layout."""
    seen_by: str = ""
    """Description of the motion and the rig."""

    @property
    def wrong(self) -> tuple[float, tuple[float, float]]:
        """Probability that labels are wrong throughout a capture of any work, and its 95 % interval."""
        tried = [one for trial in self.trials.values() for one in trial.captures or (trial,)]
        count = sum(one.wrong for one in tried)
        # Jeffreys' interval also holds for no wrong capture of a few.
        low, high = beta.ppf((0.025, 0.975), count + 0.5, len(tried) - count + 0.5)
        share = count / max(1, len(tried))
        return share, (min(float(low), share), max(float(high), share))

    @property
    def alternatives(self) -> tuple[Alternative, ...]:
        """What is wrong throughout a capture of any work, each with its probability, the likeliest first."""
        return _merged([trial.alternatives for trial in self.trials.values()])

    @property
    def advice(self) -> tuple[str, ...]:
        """Sentences on what to move, add or drop, the most important first."""
        kinds = (_alternative_advice, _capture_advice, _confusion_advice, _joint_advice, _visibility_advice)
        found: list[_Advice] = []
        for kind in kinds:
            found += sorted(kind(self), key=lambda advice: -advice[0])[:_MOST_SENTENCES]
        return tuple(sentence for _, sentence in sorted(found, key=lambda advice: -advice[0]))


def score_glove(
    glove: AnyGlove, settings: ScoreGloveSettings | None = None, *, on_step: OnStep = no_step, **options: Any
) -> LayoutScore:
    """Score a layout as `handsim glove score` does, with a given labeler or that of the glove.

    Args:
        glove: Marker layout, or its shipped name or the path of its .toml file.
        settings: Motion and rig.
        on_step: Called with the name of each step.
        options: Fields of `settings`, by name: `rig="six"`.

    Returns:
        Shares of right labels, standard deviations of joints [rad], results on the captures, and advice in
        sentences.

    Raises:
        ArgumentError: A setting is unknown or refused.
        CaptureError: The take cannot be read, or its hands are never tracked together.
        LayoutError, RigError, WeightsError: The glove, the rig or the labeler is unknown.
    """
    chosen = ScoreGloveSettings.of(settings, options)
    layout, rig = load_layout(glove), load_rig(chosen.rig)
    rng = np.random.default_rng(chosen.seed)
    on_step("simulating hands")
    hands, seen = _observed_hands(chosen, layout, rig, rng)
    on_step("learning the layout, about a minute the first time")
    given = chosen.labeler
    labeler = untrained_labeler(layout) if given is None else load_labeler(layout, given)
    on_step("labeling")
    score = score_layout(layout, hands, labeler, rng=rng)
    trials = try_layout(
        layout, rig, labeler, count=chosen.captures, told=lambda words: on_step(f"trying captures: {words}")
    )
    seen_by = f"{seen}, seen by rig {rig.name}"
    is_trained = not isinstance(labeler, LayoutLabeler)
    return dataclasses.replace(score, trials=trials, is_trained=is_trained, seen_by=seen_by)


def _observed_hands(
    settings: ScoreGloveSettings, layout: MarkerLayout, rig: CameraRig, rng: np.random.Generator
) -> tuple[list[ObservedHand], str]:
    """Hands in the requested motion, and a description of it."""
    motion, frames = settings.motion, settings.num_frames
    if motion == POSES:
        return observe_poses(layout, rig, frames, rng=rng), "random people and poses"
    if motion == TWINS:
        kinds: tuple[SimulatedKind, ...] = ("single-hand", "hand-hand", "hand-pen")
        takes = [simulate_take(kind, num_frames=_TWIN_FRAMES, seed=settings.seed) for kind in kinds]
        hands = [hand for take in takes for hand in observe_motion(take, layout, rig, frames // 6, rng=rng)]
        return hands, "simulated motion of one hand and of two"
    if isinstance(motion, Take):
        return observe_motion(motion, layout, rig, frames, rng=rng), "a take"
    return observe_motion(load_take(motion), layout, rig, frames, rng=rng), f"the take {Path(motion).name}"


def score_layout(
    layout: MarkerLayout, hands: Sequence[ObservedHand], labeler: Labeler, *, rng: np.random.Generator
) -> LayoutScore:
    """Label what a rig sees of gloved hands with a labeler of this layout; no captures are tried."""
    observed = np.concatenate([hand.frames.observed for hand in hands])
    ghosts = np.concatenate([hand.frames.ghosts for hand in hands])
    markers = np.concatenate([hand.frames.markers for hand in hands])
    center = markers.mean(axis=1, keepdims=True)
    nothing = Corruption(occlude=0, ghosts=0)
    cloud = corrupt(observed - center, nothing, ghosts=ghosts - center, rng=rng)
    recipe = paper_corruption(layout.num_markers)
    # People differ in length; both hands of one are alike.
    _, person = np.unique([hand.fit.shape.length for hand in hands], return_inverse=True)
    people = np.repeat(person, [len(hand.qpos) for hand in hands])
    seen, clean, corrupted = (
        dataclasses.replace(report, groups=people)
        for report in (
            evaluate_frames(labeler, [cloud_frames(cloud)]),
            evaluate_labeler(labeler, markers - center, nothing, rng=rng),
            evaluate_labeler(labeler, markers - center, recipe, rng=rng),
        )
    )
    is_seen = np.isfinite(observed[..., 0])
    few_seen = float((is_seen.mean(axis=1) < _AT_ONCE).mean())
    return LayoutScore(
        layout, seen, clean, corrupted, is_seen.mean(axis=0), few_seen, joint_spreads(_judged_frames(hands))
    )


def _judged_frames(hands: Sequence[ObservedHand]) -> list[ObservedHand]:
    """Some of the frames, evenly spaced."""
    step = max(1, sum(len(hand.qpos) for hand in hands) // _JUDGED_FRAMES)
    return [
        ObservedHand(hand.fit, hand.qpos[::step], type(hand.frames)(*(part[::step] for part in hand.frames)))
        for hand in hands
    ]


def joint_spreads(hands: Iterable[ObservedHand]) -> Float[np.ndarray, "20"]:
    """`layout_spreads` of observed hands."""
    return layout_spreads((hand.fit, hand.qpos, np.isfinite(hand.frames.observed[..., 0])) for hand in hands)


def layout_spreads(
    poses: Iterable[tuple[GloveFit, Float[np.ndarray, "T 27"], Bool[np.ndarray, "T M"]]],
) -> Float[np.ndarray, "20"]:
    """Standard deviation of each joint's error [rad], as root mean square over the frames.

    It follows from the information of the seen markers and the limits of the joints, as in the solver. Frames
    with fewer than four markers give no information. Tracking is more accurate, thanks to motion and the pose
    prior.
    """
    squares, count = np.zeros(NUM_JOINTS), 0
    limits = np.diag(free_spreads() ** -2.0)
    for fit, qpos, seen in poses:
        good = seen.sum(axis=1) >= pose_solver.FEWEST_MARKERS
        unseen, known = np.where(seen[good], 0.0, np.inf), known_hand(hand_arrays(fit).digits, NOISE)
        variances, _ = pose_spreads(with_keypoints(fit), limits, known, qpos[good], unseen, NOT_SMOOTHED)
        squares += variances[:, :NUM_JOINTS].sum(axis=(0, 2))
        squares += np.count_nonzero(~good) * free_spreads() ** 2
        count += len(good)
    return np.sqrt(squares / max(1, count))


def free_spreads() -> Float[np.ndarray, "20"]:
    """Standard deviation of each joint without any marker: uniform in its range [rad]."""
    ranges = np.deg2rad([joint.high_deg - joint.low_deg for joint in JOINTS])
    return np.asarray(ranges / np.sqrt(12.0))


def palm_spread(places: Sequence[MarkerPlace], model: HandModel) -> float:
    """Standard deviation of the palm's rotation about its least certain axis, from its own markers [rad].

    Infinite with fewer than three markers on the palm, or three in a line.
    """
    palm = [place for place in places if place.bone == BONE_NAMES[PALM]]
    if len(palm) < pose_solver.FEWEST_ON_PART:
        return float("inf")
    points = attach_markers(layout_at(palm, 0.003), model).points[: len(palm)]
    arms = points - points.mean(axis=0)
    information = (arms**2).sum() * np.eye(3) - arms.T @ arms
    least = float(np.linalg.eigvalsh(information)[0])
    return float(NOISE / np.sqrt(least)) if least > _LINE_INFORMATION else float("inf")


def layout_at(places: Sequence[MarkerPlace], radius: float) -> MarkerLayout:
    """A layout of any places, numbered; the first is repeated up to the least number of a glove's markers."""
    copies = (*places, *[places[0]] * (MIN_MARKERS - len(places)))
    named = [dataclasses.replace(place, name=str(number)) for number, place in enumerate(copies)]
    return MarkerLayout("places", tuple(named), radius)


def try_layout(
    layout: MarkerLayout,
    rig: CameraRig | str,
    labeler: Labeler,
    *,
    count: int = CAPTURES,
    told: Callable[[str], None] = no_step,
) -> dict[str, Trial]:
    """Label and track some simulated captures of each kind of work that the glove allows.

    `told` is called with a description before each capture.
    """
    found: dict[str, Trial] = {}
    works = WORK if len(layout.sides) > 1 else ONE_HAND
    for name, kind in works.items() if count else ():
        tried = []
        for number in range(1, count + 1):
            told(f"{name}, capture {number} of {count}")
            take = simulate_take(kind, glove=layout, num_frames=FRAMES, rig=rig, seed=number)
            tried.append(try_take(take, layout, labeler))
        found[name] = mean_trial(tried)
    return found


def try_take(truth: Take, layout: MarkerLayout, labeler: Labeler) -> Trial:
    """Label and track a simulated capture of unknown hands, whose gloves have slipped a little."""
    capture = truth.capture()
    slots, frames, wrong = {}, {}, []
    for name, make in METHODS.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HandSimWarning)
            take = make(capture, glove=layout, labeler=labeler)
        share, report = _count_right(truth, take)
        slots[name], frames[name] = share.mean(axis=0), report.figures["frame_accuracy"]
        wrong.append(_wrong_throughout(layout.names, share, report) or _stated_alternatives(take))
    tracked = take  # by the last method
    order = [tracked.hand_index(hand.side) for hand in truth.hands]
    errors = ((tracked.qpos[:, order, 7:] - truth.qpos[..., 7:]) ** 2).swapaxes(0, 1)
    size_error = abs(tracked.hands[0].shape.length - truth.hands[0].shape.length)
    of_methods = [min(1.0, sum(one.probability for one in every)) for every in wrong]
    return Trial(
        slots, frames, _root_mean_square(np.concatenate(errors)), size_error, float(np.mean(of_methods)),
        _merged(wrong),
    )  # fmt: skip


def mean_trial(trials: Sequence[Trial]) -> Trial:
    """The mean of captures of equal length."""
    return Trial(
        {name: np.mean([one.slots[name] for one in trials], axis=0) for name in METHODS},
        {name: float(np.mean([one.frames[name] for one in trials])) for name in METHODS},
        _root_mean_square(np.array([one.joints**2 for one in trials])),
        float(np.mean([one.size_error for one in trials])),
        float(np.mean([one.wrong for one in trials])),
        _merged([one.alternatives for one in trials]),
        tuple(trials),
    )


def _merged(parts: Sequence[Iterable[Alternative]]) -> tuple[Alternative, ...]:
    """Alternatives of several takes or kinds of work by their words, with their mean probability."""
    found: dict[str, Alternative] = {}
    for one in itertools.chain.from_iterable(parts):
        before = found[one.words].probability if one.words in found else 0.0
        found[one.words] = one._replace(probability=before + one.probability / len(parts))
    return tuple(sorted(found.values(), key=lambda one: -one.probability))


def _wrong_throughout(
    names: Sequence[str], share: Float[np.ndarray, "H M"], report: LabelingReport
) -> tuple[Alternative, ...]:
    """Labels that are wrong in most frames of a take, as alternatives."""
    found, count = {}, len(names)
    called = report.confusion.argmax(axis=1)
    for slot in np.flatnonzero(share < 0.5):
        mine, given = int(slot % count), int(called[slot])
        markers: tuple[int, ...] = (mine,)
        if given in (slot, share.size + 1):
            words = f"{names[mine]} is lost"
        elif given // count != slot // count:
            markers, words = tuple(range(count)), SIDES_EXCHANGED
        else:
            pair = mine, given % count
            is_mutual = called[given] == slot
            markers = tuple(sorted(pair))
            one, other = (names[marker] for marker in (markers if is_mutual else pair))
            words = f"{one} and {other} are exchanged" if is_mutual else (
                f"the points of {one} have the label {other}"
            )  # fmt: skip
        found[words] = Alternative(markers, words, 1.0)
    return tuple(found.values())


def _stated_alternatives(take: Take) -> tuple[Alternative, ...]:
    """Alternatives that a take itself states, each with its larger probability of both hands."""
    found: dict[str, Alternative] = {}
    for doubt in doubts_of(take).values():
        for one in doubt.tried:
            whole = len(one.markers) == take.hands[0].layout.num_markers
            words = SIDES_EXCHANGED if whole else one.words
            if words and (words not in found or found[words].probability < one.probability):
                found[words] = one._replace(words=words)
    return tuple(found.values())


def _root_mean_square(squares: Float[np.ndarray, "T 20"]) -> Float[np.ndarray, "20"]:
    """Root mean square over the known values; NaN where none is known."""
    known = np.isfinite(squares)
    sums: Float[np.ndarray, "20"] = np.where(known, squares, 0.0).sum(axis=0)
    return np.sqrt(sums / np.where(known.any(axis=0), known.sum(axis=0), np.nan))


def _count_right(truth: Take, take: Take) -> tuple[Float[np.ndarray, "H M"], LabelingReport]:
    """Share of the frames in which each marker of each true hand is right, and the count of the true labels.

    One more label stands for all labels of hands that the truth does not have.
    """
    names = truth.label_names
    of_hands = [names.index(name) if name in names else -1 for name in take.label_names]
    others = len(truth.hands) * truth.hands[0].layout.num_markers
    known = np.array([number if 0 <= number < others else others for number in of_hands] + [-1])
    here = np.isfinite(truth.points[..., 0])
    worn, given = np.where(truth.labels < others, truth.labels, -1), known[take.labels]
    frames = ((given[t][one], np.full(one.sum(), np.nan), worn[t][one]) for t, one in enumerate(here))
    report = count_labels((*names[:others], "another hand"), frames)
    return report.slot_accuracy_by_marker[:others].reshape(len(truth.hands), -1), report


_Advice = tuple[float, str]
"""Weight of a sentence (the share of points, frames or joints that it concerns), and the sentence."""


def _alternative_advice(score: LayoutScore) -> Iterator[_Advice]:
    """Advice on markers whose labels are wrong throughout a capture."""
    for one in score.alternatives:
        if one.probability >= _MISTAKE_SHARE:
            yield (
                one.probability,
                f"{one.words[0].upper()}{one.words[1:]} in whole captures with a probability of "
                f"{100 * one.probability:.0f} %: move a marker to where no other label fits.",
            )


def _capture_advice(score: LayoutScore) -> Iterator[_Advice]:
    """Advice on the worst marker of the simulated captures."""
    for work, trial in score.trials.items():
        shares = {method: float(trial.slots[method][trial.worst]) for method in METHODS}
        if min(shares.values()) < 1.0 - _MISTAKE_SHARE:
            told = ", ".join(f"{100 * share:.0f} % with {method}" for method, share in shares.items())
            yield (
                1.0 - min(shares.values()),
                f"With {work} {score.layout.names[trial.worst]} is labeled worst: right in {told}. Give it "
                "a marker next to it on the same digit, or other distances to the markers of the palm.",
            )


def _confusion_advice(score: LayoutScore) -> Iterator[_Advice]:
    """Advice on pairs of markers whose labels are confused."""
    names, told = score.layout.names, set()
    for mistake in mistakes(score.observed.confusion, most=2 * _MOST_SENTENCES):
        pair = frozenset((mistake.truth, mistake.called))
        if mistake.share < _MISTAKE_SHARE or pair in told:
            continue
        told.add(pair)
        first, second = names[mistake.truth], names[mistake.called]
        yield (
            mistake.share,
            f"Move {first} or {second}, so that their distances to the others differ: "
            f"{100 * mistake.share:.0f} % of the points of {first} are taken for {second}.",
        )


def _joint_advice(score: LayoutScore) -> Iterator[_Advice]:
    """Digits with poorly observed joints, and the bone to add a marker to."""
    share = score.joints / free_spreads()
    carried = {marker.bone for marker in score.layout.markers}
    for digit, name in enumerate(DIGITS):
        joints = [number for number, joint in enumerate(JOINTS) if BONES[joint.bone].digit == digit]
        poor = [number for number in joints if share[number] > _POOR_RATIO]
        bones = [BONES[JOINTS[number].bone].name for number in (*joints, *poor)]
        bone = next((one for one in reversed(bones) if one not in carried), None)
        if not poor or bone is None:
            continue
        listed = ", ".join(
            f"{JOINTS[number].name.removeprefix(name + '_').replace('_', ' ')} "
            f"({np.rad2deg(score.joints[number]):.0f} deg)"
            for number in poor
        )
        yield (
            float(share[poor].max()) * 0.1,
            f"Add a marker on {bone}: the markers tell little of the {name}'s {listed}.",
        )


def _visibility_advice(score: LayoutScore) -> Iterator[_Advice]:
    """Advice where frames show too few of a hand's markers, and on each marker that is seldom seen."""
    if score.few_seen > _HIDDEN_SHARE:
        count = score.layout.num_markers
        yield (
            score.few_seen,
            f"Add markers, on the back of the hand first: in {100 * score.few_seen:.0f} % of the frames "
            f"fewer than {math.ceil(_AT_ONCE * count)} of {count} are seen, too few to find a hand at once.",
        )
    for name, seen in zip(score.layout.names, score.seen, strict=True):
        if seen < 1.0 - _HIDDEN_SHARE:
            yield (
                1.0 - float(seen),
                f"Move {name} towards the back of the hand: it is a point in {100 * seen:.0f} % of the "
                "frames only.",
            )


def digit_of(place: MarkerPlace) -> int:
    """The digit that a marker is on."""
    return BONES[BONE_NAMES.index(place.bone)].digit
