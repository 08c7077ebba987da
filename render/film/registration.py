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

import cv2
import numpy as np
from jaxtyping import Float

from gloves.takes.take import Take
from handsim.errors import HandSimError
from handsim.pages import coordinates
from handsim.space.camera import Camera
from render.film.bundle import (
    DRIFT,
    FEWEST_KEYPOINTS,
    FOCAL,
    OFFSET,
    POSES,
    READOUT,
    Bundle,
    Detections,
    FoundFrame,
    Matches,
    Motion,
    State,
)
from render.film.first_guess import GATE, UNLIKE, first_guess
from render.film.outlines import Edges, Outlines, Seen
from render.frames import Bytes, Doubles

_FEWEST_FRAMES: Final = 20  # A camera is registered from this many frames with a hand.
_ROUNDS: Final = 3  # rounds of matching keypoints
_BOUND: Final = 3.0  # A frame does not fit beyond this many times the usual median distance.
_LEAST_BOUND: Final = 0.008  # A frame fits up to this distance in any case [widths of the picture].
_WORST: Final = 0.03  # [widths] A video whose usual median distance is larger does not show the take.
_UNKNOWN: Final = 0.05  # [m] A camera whose place has a larger deviation is not known.
_LEAST_SHARE: Final = 0.2  # This share of the frames with hands must fit.
_MOST_SPANS: Final = 4  # largest number of times between which a camera was moved
_MOVES: Final = 3  # number of times that the beginning of a span is moved
_SHORTEST_SPAN: Final = 20  # number of frames with found hands in each of them
_NO_HAND: Final = "the take has no hand then"
_OUTSIDE: Final = "no hand of the take is in the picture"
_NOT_FOUND: Final = "the detector found no hand there"
_FEWEST_EDGES: Final = 15  # A hand's outline is judged by this many edges.
_SEEN: Final = 0.4  # A hand's outline is judged if this share of it is seen.
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
    times: Float[np.ndarray, "F"]
    """Time of each frame in the video [s]."""
    distances: Float[np.ndarray, "F"]
    """Median distance of the found outlines, or keypoints, from the take's [px]; NaN where none are found."""
    reasons: tuple[str, ...]
    """Why each frame does not count; empty where it does."""
    places: Float[np.ndarray, "N 2"]
    """Found points of outlines, or keypoints, [px] in the frames that fit."""
    errors: Float[np.ndarray, "N 2"]
    """Their differences from the take's [px]."""

    def camera_of(self, number: int) -> Camera:
        """The camera of a frame of the video."""
        return self.cameras[int(np.searchsorted(self.starts, number, side="right")) - 1]

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
        when = ", ".join(f"{self.times[start]:.1f} s" for start in self.starts[1:])
        told = {
            f"The focal length is known to {100 * found['focal']:.1f} % only: the hands hardly move towards "
            "the camera and away from it.": found["focal"] > 0.01,
            f"The clock is known to {1e3 * found['offset']:.1f} ms only: the hands hardly move.":
                found["offset"] > 0.003,
            f"The camera's place is known to {1e3 * found['position']:.1f} mm only.":
                found["position"] > 0.004,
            f"The camera was moved at {when}: there are {len(self.cameras)} spans, each with its pose.":
                len(self.cameras) > 1,
        }  # fmt: skip
        return [sentence for sentence, holds in told.items() if holds]

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


