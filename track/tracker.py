"""The online tracker: the points of a frame in, the motion of hands out.

Section 4 of Han et al. 2018 with more history: labels go along with IDs while they fit, new points are
labeled by the pose that is predicted (`track.association`), and hands without history are initialized with
the labeler.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.fit import GloveFit
from handsim.hand.topology import NUM_QPOS
from handsim.space.transforms import rotation_quaternions
from track.association.frame_state import FrameState
from track.association.hand_state import Estimate, HandState, Prediction
from track.association.initialization import HandInitializer, InitializedHand
from track.association.label_consistency import exchange_labels, fit_labels, gate_labels, targets_of
from track.association.label_new_points import HandTrack, label_new_points
from track.association.labeler_review import LabelerReview
from track.association.point_linking import PointLinker
from track.bodies.rigid_body import BodyTracker, RigidTemplate
from track.config import TrackerConfig
from track.intake import IncomingFrame, Intake
from track.tracked_frame import Status, TrackedBody, TrackedFrame, TrackedHand
from train.labelers.protocol import Labeler


class Tracker:
    """Tracks the user's hands, and bodies with markers of their own, from frame to frame.

    Args:
        hands: The user's hands, each side at most once.
        labeler: Labels the markers of the hands' glove.
        bodies: Rigid bodies beside the hands.
        config: All settings.
    """

    def __init__(
        self,
        hands: Sequence[GloveFit],
        labeler: Labeler,
        bodies: Sequence[RigidTemplate] = (),
        config: TrackerConfig = TrackerConfig(),  # noqa: B008 (frozen)
    ) -> None:
        self.hands = tuple(hands)
        self.bodies = tuple(bodies)
        self.config = config
        self._intake = Intake(config.intake)
        self._bodies = [BodyTracker(body) for body in bodies]
        self._states = [HandState(hand, config) for hand in hands]
        self._initializer = HandInitializer(self._states, labeler, config)
        self._linker = PointLinker(config.linking)
        self._review = LabelerReview(labeler, len(hands), config)
        sizes = [state.num_markers for state in self._states]
        self._first = np.cumsum([0, *sizes, *(len(body.marker_names) for body in bodies)])
        self._labels: dict[int, tuple[int, float]] = {}  # label and evidence of each ID
        self._first_seen: dict[int, float] = {}  # [s] of each ID
        self._last_time = -np.inf  # [s] of the last frame
        self._last_sound = np.zeros(len(hands))  # [s] when each track was last beyond doubt

    def step(self, points: Float[np.ndarray, "N 3"], ids: Int[np.ndarray, "N"], time: float) -> TrackedFrame:
        """Track the next frame; whatever a stream may bring ends in a status or a note.

        Args:
            points: Points [m]; those without finite coordinates are left out.
            ids: The system's IDs: a point keeps its own for as long as it is visible; -1 where there is none.
            time: Time of the frame [s].

        Raises:
            ArgumentError: `points` and `ids` do not fit together.
        """
        began = perf_counter()
        incoming = self._intake.take(points, ids, time)
        if incoming.time - self._last_time > self.config.intake.silence:
            self._labels = {}  # IDs may be those of other points by now
        self._last_time = incoming.time
        bodies, labels = self._track_bodies(incoming)
        confidence, free = np.ones(len(labels)), labels < 0
        frame = self._frame_state(incoming.points[free], incoming.ids[free], incoming.time)
        hands, labels[free] = self._track_hands(frame)
        confidence[free] = frame.confidence
        all_labels, all_confidence = np.full(len(points), -1), np.ones(len(points))
        all_labels[incoming.kept], all_confidence[incoming.kept] = labels, confidence
        seconds = perf_counter() - began
        return TrackedFrame(time, hands, all_labels, all_confidence, bodies, incoming.notes, seconds)

    def _track_bodies(self, incoming: IncomingFrame) -> tuple[tuple[TrackedBody, ...], NDArray[np.int64]]:
        """Every body, and the labels (P,) of their points."""
        labels, bodies = np.full(len(incoming.points), -1), []
        for number, tracker in enumerate(self._bodies, start=len(self._states)):
            body = tracker.step(incoming.points, incoming.ids, incoming.time)
            labels[body.labels >= 0] = self._first[number] + body.labels[body.labels >= 0]
            position, rotation = np.full(3, np.nan), np.full(4, np.nan)
            if body.T_world_body is not None:
                position = body.T_world_body[:3, 3]
                rotation = rotation_quaternions(body.T_world_body[None, :3, :3])[0]
            bodies.append(TrackedBody(tracker.template.name, body.status, position, rotation, body.rms))
        return tuple(bodies), labels

    def _frame_state(self, points: NDArray[np.float64], ids: NDArray[np.int64], time: float) -> FrameState:
        """The frame with the labels and the evidence that its points carry over."""
        ids = self._linker.number(points, ids, self._labels, lambda: self._predict_points(time))
        known = [self._labels.get(point, (-1, 0.0)) for point in ids.tolist()]
        carried = np.array([label for label, _ in known], dtype=np.int64)
        first = self._first[: len(self._states) + 1, None]
        labels = carried - first[:-1]
        labels[(labels < 0) | (carried >= first[1:])] = -1
        evidence = np.array([evidence for _, evidence in known])
        self._first_seen = {point: self._first_seen.get(point, time) for point in ids.tolist() if point >= 0}
        first_seen = np.array([self._first_seen.get(point, time) for point in ids.tolist()])
        confidence = 1.0 / (1.0 + np.exp(-evidence - 1.0))
        return FrameState(points, ids, labels, evidence, confidence, first_seen, time)

    def _predict_points(self, time: float) -> dict[int, tuple[int, NDArray[np.float64]]]:
        """Hand and predicted position of the points that had a label in the last frame."""
        positions = [None if state.qpos is None else state.predict(time).positions for state in self._states]
        predicted = {}
        for number, (label, _) in self._labels.items():
            hand = int(np.searchsorted(self._first, label, side="right")) - 1
            if hand < len(positions) and (own := positions[hand]) is not None:
                predicted[number] = hand, own[label - self._first[hand]]
        return predicted

    def _track_hands(self, frame: FrameState) -> tuple[tuple[TrackedHand, ...], NDArray[np.int64]]:
        """Every hand, and the labels (P,) of points, counted through the hands."""
        estimates = self._associate(frame)
        hands = [self._update(index, frame, estimates.get(index)) for index in range(len(self._states))]
        self._initialize_lost(frame, hands)
        self._replace_doubted(frame, hands)
        first = self._first[: len(hands), None]
        labels = np.where(frame.labels >= 0, frame.labels + first, -1).max(axis=0, initial=-1)
        self._labels = {
            point: (label, evidence)
            for point, label, evidence in zip(
                frame.ids.tolist(), labels.tolist(), frame.evidence.tolist(), strict=True
            )
            if label >= 0 and point >= 0
        }
        return tuple(hands), labels

    def _associate(self, frame: FrameState) -> dict[int, Estimate]:
        """Predict the hands that have a pose, test and complete their labels, and fit their poses."""
        predictions: dict[int, Prediction] = {}
        for index, state in enumerate(self._states):
            labels = frame.labels[index]
            if (labels >= 0).sum() < self.config.track.fewest_labels and self._coasted_out(state, frame.time):
                state.qpos = None
            if state.qpos is None:
                labels[:] = -1
                continue
            predictions[index] = state.predict(frame.time)
        self._exchange(frame, predictions)
        hands = []
        for index, prediction in predictions.items():
            state, labels = self._states[index], frame.labels[index]
            gate_labels(state, frame.points, labels, prediction, self.config.gating)
            estimate = fit_labels(state, frame.points, labels, prediction, self.config.gating)
            hands.append(HandTrack(index, state, prediction, estimate))
        before = frame.labels.copy()
        confidence = label_new_points(hands, frame)
        changed = np.isfinite(confidence)
        frame.evidence[changed], frame.confidence[changed] = 0.0, confidence[changed]
        estimates = {}
        for hand in hands:
            labels, estimate = frame.labels[hand.index], hand.estimate
            if (labels != before[hand.index]).any():
                estimate = fit_labels(hand.state, frame.points, labels, hand.prediction, self.config.gating)
            estimates[hand.index] = estimate
            proposal = self._review.review(hand, estimates[hand.index], frame)
            if proposal is not None:
                changed = (proposal.labels != labels) & (proposal.labels >= 0)
                frame.evidence[changed], frame.confidence[changed] = 0.0, proposal.confidence[changed]
                labels[:], estimates[hand.index] = proposal.labels, proposal.estimate
        return estimates

    def _exchange(self, frame: FrameState, predictions: dict[int, Prediction]) -> None:
        """Exchange labels of points whose IDs the system has exchanged."""
        if not predictions:
            return
        indices = list(predictions)
        first = self._first[indices, None]
        own = frame.labels[indices]
        assigned = np.where(own >= 0, own + first, -1).max(axis=0, initial=-1)
        positions = np.full((self._first[len(self._states)], 3), np.nan)
        for index, prediction in predictions.items():
            positions[self._first[index] : self._first[index + 1]] = prediction.positions
        changed = exchange_labels(frame.points, assigned, positions, self.config.gating)
        if len(changed):
            frame.evidence[changed] = 0.0
            frame.confidence[changed] = 0.5
            last = self._first[np.array(indices) + 1, None]
            frame.labels[indices] = np.where((assigned >= first) & (assigned < last), assigned - first, -1)

    def _coasted_out(self, state: HandState, time: float) -> bool:
        """Whether a pose is too old to be predicted on."""
        return time - state.time > self.config.track.longest_coast

    def _update(self, index: int, frame: FrameState, estimate: Estimate | None) -> TrackedHand:
        """Take over a hand's estimate, or reject it; the evidence of its labels is updated."""
        state, labels = self._states[index], frame.labels[index]
        track, association = self.config.track, self.config.association
        labeled = np.flatnonzero(labels >= 0)
        enough = len(labeled) >= track.fewest_labels
        if estimate is not None and enough and estimate.rms <= self.config.initialization.most_rms:
            settled = np.zeros(state.num_markers, dtype=bool)
            settled[labels[labeled]] = frame.evidence[labeled] >= association.settled_evidence
            state.update(estimate, settled, frame.time)
            squares = ((frame.points[labeled] - state.positions[labels[labeled]]) ** 2).sum(axis=1)
            gain = association.evidence_per_frame - 0.5 * squares / state.variance[labels[labeled]]
            frame.evidence[labeled] = np.clip(frame.evidence[labeled] + gain, 0.0, association.most_evidence)
            return _tracked(state, Status.TRACKED, frame.points, labels, estimate)
        if state.qpos is not None and self._coasted_out(state, frame.time):
            state.qpos = None
        if state.qpos is None:
            labels[:] = -1
            return _tracked(state, Status.LOST, frame.points, labels, None)
        return _tracked(state, Status.COASTING, frame.points, labels, None)

    def _initialize_lost(self, frame: FrameState, hands: list[TrackedHand]) -> None:
        """Initialize hands without a pose with the points that the others leave; `hands` is overwritten."""
        lost = [index for index, hand in enumerate(hands) if hand.status in (Status.LOST, Status.COASTING)]
        if not lost:
            return
        free = frame.unlabeled_by_others(lost)
        for hand in self._initializer.initialize(frame.points[free], tuple(lost)):
            hands[hand.index] = self._start(hand, free, frame)
            lost.remove(hand.index)
            for other in lost:  # it may have kept labels of some of these points
                frame.labels[other, frame.labels[hand.index] >= 0] = -1
                state = self._states[other]
                hands[other] = _tracked(state, hands[other].status, frame.points, frame.labels[other], None)

    def _replace_doubted(self, frame: FrameState, hands: list[TrackedHand]) -> None:
        """Initialize a hand again that lacks most of its labels, or fits badly, with points around it.

        A track can hold on to a wrong pose with a few points; it must not stay there. `hands` is overwritten.
        """
        track = self.config.track
        for index, (hand, state) in enumerate(zip(hands, self._states, strict=True)):
            count = int((frame.labels[index] >= 0).sum())
            fewest = track.doubt_share * state.num_markers
            sound = count >= fewest and state.rms < track.doubt_rms
            if hand.status is not Status.TRACKED or sound:
                self._last_sound[index] = frame.time
                continue
            free = frame.unlabeled_by_others(index)
            around = np.linalg.norm(frame.points[free] - hand.qpos[:3], axis=1) < track.doubt_radius
            if around.sum() < fewest:
                self._last_sound[index] = frame.time
            if frame.time - self._last_sound[index] < track.doubt_time:
                continue
            self._last_sound[index] = frame.time
            least_score = self._initializer.score(count, state.rms) + track.replacement_margin
            for again in self._initializer.initialize(frame.points[free], [index]):
                if again.score > least_score:
                    hands[index] = self._start(again, free, frame)

    def _start(self, hand: InitializedHand, among: NDArray[np.int64], frame: FrameState) -> TrackedHand:
        """Start a track from a hand that was initialized among some points; its labels are overwritten."""
        state, labels = self._states[hand.index], frame.labels[hand.index]
        labels[:] = -1
        labels[among] = hand.labels
        targets = targets_of(frame.points, labels, state.num_markers)
        estimate = state.initialize(hand.fit.qpos[0], targets, frame.time)
        self._review.restart(hand.index, frame.time)
        return _tracked(state, Status.INITIALIZED, frame.points, labels, estimate)


def _tracked(
    state: HandState,
    status: Status,
    points: NDArray[np.float64],
    labels: NDArray[np.int64],
    estimate: Estimate | None,
) -> TrackedHand:
    """The output for a hand: labeled points (N, 3) [m] where there are some, the pose's markers elsewhere."""
    count, side = state.num_markers, state.hand.side
    if state.qpos is None:
        no_markers = np.full((count, 3), np.nan)
        return TrackedHand(side, status, np.full(NUM_QPOS, np.nan), np.nan, no_markers, np.arange(0))
    markers, labeled = state.positions.copy(), labels >= 0
    markers[labels[labeled]] = points[labeled]
    present = np.zeros(count, dtype=bool)
    present[labels[labeled]] = True
    rms = np.nan if estimate is None else state.rms_without_bias(estimate)
    return TrackedHand(side, status, state.qpos.copy(), rms, markers, np.flatnonzero(~present))
