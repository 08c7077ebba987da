"""Settings of the online tracker: one frozen dataclass per concern, all of them in `TrackerConfig`.

Lengths are in meters, times in seconds, angles in radians; log-odds are natural. The defaults made every
published figure. Constants of compiled kernels are not here but beside their kernels
(`track.kinematics.levenberg_marquardt`, `track.association.digit_fit`), because they are compiled in.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from handsim.errors import ArgumentError


def _degrees(angle: float) -> float:
    return float(np.deg2rad(angle))


@dataclass(frozen=True)
class _Settings:
    """Validates that numbers are finite, and positive unless their field has bounds."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            if dataclasses.is_dataclass(value):
                continue
            low, high = item.metadata.get("bounds", (np.nextafter(0.0, 1.0), np.inf))
            if not isinstance(value, int | float) or not (low <= value <= high and abs(value) < np.inf):
                raise ArgumentError(f"{item.name} is {value!r}, expected {_expected(low, high)}")
            if isinstance(item.default, int) and value != int(value):
                raise ArgumentError(f"{item.name} is {value!r}, expected a whole number")

    def _check_order(self, low: str, high: str) -> None:
        """Check that one number is not above another."""
        if getattr(self, low) > getattr(self, high):
            raise ArgumentError(
                f"{low} is {getattr(self, low):g}, expected at most {high}, which is {getattr(self, high):g}"
            )


def _expected(low: float, high: float) -> str:
    if high < np.inf:
        return f"a number from {low:g} to {high:g}"
    return "a finite number" if low == -np.inf else "a positive number"


def _share(default: float) -> float:
    """A field between 0 and 1."""
    return field(default=default, metadata={"bounds": (0.0, 1.0)})


def _any_sign(default: float) -> float:
    """A field of either sign."""
    return field(default=default, metadata={"bounds": (-np.inf, np.inf)})


@dataclass(frozen=True)
class IntakeConfig(_Settings):
    """Checks of what a stream brings (`track.intake`)."""

    farthest: float = 1e3
    """Largest coordinate of a point [m]; no capture volume is larger."""
    latest_time: float = 1e11
    """Largest time stamp [s]; beyond it a clock of doubles does not move on by a frame."""
    usual_interval: float = 1.0 / 120.0
    """Time between frames until a stream has shown its own [s]; 120 Hz is usual for optical systems."""
    interval_smoothing: float = _share(0.1)
    """Share of the newest interval in the usual one."""
    shortest_interval: float = 0.1
    """Least time between two frames on the tracker's clock, as a share of the usual interval."""
    longest_interval: float = 2.0
    """Longest interval that counts in the usual one, as a multiple of it."""
    silence: float = 0.25
    """Time without a frame that is noted, and that labels do not outlive [s]."""


@dataclass(frozen=True)
class SolverConfig(_Settings):
    """Weights and limits of the pose solver (`track.kinematics.pose_solver`)."""

    rest_spread: float = _degrees(90.0)
    """Standard deviation of a hinge around its resting angle [rad]: weak, for digits that lack a marker."""
    complete_digit_factor: float = _share(1e-4)
    """Factor of the resting prior's precision for a digit that has all its markers."""
    fewest_on_part: int = 3
    """Markers that determine the four hinges of a digit, also when it is straight, or the pose of a palm."""
    good_rms: float = 0.0005
    """RMS distance, limits and prior included, below which no further start is tried [m]."""
    most_steps: int = 30
    """Steps at most from each start."""
    frame_accuracy: float = 0.00003
    """In real time a fit ends when a step brings all markers together nearer by no more than this [m]."""
    easing_steps: int = 8
    """Steps at most at each widened scale of a robust loss."""