def register(
    take: Take,
    found: Sequence[FoundFrame],
    size: tuple[int, int],
    given: Camera | None = None,
    pictures: Callable[[], Iterable[Bytes]] | None = None,
) -> Registration:
    """The registration of a video of this size [px] in which a detector found hands.

    Args:
        take: The take that was filmed.
        found: What was found in the frames of the video.
        size: Width and height of the video [px].
        given: A camera with the lens of the video's, wherever it stands; the lens is found, too, when None.
        pictures: The frames, for the outlines of the hands; without them, keypoints alone tell the camera,
            which are much coarser.

    Raises:
        HandSimError: Too few hands were found, or they do not move as those of the take do.
    """
    bundle, width = Bundle(Motion(take), Detections.of(found), size, given), size[0]
    with_hands, looked = (len(np.unique(one)) for one in (bundle.found.frames, bundle.found.looked))
    if with_hands < _FEWEST_FRAMES:
        raise HandSimError(
            f"hands were found in {with_hands} of the {looked} frames that were searched, expected "
            f"{_FEWEST_FRAMES} at least"
        )
    state, noise = first_guess(bundle), 0.25 * GATE * width
    for turn in range(_ROUNDS):
        if turn > 0:
            state = _split(bundle, state, noise)
        matches = bundle.match(state, max(4.0 * noise, 0.5 * GATE * width))
        if (matches.numbers >= 0).sum() < _FEWEST_FRAMES:
            raise HandSimError(UNLIKE)
        state, _, covariance = bundle.solve(state, bundle.samples(matches), noise)
        distances = bundle.match(state, np.inf).distances
        if np.isnan(distances).all():  # the camera looks away from the hands
            raise HandSimError(UNLIKE)
        noise = max(float(np.nanmedian(distances)) / 1.177, 0.3)
    outlined = None if pictures is None else _outlined(bundle, take, state, pictures)
    if outlined is not None:
        state, covariance, fit = outlined
    elif noise > _WORST * width:
        raise HandSimError(UNLIKE)
    else:
        fit = _keypoint_fit(bundle, state)
    if fit.reasons.count("") < _LEAST_SHARE * np.isin(bundle.found.looked, bundle.found.frames).sum():
        raise HandSimError(UNLIKE)
    told = _registration(bundle, state, covariance, fit)
    if (unknown := told.deviations["position"]) > _UNKNOWN:
        raise HandSimError(
            f"the hands tell the camera's place to {1e3 * unknown:.0f} mm only; expected hands that move in "
            "all directions, and a longer video"
        )
    return told


def _outlined(
    bundle: Bundle, take: Take, state: State, pictures: Callable[[], Iterable[Bytes]]
) -> tuple[State, Doubles, _Fit] | None:
    """State, covariance and fit by the outlines of the hands; None where they are not seen."""
    outlines, noise = Outlines(take, bundle.size), _FIRST_NOISE
    shown = np.flatnonzero((bundle.match(state, GATE * bundle.size[0]).numbers >= 0).any(axis=1))
    if not len(shown):
        return None
    chosen = set(shown[np.linspace(0, len(shown) - 1, _MOST_LOOKED).astype(int)].tolist())
    looks = [(n, outlines.shrunk(picture)) for n, picture in enumerate(pictures()) if n in chosen]
    for turn, reach in enumerate(_REACHES):
        edges, _ = outlines.edges(bundle, state, looks, reach)
        if edges is None or len(edges.frames) < _FEWEST_EDGES * _FEWEST_FRAMES:
            return None
        samples = edges.samples(_MOST_EDGES)
        state, _, covariance = bundle.solve(state, samples, noise, first=turn == 0)
        noise = max(0.3, float(np.median(np.abs(bundle.rows(state, samples, 1.0)[:, 0]))) / 0.6745)
    every = ((n, outlines.shrunk(picture)) for n, picture in enumerate(pictures()))
    edges, seen = outlines.edges(bundle, state, every, _REACHES[1])
    fit = _keypoint_fit(bundle, state)
    return state, covariance, fit if edges is None else _outline_fit(bundle, edges, seen, fit)


def _split(bundle: Bundle, state: State, noise: float) -> State:
    """The state with a span more for each time at which the camera was moved."""
    while len(state.starts) < _MOST_SPANS:
        matches = bundle.match(state, 0.3 * bundle.size[0])
        change = _change(matches, state.starts, noise)
        if change is None:
            break
        span, samples = int(np.searchsorted(state.starts, change)), bundle.samples(matches)
        values = np.insert(state.values, POSES + 6 * span, state.pose(span - 1))
        before = bundle.solve(state, samples, noise, first=True)[1]
        for _ in range(_MOVES):
            split = State(values, (*state.starts[:span], change, *state.starts[span:]))
            split, cost, _ = bundle.solve(split, samples, noise, first=True)
            values, change = split.values, _better_change(bundle, split, span)
        if cost > 0.95 * before:
            break
        state = split
    return state


def _better_change(bundle: Bundle, state: State, span: int) -> int:
    """The first frame of a span, after which its camera explains what is found better than the one before."""
    alone = (State(np.append(state.values[:POSES], state.pose(number))) for number in (span - 1, span))
    early, late = (np.fmin.reduce(bundle.match(one, np.inf).distances, axis=1) for one in alone)
    first, last = (*state.starts, len(early))[span - 1 : span + 2 : 2]
    votes = np.sign(np.nan_to_num(early - late))[first:last]
    return first + int(np.clip(np.cumsum(votes).argmin() + 1, 1, last - first - 1))


