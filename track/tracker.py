"""The online tracker: points of a frame in, poses of hands out.

Section 4 of Han et al. 2018 with more history: labels are carried over by IDs while they fit, new points are
labeled by the predicted pose (`track.association`), and hands without history are initialized by the
labeler. Each step takes a frame's `FrameState` and returns the next one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.fit import GloveFit
from gloves.takes.points import Status
from handsim._checks import shown_value
from handsim._process import with_own_numerics
from handsim.arrays import Integers
from handsim.errors import ArgumentError
from handsim.hand.shape import NUM_QPOS
from handsim.kernels import kernel, squared_distance
from handsim.space.transforms import rotation_quaternions
from track.association.frame_state import FrameState, Numbering, PointHistory, targets_of
from track.association.hand_state import HandState, HandTrack, Prediction
from track.association.initialization import HandInitializer, InitializedHand
from track.association.label_consistency import (
    LabelerReview,
    exchange_labels,
    fit_labels,
    gate_labels,
    refit_labels,
)
from track.association.label_new_points import SETTLED_EVIDENCE, digit_table, label_new_points
from track.bodies.rigid_body import AnyBody, BodyTracker, load_bodies
from track.config import TrackerConfig
from track.frames import FrameValidator, IncomingFrame, TrackedBody, TrackedFrame, TrackedHand
from track.user import AnyLabeler, User, as_user, labeler_of

_EVIDENCE_PER_FRAME: Final = 2.0  # log-odds gained by a label per frame, less half its squared distance
_MOST_EVIDENCE: Final = 12.0  # log-odds bound, so that a wrong label can still be lost
_DOUBT_SHARE: Final = 0.6  # A track with a smaller share of its markers labeled is doubted.
_DOUBT_RMS: Final = 0.003  # [m] A track with a larger RMS distance, biases removed, is doubted.
_DOUBT_RADIUS: Final = 0.2  # [m] distance from the wrist within which unlabeled points confirm the doubt
_REPLACEMENT_MARGIN: Final = 20.0  # log-odds by which a new pose must be better than a doubted track
_FIRST_WAIT: Final = 0.005  # [s] to the next attempt after a failed initialization; less than a frame
_WAIT_FACTOR: Final = 1.5  # factor of the wait after each failed attempt
_LONGEST_WAIT: Final = 0.1  # [s] longest wait between attempts
_MORE_POINTS: Final = 3  # With this many more points the next attempt is made at once.
_HAND_SPACING: Final = 0.5  # [m] between the hands in the warm-up
_UNSURE_EXTENT: Final = 0.12  # [m] size of random clouds, whose labels need verification


class _Outcome(NamedTuple):
    """Result of a frame for one hand."""

    status: Status
    rms: float = np.nan
    """RMS distance of the labeled markers from the pose's, biases included [m]; NaN without a fit."""


_Outcomes = tuple[_Outcome, ...]