@dataclass(frozen=True)
class MotionConfig(_Settings):
    """Process model of a hand: how its pose is predicted (`HandState.predict`)."""

    longest_extrapolation: float = 0.05
    """Time for which a motion is extrapolated [s]; later the hand is predicted to stand."""
    velocity_smoothing: float = _share(0.6)
    """Share of the newest velocity in the smoothed one."""
    hidden_digit_damping: float = _share(0.7)
    """Factor per frame of the velocity of a digit that lacks markers."""
    joint_memory: float = 1.0
    """Time constant of the Ornstein-Uhlenbeck process of the hinges [s]; little is known of one after it."""
    joint_spread: float = _degrees(0.5)
    """Least standard deviation of a predicted hinge [rad]."""
    gesture_margin: float = _degrees(6.0)
    """Standard deviation added to that of the gestures, for poses that none of them shows [rad]."""
    wrist_spread: float = 0.001
    """Standard deviation of the predicted position of the wrist in the same frame [m]."""
    wrist_acceleration: float = 10.0
    """Unforeseen acceleration of the wrist [m/s^2]."""
    wrist_rotation_spread: float = _degrees(1.5)
    """Standard deviation of the predicted orientation of the wrist in the same frame [rad]."""
    wrist_angular_acceleration: float = 100.0
    """Unforeseen angular acceleration of the wrist [rad/s^2]."""


@dataclass(frozen=True)
class NoiseConfig(_Settings):
    """Measurement model: marker noise, and the learned bias of each marker (`HandState`)."""

    marker_noise: float = 0.001
    """Standard deviation of markers around a fitted pose [m]; optical systems and gloves reach about this."""
    first_spread_factor: float = 1.2
    """Spread of the markers of a hand that was just initialized, as a multiple of the fit's RMS."""
    first_spread_least: float = 0.0015
    """Least spread of such a marker [m]."""
    first_spread_most: float = 0.006
    """Largest spread of such a marker [m]."""
    least_spread: float = 0.0005
    """Least spread of a marker [m]: the noise of one that few cameras see."""
    bias_variation: float = _share(0.3)
    """Share of the hand's typical bias by which a marker's bias changes as the hand moves."""
    bias_doubt_time: float = 0.5
    """Time out of sight after which a marker may be off by the hand's typical bias again [s]."""
    averaging_frames: float = 120.0
    """Frames that a bias is averaged over; one second at 120 Hz."""
    learning_frames: float = 30.0
    """Frames after which the spread of a hand's markers is known."""
    bias_reuse_rms: float = 0.002
    """RMS distance below which a hand that is initialized again keeps its biases [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_order("first_spread_least", "first_spread_most")


@dataclass(frozen=True)
class PresenceConfig(_Settings):
    """Model of when markers come back and how long strays live (`HandState.presence_log_odds`)."""

    return_time: float = 0.01
    """The chance of a marker to come back in a frame is this over the time for which it was hidden [s]."""
    return_least: float = _share(0.01)
    """Least chance to come back in a frame."""
    return_most: float = _share(0.65)
    """Largest chance to come back in a frame."""
    seen_elsewhere: float = _any_sign(-7.0)
    """Log probability that a point is a marker that had another point while this one was visible."""
    stray_lifetime: float = 0.1
    """Mean time for which a stray point lives [s]."""
    most_age_log_odds: float = 3.0
    """Largest log-odds that a point's age contributes."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_order("return_least", "return_most")


@dataclass(frozen=True)
class LinkingConfig(_Settings):
    """Numbers of points where the stream's own IDs do not last (`track.association.point_linking`)."""

    lasting_share: float = _share(0.5)
    """Share of the last frame's IDs that must be there again for the stream's IDs to be used."""
    first_distance: float = 0.04
    """Distance of a point from its predicted position before hands are aligned [m]."""
    next_distance: float = 0.025
    """The same after that [m]."""
    last_distance: float = 0.015
    """The same after hands were aligned twice [m]."""
    fewest_aligned: int = 5
    """Points with which a hand is aligned."""
    beside_distance: float = 0.06
    """Distance from a hand's points within which a point without a label moves with the hand [m]."""


