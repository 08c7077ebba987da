"""`Registration`: the pose, the lens and the clock of the camera that filmed the hands of a take.

The clock is searched first: for each shift of it, an affine camera is fitted to the keypoints of a detector.
For the best shifts PnP estimates the pose for a few focal lengths, and bundle adjustment over all frames
refines clock, lens and pose together. Detected keypoints are several pixels off, but the outlines of hands
are located within half a pixel. Outlines therefore select the shift, and the last adjustments use them alone.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from film.bundle import (
    CENTER,
    DRIFT,
    FEWEST_KEYPOINTS,
    FOCAL,
    OFFSET,
    POSES,
    READOUT,
    USUAL_CENTER,
    Bundle,
    Detections,
    FoundFrame,
    Samples,
    State,
)
from film.outlines import Outlines, OutlineSight, without_lens
from gloves.takes.take import Take
from handsim.callbacks import Progress, no_progress
from handsim.errors import HandSimError
from handsim.hand.shape import SIDES
from handsim.pages import coordinates
from handsim.space.camera import Camera
from render.frames import Bytes, Doubles

_FEWEST_FRAMES: Final = 20  # least number of frames with a hand that a registration needs
_MOST_RESIDUAL_RATIO: Final = 3.0  # largest residual of a frame that fits, over the median residual
_LEAST_RESIDUAL_BOUND: Final = 0.008  # [widths of the picture] A frame with a smaller residual always fits.
_MOST_KEYPOINT_RESIDUAL: Final = 0.03  # [widths] largest median residual of keypoints of the right video
_MOST_POSITION_DEVIATION: Final = 0.05  # [m] largest standard deviation of a camera's position
_LEAST_SHARE: Final = 0.5  # share of the frames with hands that must fit; of wrong cameras 40 % did
_MOST_SPANS: Final = 4  # largest number of spans in each of which the camera stands still
_CHANGE_ITERATIONS: Final = 4  # number of searches for the first frame of a new span
_SPLIT_COST_SHARE: Final = 0.9  # A span is split if this reduces the cost below this share.
_SHORTEST_SPAN: Final = 20  # smallest number of frames in a span
_NO_HAND: Final = "the take has no hand then"
_OUTSIDE: Final = "no hand of the take is in the picture"
_FEWEST_EDGES: Final = 15  # least number of edges of an outline that is judged
_LEAST_SEEN_SHARE: Final = 0.4  # least visible share of an outline that is judged
_LEAST_BONE_LOG_ODDS: Final = -0.7  # least mean log-odds of the colors where the take has a bone
_MOST_OUTLINE_FRAMES: Final = 150  # largest number of frames whose outlines are used
_REACHES: Final = (0.04, 0.02, 0.01, 0.01)  # [widths] search ranges for edges, one for each round
_FIRST_NOISE: Final = 2.0  # [px] standard deviation of edges in the first round
_SHIFT_STEP: Final = 1.0 / 15.0  # [s] step between the shifts of the clock
_MOST_MATCHED: Final = 64  # largest number of detections that are matched
_NOWHERE: Final = 1e3  # [m] coordinate of hands that the take does not have
_MOST_SHIFTS: Final = 5  # number of the best shifts of the clock for which PnP is solved
_FRAMES_A_HYPOTHESIS: Final = 30  # number of frames whose outlines judge a hypothesis
_AGREEMENT_DISTANCE: Final = 0.004  # [widths] largest distance of an edge that agrees with an outline
_LEAST_AGREEMENT: Final = 0.5  # share of the outlines; of wrong clocks and cameras it was 0.01 to 0.39
_RIVAL_SHARE: Final = 0.8  # largest agreement of another clock, over that of the best
_MOST_JACKKNIFE_RESIDUAL: Final = 0.003  # [widths] largest median residual of a part that is held out
_DEVIATION_FACTOR: Final = 2.0
"""Factor on standard deviations, because errors of a hand's shape are the same in all frames.

