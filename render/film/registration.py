"""`Registration`: where the camera stood that filmed the hands of a take, its lens and its clock.

The clock comes first: for each shift of it, an affine camera is fitted to the keypoints that a detector
found. Then PnP finds the pose for a few focal lengths, and one bundle over all frames refines clock, lens and
pose at once. Keypoints of a detector are a little off in the same way in all pictures: their offsets in the
frames of the bones are unknowns of the bundle, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.fft import irfft, next_fast_len, rfft
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gloves.takes.take import Take
from handsim.errors import HandSimError
from handsim.hand.model import KEYPOINT_BONES
from handsim.hand.shape import NUM_KEYPOINTS, SIDES
from handsim.pages import coordinates
from handsim.space.camera import Camera, brown_lens, camera_matrix
from handsim.space.transforms import rigid
from render.frames import Doubles, Flags, Integers

if TYPE_CHECKING:
    from render.film.detector import FoundHand

_MAX_GAP: Final = 0.1  # [s] that poses are interpolated over
_STEP: Final = 1.0 / 30.0  # [s] of the shifts that are tried
_OVERLAP: Final = 0.5  # least share of the keypoints that a shift must cover, of the most that one covers
_SHIFTS: Final = 60  # at which hands are matched, of each way to tell sides
_CLOSE, _APART = 0.1, 0.3  # [s] between two of these, and between two of those that are tried on
_ROUNDS: Final = 5  # of matching
_MOST_MATCHED: Final = 400  # detections that are matched
_TRIED: Final = 3  # best matches with which PnP is tried
_FOCALS: Final = (0.5, 0.65, 0.85, 1.1, 1.45, 1.9, 2.5, 3.3)  # [widths of the picture]
_CLOCK_KEYPOINTS: Final = (0, 4, 5, 8, 9, 12, 16, 17, 20)
_FEWEST_FRAMES: Final = 20  # frames with a hand that a camera is registered with
_FEWEST_KEYPOINTS: Final = 8  # of a hand in a frame, to say whether it fits
_SURE: Final = 0.25  # least score of a keypoint
_MOST_BUNDLED: Final = 5000  # keypoints in a bundle, and in the last one
_MOST_AT_LAST: Final = 12000
_ROBUST: Final = 2.0  # [noise] from which on residuals count less
_GATE: Final = 0.08  # [widths] of keypoints' median distance from their hand's, at first
_BOUND: Final = 3.0  # A frame does not fit beyond this many times the usual median distance.
_LEAST_BOUND: Final = 0.008  # A frame fits up to this distance in any case [widths of the picture].
_WORST: Final = 0.03  # [widths] of the usual median distance
_LEAST_SHARE: Final = 0.2  # of the frames with hands that must fit
_MOST_SPANS: Final = 4
_SHORTEST_SPAN: Final = 45  # frames with hands
_BLOCK: Final = 0.5  # [s] within which residuals count as dependent
_DEPENDENT: Final = 16.0  # number of keypoints that tell as much as one whose error is its own
_MIRROR: Final = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0]])  # of a right and a left hand's bones

_UNLIKE: Final = (
    "the hands in the video do not move as those of the take at any shift of the clock; expected a video of "
    "this take, of a camera that stood still"
)

# The unknowns, before six of the pose of each span, and the standard deviation that each has beforehand.
_OFFSET, _DRIFT, _READOUT, _FOCAL, _CENTER, _LENS, _BIAS, _POSES = 0, 1, 2, 3, 4, 6, 8, 8 + 3 * NUM_KEYPOINTS
_PRIORS: Final = np.concatenate([
    [np.inf, 1e-4, 0.015, 0.7, 0.005, 0.005, 0.05, 0.05], np.full(3 * NUM_KEYPOINTS, 0.004)
])  # fmt: skip


class FoundFrame(NamedTuple):
    """The hands that a detector found in a frame of a video."""

    number: int
    time: float
    """In the video [s]."""
    hands: Sequence[FoundHand]


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
    """Median distance of the found keypoints from the take's [px]; NaN where none were found."""
    reasons: tuple[str, ...]
    """Why each frame does not count; empty where it does."""
    places: Float[np.ndarray, "N 2"]
    """Found keypoints [px] in the frames that fit."""
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
        """Median distance of the found keypoints from the take's in the frames that count [px]."""
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


