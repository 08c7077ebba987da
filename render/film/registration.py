"""`Registration`: where the camera stood that filmed the hands of a take, its lens and its clock.

The clock comes first: for each shift of it, an affine camera is fitted to the keypoints that a detector
found. Then PnP finds the pose for a few focal lengths, and one bundle over all frames refines clock, lens and
pose at once. Keypoints of a detector are several pixels off. The outlines of the hands are seen within half a
pixel, and the last bundles are of these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from gloves.takes.take import Take
from handsim.errors import HandSimError
from handsim.pages import coordinates
from handsim.space.camera import Camera
from render.film.bundle import (
    DRIFT,
    FEWEST_KEYPOINTS,
    FOCAL,
    MOST_BUNDLED,
    OFFSET,
    POSES,
    READOUT,
    Bundle,
    Detections,
    FoundFrame,
    Matches,
    Motion,
)
from render.film.first_guess import GATE, UNLIKE, first_guess
from render.film.outlines import Edges, Outlines
from render.frames import Bytes, Doubles, Integers

_FEWEST_FRAMES: Final = 20  # A camera is registered from this many frames with a hand.
_MOST_AT_LAST: Final = 12000  # largest number of keypoints in the last bundle
_BOUND: Final = 3.0  # A frame does not fit beyond this many times the usual median distance.
_LEAST_BOUND: Final = 0.008  # A frame fits up to this distance in any case [widths of the picture].
_WORST: Final = 0.03  # [widths] A video whose usual median distance is larger does not show the take.
_LEAST_SHARE: Final = 0.2  # This share of the frames with hands must fit.
_MOST_SPANS: Final = 4  # largest number of times between which a camera was moved
_SHORTEST_SPAN: Final = 45  # number of frames with hands in each of them
_NO_HAND: Final = "the take has no hand then"
_OUTSIDE: Final = "no hand of the take is in the picture"
_NOT_FOUND: Final = "the detector found no hand there"
_FEWEST_EDGES: Final = 15  # A hand's outline is judged by this many edges.
_SEEN: Final = 0.4  # A hand's outline is judged if this share of it is seen.
_WITHIN: Final = 0.8  # The bound must hold for this share of the edges.
_BESIDE: Final = -0.7  # A bone with lower mean log-odds of its colors is not where the take says.
_MOST_LOOKED: Final = 150  # largest number of frames whose outlines are used
_REACHES: Final = (0.04, 0.02, 0.01, 0.01)  # [widths] search ranges for edges, one for each round
_FIRST_NOISE: Final = 2.0  # [px] standard deviation of edges in the first round
_MOST_EDGES: Final = 12000  # largest number of edges in a bundle


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The camera of a video, its clock, and how well each frame fits.

    The time of the take is `offset + (1 + drift) time` of the video; the middle row counts, and rows are read
    from top to bottom in `readout` seconds.
    """

    cameras: tuple[Camera, ...]
    """One for each span of time in which the camera did not move."""
    starts: tuple[int, ...]
    """Number of the video's first frame of each span."""
    offset: float
    """[s]."""
    drift: float
    readout: float
    """[s]."""
    deviations: dict[str, float]
    """Standard deviations: offset and readout [s], drift, focal [share], position [m], rotation [rad]."""
    numbers: Int[np.ndarray, "F"]
    """Number of each frame that was looked at."""
    times: Float[np.ndarray, "F"]
    """Their times in the video [s]."""
    distances: Float[np.ndarray, "F"]
    """Median distance of the found outlines, or keypoints, from the take's [px]; NaN where none are found."""
    reasons: tuple[str, ...]
    """Why each frame does not count; empty where it does."""
    places: Float[np.ndarray, "N 2"]
    """Found points of outlines, or keypoints, [px] in the frames that fit."""
    errors: Float[np.ndarray, "N 2"]
    """Their differences from the take's [px]."""

    def take_times(self, times: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
        """Times in the take [s] of times in the video [s]."""
        return self.offset + (1.0 + self.drift) * times

    def span(self, number: int) -> int:
        """Index of the camera of a frame of the video."""
        return int(np.searchsorted(self.starts, number, side="right")) - 1

    def camera_of(self, number: int) -> Camera:
        """The camera of a frame of the video."""
        return self.cameras[self.span(number)]

    def left_out(self) -> list[str]:
        """How many frames do not count, and why."""
        told = sorted(set(self.reasons) - {""})
        return [f"{self.reasons.count(reason)} frames: {reason}" for reason in told]

    def residual(self) -> float:
        """Median distance of the found points from the take's in the frames that count [px]."""
        return float(np.median(np.linalg.norm(self.errors, axis=1))) if len(self.errors) else float("nan")

    def doubts(self) -> list[str]:
        """What the hands tell badly, as sentences."""
        found = self.deviations
        told = []
        if found["focal"] > 0.01:
            told.append(
                f"The focal length is known to {100 * found['focal']:.1f} % only: the hands hardly move "
                "towards the camera and away from it."
            )
        if found["offset"] > 0.003:
            told.append(f"The clock is known to {1e3 * found['offset']:.1f} ms only: the hands hardly move.")
        if found["position"] > 0.004:
            told.append(f"The camera's place is known to {1e3 * found['position']:.1f} mm only.")
        if len(self.cameras) > 1:
            when = ", ".join(f"{self.times[self.numbers >= start][0]:.1f} s" for start in self.starts[1:])
            told.append(
                f"The camera was moved at {when}: there are {len(self.cameras)} spans, each with its pose."
            )
        return told

    def figures(self) -> list[tuple[str, str, str]]:
        """A table of clock, lens and camera places: rows of a name, a value and its standard deviation."""
        known, camera = self.deviations, self.cameras[0]
        rows = [
            ("", "value", "standard deviation"),
            ("offset of the clock", f"{self.offset:.4f} s", f"{1e3 * known['offset']:.1f} ms"),
            ("drift of the clock", f"{1e6 * self.drift:.0f} ppm", f"{1e6 * known['drift']:.0f} ppm"),
            ("readout of the shutter", f"{1e3 * self.readout:.1f} ms", f"{1e3 * known['readout']:.1f} ms"),
            ("focal length", f"{camera.focal_length:.1f} px", f"{100 * known['focal']:.2f} %"),
            ("center", f"{coordinates(camera.K[:2, 2])} px", ""),
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
            "starts": list(self.starts),
            "offset": self.offset,
            "drift": self.drift,
            "readout": self.readout,
            "deviations": self.deviations,
            "frames": len(self.reasons),
            "left_out": self.left_out(),
            "doubts": self.doubts(),
        }


Pictures = Callable[[], Iterable[tuple[int, float, Bytes]]]
"""Yields the number, the time and the picture of each frame in which hands were looked for."""


def register(
    take: Take,
    found: Sequence[FoundFrame],
    size: tuple[int, int],
    given: Camera | None = None,
    pictures: Pictures | None = None,
) -> Registration:
    """The registration of a video of this size [px] in which a detector found hands.

    Args:
        take: The take that was filmed.
        found: What was found in frames of the video, in their order.
        size: Width and height of the video [px].
        given: A camera with the lens of the video's, wherever it stands; the lens is found, too, when None.
        pictures: The frames again, for the outlines of the hands; without them, keypoints alone tell the
            camera, which are much coarser.

    Raises:
        HandSimError: Too few hands were found, or they do not move as those of the take do.
    """
    motion, detections = Motion(take), Detections.of(found)
    with_hands = len(np.unique(detections.frames))
    if with_hands < _FEWEST_FRAMES:
        raise HandSimError(
            f"hands were found in {with_hands} of {len(found)} frames of the video, expected "
            f"{_FEWEST_FRAMES} at least"
        )
    bundle = Bundle(motion, detections, size, given)
    width = float(size[0])
    unknowns = first_guess(bundle)
    starts: list[int] = [0]
    noise = 0.01 * width
    for turn, gate in enumerate((GATE, 0.6 * GATE, 0.5 * GATE, 0.5 * GATE)):
        if turn >= 2:
            unknowns, starts = _split(bundle, unknowns, starts, noise)
        matches = bundle.match(
            unknowns, starts, max(4.0 * noise, gate * width) if turn >= 2 else gate * width
        )
        if (matches.numbers >= 0).sum() < _FEWEST_FRAMES:
            raise HandSimError(UNLIKE)
        most = _MOST_AT_LAST if turn == 3 else MOST_BUNDLED
        unknowns, _, covariance = bundle.solve(unknowns, bundle.samples(matches, most), starts, noise)
        distances = bundle.match(unknowns, starts, np.inf).distances
        if np.isnan(distances).all():  # the camera looks away from the hands
            raise HandSimError(UNLIKE)
        noise = max(float(np.nanmedian(distances)) / 1.177, 0.3)
    outlined = None if pictures is None else _outlined(bundle, take, unknowns, starts, pictures)
    if outlined is not None:
        unknowns, covariance, fit = outlined
    elif noise > _WORST * width:
        raise HandSimError(UNLIKE)
    else:
        fit = _keypoint_fit(bundle, unknowns, starts)
    if fit.reasons.count("") < _LEAST_SHARE * with_hands:
        raise HandSimError(UNLIKE)
    return _registration(bundle, unknowns, starts, covariance, found, fit)


def _outlined(
    bundle: Bundle,
    take: Take,
    unknowns: Doubles,
    starts: list[int],
    pictures: Pictures,
) -> tuple[Doubles, Doubles, _Fit] | None:
    """Unknowns, covariance and fit by the outlines of the hands; None where they are not seen."""
    outlines, width, noise = Outlines(take, bundle.size), bundle.size[0], _FIRST_NOISE
    shown = np.flatnonzero((bundle.match(unknowns, starts, GATE * width).numbers >= 0).any(axis=1))
    if not len(shown):
        return None
    chosen = set(shown[np.linspace(0, len(shown) - 1, _MOST_LOOKED).astype(int)].tolist())
    looks = [(n, outlines.shrunk(one[2])) for n, one in enumerate(pictures()) if n in chosen]
    for turn, reach in enumerate(_REACHES):
        edges, *_ = outlines.edges(bundle, unknowns, starts, looks, reach)
        if edges is None or len(edges.frames) < _FEWEST_EDGES * _FEWEST_FRAMES:
            return None
        samples = edges.thinned(_MOST_EDGES).samples(bundle)
        spans = np.searchsorted(starts, samples.frames, side="right") - 1
        unknowns, _, covariance = bundle.solve(unknowns, samples, starts, noise, first=turn == 0)
        left = bundle.residuals(unknowns, samples, spans, 1.0)[0]
        noise = max(0.3, float(np.median(np.abs(left))) / 0.6745)
    every = ((n, outlines.shrunk(one[2])) for n, one in enumerate(pictures()))
    edges, tried, least = outlines.edges(bundle, unknowns, starts, every, _REACHES[1])
    fit = _keypoint_fit(bundle, unknowns, starts)
    return unknowns, covariance, fit if edges is None else _outline_fit(bundle, edges, tried, least, fit)


def _split(bundle: Bundle, unknowns: Doubles, starts: list[int], noise: float) -> tuple[Doubles, list[int]]:
    """The unknowns with a span more for each time at which the camera was moved."""
    while len(starts) < _MOST_SPANS:
        matches = bundle.match(unknowns, starts, 0.3 * bundle.size[0])
        shifts = _mean_errors(bundle, unknowns, starts, matches)
        change = _change(shifts, starts, noise)
        if change is None:
            break
        after = int(np.searchsorted(starts, change))
        wide = sorted([*starts, change])
        start = np.insert(unknowns, POSES + 6 * after, unknowns[POSES + 6 * (after - 1) :][:6])
        samples = bundle.samples(matches)
        before_cost = bundle.solve(unknowns, samples, starts, noise, first=True)[1]
        split, cost, _ = bundle.solve(start, samples, wide, noise, first=True)
        if cost > 0.95 * before_cost:
            break
        unknowns, starts = split, wide
    return unknowns, starts


def _mean_errors(bundle: Bundle, unknowns: Doubles, starts: Sequence[int], matches: Matches) -> Doubles:
    """Median difference of the found keypoints from the take's in each frame (F, 2) [px], or NaN."""
    pixels = bundle.pictured(unknowns, bundle.motion.at(bundle.times(unknowns))[0], starts)
    errors = np.full((*matches.numbers.shape, 2), np.nan)
    for frame, hand in np.argwhere(matches.numbers >= 0):
        number = matches.numbers[frame, hand]
        sure = bundle.found.weights[number] > 0.0
        errors[frame, hand] = np.median(bundle.found.pixels[number, sure] - pixels[frame, hand, sure], axis=0)
    there = np.isfinite(errors[..., 0])
    return np.asarray(
        np.where(there[..., None], errors, 0.0).sum(axis=1)
        / np.where(there.any(axis=1), there.sum(axis=1), np.nan)[:, None]
    )


def _change(shifts: Doubles, starts: Sequence[int], noise: float) -> int | None:
    """The frame at which a span is best cut in two, judged by the mean errors of frames; None if nowhere."""
    best, gain = None, 0.0
    for first, last in zip(starts, [*starts[1:], len(shifts)], strict=True):
        there = first + np.flatnonzero(np.isfinite(shifts[first:last, 0]))
        values = shifts[there]
        if len(there) < 2 * _SHORTEST_SPAN:
            continue
        whole = np.abs(values - np.median(values, axis=0)).sum()
        for cut in range(_SHORTEST_SPAN, len(there) - _SHORTEST_SPAN + 1):
            parts = values[:cut], values[cut:]
            left = sum(np.abs(part - np.median(part, axis=0)).sum() for part in parts)
            step = np.abs(np.median(parts[0], axis=0) - np.median(parts[1], axis=0)).max()
            if whole - left > gain and whole - left > 0.1 * whole and step > noise:
                best, gain = int(there[cut]), whole - left
    return best


class _Fit(NamedTuple):
    """How well frames fit: as in `Registration`."""

    distances: Doubles
    reasons: list[str]
    places: Doubles
    errors: Doubles


def _keypoint_fit(bundle: Bundle, unknowns: Doubles, starts: Sequence[int]) -> _Fit:
    """How well frames fit by their keypoints."""
    matches = bundle.match(unknowns, starts, np.inf)
    points = bundle.motion.at(bundle.times(unknowns))[0]
    pixels = bundle.pictured(unknowns, points, starts)
    tracked = np.isfinite(points[..., 0, 0])
    inside = ((pixels >= 0.0) & (pixels < bundle.size)).all(axis=-1).sum(axis=-1) >= FEWEST_KEYPOINTS
    bound = max(_BOUND * float(np.nanmedian(matches.distances)), _LEAST_BOUND * bundle.size[0])
    far = np.nan_to_num(matches.distances) > 0.25 * bundle.size[0]  # somebody else's hand
    distances = np.where(far, np.nan, matches.distances)
    reasons = []
    for frame, row in enumerate(distances):
        if not tracked[frame].any():
            reasons.append(_NO_HAND)
        elif not (tracked[frame] & inside[frame]).any():
            reasons.append(_OUTSIDE)
        elif np.isnan(row).all():
            reasons.append(_NOT_FOUND)
        else:
            reasons.append(f"keypoints are more than {bound:.1f} px off" if np.nanmax(row) > bound else "")
    fits = np.array([not reason for reason in reasons])
    frames, hands = np.nonzero((matches.numbers >= 0) & ~far & fits[:, None])
    number = matches.numbers[frames, hands]
    rows, keypoints = np.nonzero(bundle.found.weights[number] > 0.0)
    places = bundle.found.pixels[number[rows], keypoints]
    lost = np.asarray(np.isnan(distances).all(axis=1))
    usual = np.nanmax(np.where(lost[:, None], np.inf, distances), axis=1)
    errors = places - pixels[frames[rows], hands[rows], keypoints]
    return _Fit(np.where(np.isinf(usual), np.nan, usual), reasons, places, errors)


def _outline_fit(bundle: Bundle, edges: Edges, tried: Integers, least: Doubles, fit: _Fit) -> _Fit:
    """How well frames fit by their outlines, or by their keypoints where hardly an outline is seen."""
    index = edges.frames * tried.shape[1] + edges.hands
    away = np.abs(edges.offsets)[np.argsort(index, kind="stable")]
    seen = np.bincount(index, minlength=tried.size)
    told = (seen >= np.maximum(_FEWEST_EDGES, _SEEN * tried.ravel())).reshape(tried.shape)
    middle, most = np.full((2, *tried.shape), np.nan)
    parts = np.split(away, np.cumsum(seen)[:-1])
    for frame, hand in np.argwhere(told):
        part = parts[frame * tried.shape[1] + hand]
        middle[frame, hand], most[frame, hand] = np.quantile(part, (0.5, _WITHIN))
    usual = float(np.nanmedian(most)) if told.any() else 0.0
    bound = max(_BOUND * usual, 0.5 * _LEAST_BOUND * bundle.size[0])
    reasons = list(fit.reasons)
    beside = np.asarray((np.nan_to_num(least) < _BESIDE).any(axis=1))
    for frame in np.flatnonzero(told.any(axis=1) | beside):
        if (most[frame] > bound).any():
            reasons[frame] = f"the hand's outline is more than {bound:.1f} px off"
        elif beside[frame]:
            reasons[frame] = "the picture has other colors where a finger should be"
        elif told[frame, tried[frame] > 0].all():
            reasons[frame] = ""
    kept = np.array([not reason for reason in reasons])[edges.frames]
    seen_at_all = np.asarray(told.any(axis=1))
    distances = np.nanmax(np.where(seen_at_all[:, None], middle, np.inf), axis=1)
    errors = edges.offsets[kept, None] * edges.normals[kept]
    return _Fit(np.where(np.isinf(distances), np.nan, distances), reasons, edges.pixels[kept], errors)


def _registration(
    bundle: Bundle,
    unknowns: Doubles,
    starts: Sequence[int],
    covariance: Doubles,
    found: Sequence[FoundFrame],
    fit: _Fit,
) -> Registration:
    """The registration of solved unknowns."""
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    offset, drift = bundle.clock(unknowns)
    pose = slice(POSES, POSES + 6)
    return Registration(
        cameras=tuple(bundle.camera(unknowns, span) for span in range(len(starts))),
        starts=tuple(0 if start == 0 else found[start].number for start in starts),
        offset=offset,
        drift=drift,
        readout=float(unknowns[READOUT]),
        deviations={
            "offset": float(deviations[OFFSET]),
            "drift": float(deviations[DRIFT]),
            "readout": float(deviations[READOUT]),
            "focal": float(deviations[FOCAL]),
            "position": _place_deviation(unknowns[pose], covariance[pose, pose]),
            "rotation": float(np.linalg.norm(deviations[POSES : POSES + 3])),
        },
        numbers=np.array([frame.number for frame in found]),
        times=bundle.found.times,
        distances=fit.distances,
        reasons=tuple(fit.reasons),
        places=fit.places,
        errors=fit.errors,
    )


def _place_deviation(pose: Doubles, covariance: Doubles) -> float:
    """Standard deviation of a camera's position [m], of its rotation vector and translation."""
    jacobian = np.zeros((3, 6))
    step = 1e-6
    for number in range(6):
        moved = np.array([pose, pose])
        moved[:, number] += (-step, step)
        low, high = (-Rotation.from_rotvec(one[:3]).as_matrix().T @ one[3:] for one in moved)
        jacobian[:, number] = (high - low) / (2.0 * step)
    return float(np.sqrt(max(np.trace(jacobian @ covariance @ jacobian.T), 0.0)))