def _change(matches: Matches, starts: Sequence[int], noise: float) -> int | None:
    """The frame at which a span is best cut in two, by the median errors of its frames; None if nowhere."""
    best, gain = None, 0.0
    shown = np.flatnonzero((matches.numbers >= 0).any(axis=1))
    shifts = np.nanmedian(matches.errors[shown].reshape(len(shown), -1, 2), axis=1)
    for first, last in zip(starts, [*starts[1:], len(matches.numbers)], strict=True):
        mine = (shown >= first) & (shown < last)
        values = shifts[mine]
        whole = np.abs(values - np.median(values, axis=0)).sum() if len(values) else 0.0
        for cut in range(_SHORTEST_SPAN, len(values) - _SHORTEST_SPAN + 1):
            parts = values[:cut], values[cut:]
            middles = [np.median(part, axis=0) for part in parts]
            left = sum(np.abs(part - middle).sum() for part, middle in zip(parts, middles, strict=True))
            step = np.abs(middles[0] - middles[1]).max()
            if whole - left > max(gain, 0.1 * whole) and step > noise:
                best, gain = int(shown[mine][cut]), whole - left
    return best


class _Fit(NamedTuple):
    """How well frames fit: as in `Registration`."""

    distances: Doubles
    reasons: list[str]
    places: Doubles
    errors: Doubles


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
        _NOT_FOUND: np.isnan(distances),
        f"keypoints are more than {bound:.1f} px off": distances > bound,
    }
    reasons = np.select(list(cases.values()), list(cases), "")
    fits = np.isfinite(matches.errors) & (reasons == "")[:, None, None, None]
    errors = matches.errors[fits].reshape(-1, 2)
    frames, hands, keypoints = np.nonzero(fits[..., 0])
    return _Fit(distances, reasons.tolist(), pixels[frames, hands, keypoints] + errors, errors)


def _outline_fit(bundle: Bundle, edges: Edges, seen: Seen, fit: _Fit) -> _Fit:
    """How well frames fit by their outlines, or by their keypoints where hardly an outline is seen."""
    told = seen.found >= np.maximum(_FEWEST_EDGES, _SEEN * seen.tried)
    middle, most = (np.where(told, one, np.nan) for one in (seen.middle, seen.most))
    usual = float(np.nanmedian(most)) if told.any() else 0.0
    bound = max(_BOUND * usual, 0.5 * _LEAST_BOUND * bundle.size[0])
    whole = told.any(axis=1) & (told | ~(seen.tried > 0.0)).all(axis=1)
    cases = {
        f"the hand's outline is more than {bound:.1f} px off": (most > bound).any(axis=1),
        "the picture has other colors where a finger should be": (seen.odds < _BESIDE).any(axis=1),
        "": whole,
    }
    reasons = np.select(list(cases.values()), list(cases), fit.reasons)
    kept = (reasons == "")[edges.frames]
    errors = edges.offsets[kept, None] * edges.normals[kept]
    return _Fit(np.fmax.reduce(middle, axis=1), reasons.tolist(), edges.pixels[kept], errors)


def _registration(bundle: Bundle, state: State, covariance: Doubles, fit: _Fit) -> Registration:
    """The registration of a solved state."""
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    told = {"offset": OFFSET, "drift": DRIFT, "readout": READOUT, "focal": FOCAL}
    (offset, drift), pose = bundle.clock(state), slice(POSES, POSES + 6)
    rotation, derivatives = cv2.Rodrigues(state.pose(0)[:3])
    by_turn = derivatives.reshape(3, 3, 3).transpose(0, 2, 1) @ state.pose(0)[3:]
    by_pose = np.column_stack([by_turn.T, rotation.T])  # derivatives of the camera's place, negated
    place = np.trace(by_pose @ covariance[pose, pose] @ by_pose.T)
    return Registration(
        cameras=tuple(bundle.cameras(state)),
        starts=state.starts,
        offset=offset,
        drift=drift,
        readout=float(state.values[READOUT]),
        deviations={name: float(deviations[number]) for name, number in told.items()}
        | {
            "position": float(np.sqrt(max(place, 0.0))),
            "rotation": float(np.linalg.norm(deviations[POSES : POSES + 3])),
        },
        times=bundle.found.times,
        distances=fit.distances,
        reasons=tuple(fit.reasons),
        places=fit.places,
        errors=fit.errors,
    )