class Tracker:
    """Tracks the user's hands, and rigid bodies with markers, from frame to frame.

    Args:
        hands: The user's hands, each side at most once: a `User`; other sequences of hands, which count as
            calibrated; or the path of a user's file.
        labeler: Labeler of the glove's markers, or its name or path for `train.load_labeler`; the glove's own
            if not given.
        bodies: Rigid bodies beside the hands, or names of handsim's objects, or paths of their files.
        config: Settings.

    Raises:
        ArgumentError: An argument has a wrong type, or two hands have the same side.
        UserError: The user's file cannot be read.
        WeightsError: There is no labeler of that name, or it knows other markers.
    """

    def __init__(
        self,
        hands: User | Sequence[GloveFit] | str | Path,
        labeler: AnyLabeler = None,
        bodies: Sequence[AnyBody] = (),
        config: TrackerConfig = TrackerConfig(),  # noqa: B008 (frozen)
    ) -> None:
        if not isinstance(config, TrackerConfig):
            raise ArgumentError(f"config is {shown_value(config)}, expected a TrackerConfig")
        self.user = as_user(hands)
        self.hands = self.user.hands
        self.bodies = load_bodies(bodies)
        self.config = config
        self.labeler = labeler_of(self.user.layout, labeler)
        self._intake = FrameValidator(config.silence)
        self._bodies = [BodyTracker(body) for body in self.bodies]
        known = [(hand, self.user.origin(hand.side), self.user.errors.get(hand.side)) for hand in self.hands]
        self._states = [HandState(one, config, origin=origin, errors=errors) for one, origin, errors in known]
        counts = [*(one.num_markers for one in self._states), *(len(one.marker_names) for one in self.bodies)]
        self._numbering = Numbering(counts)
        self._history = PointHistory(self._numbering, config.silence)
        self._digits = digit_table(self._states, self._numbering)
        self._initializer = HandInitializer(self._states, self.labeler, config)
        self._review = LabelerReview(self.labeler, len(self.hands), config)
        self._last_attempt, self._attempt_wait = -np.inf, 0.0  # [s] last attempt, wait after it
        self._attempt_points = 0  # number of free points in that attempt
        self._last_sound = np.zeros(len(self.hands))  # [s] time at which each track was last not doubted

    def warm_up(self) -> None:
        """Load all kernels and let the labeler label a few clouds, so that streams need not wait.

        The state of this tracker does not change.
        """
        tracker, hands = Tracker(self.user, self.labeler), self.hands
        qpos = np.zeros((len(hands), NUM_QPOS))
        qpos[:, 0], qpos[:, 3] = _HAND_SPACING * np.arange(len(hands)), 1.0
        worn = [hand.markers(row[None])[0][0] for hand, row in zip(hands, qpos, strict=True)]
        points = np.concatenate(worn)
        for number in range(3):  # initialized, tracked, and labeled again
            ids = np.arange(len(points)) + (number == 2) * len(points) * (np.arange(len(points)) % 4 == 0)
            for hand in tracker.step(points, ids, 0.01 * number).hands:
                _ = hand.angle_spread
        unsure = np.random.default_rng(0).uniform(0.0, _UNSURE_EXTENT, (4, len(points) // len(hands), 3))
        for cloud in unsure:  # random points, whose labels must be verified by a pose
            self.labeler.label_frames([cloud])

    def resize(self, user: User, keep: float = 0.0) -> None:
        """Replace the hands by the same hands of another size; they keep poses and labels.

        Args:
            user: The hands, in the same order.
            keep: Share of the learned marker biases to keep, from 0 to 1. More than 0 marks a step of a
                gradual change, which takes a tenth of the time; 0 makes the size final.
        """
        self.user, self.hands = user, user.hands
        for state, hand in zip(self._states, self.hands, strict=True):
            state.resize(hand, user.origin(hand.side), user.errors.get(hand.side), keep)
        self._digits = digit_table(self._states, self._numbering)
        if not keep:
            self._initializer = HandInitializer(self._states, self.labeler, self.config)

    @with_own_numerics
    def step(
        self,
        points: Float[np.ndarray, "N 3"],
        ids: Int[np.ndarray, "N"] | None = None,
        time: float | None = None,
    ) -> TrackedFrame:
        """Track the next frame; faults of the stream end in a status or a note, not in an error.

        Args:
            points: Points [m]; non-finite ones are left out.
            ids: IDs of the camera system: a point keeps its ID while it is visible; -1 where it has none.
                Without IDs the tracker links points from frame to frame itself.
            time: Time of the frame [s].

        Raises:
            ArgumentError: `points` and `ids` do not fit together or are not numbers, or `time` is missing.
        """
        began = perf_counter()
        incoming = self._intake.check_frame(points, ids, time)
        bodies, labels = self._track_bodies(incoming)
        free = labels < 0
        posed = ((hand, state) for hand, state in enumerate(self._states) if state.qpos is not None)
        predictions = {hand: state.predict(incoming.time) for hand, state in posed}
        expected = self._marker_positions(predictions)
        carried = self._history.carry(incoming.points[free], incoming.ids[free], incoming.time, expected)
        followed = self._give_up_old_poses(carried)
        exchanged = exchange_labels(followed, expected)
        fitted, tracks = self._fit_kept_labels(exchanged, predictions)
        labeled = label_new_points(fitted, tracks, self._digits)
        reviewed, tracks = self._review_labels(fitted, labeled, tracks)
        updated, outcomes = self._update(reviewed, tracks)
        started, outcomes = self._initialize_lost(updated, outcomes)
        final, outcomes = self._replace_doubted(started, outcomes)
        self._history.keep(final)
        pairs = enumerate(zip(self._states, outcomes, strict=True))
        hands = tuple(_tracked_hand(state, one, final, final.markers(hand)) for hand, (state, one) in pairs)
        all_labels, all_confidence = np.full(incoming.num_points, -1), np.ones(incoming.num_points)
        all_labels[incoming.kept] = labels
        all_labels[incoming.kept[free]], all_confidence[incoming.kept[free]] = final.labels, final.confidence
        took = perf_counter() - began
        return TrackedFrame(incoming.stamp, hands, all_labels, all_confidence, bodies, incoming.notes, took)

    def _track_bodies(self, incoming: IncomingFrame) -> tuple[tuple[TrackedBody, ...], Integers]:
        """Track every body; return also the labels (P,) of their points."""
        labels, bodies = np.full(len(incoming.points), -1), []
        for owner, tracker in enumerate(self._bodies, start=len(self._states)):
            side = tracker.template.forearm
            wrists = (one.qpos for one in self._states if one.qpos is not None and one.hand.side == side)
            wrist = next((qpos[:7] for qpos in wrists), None)
            body = tracker.step(incoming.points, incoming.ids, incoming.time, wrist)
            labels = self._numbering.with_markers(owner, body.labels, labels)
            position, rotation = np.full(3, np.nan), np.full(4, np.nan)
            if body.T_world_body is not None:
                position = body.T_world_body[:3, 3]
                rotation = rotation_quaternions(body.T_world_body[None, :3, :3])[0]
            bodies.append(TrackedBody(tracker.template.name, body.status, position, rotation, body.rms))
        return tuple(bodies), labels

    def _marker_positions(self, predictions: Mapping[int, Prediction]) -> Float[np.ndarray, "K 3"]:
        """Predicted position of each label's marker [m]; NaN for bodies and for hands without a pose."""
        positions = np.full((len(self._numbering.owners), 3), np.nan)
        for hand, prediction in predictions.items():
            positions[self._numbering.part(hand)] = prediction.positions
        return positions

    def _give_up_old_poses(self, frame: FrameState) -> FrameState:
        """Drop poses too old to be predicted, and the labels of hands without a pose."""
        for hand, state in enumerate(self._states):
            labeled = int((frame.markers(hand) >= 0).sum())
            if labeled < self.config.fewest_labels and self._coasted_out(state, frame.time):
                state.qpos = None
            if state.qpos is None and labeled:
                frame = frame.with_markers(hand, np.full(len(frame.points), -1))
        return frame

    def _fit_kept_labels(
        self, frame: FrameState, predictions: Mapping[int, Prediction]
    ) -> tuple[FrameState, list[HandTrack]]:
        """Fit hands with a pose to the labels that are consistent with it."""
        tracks = []
        for hand, state in enumerate(self._states):
            if state.qpos is not None:
                prediction = predictions[hand]
                frame = gate_labels(frame, hand, state, prediction)
                frame, estimate = fit_labels(frame, hand, state, prediction)
                tracks.append(HandTrack(hand, state, prediction, estimate))
        return frame, tracks

    def _review_labels(
        self, fitted: FrameState, frame: FrameState, tracks: Sequence[HandTrack]
    ) -> tuple[FrameState, list[HandTrack]]:
        """Refit hands with new labels, and compare their labels with the labeler's."""
        reviewed = []
        for fit in tracks:
            frame, track = refit_labels(fitted, frame, fit)
            frame, track = self._review.review(frame, track)
            reviewed.append(track)
        return frame, reviewed

    def _coasted_out(self, state: HandState, time: float) -> bool:
        """Whether a pose is too old for further prediction."""
        return time - state.time > self.config.longest_coast

    def _update(self, frame: FrameState, tracks: Sequence[HandTrack]) -> tuple[FrameState, _Outcomes]:
        """Accept or reject the hands' estimates, and update the evidence of their labels."""
        estimates, outcomes = {track.hand: track.estimate for track in tracks}, []
        evidence = frame.evidence.copy()
        for hand, state in enumerate(self._states):
            markers, estimate = frame.markers(hand), estimates.get(hand)
            labeled = np.count_nonzero(markers >= 0)
            enough = labeled >= self.config.fewest_labels
            if estimate is not None and enough and estimate.rms <= self.config.most_rms:
                rms = state.rms_from_design(estimate)  # with the biases used by the fit
                settled = _weigh_labels(frame.points, markers, estimate.positions, state.variance, evidence)
                state.update(estimate, settled, frame.time)
                outcomes.append(_Outcome(Status.TRACKED, rms))
                continue
            if state.qpos is not None and self._coasted_out(state, frame.time):
                state.qpos = None
            if state.qpos is None and labeled:
                frame = frame.with_markers(hand, np.full(len(markers), -1))
            outcomes.append(_Outcome(Status.LOST if state.qpos is None else Status.COASTING))
        return frame._replace(evidence=evidence), tuple(outcomes)

    def _initialize_lost(self, frame: FrameState, outcomes: _Outcomes) -> tuple[FrameState, _Outcomes]:
        """Initialize hands without a pose from the points left by the others."""
        lost = tuple(hand for hand, one in enumerate(outcomes) if one.status < Status.INITIALIZED)
        if not lost:
            return frame, outcomes
        free = frame.free_for(lost)
        # Attempts become rarer while the number of points stays the same.
        is_due = frame.time >= self._last_attempt + self._attempt_wait
        if not is_due and len(free) < self._attempt_points + _MORE_POINTS:
            return frame, outcomes
        initialized = self._initializer.initialize(frame.points[free], lost)
        for found in initialized:
            frame, outcomes = self._start(frame, outcomes, found, free)
        goes_on = bool(initialized) or self._initializer.is_searching(lost)
        longer = min(_WAIT_FACTOR * max(self._attempt_wait, _FIRST_WAIT), _LONGEST_WAIT)
        self._attempt_wait = 0.0 if goes_on else longer
        self._last_attempt, self._attempt_points = frame.time, len(free)
        return frame, outcomes

    def _replace_doubted(self, frame: FrameState, outcomes: _Outcomes) -> tuple[FrameState, _Outcomes]:
        """Initialize a hand again if it lacks most labels, or fits badly, and has unlabeled points around it.

        Otherwise a track could hold on to a wrong pose by a few points.
        """
        for hand, state in enumerate(self._states):
            count = int((frame.markers(hand) >= 0).sum())
            fewest = _DOUBT_SHARE * state.num_markers
            sound = count >= fewest and state.rms < _DOUBT_RMS
            if outcomes[hand].status is not Status.TRACKED or state.qpos is None or sound:
                self._last_sound[hand] = frame.time
                continue
            free = frame.free_for((hand,))
            around = np.linalg.norm(frame.points[free] - state.qpos[:3], axis=1) < _DOUBT_RADIUS
            if around.sum() < fewest:
                self._last_sound[hand] = frame.time
            if frame.time - self._last_sound[hand] < self.config.doubt_time:
                continue
            least_score = self._initializer.score(count, state.rms) + _REPLACEMENT_MARGIN
            for again in self._initializer.initialize(frame.points[free], (hand,)):
                if again.score > least_score:
                    frame, outcomes = self._start(frame, outcomes, again, free)
            if not self._initializer.is_searching((hand,)):
                self._last_sound[hand] = frame.time
        return frame, outcomes

    def _start(
        self, frame: FrameState, outcomes: _Outcomes, found: InitializedHand, among: Integers
    ) -> tuple[FrameState, _Outcomes]:
        """Start a track from an initialized hand."""
        state, markers = self._states[found.index], np.full(len(frame.points), -1)
        markers[among] = found.labels
        targets = targets_of(frame.points, markers, state.num_markers)
        estimate = state.initialize(found.fit.qpos[0], targets, frame.time)
        self._review.restart(found.index, frame.time)
        started = _Outcome(Status.INITIALIZED, state.rms_from_design(estimate))
        others = outcomes[: found.index], outcomes[found.index + 1 :]
        return frame.with_markers(found.index, markers), (*others[0], started, *others[1])


@kernel
def _weigh_labels(
    points: Float[np.ndarray, "P 3"],
    markers: Int[np.ndarray, "P"],
    positions: Float[np.ndarray, "M 3"],
    variance: Float[np.ndarray, "M"],
    evidence: Float[np.ndarray, "P"],
) -> Bool[np.ndarray, "M"]:
    """Update the evidence of a hand's labels; return which markers had settled labels before."""
    settled = np.zeros(len(positions), dtype=np.bool_)
    for point in range(len(markers)):
        marker = markers[point]
        if marker >= 0:
            settled[marker] = evidence[point] >= SETTLED_EVIDENCE
            square = squared_distance(points[point], positions[marker])
            gain = _EVIDENCE_PER_FRAME - 0.5 * square / variance[marker]
            evidence[point] = min(max(evidence[point] + gain, 0.0), _MOST_EVIDENCE)
    return settled


def _tracked_hand(state: HandState, outcome: _Outcome, frame: FrameState, own: Integers) -> TrackedHand:
    """Output for a hand: its labeled points, and the pose's markers where points are missing."""
    count, side = state.num_markers, state.hand.side
    if state.qpos is None:
        no_markers = np.full((count, 3), np.nan)
        return TrackedHand(side, outcome.status, np.full(NUM_QPOS, np.nan), np.nan, no_markers, np.arange(0))
    seen = targets_of(frame.points, own, count)
    is_missing = np.isnan(seen[:, 0])
    markers, filled = np.where(is_missing[:, None], state.positions, seen), np.flatnonzero(is_missing)
    spreads = state.pose_spread(frame.time)
    # A predicted or newly initialized pose has no known velocity.
    velocity_factor = 1.0 if outcome.status is Status.TRACKED else np.nan
    qpos, velocity = state.qpos.copy(), velocity_factor * state.velocity
    return TrackedHand(side, outcome.status, qpos, outcome.rms, markers, filled, spreads, velocity)
