"""`Bundle`: clock, lens and poses of a camera, adjusted to keypoints and outlines of hands in its video."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gloves.takes.take import Take
from handsim.hand.shape import NUM_KEYPOINTS, SIDES
from handsim.space.camera import Camera, brown_lens, camera_matrix
from handsim.space.transforms import rigid
from render.frames import Doubles, Integers

if TYPE_CHECKING:
    from film.detector import FoundHand

_MAX_GAP: Final = 0.1  # [s] Poses are interpolated over gaps up to this length.
FEWEST_KEYPOINTS: Final = 8  # A hand in a frame is judged by this many keypoints.
_SURE: Final = 0.25  # Keypoints with a lower score are not used.
_MOST_BUNDLED: Final = 5000  # largest number of keypoints in a bundle
_ROBUST: Final = 2.0  # Residuals beyond this many standard deviations count less.
_WEAK_INFORMATION: Final = 1e-2  # prior information on free unknowns
_PARTS: Final = 8  # number of parts of a video that are held out, one after the other
_TINY: Final = 1e-6  # [s], [rad] step of the finite differences by time and by rotations
_SAMPLES_PER_ERROR: Final = 16.0  # This many samples count as one with an independent error.

# Places of the unknowns in a state's values. From POSES on, each span has six numbers for its camera's pose.
# _PRIORS holds the standard deviation of each unknown before any picture is seen. THICKER says how much
# thicker the filmed hands are than the tracked ones [m], because of cloth or an error of a measured hand, and
# LARGER by which share they are larger.
OFFSET, DRIFT, FOCAL, THICKER, LARGER, POSES = 0, 1, 2, 7, 8, 11
CENTER, _LENS, READOUT = slice(3, 5), slice(5, 7), slice(9, 11)
USUAL_CENTER: Final = 0.01  # [widths] standard deviation of lens centers from the middle of the picture
_PRIORS: Final = np.array(
    [np.inf, 1e-4, 0.7, USUAL_CENTER, USUAL_CENTER, 0.05, 0.05, 0.0007, 0.02, 0.015, 0.015]
)


class FoundFrame(NamedTuple):
    """A frame of a video, and the hands that a detector found in it."""

    time: float  # in the video [s]
    hands: Sequence[FoundHand] | None  # None where the detector did not look


class Detections(NamedTuple):
    """The detections of a video with enough keypoints: D hands in F frames."""

    times: Doubles  # (F,)
    looked: Integers  # (F,): the nearest frame in which hands were looked for
    frames: Integers  # (D,)
    sides: Integers  # (D,), as in `SIDES`
    pixels: Doubles  # (D, 21, 2)
    weights: Doubles  # (D, 21): 0 for keypoints that are not sure

    @classmethod
    def of(cls, found: Sequence[FoundFrame]) -> Detections:
        """Those in the frames of a video."""
        looked = np.array([index for index, frame in enumerate(found) if frame.hands is not None])
        between = np.searchsorted(0.5 * (looked[1:] + looked[:-1]), np.arange(len(found)))
        hands = [
            (index, hand)
            for index, frame in enumerate(found)
            for hand in frame.hands or ()
            if (hand.scores >= _SURE).sum() >= FEWEST_KEYPOINTS
        ]
        scores = np.array([hand.scores for _, hand in hands], dtype=np.float64).reshape(-1, NUM_KEYPOINTS)
        return cls(
            np.array([frame.time for frame in found]),
            looked[between],
            np.array([index for index, _ in hands], dtype=np.int64),
            np.array([SIDES.index(hand.side) for _, hand in hands], dtype=np.int64),
            np.array([hand.keypoints for _, hand in hands], dtype=np.float64).reshape(-1, NUM_KEYPOINTS, 2),
            np.where(scores >= _SURE, np.sqrt(np.clip(scores, 0.0, 1.0)), 0.0),
        )


class State(NamedTuple):
    """What a bundle knows of a camera and its clock."""

    values: Doubles  # of the unknowns
    starts: tuple[int, ...] = (0,)  # first frame of each span in which the camera did not move

    def spans(self, frames: Integers) -> Integers:
        """Number of the span of each frame."""
        return np.searchsorted(self.starts, frames, side="right") - 1

    def pose(self, span: int) -> Doubles:
        """The camera's rotation vector and place (6,) in a span."""
        return self.values[POSES + 6 * span :][:6]