In six videos of another renderer errors were up to 1.5 times the deviations with it, and 2.9 times without.
"""
_ZOOMED: Final = 3.0  # [standard deviations] largest difference of the focal lengths of spans
_SAME_CLOCK, _SAME_DIRECTION = 0.05, 0.1  # [s], [rad] Smaller differences make two hypotheses the same.
_STILL_AGREEMENT: Final = 0.7  # A camera with at least this agreement is taken to have stood still.
_LEAST_SHIFT_GAP: Final = 0.3  # [s] least distance of two shifts for which PnP is solved
_FOCALS: Final = (0.5, 0.65, 0.85, 1.1, 1.45, 1.9, 2.5, 3.3)  # [picture widths] focal lengths that PnP tries
_GATE: Final = 0.08  # [widths] largest median distance between a detection and the hand that it shows
_NO_MATCH: Final = (
    "the hands in the video do not move as those of the take at any shift of the clock; expected a video of "
    "this take, cut to its time, of a camera that stood still"
)
_CAMERA_CHANGED: Final = (
    "the camera's {} is not the same in all of the video; expected one focal length, no image stabilization, "
    "and a camera that is pushed three times at most: cut the video, and register the parts"
)
_SLOW_MOTION: Final = (
    "the hands in the video move {0} times as slowly as those of the take: is it slow motion? Make it {0} "
    "times as fast: ffmpeg -itsscale {1:.6g} -i slow.mp4 -an -c copy true.mp4"
)
_SLOW_MOTION_RATIOS: Final = (2, 4, 5, 8, 10, 16, 20, 32)
"""Usual ratios of the playing time of slow motion to the time that it took."""

_NumberedPictures = list[tuple[int, Bytes]]


class _NoMatchError(HandSimError):
    """The hands in the video do not move as those of the take."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The camera of a video, its clock, and how well each frame fits.

    The time of the take is `offset + (1 + drift) time` of the video in the middle of the picture.
    """

    cameras: tuple[Camera, ...]
    """One for each span of time in which the camera did not move."""
    starts: tuple[int, ...]
    """Number of the video's first frame of each span."""
    offset: float
    """[s]."""
    drift: float
    readout: tuple[float, float]
    """How much later the right edge is read than the left one, and the lower edge than the upper one [s]."""
    deviations: dict[str, float]
    """Standard deviations: offset and readout [s], drift, focal [share], center [px], position [m],
    rotation [rad]."""
    times: Float[np.ndarray, "F"]
    """Time of each frame in the video [s]."""
    distances: Float[np.ndarray, "F"]
    """Median distance of the found outlines, or keypoints, from the take's [px]; NaN where none are found."""
    reasons: tuple[str, ...]
    """Why each frame does not count; empty where it does."""

    def camera_of(self, number: int) -> Camera:
        """The camera of a frame of the video."""
        return self.cameras[int(np.searchsorted(self.starts, number, side="right")) - 1]

    def left_out(self) -> list[str]:
        """How many frames do not count, and why."""
        told = sorted(set(self.reasons) - {""})
        return [f"{self.reasons.count(reason)} frames: {reason}" for reason in told]

    def residual(self) -> float:
        """Median of the distances in the frames that count [px]."""
        return float(np.median(self.distances[np.array(self.reasons) == ""]))

    def doubts(self) -> list[str]:
        """Sentences on what the hands determine badly."""
        known = self.deviations
        when = ", ".join(f"{self.times[start]:.1f} s" for start in self.starts[1:])
        sentences = {
            f"The focal length is known to {100 * known['focal']:.1f} % only: the hands hardly move towards "
            "the camera and away from it.": known["focal"] > 0.01,
            f"The clock is known to {1e3 * known['offset']:.1f} ms only: the hands hardly move.":
                known["offset"] > 0.003,
            f"The lens's center is known to {known['center']:.1f} px only: it is near the picture's middle.":
                known["center"] > 0.7 * USUAL_CENTER * self.cameras[0].size[0],
            f"The camera's position is known to {1e3 * known['position']:.1f} mm only.":
                known["position"] > 0.004,
            f"The camera was moved at {when}: there are {len(self.cameras)} spans, each with its pose.":
                len(self.cameras) > 1,
        }  # fmt: skip
        return [sentence for sentence, holds in sentences.items() if holds]

    def figures(self) -> list[tuple[str, str, str]]:
        """A table of clock, lens and camera positions: rows of a name, a value and its standard deviation."""
        known, camera = self.deviations, self.cameras[0]
        readout = " ".join(f"{1e3 * one:.1f}" for one in self.readout)
        rows = [
            ("", "value", "standard deviation"),
            ("offset of the clock", f"{self.offset:.4f} s", f"{1e3 * known['offset']:.1f} ms"),
            ("drift of the clock", f"{1e6 * self.drift:.0f} ppm", f"{1e6 * known['drift']:.0f} ppm"),
            ("readout, across and down", f"{readout} ms", f"{1e3 * known['readout']:.1f} ms"),
            ("focal length", f"{camera.focal_length:.1f} px", f"{100 * known['focal']:.2f} %"),
            ("center", f"{coordinates(camera.K[:2, 2])} px", f"{known['center']:.1f} px"),
            ("lens", " ".join([camera.lens.kind, coordinates(camera.lens.coefficients)]), ""),
        ]
        deviation = f"{1e3 * known['position']:.1f} mm, {np.rad2deg(known['rotation']):.2f} degrees"
        for number, one in enumerate(self.cameras, 1):
            position = f"{coordinates(one.T_world_camera[:3, 3])} m"
            rows.append((f"position in span {number}", position, deviation))
        return rows

    def record(self) -> dict[str, Any]:
        """The registration as JSON."""
        return {
            "cameras": [camera.record() for camera in self.cameras],
            **{name: getattr(self, name) for name in ("starts", "offset", "drift", "readout", "deviations")},
            "frames": len(self.reasons),
            "frames_that_count": self.reasons.count(""),
            "left_out": self.left_out(),
            "doubts": self.doubts(),
        }