class _Motion:
    """Keypoints of a take's hands at any time, and how their bones are turned."""

    def __init__(self, take: Take) -> None:
        self.times, self.num_hands = take.times, len(take.hands)
        self._points, self._hands, self._qpos = take.keypoints(), take.hands, take.qpos
        self.sides = np.array([SIDES.index(side) for side in take.sides])
        self.mirrors = _MIRROR[[0 if side == "right" else 1 for side in take.sides]]

    def at(self, times: Doubles) -> tuple[Doubles, Doubles]:
        """Keypoints (N, H, 21, 3) [m] and their velocities [m/s]; NaN where the take has none."""
        before = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, max(len(self.times) - 2, 0))
        after = np.minimum(before + 1, len(self.times) - 1)
        step = self.times[after] - self.times[before]
        gap = (step > _MAX_GAP) | (times < self.times[0]) | (times > self.times[-1])
        step = np.where(gap | (step <= 0.0), np.nan, step)[:, None, None, None]
        first = self._points[before]
        velocities = (self._points[after] - first) / step
        return first + velocities * (times - self.times[before])[:, None, None, None], velocities

    def rotations(self, times: Doubles) -> Doubles:
        """Rotations (N, H, 21, 3, 3) of the keypoints' bones in the frames nearest to some times."""
        nearest = np.clip(np.searchsorted(self.times, times), 0, len(self.times) - 1)
        turned = np.full((len(times), self.num_hands, NUM_KEYPOINTS, 3, 3), np.nan)
        for number, hand in enumerate(self._hands):
            there = np.isfinite(self._qpos[nearest, number, 0])
            bones = hand.model.forward_kinematics(self._qpos[nearest[there], number])
            turned[there, number] = bones[:, list(KEYPOINT_BONES), :3, :3]
        return turned


class _Detections(NamedTuple):
    """All detections of a video: D hands in F frames."""

    times: Doubles
    """(F,)."""
    frames: Integers
    """(D,)."""
    sides: Integers
    """(D,), as in `SIDES`."""
    confidence: Doubles
    """(D,)."""
    pixels: Doubles
    """(D, 21, 2)."""
    weights: Doubles
    """(D, 21); 0 for keypoints that are not sure."""


def _detections(found: Sequence[FoundFrame]) -> _Detections:
    hands = [(index, hand) for index, frame in enumerate(found) for hand in frame.hands]
    scores = np.array([hand.scores for _, hand in hands], dtype=np.float64).reshape(-1, NUM_KEYPOINTS)
    return _Detections(
        np.array([frame.time for frame in found]),
        np.array([index for index, _ in hands], dtype=np.int64),
        np.array([SIDES.index(hand.side) for _, hand in hands], dtype=np.int64),
        np.array([hand.confidence for _, hand in hands], dtype=np.float64),
        np.array([hand.keypoints for _, hand in hands], dtype=np.float64).reshape(-1, NUM_KEYPOINTS, 2),
        np.where(scores >= _SURE, np.sqrt(np.clip(scores, 0.0, 1.0)), 0.0),
    )


class _Matches(NamedTuple):
    """Which detection shows each hand of the take in each frame, or -1."""

    numbers: Integers
    """(F, H)."""
    distances: Doubles
    """(F, H): median distance of its keypoints from the take's [px]."""


class _Samples(NamedTuple):
    """Keypoints that a bundle explains."""

    frames: Integers
    hands: Integers
    keypoints: Integers
    pixels: Doubles
    weights: Doubles