class Matches(NamedTuple):
    """Which detection shows each hand of the take in each frame."""

    numbers: Integers  # (F, H), -1 for none
    distances: Doubles  # (F, H): median distance of its keypoints from the take's [px]
    errors: Doubles  # (F, H, 21, 2): its keypoints less the take's [px]; NaN for those that are not sure


class Samples(NamedTuple):
    """Points of hands, and lines in pictures on which they are: two for a keypoint, one for an outline."""

    frames: Integers  # (N,)
    pixels: Doubles  # (N, 2): a point of the line
    normals: Doubles  # (N, 2): normal of the line, as long as its weight
    outward: Doubles  # (N, 3): the way in which a thicker hand moves the point
    larger: Doubles  # (N, 3): from the hand's middle to the point [m]
    points_at: Callable[[Doubles], Doubles]
    """Points (N, 3) [m] at their times (N,) in the take."""


class Bundle:
    """Clock, lens and poses of a camera, from keypoints and outlines in its pictures."""

    def __init__(self, take: Take, found: Detections, size: tuple[int, int], given: Camera | None) -> None:
        self.take, self.found, self.size, self.given = take, found, size, given
        self._points, self._middle = take.keypoints(), float(np.median(found.times))

    def keypoints(self, times: Doubles, *which: Integers) -> Doubles:
        """Keypoints (N, H, 21, 3) [m] at times in the take; NaN where it has none.

        With numbers (N,) of hands and of keypoints, they are only those: (N, 3).
        """
        known = self.take.times
        index = np.interp(times, known, np.arange(len(known)), np.nan, np.nan)
        before = np.nan_to_num(index).astype(np.int64)
        after = np.minimum(before + 1, len(known) - 1)
        share = np.where(known[after] - known[before] > _MAX_GAP, np.nan, index - before)
        first, second = self._points[before, *which], self._points[after, *which]
        return np.asarray(first + share.reshape(-1, *(first.ndim - 1) * [1]) * (second - first))

    def clock(self, state: State) -> tuple[float, float]:
        """Offset [s] and drift of the take's time over the video's."""
        offset, drift = state.values[[OFFSET, DRIFT]].tolist()
        return offset - drift * self._middle, drift

    def times(self, state: State) -> Doubles:
        """Times of the frames in the take [s]."""
        offset, drift = self.clock(state)
        return offset + (1.0 + drift) * self.found.times

    def cameras(self, state: State) -> list[Camera]:
        """The cameras of all spans."""
        camera, cameras = self.given, []
        if camera is None:
            focal = self.size[0] * np.exp(state.values[FOCAL])
            center = 0.5 * np.array(self.size) + self.size[0] * state.values[CENTER]
            lens = brown_lens(*state.values[_LENS], 0.0, 0.0, 0.0)
            camera = Camera("film", self.size, camera_matrix(focal, focal, *center), lens=lens)
        for span in range(len(state.starts)):
            pose, name = state.pose(span), f"film{span + 1}" if span else "film"
            place = rigid(Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:])
            cameras.append(dataclasses.replace(camera, name=name, T_world_camera=place))
        return cameras

    def projected(self, state: State, frames: Integers, points: Doubles) -> Doubles:
        """Pixels (N, ..., 2) of points (N, ..., 3) [m] in frames (N,); NaN where there are none."""
        pixels, spans = np.empty((*points.shape[:-1], 2)), state.spans(frames)
        for span, camera in enumerate(self.cameras(state)):
            pixels[spans == span] = camera.project(points[spans == span])
        return pixels

    def pictured(self, state: State) -> Doubles:
        """Where the camera sees the take's keypoints in each frame (F, H, 21, 2) [px]; NaN without a hand."""
        times = self.times(state)
        return self.projected(state, np.arange(len(times)), self.keypoints(times))

    def match(self, state: State, gate: float) -> Matches:
        """The detections nearest to the hands of the take, within a median distance [px]."""
        found, pixels = self.found, self.pictured(state)
        errors = found.pixels[:, None] - pixels[found.frames]  # (D, H, 21, 2)
        away = np.nan_to_num(np.linalg.norm(errors, axis=-1), nan=np.inf)
        unsure = np.broadcast_to((found.weights == 0.0)[:, None], away.shape)
        errors[unsure] = away[unsure] = np.nan
        away = np.nanmedian(away, axis=-1)  # (D, H)
        hand, nearest = away.argmin(axis=1), away.min(axis=1)
        order = np.argsort(-nearest, kind="stable")
        order = order[nearest[order] < gate]
        at = found.frames[order], hand[order]  # where the nearest comes last
        matches = Matches(
            np.full(pixels.shape[:2], -1), np.full(pixels.shape[:2], np.nan), np.full(pixels.shape, np.nan)
        )
        matches.numbers[at], matches.distances[at] = order, nearest[order]
        matches.errors[at] = errors[order, hand[order]]
        return matches

    def samples(self, matches: Matches) -> Samples:
        """The keypoints of matched hands, thinned out to about `_MOST_BUNDLED`."""
        frames, hands, keypoints = np.nonzero(np.isfinite(matches.errors[..., 0]))
        kept = matches.numbers[frames, hands] % (1 + len(frames) // _MOST_BUNDLED) == 0
        frames, hands, keypoints = (np.repeat(one[kept], 2) for one in (frames, hands, keypoints))
        which = matches.numbers[frames, hands], keypoints
        normals = np.tile(np.eye(2), (len(frames) // 2, 1)) * self.found.weights[which][:, None]
        still = np.zeros((len(frames), 3))
        return Samples(
            frames, self.found.pixels[which], normals, still, still,
            lambda times: self.keypoints(times, hands, keypoints),
        )  # fmt: skip

    def solve(
        self, state: State, samples: Samples, noise: float, *, first: bool = False
    ) -> tuple[State, float, Doubles]:
        """Adjust a state to samples; return it with its cost per sample and its covariance.

        Samples of weight 1 have the standard deviation `noise` [px]. Samples that are far off in the given
        state count less. With `first`, the lens and the size of the hands stay as they are.
        """
        size, count = len(state.values), len(samples.frames)
        free = np.ones(size, dtype=bool)
        free[FOCAL:THICKER] = self.given is None
        if first:
            free[DRIFT] = free[CENTER] = free[_LENS] = free[THICKER] = free[LARGER] = free[READOUT] = False
        priors = np.concatenate([_PRIORS, np.full(size - POSES, np.inf)])
        robust = 1.0 / np.sqrt(1.0 + (self.residuals(state, samples, noise) / _ROBUST) ** 2)

        def widened(part: Doubles) -> State:
            values = state.values.copy()
            values[free] = part
            return state._replace(values=values)

        known = np.sqrt(_SAMPLES_PER_ERROR) / priors

        def rows(part: Doubles) -> Doubles:
            now = widened(part)
            return np.concatenate([robust * self.residuals(now, samples, noise), known * now.values])

        def jacobian(part: Doubles) -> Doubles:
            told = robust[:, None] * self.jacobian(widened(part), samples, noise)
            return np.concatenate([told, np.diag(known)])[:, free]

        done = least_squares(
            rows, state.values[free], jacobian, x_scale=np.where(np.isfinite(priors), priors, 0.1)[free],
            max_nfev=40, xtol=1e-6, ftol=1e-6,
        )  # fmt: skip
        covariance = np.zeros((size, size))
        # An unknown without any information gets a standard deviation of 40 s, m or rad.
        inverse = np.linalg.inv(done.jac.T @ done.jac + _WEAK_INFORMATION * np.eye(len(done.x)))
        covariance[np.ix_(free, free)] = _SAMPLES_PER_ERROR * inverse
        return widened(done.x), 2.0 * float(done.cost) / max(count, 1), covariance

    def held_out(self, state: State, samples: Samples, noise: float) -> tuple[Doubles, float]:
        """Standard deviations of the unknowns from solutions that each leave out a part of the time.

        In this jackknife errors that last count as what they are. The second value is the median residual
        [px] of the part that the solution without it fits least.
        """
        ends = np.quantile(samples.frames, np.linspace(0.0, 1.0, _PARTS + 1)[1:-1])
        parts, surprise, found = np.searchsorted(ends, samples.frames), 0.0, []
        for part in range(_PARTS):
            out = parts == part
            kept = samples._replace(normals=np.where(out[:, None], 0.0, samples.normals))
            other = self.solve(state, kept, noise)[0]
            away = np.abs(self.residuals(other, samples, 1.0)[out])
            surprise = max(surprise, float(np.median(away))) if out.any() else surprise
            found.append(other.values)
        return np.std(found, axis=0) * np.sqrt(_PARTS - 1), surprise

    def jacobian(self, state: State, samples: Samples, noise: float) -> Doubles:
        """Derivatives (N, U) of the residuals by all unknowns; those by a given lens do not count."""
        cameras, spans = self.cameras(state), state.spans(samples.frames)
        points, later = (self._points_of(state, samples, late) for late in (0.0, _TINY))
        poses, lens = np.stack([one.T_world_camera for one in cameras])[spans], cameras[0].lens
        axes, away, across = poses[:, :3, :3], points - poses[:, :3, 3], samples.normals / noise
        local, focal = np.einsum("nij,ni->nj", axes, away), across * cameras[0].focal_lengths
        flat = local[:, :2] / local[:, 2:]
        slopes = np.einsum("ni,nij->nj", focal, lens.jacobian(local)) / local[:, 2:]
        by_local = np.column_stack([slopes, -(slopes * flat).sum(axis=1)])
        by_point, pose = np.einsum("nij,nj->ni", axes, by_local), np.zeros((len(points), len(cameras), 6))
        for span in range(len(cameras)):
            turn, mine = state.pose(span)[:3], spans == span
            turned = Rotation.from_rotvec(turn + _TINY * np.eye(3)) * Rotation.from_rotvec(turn).inv()
            pose[mine, span, :3] = np.cross(by_point[mine], away[mine]) @ turned.as_rotvec().T / _TINY
            pose[mine, span, 3:] = -by_point[mine]
        by_time, square = ((later - points) * by_point).sum(axis=1) / _TINY, (flat**2).sum(axis=1)
        bent, elapsed = (focal * flat).sum(axis=1) * square, self.found.times[samples.frames] - self._middle
        found = np.column_stack([
            by_time, by_time * elapsed, (focal * lens.distort(local)).sum(axis=1), self.size[0] * across,
            bent, bent * square, (by_point * samples.outward).sum(axis=1),
            (by_point * samples.larger).sum(axis=1), by_time[:, None] * (samples.pixels / self.size - 0.5),
            pose.reshape(len(points), 6 * len(cameras)),
        ])  # fmt: skip
        return np.where(np.isfinite(found).all(axis=1, keepdims=True), found, 0.0)

    def _points_of(self, state: State, samples: Samples, late: float = 0.0) -> Doubles:
        """The samples' points (N, 3) [m] when the shutter reads them, or later [s]."""
        times = self.times(state)[samples.frames] + (samples.pixels / self.size - 0.5) @ state.values[READOUT]
        shift = state.values[THICKER] * samples.outward + state.values[LARGER] * samples.larger
        return np.asarray(samples.points_at(times + late) + shift)

    def residuals(self, state: State, samples: Samples, noise: float) -> Doubles:
        """Distances (N,) from the lines, over the noise; 0 where the take has no pose."""
        points = self._points_of(state, samples)
        pixels = self.projected(state, samples.frames, points)
        away = ((pixels - samples.pixels) * samples.normals).sum(axis=1) / noise
        away = np.nan_to_num(away, nan=self.size[0] / noise)  # behind the camera
        return np.where(np.isfinite(points[:, 0]), away, 0.0)
