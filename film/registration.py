"""`Registration`: where the camera stood that filmed the hands of a take, its lens and its clock.

The clock comes first: for each shift of it, an affine camera is fitted to the keypoints that a detector
found. For the best shifts PnP finds the pose for a few focal lengths, and a bundle over all frames refines
clock, lens and pose at once. Keypoints of a detector are several pixels off. The outlines of the hands are
seen within half a pixel: they decide between the shifts, and the last bundles are of them.
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
from film.outlines import Outlines, Seen, straight
from gloves.takes.take import Take
from handsim.callbacks import Progress, no_progress
from handsim.errors import HandSimError
from handsim.hand.shape import SIDES
from handsim.pages import coordinates
from handsim.space.camera import Camera
from render.frames import Bytes, Doubles

_FEWEST_FRAMES: Final = 20  # A camera is registered from this many frames with a hand.
_BOUND: Final = 3.0  # A frame does not fit beyond this many times the usual median distance.
_LEAST_BOUND: Final = 0.008  # A frame fits up to this distance in any case [widths of the picture].
_WORST: Final = 0.03  # [widths] A video whose usual median distance is larger does not show the take.
_UNKNOWN: Final = 0.05  # [m] A camera whose place has a larger deviation is not known.
_LEAST_SHARE: Final = 0.5  # This share of the frames with hands must fit; of wrong cameras 40 % did.
_MOST_SPANS: Final = 4  # largest number of spans in each of which the camera stands still
_MOVES: Final = 4  # number of times that the beginning of a new span is looked for
_LOWER: Final = 0.9  # A span is cut in two if the cost is then less than this share of what it was.
_SHORTEST_SPAN: Final = 20  # smallest number of frames in a span
_NO_HAND: Final = "the take has no hand then"
_OUTSIDE: Final = "no hand of the take is in the picture"
_FEWEST_EDGES: Final = 15  # A hand's outline is judged by this many edges.
_SEEN: Final = 0.4  # A hand's outline is judged if this share of it is seen.
_BESIDE: Final = -0.7  # A bone with lower mean log-odds of its colors is not where the take says.
_MOST_LOOKED: Final = 150  # largest number of frames whose outlines are used
_REACHES: Final = (0.04, 0.02, 0.01, 0.01)  # [widths] search ranges for edges, one for each round
_FIRST_NOISE: Final = 2.0  # [px] standard deviation of edges in the first round
_STEP: Final = 1.0 / 15.0  # [s] step between the shifts of the clock
_MOST_MATCHED: Final = 64  # largest number of detections that are matched
_NOWHERE: Final = 1e3  # [m] where hands are that the take does not have
_TRIED: Final = 5  # PnP solves the camera for this many shifts of the clock, the best ones.
_SCREENED: Final = 30  # number of frames whose outlines judge a hypothesis
_NEAR: Final = 0.004  # [widths] An edge this near to an outline agrees.
_LEAST_AGREEMENT: Final = 0.5  # share of the outlines; of wrong clocks and cameras it was 0.01 to 0.39
_MARGIN: Final = 0.8  # Another clock explains at most this share of what the best does.
_SURPRISE: Final = 0.003  # [widths] Outlines of a part that was held out are at most this far off.
_DEVIATION_FACTOR: Final = 2.0
"""Deviations are this many times larger, as errors of a hand's shape are the same in all frames.