@dataclass(frozen=True)
class GatingConfig(_Settings):
    """Tests of labels that go along with IDs (`track.association.label_consistency`)."""

    gate: float = 16.0
    """Squared Mahalanobis distance beyond which a point is not fitted: four standard deviations."""
    prediction_spread: float = 0.004
    """Least standard deviation of a predicted marker beside its own spread [m]."""
    prediction_factor: float = 2.0
    """The same as a multiple of what the hand's other markers show in this frame."""
    exchange_margin: float = 8.0
    """Log-odds from which on two labels are exchanged; systems rarely exchange IDs."""
    exchange_distance: float = 0.04
    """Distance of two points within which their IDs may be exchanged [m]."""
    exchange_spread: float = 0.002
    """Least standard deviation of the offset of two predicted markers [m]."""
    fit_spread: float = 0.0015
    """Standard deviation of a fitted marker beside its own spread [m]."""
    most_gated: float = _share(0.3)
    """Largest share of a hand's labels that may be dropped at once; with more the prediction is wrong."""
    restart_rms: float = 0.004
    """RMS distance beyond which a fit is tried again from shapes instead of from the prediction [m]."""


@dataclass(frozen=True)
class AssociationConfig(_Settings):
    """Association of new points with markers (`candidates`, `digit_hypotheses`, `label_new_points`)."""

    evidence_per_frame: float = 2.0
    """Evidence of a label per frame (log-odds), less half the squared Mahalanobis distance of its point."""
    most_evidence: float = 12.0
    """Largest evidence of a label (log-odds), so that a wrong one can still be lost."""
    settled_evidence: float = 4.0
    """Evidence from which on a label is settled (log-odds); below it the label can be reassigned."""
    seen_radius: float = 0.012
    """Distance from a marker that has a point within which further points are its candidates [m]."""
    missing_radius: float = 0.05
    """Distance from a missing marker within which points are its candidates [m]."""
    length_tolerance: float = 0.003
    """Tolerance of the distances between two markers of a digit over all poses of the hand [m]."""
    pruning_margin: float = 7.0
    """Log-odds behind another hypothesis from which on a hypothesis is not fitted."""
    start_distance: float = _degrees(5.0)
    """Largest difference of a hinge between two starts of which one is enough [rad]."""
    stray_density: float = 2000.0
    """Strays near a hand that could be taken for a marker [1/m^3]: one in a cube of 8 cm."""
    bias_slack: float = 2.5
    """Standard deviations of a marker that count in how far it may be off its designed position."""


