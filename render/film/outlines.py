"""`Outlines`: where the outlines of a take's hands are in pictures, near where a camera would see them.

The tracked hand is drawn, and its colors and those around it are counted. Across each point of its outline,
the edge is where the picture's colors change from the hand's to the others (region-based tracking: Prisacariu
and Reid 2012, Int. J. Comput. Vis. 98:335; Stoiber et al. 2022, Int. J. Comput. Vis. 130:1008).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from gloves.fit import GloveFit
from gloves.takes.take import Take
from handsim.hand.model import between_poses
from handsim.space.camera import Camera
from handsim.space.transforms import pose_matrices
from render.film.bundle import READOUT, Bundle, Samples
from render.frames import FOREARM, PARTS_A_HAND, Bytes, Doubles, Flags, Floats, Geometry, Integers
from render.painting.figures import BodyFigure
from render.painting.rasterizer import Triangles, see
from render.skin.mesh import PosableSkin

_WIDEST: Final = 800  # [px] Wider pictures are shrunk to this width.
_MOST_POINTS: Final = 80  # largest number of outline points of a hand in a picture
_STEP: Final = 0.004  # [s] step of the central differences that give velocities
_LEVELS: Final = 5  # bits of each color channel in the histograms
_SMOOTH: Final = 1.0  # [levels] standard deviation of the histograms' smoothing
_SUREST: Final = 3.0  # largest log-odds that one color gives
_DEPENDENT: Final = 0.5  # Neighboring pixels are alike: this share of their log-odds counts.
_CONTRAST: Final = 0.6  # An edge has at least these mean log-odds on both sides.
_BESIDE: Final = 5  # [px] width of each side for this mean
_FLAT: Final = 3  # number of pixels at each end that show the colors of the two sides
_NOISIEST: Final = 0.25  # largest deviation of those colors, over the difference of the two sides
_LINEAR: Final = (np.linspace(0.0, 1.0, 256, dtype=np.float32) ** 2.2)[:, None]
_FEWEST_PIXELS: Final = 30  # Colors of a region are counted if it has this many pixels.
_AROUND: Final = 14  # [px] width of the ring around the reach whose colors are the background's
_BLUR: Final = 0.3  # [px] least standard deviation of an edge
_ARM: Final = 0.02  # [m] The outline this near to the forearm is left out, because the wrist bends there.
_BALL: Final = 0.004  # [m] The outline this near to a marker is left out, because the glove may carry it.
_EDGE: Final = 3.0  # [px] The outline this near to the edge of the picture is left out.
_OTHER: Final = 4.0  # [px] The outline this near to another hand or thing is left out.


class Edges(NamedTuple):
    """Points of outlines, and where in the pictures they are seen."""

    frames: Integers
    hands: Integers
    pixels: Doubles
    """(N, 2): where each edge is."""
    normals: Doubles
    """(N, 2): unit normals of the edges, out of the hand."""
    weights: Doubles
    """(N,): one over the standard deviation [1/px]."""
    points: Doubles
    """(N, 3): on the drawn hand [m]."""
    velocities: Doubles
    """(N, 3) [m/s]."""
    outward: Doubles
    """(N, 3): unit normals of the hand's surface."""
    regions: Integers
    """(N,): one of four sides of one bone of one hand."""
    times: Doubles
    """(N,): of the take, at which the points are there [s]."""
    offsets: Doubles
    """(N,): distance of the edge from the drawn outline [px]."""

    def thinned(self, most: int) -> Edges:
        """This many at most, evenly."""
        kept: list[Any] = [values[:: 1 + len(values) // most] for values in self]
        return Edges(*kept)

    def samples(self, bundle: Bundle) -> Samples:
        """The edges for a bundle."""
        aside = self.pixels + self.normals[:, ::-1] * [-1.0, 1.0]
        pixels, beside = (bundle.flat(one)[0] for one in (self.pixels, aside))
        along = beside - pixels
        length = np.linalg.norm(along, axis=1)
        normals = along[:, ::-1] * [1.0, -1.0] / length[:, None]

        def points_at(times: Doubles) -> tuple[Doubles, Doubles]:
            late = (times[self.frames] - self.times)[:, None]
            return self.points + self.velocities * late, self.velocities

        return Samples(
            self.frames, pixels, normals[:, None], self.weights / length, self.outward, self.regions,
            points_at,
        )  # fmt: skip


class Outlines:
    """Finds the edges of a take's hands in pictures of a video of this size."""

    def __init__(self, take: Take, size: tuple[int, int]) -> None:
        self._take, self._scale = take, min(1.0, _WIDEST / max(size))
        width, height = (max(1, round(self._scale * side)) for side in size)
        self._size = width, height
        self._skins = [PosableSkin(hand.model, bony=0.5) for hand in take.hands]
        self._bodies = [BodyFigure(body, (0.5, 0.5, 0.5)) for body in take.bodies]
        self._seen = np.zeros((len(take.hands), 1 << 3 * _LEVELS))  # counts of the hands' colors

    def shrunk(self, picture: Bytes) -> Bytes:
        """A picture as it is looked at."""
        if self._scale == 1.0:
            return picture
        return np.asarray(cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA))

    def edges(
        self,
        bundle: Bundle,
        unknowns: Doubles,
        starts: Sequence[int],
        looks: Iterable[tuple[int, Bytes]],
        reach: float,
    ) -> tuple[Edges | None, Integers, Doubles]:
        """The edges within `reach` [widths] in numbered frames.

        Returns:
            Edges, numbers (F, H) of points that were tried, and the least mean log-odds of a bone's colors.
        """
        take, times = self._take, bundle.times(unknowns)
        spans = np.searchsorted(starts, np.arange(len(times)), side="right") - 1
        cameras = [bundle.camera(unknowns, span) for span in range(len(starts))]
        moments = times[:, None] + unknowns[READOUT] * self._late(cameras, spans, times)  # (F, H)
        cameras = [self._shrunk_camera(camera) for camera in cameras]
        poses = [
            [between_poses(take.times, one + shift, take.qpos[:, [hand]], take.rate)[:, 0]
             for shift in (0.0, -_STEP, _STEP)]
            for hand, one in enumerate(moments.T)
        ]  # fmt: skip
        qpos = np.moveaxis(np.array(poses), 2, 0)  # (F, H, 3, 27)
        bodies = between_poses(take.times, times, take.body_poses, take.rate)
        tried, radius = np.zeros(moments.shape, dtype=np.int64), max(3, round(reach * self._size[0]))
        least, parts = np.full(moments.shape, np.nan), []
        for frame, picture in looks:
            there = np.flatnonzero(np.isfinite(qpos[frame, :, :, 0]).all(axis=1)).tolist()
            if not there:
                continue
            camera = cameras[spans[frame]]
            drawn = [self._hand(hand, qpos[frame, hand, 0]) for hand in there]
            drawn += self._things(bodies[frame])
            truth = see(camera, drawn, with_normals=False)
            for hand in there:
                outline = _outline(truth, hand, camera, take.hands[hand], qpos[frame, hand, 0])
                if outline is None:
                    continue
                tried[frame, hand] = len(outline.pixels)
                chosen, offsets, spreads, least[frame, hand] = self._across(
                    picture, truth, hand, outline, radius
                )
                kept: list[Any] = [values[chosen] for values in outline]
                outline = _Outline(*kept)
                count = len(offsets)
                velocities, regions = self._moved(hand, qpos[frame, hand], outline)
                parts.append(Edges(
                    np.full(count, frame), np.full(count, hand),
                    (outline.pixels + offsets[:, None] * outline.normals) / self._scale, outline.normals,
                    self._scale / spreads, outline.points, velocities, outline.outward,
                    regions, np.full(count, moments[frame, hand]), offsets / self._scale,
                ))  # fmt: skip
        found = Edges(*(np.concatenate(values) for values in zip(*parts, strict=True))) if parts else None
        return found, tried, least

    def _late(self, cameras: list[Camera], spans: Integers, times: Doubles) -> Doubles:
        """Rows of the hands' wrists (F, H), from -0.5 to 0.5 of the picture's height."""
        take = self._take
        wrists = between_poses(take.times, times, take.qpos, take.rate)[..., :3]
        rows = np.array([cameras[span].project(one)[:, 1] for span, one in zip(spans, wrists, strict=True)])
        return np.clip(np.nan_to_num(rows / cameras[0].size[1] - 0.5), -0.5, 0.5)

    def _shrunk_camera(self, camera: Camera) -> Camera:
        K = np.diag([self._scale, self._scale, 1.0]) @ camera.K
        return Camera(camera.name, self._size, K, camera.T_world_camera, camera.lens)

    def _hand(self, hand: int, qpos: Doubles) -> Triangles:
        """A drawn hand."""
        skin = self._skins[hand].posed(qpos)
        count = len(skin.faces)
        return Triangles(
            skin.vertices, skin.faces, skin.normals, (1 + PARTS_A_HAND * hand + skin.parts).astype(np.uint8),
            np.full(count, 1 + hand, np.uint8), np.zeros(count, np.uint8),
        )  # fmt: skip

    def _things(self, poses: Doubles) -> list[Triangles]:
        """The rigid bodies that the frame has."""
        found = []
        for number, T_world_body in enumerate(pose_matrices(poses)):
            if np.isfinite(T_world_body).all():
                instance = 1 + len(self._skins) + number
                found += [one.triangles for one in self._bodies[number].drawn(T_world_body, instance)]
        return found

    def _moved(self, hand: int, qpos: Doubles, outline: _Outline) -> tuple[Doubles, Integers]:
        """Velocities (N, 3) [m/s] of points, from poses (3, 27) now, before and after; and their regions."""
        bones = self._take.hands[hand].model.forward_kinematics(qpos)[:, outline.bones]  # (3, N, 4, 4)
        now, step = bones[0], (bones[2] - bones[1]) / (2.0 * _STEP)
        local = np.einsum("nji,nj->ni", now[:, :3, :3], outline.points - now[:, :3, 3])
        velocities = np.einsum("nij,nj->ni", step[:, :3, :3], local) + step[:, :3, 3]
        sides = np.einsum("nji,nj->ni", now[:, :3, 1:3], outline.outward) > 0.0
        return velocities, 4 * (FOREARM * hand + outline.bones) + sides @ [1, 2]

    def _across(
        self, picture: Bytes, truth: Geometry, hand: int, found: _Outline, reach: int
    ) -> tuple[Integers, Doubles, Doubles, float]:
        """Points of an outline with an edge, its distance, its deviation [px]; and the least log-odds."""
        room = 2 * reach + _AROUND
        low = np.maximum(np.floor(found.pixels.min(axis=0)).astype(int) - room, 0)
        high = np.minimum(np.ceil(found.pixels.max(axis=0)).astype(int) + room, picture.shape[1::-1])
        part = (slice(low[1], high[1]), slice(low[0], high[0]))
        mine, free = truth.instances[part] == 1 + hand, truth.instances[part] == 0
        levels = (picture[part] >> (8 - _LEVELS)).astype(np.int64)
        colors = (levels[..., 0] << 2 * _LEVELS) | (levels[..., 1] << _LEVELS) | levels[..., 2]
        inside = cv2.distanceTransform(mine.view(np.uint8), cv2.DIST_L2, 3)
        outside = cv2.distanceTransform((~mine).view(np.uint8), cv2.DIST_L2, 3)
        deep = inside > min(0.7 * reach, 0.5 * float(inside.max()))
        around = free & (outside > min(0.7 * reach, 6.0)) & (outside < reach + _AROUND)
        if deep.sum() < _FEWEST_PIXELS or around.sum() < _FEWEST_PIXELS:
            return np.empty(0, np.int64), np.empty(0), np.empty(0), np.nan
        self._seen[hand] += np.bincount(colors[deep], minlength=self._seen.shape[1])
        beside = np.bincount(colors[around], minlength=self._seen.shape[1]).astype(np.float64)
        odds = np.log(_shares(self._seen[hand]) / _shares(beside)).clip(-_SUREST, _SUREST)
        table = odds.astype(np.float32)[colors]
        within = mine & (inside > 1.5)
        bones = truth.parts[part][within].astype(np.int64) - 1 - PARTS_A_HAND * hand
        count = np.bincount(bones, minlength=PARTS_A_HAND)[:FOREARM]
        total = np.bincount(bones, table[within], minlength=PARTS_A_HAND)[:FOREARM]
        least = float((total / np.maximum(count, 1))[count >= _FEWEST_PIXELS].min(initial=_SUREST))
        steps = np.arange(-reach, reach + 1)
        places = (found.pixels - low)[:, None] + steps[:, None] * found.normals[:, None] - 0.5
        at = places.astype(np.float32)
        across = cv2.remap(table, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        in_me, in_free = (
            cv2.remap(flags.view(np.uint8), at, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0
            for flags in (mine, free)
        )
        chosen, offsets = _edge(across, in_me, in_free, reach)
        if not len(chosen):
            return chosen, offsets, offsets, least
        normals = found.normals[chosen]
        light = cv2.LUT(np.ascontiguousarray(picture[part]), _LINEAR)
        at = (found.pixels[chosen] - low + offsets[:, None] * normals)[:, None] - 0.5
        at = at + np.arange(-_BESIDE, _BESIDE + 1)[:, None] * normals[:, None]
        colors = cv2.remap(
            light, at.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        sharp, beyond, spreads = _sharpened(colors.reshape(*at.shape[:2], 3))
        return chosen[sharp], (offsets + beyond)[sharp], spreads[sharp], least


class _Outline(NamedTuple):
    """Points of a hand's outline against the background."""

    pixels: Doubles
    normals: Doubles
    points: Doubles
    outward: Doubles
    bones: Integers


def _outline(truth: Geometry, hand: int, camera: Camera, fit: GloveFit, qpos: Doubles) -> _Outline | None:
    """Points of a drawn hand's outline, without its wrist and what is beside markers and other things."""
    mine = truth.instances == 1 + hand
    left, top, width, height = cv2.boundingRect(mine.view(np.uint8))
    if width < 8 or height < 8:
        return None
    low = np.maximum([left - 8, top - 8], 0)
    high = np.minimum([left + width + 8, top + height + 8], camera.size)
    part = (slice(low[1], high[1]), slice(low[0], high[0]))
    mine, instances = np.ascontiguousarray(mine[part]), truth.instances[part]
    scale = camera.focal_length / float(truth.depth[part][mine].mean())  # [px/m]
    arm = truth.parts[part] == 1 + PARTS_A_HAND * hand + FOREARM
    other = ~mine & (instances > 0)
    nearby = cv2.dilate((instances == 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    rim = mine & nearby & ~arm
    for away, flags in ((_ARM * scale, arm), (_OTHER, other)):
        if flags.any():
            rim &= cv2.distanceTransform((~flags).astype(np.uint8), cv2.DIST_L2, 3) > away
    soft = cv2.GaussianBlur(mine.astype(np.float32), (0, 0), 1.0)
    gx, gy = (cv2.Sobel(soft, cv2.CV_32F, *order, ksize=3) / 8.0 for order in ((1, 0), (0, 1)))
    rows, columns = np.nonzero(rim)
    if len(rows) < 10:
        return None
    if len(rows) > _MOST_POINTS:
        some = np.linspace(0, len(rows) - 1, _MOST_POINTS).astype(int)
        rows, columns = rows[some], columns[some]
    gradient = np.stack([gx[rows, columns], gy[rows, columns]], axis=1).astype(np.float64)
    size = np.maximum(np.linalg.norm(gradient, axis=1), 1e-9)
    normals = -gradient / size[:, None]
    beyond = np.clip((soft[rows, columns] - 0.5) / size, -1.0, 1.0)
    pixels = low + np.stack([columns, rows], axis=1) + 0.5 + beyond[:, None] * normals
    rays = camera.unproject(np.stack([pixels, pixels + normals]))
    rays /= rays[..., 2:]
    good = (size > 0.1) & ((pixels > _EDGE) & (pixels < np.array(camera.size) - _EDGE)).all(axis=1)
    good &= np.isfinite(rays).all(axis=(0, 2))
    balls = pixels[:, None] - camera.project(fit.markers(qpos[None])[0][0])
    good &= (np.linalg.norm(balls, axis=2) > (fit.layout.radius + _BALL) * scale).all(axis=1)
    if good.sum() < 10:
        return None
    pixels, normals, rows, columns, rays = (
        pixels[good],
        normals[good],
        rows[good],
        columns[good],
        rays[:, good],
    )
    rotation, place = camera.T_world_camera[:3, :3], camera.T_world_camera[:3, 3]
    depth = truth.depth[part][rows, columns].astype(np.float64)
    outward = (rays[1] - rays[0]) / np.linalg.norm(rays[1] - rays[0], axis=1, keepdims=True)
    bones = truth.parts[part][rows, columns].astype(np.int64) - 1 - PARTS_A_HAND * hand
    points = (rays[0] * depth[:, None]) @ rotation.T + place
    return _Outline(pixels, normals, points, outward @ rotation.T, bones)


def _shares(counts: Doubles) -> Doubles:
    """Shares of colors, smoothed, of their counts."""
    side = 1 << _LEVELS
    smooth = gaussian_filter(
        counts.reshape(side, side, side).astype(np.float32), _SMOOTH, mode="nearest"
    ).ravel()
    return np.asarray(smooth / smooth.sum() + 3e-5)


def _edge(odds: Floats, in_me: Flags, in_free: Flags, reach: int) -> tuple[Integers, Doubles]:
    """Which log-odds (N, 2 R + 1) of the hand's colors, outwards, change their sign, and where [px]."""
    valid = np.ones(odds.shape, dtype=bool)
    valid[:, : reach - 1] = np.logical_and.accumulate(in_me[:, : reach - 1][:, ::-1], axis=1)[:, ::-1]
    valid[:, reach + 2 :] = np.logical_and.accumulate(in_free[:, reach + 2 :], axis=1)
    sums = np.cumsum(np.where(valid, odds, 0.0), axis=1, dtype=np.float64)
    at = np.arange(-reach, reach) + 0.5  # an edge is half a pixel beyond the last pixel of the hand
    score = 2.0 * _DEPENDENT * sums[:, :-1] - 0.5 * (at / (0.7 * reach)) ** 2
    score = np.where(valid[:, :-1] & valid[:, 1:], score, -np.inf)
    share = np.exp(score - score.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    mean = share @ at
    spread = np.sqrt(np.maximum(share @ at**2 - mean**2, 0.0))
    padded = np.pad(sums, ((0, 0), (1, 0)))
    best, rows = score.argmax(axis=1) + 1, np.arange(len(odds))
    first, last = np.maximum(best - _BESIDE, 0), np.minimum(best + _BESIDE, odds.shape[1])
    good = padded[rows, best] - padded[rows, first] > _CONTRAST * _BESIDE
    good &= padded[rows, best] - padded[rows, last] > _CONTRAST * _BESIDE
    good &= (np.abs(mean) < reach - 1.0) & (spread < 0.4 + 0.15 * reach)
    return np.flatnonzero(good), mean[good]


def _sharpened(colors: Floats) -> tuple[Flags, Doubles, Doubles]:
    """Edges of linear colors (N, 2 B + 1, 3), outwards: which are sharp, how far from the middle, deviations.

    An edge is where its pixels' light is shared between the colors on both sides.
    """
    ends = colors[:, :_FLAT], colors[:, -_FLAT:]
    inner, outer = (one.mean(axis=1, keepdims=True) for one in ends)
    step = outer - inner
    size = np.maximum((step**2).sum(axis=2), 1e-9)
    share = ((colors - inner) * step).sum(axis=2) / size
    flat = np.concatenate([share[:, :_FLAT], share[:, -_FLAT:] - 1.0], axis=1)
    noise = np.sqrt((flat**2).mean(axis=1))
    inside = 1.0 - share[:, _FLAT:-_FLAT].clip(-0.2, 1.2)
    beyond = inside.sum(axis=1) - 0.5 * inside.shape[1]
    sharp = (noise < _NOISIEST) & (np.abs(beyond) < 0.4 * inside.shape[1])
    return sharp, beyond.astype(np.float64), np.hypot(2.0 * noise, _BLUR).astype(np.float64)