In six videos of another renderer errors were up to 1.5 times the deviations with it, and 2.9 times without.
"""
_ZOOMED: Final = 3.0  # Focal lengths of two spans differ by more than this many standard deviations.
_SAME_CLOCK, _SAME_WAY = 0.05, 0.1  # [s, rad]
_STILL: Final = 0.7  # No push is looked for if this share agrees with a camera that stood still.
_APART: Final = 0.3  # [s] least distance of two shifts for which PnP is tried
_FOCALS: Final = (0.5, 0.65, 0.85, 1.1, 1.45, 1.9, 2.5, 3.3)  # [picture widths] tried by PnP
_GATE: Final = 0.08  # [widths] A detection is not of a hand whose keypoints are farther off in the median.
_UNLIKE: Final = (
    "the hands in the video do not move as those of the take at any shift of the clock; expected a video of "
    "this take, cut to its time, of a camera that stood still"
)
_CHANGED: Final = (
    "the camera's {} is not the same in all of the video; expected one focal length, no image stabilization, "
    "and a camera that is pushed three times at most: cut the video, and register the parts"
)
_SLOW: Final = (
    "the hands in the video move {0} times as slowly as those of the take: is it slow motion? Make it {0} "
    "times as fast: ffmpeg -itsscale {1:.6g} -i slow.mp4 -an -c copy true.mp4"
)
_RATIOS: Final = (2, 4, 5, 8, 10, 16, 20, 32)
"""How many times as slowly as it was taken slow motion is stored."""


_Looks = list[tuple[int, Bytes]]


class _UnlikeError(HandSimError):
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
        """What the hands tell badly, as sentences."""
        found = self.deviations
        when = ", ".join(f"{self.times[start]:.1f} s" for start in self.starts[1:])
        told = {
            f"The focal length is known to {100 * found['focal']:.1f} % only: the hands hardly move towards "
            "the camera and away from it.": found["focal"] > 0.01,
            f"The clock is known to {1e3 * found['offset']:.1f} ms only: the hands hardly move.":
                found["offset"] > 0.003,
            f"The lens's center is known to {found['center']:.1f} px only: it is near the picture's middle.":
                found["center"] > 0.7 * USUAL_CENTER * self.cameras[0].size[0],
            f"The camera's place is known to {1e3 * found['position']:.1f} mm only.":
                found["position"] > 0.004,
            f"The camera was moved at {when}: there are {len(self.cameras)} spans, each with its pose.":
                len(self.cameras) > 1,
        }  # fmt: skip
        return [sentence for sentence, holds in told.items() if holds]

    def figures(self) -> list[tuple[str, str, str]]:
        """A table of clock, lens and camera places: rows of a name, a value and its standard deviation."""
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
        turn = f"{np.rad2deg(known['rotation']):.2f} degrees"
        for number, one in enumerate(self.cameras, 1):
            place = f"{coordinates(one.T_world_camera[:3, 3])} m"
            rows.append((f"place of span {number}", place, f"{1e3 * known['position']:.1f} mm, {turn}"))
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
    found: Sequence[FoundFrame],
    size: tuple[int, int],
    given: Camera | None = None,
    pictures: Callable[[], Iterable[Bytes]] | None = None,
    progress: Progress = no_progress,
) -> Registration:
    """The registration of a video of this size [px] in which a detector found hands.

    A `given` camera has the lens of the video's. Without `pictures`, the frames, for the outlines of the
    hands, keypoints alone tell the camera, which are much coarser.
    """
    try:
        return _register(take, found, size, given, pictures, progress)
    except _UnlikeError as error:
        if ratio := _slowed(take, found, size, given):
            raise HandSimError(_SLOW.format(ratio, 1.0 / ratio)) from error
        raise


def _slowed(take: Take, found: Sequence[FoundFrame], size: tuple[int, int], given: Camera | None) -> int:
    """How many times too slow a video's clock is; 0 if the hands of the take fit at no usual ratio."""
    videos = {ratio: [one._replace(time=one.time / ratio) for one in found] for ratio in _RATIOS}
    bundles = {ratio: Bundle(take, Detections.of(one), size, given) for ratio, one in videos.items()}
    best = max(_RATIOS, key=lambda ratio: _shifts(bundles[ratio])[0][0])
    try:
        _register(take, videos[best], size, given)
    except HandSimError:
        return 0
    return best