@dataclass(frozen=True)
class InitializationConfig(_Settings):
    """Track initialization: hands among points without any history (`track.association.initialization`)."""

    link_distance: float = 0.085
    """Largest distance between neighboring markers of one hand [m], or more where its glove asks for it."""
    least_share: float = _share(0.45)
    """Least share of a hand's markers that must be labeled."""
    fewest_points: int = 4
    """Least number of labeled points of a hand; a pose needs as many."""
    most_points: int = 100
    """Largest number of points of a group; larger groups are not hands."""
    spare_points: int = 6
    """Points beyond a hand's markers from which on a group is cut in halves: two hands may touch."""
    num_cuts: int = 12
    """Directions along which a group is cut, even over half a sphere."""
    most_fits: int = 8
    """Labeled clouds that are fitted at most, the most confident first."""
    refinements: int = 2
    """Rounds of assigning points to the markers of a fitted hand."""
    search_factor: float = 4.0
    """Spread of the markers in these rounds, as a multiple of that of the fit."""
    search_least: float = 0.003
    """Least such spread [m]."""
    search_most: float = 0.012
    """Largest such spread [m]."""
    free_coordinates: float = 20.0
    """Degrees of freedom that a pose takes from the coordinates of its points, in effect."""
    least_spread: float = 0.0003
    """Least spread that is estimated from a fit [m]."""
    most_rms: float = 0.008
    """RMS distance beyond which a pose is rejected [m]; Han et al. 2018, section 4.4."""
    least_score: float = 50.0
    """Least log-odds of a hand: about those of twelve points that are 5 mm off."""
    certain_score: float = 10.0
    """Log-odds per marker of a hand beyond doubt, after which no further cloud is tried."""
    known_spread_attempts: int = 60
    """Attempts in which a hand that was known must fit as well as it did before; half a second at 120 Hz."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_order("search_least", "search_most")


@dataclass(frozen=True)
class TrackConfig(_Settings):
    """Life of a track: when a pose is kept, and when a hand is initialized again (`track.tracker`)."""

    fewest_labels: int = 5
    """Labeled points from which on a pose is reliable."""
    longest_coast: float = 0.1
    """Time for which a pose is predicted without enough labels [s]."""
    doubt_share: float = _share(0.6)
    """A track with a smaller share of its markers labeled is doubted."""
    doubt_rms: float = 0.003
    """RMS distance, biases removed, from which on the track is doubted [m]."""
    doubt_radius: float = 0.2
    """Distance from the wrist within which points without a label confirm the doubt [m]."""
    doubt_time: float = 0.15
    """Time for which a track is doubted before the hand is initialized again [s]."""
    replacement_margin: float = 20.0
    """Log-odds by which another pose must be better to replace a doubted track."""


@dataclass(frozen=True)
class ReviewConfig(_Settings):
    """Reviews of a hand's labels by the labeler (`track.association.labeler_review`)."""

    radius: float = 0.06
    """Distance from a missing marker within which points without a label are shown to the labeler [m]."""
    first_wait: float = 0.01
    """Time from a review that changed something to the next one [s]."""
    wait_factor: float = 1.6
    """Factor of that time after each review that changed nothing."""
    longest_wait: float = 0.25
    """Longest time between two reviews [s]."""
    seen_elsewhere: float = _any_sign(-2.0)
    """Log probability that a point is a marker that the track saw elsewhere while this one was visible."""
    margin: float = 8.0
    """Log-odds by which the labeler's labels must be likelier than those of the track."""
    much_nearer: float = _share(0.85)
    """Largest share of a point's distance from a marker that is left without its bias, to doubt the bias."""
    moved_label: float = 2.0
    """Log-odds that a point keeps the label that it has."""
    persistence: float = 1.0
    """Log-odds that each earlier review with the same labels adds, which were likelier by less."""
    most_answer_log_odds: float = 7.0
    """Largest log-odds that the labeler's confidence in a label contributes."""


@dataclass(frozen=True)
class TrackerConfig(_Settings):
    """All settings of `track.Tracker`; `dataclasses.asdict` makes JSON of them.

    Each field is a dataclass whose fields state their units: lengths in [m], times in [s], angles in [rad].
    A tracked take records the settings that made it.

    Raises:
        ArgumentError: A number of a concern is not finite, not positive, or out of its range.
    """

    intake: IntakeConfig = IntakeConfig()
    """Checks of frames, before anything else."""
    solver: SolverConfig = SolverConfig()
    """Weights of the pose solver."""
    motion: MotionConfig = MotionConfig()
    """Process model: prediction of poses."""
    noise: NoiseConfig = NoiseConfig()
    """Measurement model: spread and bias of markers."""
    presence: PresenceConfig = PresenceConfig()
    """When markers come back, and how long strays live."""
    linking: LinkingConfig = LinkingConfig()
    """Numbers of points in streams without lasting IDs."""
    gating: GatingConfig = GatingConfig()
    """Tests of labels that go along with IDs."""
    association: AssociationConfig = AssociationConfig()
    """Association of new points with markers."""
    review: ReviewConfig = ReviewConfig()
    """Reviews of labels by the labeler."""
    initialization: InitializationConfig = InitializationConfig()
    """Hands without any history."""
    track: TrackConfig = TrackConfig()
    """When a pose is kept, doubted and given up."""