def register(
    take: Take,
    frames: Sequence[FoundFrame],
    size: tuple[int, int],
    known_camera: Camera | None = None,
    pictures: Callable[[], Iterable[Bytes]] | None = None,
    progress: Progress = no_progress,
) -> Registration:
    """Register a video of this size [px], in whose frames a detector found hands, to a take.

    A `known_camera` has the lens of the video's. `pictures` returns all frames, for the outlines of the
    hands; without it only the keypoints are used, which are much coarser.
    """
    try:
        return _register(take, frames, size, known_camera, pictures, progress)
    except _NoMatchError as error:
        if ratio := _slow_motion_ratio(take, frames, size, known_camera):
            raise HandSimError(_SLOW_MOTION.format(ratio, 1.0 / ratio)) from error
        raise


def _slow_motion_ratio(
    take: Take, frames: Sequence[FoundFrame], size: tuple[int, int], known_camera: Camera | None
) -> int:
    """Ratio by which a video is too slow; 0 if the hands of the take fit at no usual ratio."""
    videos = {ratio: [one._replace(time=one.time / ratio) for one in frames] for ratio in _SLOW_MOTION_RATIOS}
    bundles = {ratio: Bundle(take, Detections.of(one), size, known_camera) for ratio, one in videos.items()}
    best = max(_SLOW_MOTION_RATIOS, key=lambda ratio: _shifts(bundles[ratio])[0][0])
    try:
        _register(take, videos[best], size, known_camera)
    except HandSimError:
        return 0
    return best