def _register(
    take: Take,
    found: Sequence[FoundFrame],
    size: tuple[int, int],
    given: Camera | None,
    pictures: Callable[[], Iterable[Bytes]] | None = None,
    progress: Progress = no_progress,
) -> Registration:
    """The registration of a video whose clock is right."""
    bundle, width = Bundle(take, Detections.of(found), size, given), size[0]
    with_hands, looked = (len(np.unique(one)) for one in (bundle.found.frames, bundle.found.looked))
    if with_hands < _FEWEST_FRAMES:
        raise HandSimError(
            f"hands were found in {with_hands} of the {looked} frames that were searched, expected "
            f"{_FEWEST_FRAMES} at least: hands that fill a third of the picture's height, for some seconds"
        )
    looks = _looks(bundle, pictures) if pictures else []
    tried = _hypotheses(bundle, looks, progress)
    best, state, covariance = tried[0], tried[0].state, tried[0].covariance
    if looks and best.agreement < _LEAST_AGREEMENT:
        raise _UnlikeError(_UNLIKE)
    _check_margin(bundle, tried)
    outlined = _outlined(bundle, state, looks, pictures, progress) if pictures else None
    if outlined is not None:
        state, covariance, fit = outlined
    elif best.noise > _WORST * width:
        raise _UnlikeError(_UNLIKE)
    else:
        fit = _keypoint_fit(bundle, state)
    if fit.reasons.count("") < _LEAST_SHARE * np.isin(bundle.found.looked, bundle.found.frames).sum():
        raise _UnlikeError(_UNLIKE)
    (offset, drift), deviations = bundle.clock(state), np.sqrt(np.diag(covariance))
    unknowns: dict[str, int | slice] = {"offset": OFFSET, "drift": DRIFT, "readout": READOUT, "focal": FOCAL}
    known = {name: float(np.max(deviations[numbers])) for name, numbers in unknowns.items()}
    poses = np.linalg.norm(deviations[POSES:].reshape(-1, 2, 3), axis=2)
    known["center"] = float(width * min(USUAL_CENTER, np.max(deviations[CENTER])))
    known["rotation"], known["position"] = poses.max(axis=0).tolist()  # of the span that is known least
    if known["position"] > _UNKNOWN:
        raise HandSimError(
            f"the hands tell the camera's place to {1e3 * known['position']:.0f} mm only; expected hands "
            "that move in all directions, and a longer video"
        )
    across, down = state.values[READOUT].tolist()
    return Registration(
        tuple(bundle.cameras(state)), state.starts, offset, drift, (across, down), known, bundle.found.times,
        fit.distances, tuple(fit.reasons),
    )  # fmt: skip


def _adjusted(bundle: Bundle, state: State, *, splits: bool) -> tuple[State, Doubles, float]:
    """The state after some rounds of matching keypoints, its covariance, and their noise [px]."""
    noise = 0.25 * _GATE * bundle.size[0]
    for turn in range(3):
        if turn > 0 and splits:
            state = _split(bundle, state, noise)
        matches = bundle.match(state, max(4.0 * noise, 0.5 * _GATE * bundle.size[0]))
        if (matches.numbers >= 0).sum() < _FEWEST_FRAMES:
            raise _UnlikeError(_UNLIKE)
        state, _, covariance = bundle.solve(state, bundle.samples(matches), noise)
        distances = bundle.match(state, np.inf).distances
        if np.isnan(distances).all():  # the camera looks away from the hands
            raise _UnlikeError(_UNLIKE)
        noise = max(float(np.nanmedian(distances)) / 1.177, 0.3)
    return state, covariance, noise


class _Hypothesis(NamedTuple):
    """A clock and a camera that may be the video's."""

    agreement: float  # share of what is seen that it explains
    state: State
    covariance: Doubles
    noise: float  # of keypoints [px]