class _Bundle:
    """Clock, lens and poses of a camera, from keypoints in its pictures."""

    def __init__(
        self, motion: _Motion, found: _Detections, size: tuple[int, int], given: Camera | None
    ) -> None:
        self.motion, self.found, self.size = motion, found, size
        self._given, self._middle = given, float(np.median(found.times))
        if given is not None:  # the pictures of a pinhole camera with this matrix
            rays = given.unproject(found.pixels)
            pixels = rays[..., :2] / rays[..., 2:] * given.K[[0, 1], [0, 1]] + given.K[:2, 2]
            seen = np.isfinite(pixels).all(axis=-1) & (rays[..., 2] > 0.0)
            self.found = found._replace(
                pixels=np.where(seen[..., None], pixels, 0.0), weights=np.where(seen, found.weights, 0.0)
            )

    def clock(self, unknowns: Doubles) -> tuple[float, float]:
        """Offset [s] and drift of the take's time over the video's."""
        return float(unknowns[_OFFSET] - unknowns[_DRIFT] * self._middle), float(unknowns[_DRIFT])

    def times(self, unknowns: Doubles) -> Doubles:
        """Times of the frames in the take [s]."""
        offset, drift = self.clock(unknowns)
        return offset + (1.0 + drift) * self.found.times

    def matrix(self, unknowns: Doubles) -> Doubles:
        """K."""
        if self._given is not None:
            return self._given.K
        width, height = self.size
        focal = width * np.exp(unknowns[_FOCAL])
        center = 0.5 * np.array([width, height]) + width * unknowns[_CENTER : _CENTER + 2]
        return camera_matrix(focal, focal, *center)

    def free(self, num_spans: int, *, first: bool = False) -> Flags:
        """The unknowns that are looked for; `first`, before the lens and the bones' offsets."""
        free = np.ones(_POSES + 6 * num_spans, dtype=bool)
        free[_FOCAL:_BIAS] = self._given is None
        if first:
            free[[_DRIFT, _READOUT]] = False
            free[_CENTER:_POSES] = False
        return free

    def camera(self, unknowns: Doubles, span: int) -> Camera:
        """The camera of a span."""
        pose = unknowns[_POSES + 6 * span :][:6]
        rotation = Rotation.from_rotvec(pose[:3]).as_matrix()
        place = rigid(rotation.T, -rotation.T @ pose[3:])
        name = "film" if span == 0 else f"film{span + 1}"
        if self._given is not None:
            return Camera(name, self.size, self._given.K, place, self._given.lens)
        k1, k2 = unknowns[_LENS : _LENS + 2]
        return Camera(name, self.size, self.matrix(unknowns), place, brown_lens(k1, k2, 0.0, 0.0, 0.0))

    def project(self, unknowns: Doubles, points: Doubles, span: int) -> tuple[Doubles, Doubles]:
        """Pixels (N, 2) of points (N, 3), and their derivatives (N, 2, 15) as OpenCV orders them."""
        pose = unknowns[_POSES + 6 * span :][:6]
        lens = np.zeros(5)
        lens[:2] = unknowns[_LENS : _LENS + 2] if self._given is None else 0.0
        if not len(points):
            return np.empty((0, 2)), np.empty((0, 2, 15))
        pixels, jacobian = cv2.projectPoints(
            np.ascontiguousarray(points)[:, None], pose[:3], pose[3:], self.matrix(unknowns), lens
        )
        return pixels[:, 0], jacobian.reshape(-1, 2, 15)

    def match(self, unknowns: Doubles, starts: Sequence[int], gate: float) -> _Matches:
        """The detections nearest to the hands of the take, within a median distance [px]."""
        found, points = self.found, self.motion.at(self.times(unknowns))[0]
        pixels = self._pictured(unknowns, points, starts)
        index = np.full(points.shape[:2], -1)
        distances = np.full(points.shape[:2], np.inf)
        for number, frame in enumerate(found.frames):
            sure = found.weights[number] > 0.0
            if sure.sum() < _FEWEST_KEYPOINTS:
                continue
            away = np.linalg.norm(pixels[frame][:, sure] - found.pixels[number, sure], axis=-1)
            away = np.median(np.where(np.isfinite(away), away, np.inf), axis=1)
            hand = int(away.argmin())
            if away[hand] < min(gate, distances[frame, hand]):
                index[frame, hand], distances[frame, hand] = number, away[hand]
        return _Matches(index, np.where(index >= 0, distances, np.nan))

    def _pictured(self, unknowns: Doubles, points: Doubles, starts: Sequence[int]) -> Doubles:
        """Pixels of keypoints (F, H, 21, 3) by each frame's span; NaN where unknown or behind the camera."""
        pixels = np.full((*points.shape[:-1], 2), np.nan)
        spans = np.searchsorted(starts, np.arange(len(points)), side="right") - 1
        for span in range(len(starts)):
            pose = unknowns[_POSES + 6 * span :][:6]
            ahead = (points @ Rotation.from_rotvec(pose[:3]).as_matrix()[2] + pose[5]) > 0.05
            mine = ahead & (spans == span)[:, None, None]
            pixels[mine] = self.project(unknowns, points[mine], span)[0]
        return pixels

    def samples(self, matches: _Matches, most: int = _MOST_BUNDLED) -> _Samples:
        """The keypoints of matched hands, evenly thinned out over time to `most`."""
        frames, hands = np.nonzero(matches.numbers >= 0)
        number = matches.numbers[frames, hands]
        rows, keypoints = np.nonzero(self.found.weights[number] > 0.0)
        total = max(len(rows), 1)
        if total > most:  # whole hands
            kept = np.unique(np.linspace(0, len(frames) - 1, max(1, len(frames) * most // total)).astype(int))
            chosen = np.isin(rows, kept)
            rows, keypoints = rows[chosen], keypoints[chosen]
        return _Samples(
            frames[rows], hands[rows], keypoints,
            self.found.pixels[number[rows], keypoints], self.found.weights[number[rows], keypoints],
        )  # fmt: skip

    def solve(
        self,
        start: Doubles,
        samples: _Samples,
        starts: Sequence[int],
        noise: float,
        *,
        first: bool = False,
    ) -> tuple[Doubles, float, Doubles]:
        """Unknowns, their cost per keypoint, and their covariance, where keypoints are `noise` [px] off."""
        spans = np.searchsorted(starts, samples.frames, side="right") - 1
        free = self.free(len(starts), first=first)
        rotations = None if first else self._turned(start, samples)
        priors = np.concatenate([_PRIORS, np.full(len(start) - _POSES, np.inf)])
        center = np.zeros(len(start))
        center[_FOCAL] = 0.1
        held = free & np.isfinite(priors)
        weights = np.where(held, np.sqrt(_DEPENDENT) / priors, 0.0)
        scale = np.where(np.isfinite(priors), priors, 0.1)

        def linearized(part: Doubles) -> tuple[Doubles, Doubles]:
            unknowns = start.copy()
            unknowns[free] = part
            return self._residuals(unknowns, samples, spans, rotations, noise)

        def residuals(part: Doubles) -> Doubles:
            prior = np.zeros(len(start))
            prior[free] = part
            prior = ((prior - center) * weights)[held]
            return np.concatenate([linearized(part)[0].ravel(), prior])

        def jacobian(part: Doubles) -> Doubles:
            prior = np.diag(weights)[held]
            rows = linearized(part)[1].reshape(-1, len(start))
            return np.concatenate([rows, prior])[:, free]

        done = least_squares(
            residuals,
            start[free],
            jacobian,
            loss="cauchy",
            f_scale=_ROBUST,
            x_scale=scale[free],
            max_nfev=40,
            xtol=1e-6,
            ftol=1e-6,
        )
        unknowns = start.copy()
        unknowns[free] = done.x
        covariance = np.zeros((len(start), len(start)))
        if not first:
            left, rows = linearized(done.x)
            told = self._covariance(left, rows[..., free], weights[free] ** 2, samples.frames)
            covariance[np.ix_(free, free)] = told
        return unknowns, 2.0 * float(done.cost) / max(len(samples.frames), 1), covariance

    def _turned(self, unknowns: Doubles, samples: _Samples) -> Doubles:
        """The sampled keypoints' bones (N, 3, 3), mirrored for left hands."""
        frames, rows = np.unique(samples.frames, return_inverse=True)
        rotations = self.motion.rotations(self.times(unknowns)[frames])
        found = rotations[rows, samples.hands, samples.keypoints]
        return np.asarray(np.nan_to_num(found) * self.motion.mirrors[samples.hands][:, None])

    def _residuals(
        self, unknowns: Doubles, samples: _Samples, spans: Integers, rotations: Doubles | None, noise: float
    ) -> tuple[Doubles, Doubles]:
        """Differences (N, 2) in units of the noise, and their derivatives (N, 2, U); 0 without a pose."""
        points, velocities = (one[samples.frames, samples.hands, samples.keypoints]
                              for one in self.motion.at(self.times(unknowns)))  # fmt: skip
        row = samples.pixels[:, 1] / self.size[1] - 0.5
        points = points + velocities * (unknowns[_READOUT] * row)[:, None]
        if rotations is not None:
            bias = unknowns[_BIAS:_POSES].reshape(-1, 3)[samples.keypoints]
            points = points + np.einsum("nij,nj->ni", rotations, bias)
        residuals = np.zeros((len(points), 2))
        jacobian = np.zeros((len(points), 2, len(unknowns)))
        there = np.isfinite(points).all(axis=1)
        for span in np.unique(spans):
            mine = np.flatnonzero(there & (spans == span))
            pixels, derivatives = self.project(unknowns, points[mine], span)
            first = _POSES + 6 * span
            rotation = Rotation.from_rotvec(unknowns[first : first + 3]).as_matrix()
            by_point = derivatives[:, :, 3:6] @ rotation
            by_time = np.einsum("nij,nj->ni", by_point, velocities[mine])
            # Unequal weights make a plain sum of squares of the residuals.
            weight = (samples.weights[mine] / noise)[:, None]
            residuals[mine] = weight * (pixels - samples.pixels[mine])
            part = np.zeros((len(mine), 2, len(unknowns)))
            part[:, :, _OFFSET] = by_time
            part[:, :, _DRIFT] = by_time * (self.found.times[samples.frames[mine]] - self._middle)[:, None]
            part[:, :, _READOUT] = by_time * row[mine, None]
            if self._given is None:
                focal = self.matrix(unknowns)[0, 0]
                part[:, :, _FOCAL] = derivatives[:, :, 6:8].sum(axis=2) * focal
                part[:, :, _CENTER:_LENS] = derivatives[:, :, 8:10] * self.size[0]
                part[:, :, _LENS:_BIAS] = derivatives[:, :, 10:12]
            if rotations is not None:
                by_bias = by_point @ rotations[mine]
                columns = _BIAS + 3 * samples.keypoints[mine, None] + np.arange(3)
                np.put_along_axis(part, np.broadcast_to(columns[:, None], by_bias.shape), by_bias, axis=2)
            part[:, :, first : first + 6] = derivatives[:, :, :6]
            jacobian[mine] = weight[..., None] * part
        return residuals, jacobian

    def _covariance(
        self, residuals: Doubles, jacobian: Doubles, priors: Doubles, frames: Integers
    ) -> Doubles:
        """Covariance of the unknowns; residuals within a block of time are dependent, those of others not."""
        weights = 1.0 / (1.0 + (residuals / _ROBUST) ** 2)
        rows = jacobian.reshape(-1, jacobian.shape[-1])
        information = (rows * weights.reshape(-1, 1)).T @ rows + np.diag(priors)
        gradients = (jacobian * (weights * residuals)[..., None]).sum(axis=1)
        blocks = np.floor(self.found.times[frames] / _BLOCK).astype(np.int64)
        order = np.argsort(blocks, kind="stable")
        firsts = np.flatnonzero(np.diff(blocks[order], prepend=blocks.min() - 1))
        gradients = np.add.reduceat(gradients[order], firsts, axis=0)
        inverse = np.linalg.pinv(information)
        return np.asarray(inverse @ (gradients.T @ gradients + _DEPENDENT * np.diag(priors)) @ inverse)


def register(
    take: Take, found: Sequence[FoundFrame], size: tuple[int, int], given: Camera | None = None
) -> Registration:
    """The registration of a video of this size [px] in which a detector found hands.

    Args:
        take: The take that was filmed.
        found: What was found in frames of the video, in their order.
        size: Width and height of the video [px].
        given: A camera with the lens of the video's, wherever it stands; the lens is found, too, when None.

    Raises:
        HandSimError: Too few hands were found, or they do not move as those of the take do.
    """
    motion, detections = _Motion(take), _detections(found)
    with_hands = len(np.unique(detections.frames))
    if with_hands < _FEWEST_FRAMES:
        raise HandSimError(
            f"hands were found in {with_hands} of {len(found)} frames of the video, expected "
            f"{_FEWEST_FRAMES} at least"
        )
    bundle = _Bundle(motion, detections, size, given)
    width = float(size[0])
    unknowns = _first_guess(bundle)
    starts: list[int] = [0]
    noise = 0.01 * width
    for turn, gate in enumerate((_GATE, 0.6 * _GATE, 0.5 * _GATE, 0.5 * _GATE)):
        if turn >= 2:
            unknowns, starts = _split(bundle, unknowns, starts, noise)
        matches = bundle.match(
            unknowns, starts, max(4.0 * noise, gate * width) if turn >= 2 else gate * width
        )
        if (matches.numbers >= 0).sum() < _FEWEST_FRAMES:
            raise HandSimError(_UNLIKE)
        most = _MOST_AT_LAST if turn == 3 else _MOST_BUNDLED
        unknowns, _, covariance = bundle.solve(unknowns, bundle.samples(matches, most), starts, noise)
        distances = bundle.match(unknowns, starts, np.inf).distances
        if np.isnan(distances).all():  # the camera looks away from the hands
            raise HandSimError(_UNLIKE)
        noise = max(float(np.nanmedian(distances)) / 1.177, 0.3)
    registration = _registration(bundle, unknowns, starts, covariance, found)
    if noise > _WORST * width or registration.reasons.count("") < _LEAST_SHARE * with_hands:
        raise HandSimError(_UNLIKE)
    return registration


def _first_guess(bundle: _Bundle) -> Doubles:
    """Unknowns that explain most of what was found: clock by all shifts, pose by PnP."""
    tried = [
        (*_affine_matches(bundle, offset, swapped), offset)
        for swapped in (False, True)
        for offset in _shifts(bundle, swapped)
    ]
    best: tuple[float, Doubles] | None = None
    offsets: list[float] = []
    for _, matches, offset in sorted(tried, key=lambda one: one[0]):
        if len(offsets) == _TRIED:
            break
        if any(abs(offset - other) < _APART for other in offsets):
            continue
        offsets.append(offset)
        samples = bundle.samples(matches, 1500)
        start = _posed(bundle, samples, offset)
        if start is None:
            continue
        unknowns, *_ = bundle.solve(start, samples, [0], 0.01 * bundle.size[0], first=True)
        gate = _GATE * bundle.size[0]
        agreeing = float(np.nansum(1.0 - bundle.match(unknowns, [0], gate).distances / gate))
        if best is None or agreeing > best[0]:
            best = agreeing, unknowns
    if best is None:
        raise HandSimError(_UNLIKE)
    return best[1]


def _affine_matches(bundle: _Bundle, offset: float, swapped: bool) -> tuple[float, _Matches]:
    """How far off an affine camera is that explains what was found at this shift, and its matches.

    It begins with the sides that the detector told, or with the other ones, and then gives each detection to
    the hand that is nearest in the picture: a detector is often wrong about sides.
    """
    found, motion = bundle.found, bundle.motion
    some = np.unique(np.linspace(0, len(found.frames) - 1, _MOST_MATCHED).astype(int))
    frames, weights = found.frames[some], found.weights[some]
    points = motion.at(found.times + offset)[0][frames]  # (D, H, 21, 3)
    there = np.isfinite(points[..., 0, 0])
    rows = np.concatenate([np.nan_to_num(points), np.ones((*points.shape[:-1], 1))], axis=-1)
    sides = np.where(swapped, 1 - found.sides[some], found.sides[some])
    told = there & (motion.sides == sides[:, None])
    hand, counts = told.argmax(axis=1), told.any(axis=1).astype(float)
    distances = np.full(there.shape, np.inf)
    for _ in range(_ROUNDS):
        if not counts.any():
            break
        left = rows[np.arange(len(some)), hand]
        weighted = left * (weights * counts[:, None])[..., None]
        normal = np.einsum("nki,nkj->ij", weighted, left) + 1e-6 * np.eye(4)
        pictured = rows @ np.linalg.solve(normal, np.einsum("nki,nkj->ij", weighted, found.pixels[some]))
        away = np.linalg.norm(pictured - found.pixels[some, None], axis=-1)
        away = (away * weights[:, None]).sum(axis=-1) / np.maximum(weights.sum(axis=1), 1e-6)[:, None]
        distances = np.where(there, away, np.inf)
        hand = distances.argmin(axis=1)
        nearest = distances.min(axis=1)
        counts = 1.0 / (1.0 + (nearest / (2.0 * _GATE * bundle.size[0])) ** 2)
    numbers = np.full((len(found.times), motion.num_hands), -1)
    order = np.argsort(-distances.min(axis=1), kind="stable")
    order = order[np.isfinite(distances.min(axis=1)[order])]
    numbers[frames[order], hand[order]] = some[order]  # the nearest comes last
    return -float(counts.sum()), _Matches(numbers, np.zeros(numbers.shape))


def _posed(bundle: _Bundle, samples: _Samples, offset: float) -> Doubles | None:
    """Unknowns that hold the focal length and pose by which most samples are explained, or None."""
    if len(samples.frames) < 6 * _FEWEST_KEYPOINTS:
        return None
    width = bundle.size[0]
    points = bundle.motion.at(bundle.found.times + offset)[0]
    points = np.ascontiguousarray(points[samples.frames, samples.hands, samples.keypoints])
    best, most = None, 0
    for focal in _FOCALS if bundle._given is None else (1.0,):
        unknowns = np.zeros(_POSES + 6)
        unknowns[_OFFSET], unknowns[_FOCAL] = offset, np.log(focal)
        try:
            done, turn, shift, inliers = cv2.solvePnPRansac(
                points, samples.pixels, bundle.matrix(unknowns), None, iterationsCount=300,
                reprojectionError=0.025 * width, flags=cv2.SOLVEPNP_EPNP,
            )  # fmt: skip
        except cv2.error:  # points of a degenerate draw
            continue
        if done and inliers is not None and len(inliers) > most:
            most = len(inliers)
            unknowns[_POSES:] = np.concatenate([turn.ravel(), shift.ravel()])
            best = unknowns
    return best


def _shifts(bundle: _Bundle, swapped: bool) -> list[float]:
    """The offsets of the clock at which an affine camera explains the pictures best.

    An affine camera maps keypoints x to pixels A x + b. All sums that its fit needs are correlations of the
    two series, which FFT yields for all shifts at once.
    """
    found, motion = bundle.found, bundle.motion
    first, begin = float(motion.times[0]), float(found.times.min())
    ticks = np.arange(first, motion.times[-1], _STEP)
    points = motion.at(ticks)[0][:, :, list(_CLOCK_KEYPOINTS)]
    middle = np.nanmedian(points, axis=(0, 1, 2))
    points = points - middle
    nodes = np.rint((found.times - begin) / _STEP).astype(np.int64)
    count = int(nodes.max()) + 1
    length = next_fast_len(len(ticks) + count, real=True)
    order = np.argsort(found.confidence, kind="stable")
    sums = np.zeros((19, length // 2 + 1), dtype=np.complex128)
    for hand, side in enumerate(motion.sides):
        mine = order[found.sides[order] == (1 - side if swapped else side)]
        for number, keypoint in enumerate(_CLOCK_KEYPOINTS):
            seen = np.zeros((4, count))
            sure = mine[found.weights[mine, keypoint] > 0.0]
            pixels = found.pixels[sure, keypoint] / bundle.size[0] - 0.5
            at = nodes[found.frames[sure]]
            seen[:, at] = np.stack([np.ones(len(at)), *pixels.T, (pixels**2).sum(axis=1)])
            x = points[:, hand, number]
            rows = np.concatenate([np.isfinite(x[:, :1]), np.nan_to_num(x)], axis=1).T
            rows = np.concatenate([rows, rows[[1, 1, 1, 2, 2, 3]] * rows[[1, 2, 3, 2, 3, 3]]])
            taken, filmed = rfft(rows, length), np.conj(rfft(seen, length))
            sums[:10] += taken * filmed[0]
            sums[10:14] += taken[:4] * filmed[1]
            sums[14:18] += taken[:4] * filmed[2]
            sums[18] += taken[0] * filmed[3]
    values = irfft(sums, length)
    shifts = np.arange(length)
    shifts = np.where(shifts >= len(ticks), shifts - length, shifts)
    score = values[0] * np.log(_affine_residuals(values))
    score[values[0] < max(_OVERLAP * values[0].max(), 6.0 * len(_CLOCK_KEYPOINTS))] = np.inf
    offsets: list[float] = []
    for index in np.argsort(score):
        offset = float(first + shifts[index] * _STEP - begin)
        if not np.isfinite(score[index]) or len(offsets) == _SHIFTS:
            break
        if all(abs(offset - other) >= _CLOSE for other in offsets):
            offsets.append(offset)
    return offsets


def _affine_residuals(sums: Doubles) -> Doubles:
    """The share of the pixels' variance that an affine camera leaves, for sums (19, L) of `_shifts`."""
    count = np.maximum(sums[0], 1.0)
    order = np.array([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])
    normal = np.moveaxis(sums[order], -1, 0) + 1e-6 * np.eye(4) * count[:, None, None]
    right = np.stack([sums[10:14].T, sums[14:18].T], axis=-1)
    explained = (right * np.linalg.solve(normal, right)).sum(axis=(1, 2))
    variance = sums[18] - (sums[10] ** 2 + sums[14] ** 2) / count
    return np.asarray(np.clip((sums[18] - explained) / np.maximum(variance, 1e-9), 1e-3, 1.0))


def _split(bundle: _Bundle, unknowns: Doubles, starts: list[int], noise: float) -> tuple[Doubles, list[int]]:
    """The unknowns with a span more for each time at which the camera was moved."""
    while len(starts) < _MOST_SPANS:
        matches = bundle.match(unknowns, starts, 0.3 * bundle.size[0])
        shifts = _mean_errors(bundle, unknowns, starts, matches)
        change = _change(shifts, starts, noise)
        if change is None:
            break
        after = int(np.searchsorted(starts, change))
        wide = sorted([*starts, change])
        start = np.insert(unknowns, _POSES + 6 * after, unknowns[_POSES + 6 * (after - 1) :][:6])
        samples = bundle.samples(matches)
        before_cost = bundle.solve(unknowns, samples, starts, noise, first=True)[1]
        split, cost, _ = bundle.solve(start, samples, wide, noise, first=True)
        if cost > 0.95 * before_cost:
            break
        unknowns, starts = split, wide
    return unknowns, starts


def _mean_errors(bundle: _Bundle, unknowns: Doubles, starts: Sequence[int], matches: _Matches) -> Doubles:
    """Median difference of the found keypoints from the take's in each frame (F, 2) [px], or NaN."""
    pixels = bundle._pictured(unknowns, bundle.motion.at(bundle.times(unknowns))[0], starts)
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


def _registration(
    bundle: _Bundle,
    unknowns: Doubles,
    starts: Sequence[int],
    covariance: Doubles,
    found: Sequence[FoundFrame],
) -> Registration:
    """The registration of solved unknowns, with the frames that fit."""
    matches = bundle.match(unknowns, starts, np.inf)
    points = bundle.motion.at(bundle.times(unknowns))[0]
    pixels = bundle._pictured(unknowns, points, starts)
    tracked = np.isfinite(points[..., 0, 0])
    inside = ((pixels >= 0.0) & (pixels < bundle.size)).all(axis=-1).sum(axis=-1) >= _FEWEST_KEYPOINTS
    bound = max(_BOUND * float(np.nanmedian(matches.distances)), _LEAST_BOUND * bundle.size[0])
    far = np.nan_to_num(matches.distances) > 0.25 * bundle.size[0]  # somebody else's hand
    distances = np.where(far, np.nan, matches.distances)
    reasons = []
    for frame, row in enumerate(distances):
        if not tracked[frame].any():
            reasons.append("the take has no hand then")
        elif not (tracked[frame] & inside[frame]).any():
            reasons.append("no hand of the take is in the picture")
        elif np.isnan(row).all():
            reasons.append("the detector found no hand there")
        else:
            reasons.append(f"keypoints are more than {bound:.1f} px off" if np.nanmax(row) > bound else "")
    fits = np.array([not reason for reason in reasons])
    frames, hands = np.nonzero((matches.numbers >= 0) & ~far & fits[:, None])
    number = matches.numbers[frames, hands]
    rows, keypoints = np.nonzero(bundle.found.weights[number] > 0.0)
    places = bundle.found.pixels[number[rows], keypoints]
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    offset, drift = bundle.clock(unknowns)
    pose = slice(_POSES, _POSES + 6)
    with np.errstate(all="ignore"):
        usual = np.array([np.nanmax(row) if np.isfinite(row).any() else np.nan for row in distances])
    return Registration(
        cameras=tuple(bundle.camera(unknowns, span) for span in range(len(starts))),
        starts=tuple(0 if start == 0 else found[start].number for start in starts),
        offset=offset,
        drift=drift,
        readout=float(unknowns[_READOUT]),
        deviations={
            "offset": float(deviations[_OFFSET]),
            "drift": float(deviations[_DRIFT]),
            "readout": float(deviations[_READOUT]),
            "focal": float(deviations[_FOCAL]),
            "position": _place_deviation(unknowns[pose], covariance[pose, pose]),
            "rotation": float(np.linalg.norm(deviations[_POSES : _POSES + 3])),
        },
        numbers=np.array([frame.number for frame in found]),
        times=bundle.found.times,
        distances=usual,
        reasons=tuple(reasons),
        places=places,
        errors=places - pixels[frames[rows], hands[rows], keypoints],
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