def _register(
    take: Take,
    frames: Sequence[FoundFrame],
    size: tuple[int, int],
    known_camera: Camera | None,
    pictures: Callable[[], Iterable[Bytes]] | None = None,
    progress: Progress = no_progress,
) -> Registration:
    """Register a video that is no slow motion."""
    detections, width = Detections.of(frames), size[0]
    bundle = Bundle(take, detections, size, known_camera)
    with_hands, searched = (len(np.unique(one)) for one in (detections.frames, detections.searched))
    if with_hands < _FEWEST_FRAMES:
        raise HandSimError(
            f"hands were found in {with_hands} of the {searched} frames that were searched, expected "
            f"{_FEWEST_FRAMES} at least: hands that fill a third of the picture's height, for some seconds"
        )
    looks = _shrunk_pictures(bundle, pictures) if pictures else []
    hypotheses = _hypotheses(bundle, looks, progress)
    best = hypotheses[0]
    if looks and best.agreement < _LEAST_AGREEMENT:
        raise _NoMatchError(_NO_MATCH)
    _check_margin(bundle, hypotheses)
    outlined = _adjust_to_outlines(bundle, best.state, looks, pictures, progress) if pictures else None
    if outlined is None and best.noise > _MOST_KEYPOINT_RESIDUAL * width:
        raise _NoMatchError(_NO_MATCH)
    state, covariance, fit = outlined or (best.state, best.covariance, _keypoint_fit(bundle, best.state))
    if fit.reasons.count("") < _LEAST_SHARE * np.isin(detections.searched, detections.frames).sum():
        raise _NoMatchError(_NO_MATCH)
    (offset, drift), deviations = bundle.clock(state), np.sqrt(np.diag(covariance))
    unknowns: dict[str, int | slice] = {"offset": OFFSET, "drift": DRIFT, "readout": READOUT, "focal": FOCAL}
    known = {name: float(np.max(deviations[numbers])) for name, numbers in unknowns.items()}
    poses = np.linalg.norm(deviations[POSES:].reshape(-1, 2, 3), axis=2)
    known["center"] = float(width * min(USUAL_CENTER, np.max(deviations[CENTER])))
    known["rotation"], known["position"] = poses.max(axis=0).tolist()  # of the span that is known least
    if known["position"] > _MOST_POSITION_DEVIATION:
        raise HandSimError(
            f"the hands determine the camera's position to {1e3 * known['position']:.0f} mm only; expected "
            "hands that move in all directions, and a longer video"
        )
    across, down = state.values[READOUT].tolist()
    clock = offset, drift, (across, down)
    cameras, reasons = tuple(bundle.cameras(state)), tuple(fit.reasons)
    return Registration(cameras, state.starts, *clock, known, detections.times, fit.distances, reasons)


def _adjust_to_keypoints(bundle: Bundle, state: State, *, splits: bool) -> tuple[State, Doubles, float]:
    """Match and adjust three times; return the state, its covariance, and the noise of keypoints [px]."""
    noise = 0.25 * _GATE * bundle.size[0]
    for iteration in range(3):
        if iteration > 0 and splits:
            state = _split_spans(bundle, state, noise)
        matches = bundle.match(state, max(4.0 * noise, 0.5 * _GATE * bundle.size[0]))
        if (matches.numbers >= 0).sum() < _FEWEST_FRAMES:
            raise _NoMatchError(_NO_MATCH)
        state, _, covariance = bundle.solve(state, bundle.samples(matches), noise)
        distances = bundle.match(state, np.inf).distances
        if np.isnan(distances).all():  # the camera looks away from the hands
            raise _NoMatchError(_NO_MATCH)
        noise = max(float(np.nanmedian(distances)) / 1.177, 0.3)
    return state, covariance, noise


class _Hypothesis(NamedTuple):
    """A clock and a camera that may be the video's."""

    agreement: float  # share of the outlines, or of the detections, that it explains
    state: State
    covariance: Doubles
    noise: float  # noise of keypoints [px]