def _hypotheses(bundle: Bundle, looks: _Looks, progress: Progress) -> list[_Hypothesis]:
    """What may be the video's clock and camera, best first; a push is looked for if no still camera fits."""
    some = looks[:: max(1, len(looks) // _SCREENED)]
    found: list[tuple[_Hypothesis, State]] = []
    guesses, frames = _first_guesses(bundle), len(bundle.found.times)

    def judge(start: State, *, splits: bool) -> None:
        with contextlib.suppress(HandSimError):  # the others are tried all the same
            state, covariance, noise = _adjusted(bundle, start, splits=splits)
            if any(_are_same(bundle, state, one.state) for one, _ in found):
                return
            agreement, state = _agreement(bundle, state, some)
            found.append((_Hypothesis(agreement, state, covariance, noise), start))

    for number, start in enumerate(guesses):
        judge(start, splits=False)
        progress((number + 1) * frames // len(guesses), 2 * frames)
    found.sort(key=lambda one: -one[0].agreement)
    if not found or not looks or found[0][0].agreement < _STILL:
        judge(found[0][1] if found else guesses[0], splits=True)
    if not found:
        raise _UnlikeError(_UNLIKE)
    return sorted((one for one, _ in found), key=lambda one: -one.agreement)


def _agreement(bundle: Bundle, state: State, looks: _Looks) -> tuple[float, State]:
    """The share of the hands' outlines that is where pictures have edges, and the state adjusted to these.

    Without pictures it is how near keypoints are.
    """
    if not looks:
        away = bundle.match(state, np.inf).distances / (_GATE * bundle.size[0])
        return float(np.nansum((1.0 - away).clip(min=0.0)) / len(bundle.found.frames)), state
    outlines, share = Outlines(bundle), 0.0
    for reach in _REACHES[:3]:
        samples, seen = outlines.edges(state, looks, reach)
        if samples is None:
            return 0.0, state
        state, *_ = bundle.solve(state, samples, _FIRST_NOISE, first=True)
        near = np.abs(bundle.residuals(state, samples, 1.0)) < _NEAR * bundle.size[0]
        share = float(near.sum() / np.nansum(seen.tried))
    return share, state


def _check_margin(bundle: Bundle, tried: list[_Hypothesis]) -> None:
    """Raise if another clock or camera explains nearly as much as the best.

    Hypotheses with the same clock and direction count as one: a longer search would make them equal.
    """
    best = tried[0]
    for other in tried[1:]:
        ways = Rotation.from_rotvec([one.state.pose(0)[:3] for one in (best, other)])
        alike = _have_one_clock(bundle, best.state, other.state) and (
            (ways[0].inv() * ways[1]).magnitude() < _SAME_WAY or best.state.starts != other.state.starts
        )
        if not alike and other.agreement > _MARGIN * best.agreement:
            (clock, _), (another, _) = bundle.clock(best.state), bundle.clock(other.state)
            raise HandSimError(
                f"cameras with the clock at {clock:.2f} and at {another:.2f} s explain "
                f"{100 * best.agreement:.0f} and {100 * other.agreement:.0f} % of the hands in the video; "
                "expected hands that move in all directions without repeating themselves, and a longer video"
            )


def _first_guesses(bundle: Bundle) -> list[State]:
    """Unknowns that explain much of what was found: clock by all shifts, pose by PnP."""
    gate, guesses = _GATE * bundle.size[0], list[State]()
    tried: list[float] = []
    # The best fits are computed again, because those of all shifts together would fill the memory.
    for _, shift in _shifts(bundle):
        if len(tried) == _TRIED:
            break
        if any(abs(shift - other) < _APART for other in tried):
            continue
        tried.append(shift)
        start = _posed(bundle, shift, *_affine_fit(bundle, shift)[1:])
        if start is None:
            continue
        samples = bundle.samples(bundle.match(start, gate))
        state, *_ = bundle.solve(start, samples, 0.01 * bundle.size[0], first=True)
        if not any(_are_same(bundle, state, other) for other in guesses):
            guesses.append(state)
    if not guesses:
        raise _UnlikeError(_UNLIKE)
    return guesses


def _are_same(bundle: Bundle, one: State, other: State) -> bool:
    """Whether two states have the same clock, the same spans and nearly the same place of the camera."""
    near = np.linalg.norm(one.pose(0)[3:] - other.pose(0)[3:]) < _UNKNOWN
    return one.starts == other.starts and bool(near) and _have_one_clock(bundle, one, other)


def _have_one_clock(bundle: Bundle, one: State, other: State) -> bool:
    """Whether two states have the same clock at both ends of the video."""
    return bool(np.abs(bundle.times(one) - bundle.times(other))[[0, -1]].max() < _SAME_CLOCK)


def _shifts(bundle: Bundle) -> list[tuple[float, float]]:
    """How many detections an affine camera explains at each shift of the clock, and the shift; best first."""
    taken, filmed = bundle.take.times, bundle.found.times
    shifts = np.arange(taken[0] - filmed[-1], taken[-1] - filmed[0], _STEP).tolist()
    return sorted(((_affine_fit(bundle, shift)[0], shift) for shift in shifts), reverse=True)


def _affine_fit(bundle: Bundle, offset: float) -> tuple[float, Doubles, Doubles]:
    """How many detections an affine camera explains at a shift, and their keypoints (N, 3) [m], (N, 2) [px].

    It begins with the sides that the detector told, where the take has them, and then gives each detection to
    the hand that is nearest in the picture: a detector is often wrong about sides.
    """
    found, sides = bundle.found, np.array([SIDES.index(side) for side in bundle.take.sides])
    some = np.unique(np.linspace(0, len(found.frames) - 1, _MOST_MATCHED).astype(int))
    pixels, weights = found.pixels[some], found.weights[some]
    times = found.times[found.frames[some]] + offset
    points = np.nan_to_num(bundle.keypoints(times), nan=_NOWHERE)  # (N, H, 21, 3)
    there = points[..., 0, 0] != _NOWHERE
    rows = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
    told = there & (sides == found.sides[some, None])
    hand, each = np.where(told.any(axis=1), told.argmax(axis=1), there.argmax(axis=1)), np.arange(len(some))
    counts = there[each, hand].astype(float)
    for _ in range(4):
        mine = rows[each, hand]
        weighted = mine * (weights * counts[:, None])[..., None]
        normal = np.einsum("nki,nkj->ij", weighted, mine) + 1e-6 * np.eye(4)
        affine = np.linalg.solve(normal, np.einsum("nki,nkj->ij", weighted, pixels))
        away = np.linalg.norm(rows @ affine - pixels[:, None], axis=-1)
        away = (away * weights[:, None]).sum(axis=-1) / weights.sum(axis=1)[:, None]
        distances = np.where(there, away, np.inf)
        hand = distances.argmin(axis=1)
        counts = 1.0 / (1.0 + (distances.min(axis=1) / (2.0 * _GATE * bundle.size[0])) ** 2)
    sure = (weights > 0.0) & there[each, hand, None]
    return float(counts.sum()), points[each, hand][sure], pixels[sure]


def _posed(bundle: Bundle, offset: float, points: Doubles, pixels: Doubles) -> State | None:
    """The focal length and pose by which most keypoints are explained, or None."""
    if bundle.given is not None:  # as a pinhole camera with its matrix sees them
        pixels = straight(bundle.given).at(np.eye(4)).project(bundle.given.unproject(pixels))
        seen = np.isfinite(pixels[:, 0])
        points, pixels = points[seen], pixels[seen]
    if len(points) < 6 * FEWEST_KEYPOINTS:
        return None
    best, most = None, 0
    for focal in _FOCALS if bundle.given is None else (1.0,):
        values = np.zeros(POSES + 6)
        values[OFFSET], values[FOCAL] = offset, np.log(focal)
        try:
            done, turn, shift, inliers = cv2.solvePnPRansac(
                points, pixels, bundle.cameras(State(values))[0].K, None, iterationsCount=300,
                reprojectionError=0.025 * bundle.size[0], flags=cv2.SOLVEPNP_EPNP,
            )  # fmt: skip
        except cv2.error:  # points of a degenerate draw
            continue
        if done and inliers is not None and len(inliers) > most:
            rotation = Rotation.from_rotvec(-turn.ravel())
            values[POSES:] = np.concatenate([rotation.as_rotvec(), -rotation.apply(shift.ravel())])
            best, most = State(values), len(inliers)
    return best


def _looks(bundle: Bundle, pictures: Callable[[], Iterable[Bytes]]) -> _Looks:
    """Numbered pictures, shrunk, of some frames in which hands were found."""
    outlines, shown = Outlines(bundle), np.unique(bundle.found.frames)
    chosen = set(shown[np.linspace(0, len(shown) - 1, _MOST_LOOKED).astype(int)].tolist())
    return [(n, outlines.shrunk(picture)) for n, picture in enumerate(pictures()) if n in chosen]


def _outlined(
    bundle: Bundle,
    state: State,
    looks: _Looks,
    pictures: Callable[[], Iterable[Bytes]],
    progress: Progress,
) -> tuple[State, Doubles, _Fit] | None:
    """State, covariance and fit by the outlines of the hands; None where they are not seen."""
    outlines, noise = Outlines(bundle), _FIRST_NOISE
    for turn, reach in enumerate(_REACHES):
        edges, _ = outlines.edges(state, looks, reach)
        if edges is None or len(edges.frames) < _FEWEST_EDGES * _FEWEST_FRAMES:
            return None
        samples = edges
        state, _, covariance = bundle.solve(state, samples, noise, first=turn == 0)
        noise = max(0.3, float(np.median(np.abs(bundle.residuals(state, samples, 1.0)))) / 0.6745)
    deviations, surprise = bundle.held_out(state, samples, noise)
    if surprise > _SURPRISE * bundle.size[0]:
        raise HandSimError(_CHANGED.format("place or zoom"))
    covariance = _DEVIATION_FACTOR**2 * np.diag(np.maximum(np.diag(covariance), deviations**2))
    if len(state.starts) > 1 and _zoomed(bundle, state, samples, noise):
        raise HandSimError(_CHANGED.format("focal length"))
    frames = len(bundle.found.times)

    def every() -> Iterator[tuple[int, Bytes]]:
        for number, picture in enumerate(pictures()):
            progress(frames + number + 1, 2 * frames)
            yield number, outlines.shrunk(picture)

    _, seen = outlines.edges(state, every(), _REACHES[1])
    return state, covariance, _outline_fit(bundle, seen, _keypoint_fit(bundle, state))


def _zoomed(bundle: Bundle, state: State, samples: Samples, noise: float) -> bool:
    """Whether spans, each by itself, have focal lengths that differ."""
    spans, focals, variances = state.spans(samples.frames), [], []
    for span in range(len(state.starts)):
        alone = samples._replace(normals=np.where((spans == span)[:, None], samples.normals, 0.0))
        found, _, covariance = bundle.solve(state, alone, noise)
        focals.append(found.values[FOCAL])
        variances.append(covariance[FOCAL, FOCAL])
    return bool(np.ptp(focals) > _ZOOMED * np.sqrt(np.sum(variances)))


def _split(bundle: Bundle, state: State, noise: float) -> State:
    """The state with a span more for each time at which the camera was moved."""
    while len(state.starts) < _MOST_SPANS:
        samples = bundle.samples(bundle.match(state, 0.3 * bundle.size[0]))
        before = bundle.solve(state, samples, noise, first=True)[1]
        cuts = [_cut(bundle, state, span, samples, noise) for span in range(len(state.starts))]
        cost, split = min(cuts, key=lambda cut: cut[0])
        if cost > _LOWER * before:
            break
        state = split
    return state


def _cut(bundle: Bundle, state: State, span: int, samples: Samples, noise: float) -> tuple[float, State]:
    """The cost of a state with one span in two, and that state; it begins with a cut in the middle."""
    first, last = (*state.starts, len(bundle.found.times))[span : span + 2]
    if last - first < 2 * _SHORTEST_SPAN:
        return np.inf, state
    values, change = np.insert(state.values, POSES + 6 * span, state.pose(span)), (first + last) // 2
    for _ in range(_MOVES):
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
    """How well frames fit: as in `Registration`."""

    distances: Doubles
    reasons: list[str]


def _keypoint_fit(bundle: Bundle, state: State) -> _Fit:
    """How well frames fit by their keypoints, or by those of the nearest frame that was looked at."""
    found, pixels = bundle.found, bundle.pictured(state)
    matches = bundle.match(state, 0.25 * bundle.size[0])  # Hands that are farther are somebody else's.
    tracked = np.isfinite(pixels[..., 0]).any(axis=(1, 2))
    inside = ((pixels >= 0.0) & (pixels < bundle.size)).all(axis=-1).sum(axis=-1) >= FEWEST_KEYPOINTS
    bound = max(_BOUND * float(np.nanmedian(matches.distances)), _LEAST_BOUND * bundle.size[0])
    distances = np.fmax.reduce(matches.distances, axis=1)[found.looked]
    cases = {
        _NO_HAND: ~tracked,
        _OUTSIDE: ~inside.any(axis=1),
        "the detector found no hand there": np.isnan(distances),
        f"keypoints are more than {bound:.1f} px off": distances > bound,
    }
    return _Fit(distances, np.select(list(cases.values()), list(cases), "").tolist())


def _outline_fit(bundle: Bundle, seen: Seen, fit: _Fit) -> _Fit:
    """How well frames fit by their outlines, or by their keypoints where hardly an outline is seen."""
    told = seen.found >= np.maximum(_FEWEST_EDGES, _SEEN * seen.tried)
    middle, most = (np.where(told, one, np.nan) for one in (seen.middle, seen.most))
    usual = float(np.nanmedian(most)) if told.any() else 0.0
    least = 0.5 * _LEAST_BOUND * bundle.size[0]
    bound = min(max(_BOUND * usual, least), 2.0 * least)
    whole = told.any(axis=1) & (told | ~(seen.tried > 0.0)).all(axis=1)
    cases = {
        f"the hand's outline is more than {bound:.1f} px off": (most > bound).any(axis=1),
        "the picture has other colors where a finger should be": (seen.odds < _BESIDE).any(axis=1),
        "": whole,
    }
    reasons = np.select(list(cases.values()), list(cases), fit.reasons)
    distances = np.where(told.any(axis=1), np.fmax.reduce(middle, axis=1), fit.distances)
    return _Fit(distances, reasons.tolist())