def _hypotheses(bundle: Bundle, looks: _NumberedPictures, progress: Progress) -> list[_Hypothesis]:
    """Candidates for the video's clock and camera, best first; one camera that moves if none stands still."""
    some = looks[:: max(1, len(looks) // _FRAMES_A_HYPOTHESIS)]
    judged: list[tuple[_Hypothesis, State]] = []
    guesses, frames = _first_guesses(bundle), len(bundle.detections.times)

    def judge(start: State, *, splits: bool) -> None:
        with contextlib.suppress(HandSimError):  # A hypothesis that fails must not end the others.
            state, covariance, noise = _adjust_to_keypoints(bundle, start, splits=splits)
            if any(_are_same(bundle, state, one.state) for one, _ in judged):
                return
            agreement, state = _agreement(bundle, state, some)
            judged.append((_Hypothesis(agreement, state, covariance, noise), start))

    for number, start in enumerate(guesses):
        judge(start, splits=False)
        progress((number + 1) * frames // len(guesses), 2 * frames)
    judged.sort(key=lambda one: -one[0].agreement)
    if not judged or not looks or judged[0][0].agreement < _STILL_AGREEMENT:
        judge(judged[0][1] if judged else guesses[0], splits=True)
    if not judged:
        raise _NoMatchError(_NO_MATCH)
    return sorted((one for one, _ in judged), key=lambda one: -one.agreement)


def _agreement(bundle: Bundle, state: State, looks: _NumberedPictures) -> tuple[float, State]:
    """Share of the hands' outlines that lie on edges of the pictures, and the state adjusted to these edges.

    Without pictures, the mean agreement of the keypoints replaces the share, and the state is kept.
    """
    if not looks:
        away = bundle.match(state, np.inf).distances / (_GATE * bundle.size[0])
        return float(np.nansum((1.0 - away).clip(min=0.0)) / len(bundle.detections.frames)), state
    outlines, share = Outlines(bundle), 0.0
    for reach in _REACHES[:3]:
        samples, seen = outlines.edges(state, looks, reach)
        if samples is None:
            return 0.0, state
        state, *_ = bundle.solve(state, samples, _FIRST_NOISE, first=True)
        near = np.abs(bundle.residuals(state, samples, 1.0)) < _AGREEMENT_DISTANCE * bundle.size[0]
        share = float(near.sum() / np.nansum(seen.tried))
    return share, state


def _check_margin(bundle: Bundle, hypotheses: list[_Hypothesis]) -> None:
    """Raise if another clock or camera explains nearly as much as the best.

    Hypotheses with the same clock and direction count as one: a longer search would make them equal.
    """
    best = hypotheses[0]
    for other in hypotheses[1:]:
        first, second = Rotation.from_rotvec([one.state.pose(0)[:3] for one in (best, other)])
        alike = _have_one_clock(bundle, best.state, other.state) and (
            (first.inv() * second).magnitude() < _SAME_DIRECTION or best.state.starts != other.state.starts
        )
        if not alike and other.agreement > _RIVAL_SHARE * best.agreement:
            (clock, _), (another, _) = bundle.clock(best.state), bundle.clock(other.state)
            raise HandSimError(
                f"cameras with the clock at {clock:.2f} and at {another:.2f} s explain "
                f"{100 * best.agreement:.0f} and {100 * other.agreement:.0f} % of the hands in the video; "
                "expected hands that move in all directions without repeating themselves, and a longer video"
            )


def _first_guesses(bundle: Bundle) -> list[State]:
    """States from the shifts of the clock that explain most detections, with poses by PnP."""
    gate, guesses, chosen = _GATE * bundle.size[0], list[State](), list[float]()
    for _, shift in _shifts(bundle):
        if len(chosen) < _MOST_SHIFTS and all(abs(shift - other) >= _LEAST_SHIFT_GAP for other in chosen):
            chosen.append(shift)
    for shift in chosen:
        # The fit is computed again, because the fits of all shifts together would fill the memory.
        start = _pnp_state(bundle, shift, *_affine_fit(bundle, shift)[1:])
        if start is None:
            continue
        samples = bundle.samples(bundle.match(start, gate))
        state, *_ = bundle.solve(start, samples, 0.01 * bundle.size[0], first=True)
        if not any(_are_same(bundle, state, other) for other in guesses):
            guesses.append(state)
    if not guesses:
        raise _NoMatchError(_NO_MATCH)
    return guesses


def _are_same(bundle: Bundle, one: State, other: State) -> bool:
    """Whether two states have the same clock, the same spans and nearly the same position of the camera."""
    near = np.linalg.norm(one.pose(0)[3:] - other.pose(0)[3:]) < _MOST_POSITION_DEVIATION
    return one.starts == other.starts and bool(near) and _have_one_clock(bundle, one, other)


def _have_one_clock(bundle: Bundle, one: State, other: State) -> bool:
    """Whether two states have the same clock at both ends of the video."""
    return bool(np.abs(bundle.times(one) - bundle.times(other))[[0, -1]].max() < _SAME_CLOCK)


def _shifts(bundle: Bundle) -> list[tuple[float, float]]:
    """Shifts of the clock after the number of detections that an affine camera explains; best first."""
    taken, filmed = bundle.take.times, bundle.detections.times
    shifts = np.arange(taken[0] - filmed[-1], taken[-1] - filmed[0], _SHIFT_STEP).tolist()
    return sorted(((_affine_fit(bundle, shift)[0], shift) for shift in shifts), reverse=True)


def _affine_fit(bundle: Bundle, offset: float) -> tuple[float, Doubles, Doubles]:
    """Number of detections that an affine camera explains, their keypoints (N, 3) [m], and pixels (N, 2).

    The first round takes the side of each detection from the detector, if the take has that hand. Later
    rounds assign each detection to the nearest hand in the picture, because detectors often confuse sides.
    """
    detections, sides = bundle.detections, np.array([SIDES.index(side) for side in bundle.take.sides])
    some = np.unique(np.linspace(0, len(detections.frames) - 1, _MOST_MATCHED).astype(int))
    pixels, weights = detections.pixels[some], detections.weights[some]
    times = detections.times[detections.frames[some]] + offset
    points = np.nan_to_num(bundle.keypoints(times), nan=_NOWHERE)  # (N, H, 21, 3)
    there = points[..., 0, 0] != _NOWHERE
    rows = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
    detected = there & (sides == detections.sides[some, None])
    hand = np.where(detected.any(axis=1), detected.argmax(axis=1), there.argmax(axis=1))
    each = np.arange(len(some))
    counts = there[each, hand].astype(float)
    for _ in range(4):
        own = rows[each, hand]
        weighted = own * (weights * counts[:, None])[..., None]
        normal = np.einsum("nki,nkj->ij", weighted, own) + 1e-6 * np.eye(4)
        affine = np.linalg.solve(normal, np.einsum("nki,nkj->ij", weighted, pixels))
        errors = np.linalg.norm(rows @ affine - pixels[:, None], axis=-1)
        errors = (errors * weights[:, None]).sum(axis=-1) / weights.sum(axis=1)[:, None]
        distances = np.where(there, errors, np.inf)
        hand = distances.argmin(axis=1)
        counts = 1.0 / (1.0 + (distances.min(axis=1) / (2.0 * _GATE * bundle.size[0])) ** 2)
    sure = (weights > 0.0) & there[each, hand, None]
    return float(counts.sum()), points[each, hand][sure], pixels[sure]


def _pnp_state(bundle: Bundle, offset: float, points: Doubles, pixels: Doubles) -> State | None:
    """The state with the focal length and pose that explain most keypoints by PnP, or None."""
    if bundle.known_camera is not None:  # PnP needs the pixels of a pinhole camera
        pixels = (
            without_lens(bundle.known_camera).at(np.eye(4)).project(bundle.known_camera.unproject(pixels))
        )
        seen = np.isfinite(pixels[:, 0])
        points, pixels = points[seen], pixels[seen]
    if len(points) < 6 * FEWEST_KEYPOINTS:
        return None
    best, most = None, 0
    for focal in _FOCALS if bundle.known_camera is None else (1.0,):
        values = np.zeros(POSES + 6)
        values[OFFSET], values[FOCAL] = offset, np.log(focal)
        try:
            solved, vector, shift, inliers = cv2.solvePnPRansac(
                points, pixels, bundle.cameras(State(values))[0].K, None, iterationsCount=300,
                reprojectionError=0.025 * bundle.size[0], flags=cv2.SOLVEPNP_EPNP,
            )  # fmt: skip
        except cv2.error:  # RANSAC drew degenerate points
            continue
        if solved and inliers is not None and len(inliers) > most:
            rotation = Rotation.from_rotvec(-vector.ravel())
            values[POSES:] = np.concatenate([rotation.as_rotvec(), -rotation.apply(shift.ravel())])
            best, most = State(values), len(inliers)
    return best


def _shrunk_pictures(bundle: Bundle, pictures: Callable[[], Iterable[Bytes]]) -> _NumberedPictures:
    """Numbered and shrunk pictures of some frames in which hands were found."""
    outlines, shown = Outlines(bundle), np.unique(bundle.detections.frames)
    chosen = set(shown[np.linspace(0, len(shown) - 1, _MOST_OUTLINE_FRAMES).astype(int)].tolist())
    return [(n, outlines.shrunk(picture)) for n, picture in enumerate(pictures()) if n in chosen]


def _adjust_to_outlines(
    bundle: Bundle,
    state: State,
    looks: _NumberedPictures,
    pictures: Callable[[], Iterable[Bytes]],
    progress: Progress,
) -> tuple[State, Doubles, _Fit] | None:
    """Adjust the state to the outlines of the hands; None where too little of them is seen."""
    outlines, noise = Outlines(bundle), _FIRST_NOISE
    for iteration, reach in enumerate(_REACHES):
        edges, _ = outlines.edges(state, looks, reach)
        if edges is None or len(edges.frames) < _FEWEST_EDGES * _FEWEST_FRAMES:
            return None
        samples = edges
        state, _, covariance = bundle.solve(state, samples, noise, first=iteration == 0)
        noise = max(0.3, float(np.median(np.abs(bundle.residuals(state, samples, 1.0)))) / 0.6745)
    deviations, worst_residual = bundle.jackknife(state, samples, noise)
    if worst_residual > _MOST_JACKKNIFE_RESIDUAL * bundle.size[0]:
        raise HandSimError(_CAMERA_CHANGED.format("place or zoom"))
    covariance = _DEVIATION_FACTOR**2 * np.diag(np.maximum(np.diag(covariance), deviations**2))
    if len(state.starts) > 1 and _zoomed(bundle, state, samples, noise):
        raise HandSimError(_CAMERA_CHANGED.format("focal length"))
    frames = len(bundle.detections.times)

    def every() -> Iterator[tuple[int, Bytes]]:
        for number, picture in enumerate(pictures()):
            progress(frames + number + 1, 2 * frames)
            yield number, outlines.shrunk(picture)

    _, seen = outlines.edges(state, every(), _REACHES[1])
    return state, covariance, _outline_fit(bundle, seen, _keypoint_fit(bundle, state))


def _zoomed(bundle: Bundle, state: State, samples: Samples, noise: float) -> bool:
    """Whether the focal lengths differ between spans that are adjusted separately."""
    spans, focals, variances = state.spans(samples.frames), [], []
    for span in range(len(state.starts)):
        alone = samples._replace(normals=np.where((spans == span)[:, None], samples.normals, 0.0))
        solution, _, covariance = bundle.solve(state, alone, noise)
        focals.append(solution.values[FOCAL])
        variances.append(covariance[FOCAL, FOCAL])
    return bool(np.ptp(focals) > _ZOOMED * np.sqrt(np.sum(variances)))


def _split_spans(bundle: Bundle, state: State, noise: float) -> State:
    """Add a span to the state for each time at which the camera was moved."""
    while len(state.starts) < _MOST_SPANS:
        samples = bundle.samples(bundle.match(state, 0.3 * bundle.size[0]))
        before = bundle.solve(state, samples, noise, first=True)[1]
        cuts = [_split_span(bundle, state, span, samples, noise) for span in range(len(state.starts))]
        cost, split = min(cuts, key=lambda cut: cut[0])
        if cost > _SPLIT_COST_SHARE * before:
            break
        state = split
    return state


def _split_span(
    bundle: Bundle, state: State, span: int, samples: Samples, noise: float
) -> tuple[float, State]:
    """Split a span, first in its middle; return the cost and the state with both parts."""
    first, last = (*state.starts, len(bundle.detections.times))[span : span + 2]
    if last - first < 2 * _SHORTEST_SPAN:
        return np.inf, state
    values, change = np.insert(state.values, POSES + 6 * span, state.pose(span)), (first + last) // 2
    for _ in range(_CHANGE_ITERATIONS):
        split = State(values, (*state.starts[: span + 1], change, *state.starts[span + 1 :]))
        split, cost, _ = bundle.solve(split, samples, noise, first=True)
        values, change = split.values, _better_change(bundle, split, span, first, last)
    return cost, split


def _better_change(bundle: Bundle, state: State, span: int, first: int, last: int) -> int:
    """The first frame in which the camera of the next span fits better than the camera of this span."""
    alone = (State(np.append(state.values[:POSES], state.pose(number))) for number in (span, span + 1))
    early, late = (np.fmin.reduce(bundle.match(one, np.inf).distances, axis=1) for one in alone)
    votes = np.sign(np.nan_to_num(early - late))[first:last]
    return int(np.clip(first + np.cumsum(votes).argmin() + 1, first + _SHORTEST_SPAN, last - _SHORTEST_SPAN))


class _Fit(NamedTuple):
    """Residual of each frame, and the reasons why frames do not fit, as in `Registration`."""

    distances: Doubles
    reasons: list[str]


def _keypoint_fit(bundle: Bundle, state: State) -> _Fit:
    """Judge frames by their keypoints, or by those of the nearest frame that the detector searched."""
    pixels = bundle.projected_keypoints(state)
    matches = bundle.match(state, 0.25 * bundle.size[0])  # Hands that are farther are somebody else's.
    tracked = np.isfinite(pixels[..., 0]).any(axis=(1, 2))
    inside = ((pixels >= 0.0) & (pixels < bundle.size)).all(axis=-1).sum(axis=-1) >= FEWEST_KEYPOINTS
    bound = max(
        _MOST_RESIDUAL_RATIO * float(np.nanmedian(matches.distances)), _LEAST_RESIDUAL_BOUND * bundle.size[0]
    )
    distances = np.fmax.reduce(matches.distances, axis=1)[bundle.detections.searched]
    cases = {
        _NO_HAND: ~tracked,
        _OUTSIDE: ~inside.any(axis=1),
        "the detector found no hand there": np.isnan(distances),
        f"keypoints are more than {bound:.1f} px off": distances > bound,
    }
    return _Fit(distances, np.select(list(cases.values()), list(cases), "").tolist())


def _outline_fit(bundle: Bundle, seen: OutlineSight, fit: _Fit) -> _Fit:
    """Judge frames by their outlines, or by their keypoints where hardly an outline is seen."""
    judged = seen.found >= np.maximum(_FEWEST_EDGES, _LEAST_SEEN_SHARE * seen.tried)
    middle, most = (np.where(judged, one, np.nan) for one in (seen.middle, seen.most))
    usual = float(np.nanmedian(most)) if judged.any() else 0.0
    least = 0.5 * _LEAST_RESIDUAL_BOUND * bundle.size[0]
    bound = min(max(_MOST_RESIDUAL_RATIO * usual, least), 2.0 * least)
    whole = judged.any(axis=1) & (judged | ~(seen.tried > 0.0)).all(axis=1)
    cases = {
        f"the hand's outline is more than {bound:.1f} px off": (most > bound).any(axis=1),
        "the picture has other colors where a finger should be": (seen.odds < _LEAST_BONE_LOG_ODDS).any(
            axis=1
        ),
        "": whole,
    }
    reasons = np.select(list(cases.values()), list(cases), fit.reasons)
    distances = np.where(judged.any(axis=1), np.fmax.reduce(middle, axis=1), fit.distances)
    return _Fit(distances, reasons.tolist())
