"""`Outlines`: where the outlines of a take's hands are in pictures, near where a camera would see them.

The tracked hand is drawn, and its colors and those around it are counted. Across each point of its outline,
the edge is where the picture's colors change from the hand's to the others (region-based tracking: Prisacariu
and Reid 2012, Int. J. Comput. Vis. 98:335; Stoiber et al. 2022, Int. J. Comput. Vis. 130:1008).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np

from film.bundle import READOUT, Bundle, Samples, State
from gloves.fit import GloveFit
from gloves.takes.take import Take
from handsim.hand.model import between_poses
from handsim.space.camera import Camera, Lens
from handsim.space.transforms import pose_matrices, unit
from render.frames import FOREARM, PARTS_A_HAND, Bytes, Doubles, Flags, Floats, Geometry, Integers
from render.painting.figures import BodyFigure
from render.painting.rasterizer import Triangles, see
from render.skin.mesh import PosableSkin, face_parts, skin_atlas

_WIDEST: Final = 800  # [px] Wider pictures are shrunk to this width.
_MOST_POINTS: Final = 80  # largest number of outline points of a hand in a picture
_STEP: Final = 0.004  # [s] step of the central differences that give velocities
_LEVELS: Final = 32  # of each color channel in the histograms
_SMOOTH: Final = 1.0  # [levels] standard deviation of the histograms' smoothing
_SUREST: Final = 3.0  # largest log-odds that one color gives
_PIXEL_INDEPENDENCE: Final = 0.5  # Neighboring pixels are alike: this share of their log-odds counts.
_CONTRAST: Final = 0.6  # An edge has at least these mean log-odds on both sides.
_BESIDE: Final = 5  # [px] width of each side for this mean
_FLAT: Final = 3  # number of pixels at each end that show the colors of the two sides
_NOISIEST: Final = 0.25  # largest deviation of those colors, over the difference of the two sides
_LINEAR: Final = (np.linspace(0.0, 1.0, 256, dtype=np.float32) ** 2.2)[:, None]
_FEWEST_POINTS: Final = 10  # An outline has this many points.
_FEWEST_PIXELS: Final = 30  # Colors of a region are counted if it has this many pixels.
_AROUND: Final = 14  # [px] width of the ring around the reach whose colors are the background's
_ARM: Final = 0.02  # [m] The outline this near to the forearm is left out, because the wrist bends there.
_BALL: Final = 0.004  # [m] The outline this near to a marker is left out, because the glove may carry it.
_EDGE: Final = 3.0  # [px] The outline this near to the edge of the picture is left out.
_WITHIN: Final = 0.8  # share of the edges whose largest distance is told
_OTHER: Final = 4.0  # [px] The outline this near to another hand or thing is left out.


class Seen(NamedTuple):
    """How well the outlines of hands are seen in frames; NaN where there is no hand."""

    tried: Doubles  # (F, H): number of points at which an edge was looked for
    found: Doubles  # (F, H): number of edges
    middle: Doubles  # (F, H): median distance of the edges from the drawn outline [px]
    most: Doubles  # (F, H): distance within which the share `_WITHIN` of them is [px]
    odds: Doubles  # (F, H): least mean log-odds of a bone's colors


def poses_at(take: Take, moments: Doubles) -> Doubles:
    """Poses (F, H, 27) of each hand at its own times (F, H) [s]; NaN before and after the take."""
    poses = np.empty((*moments.shape, take.qpos.shape[2]))
    for hand, times in enumerate(moments.T):
        poses[:, [hand]] = between_poses(take.times, times, take.qpos[:, [hand]], take.rate)
    poses[(moments < take.times[0]) | (moments > take.times[-1])] = np.nan
    return poses


def shutter_times(take: Take, times: Doubles, cameras: Sequence[Camera], readout: Doubles) -> Doubles:
    """Times (F, H) [s] at which a rolling shutter reads each hand, given that of each picture's middle."""
    wrists = between_poses(take.times, times, take.qpos, take.rate)[..., :3]
    pixels = np.array([camera.project(one) for camera, one in zip(cameras, wrists, strict=True)])
    late = np.clip(np.nan_to_num(pixels / cameras[0].size - 0.5), -0.5, 0.5)
    return np.asarray(times[:, None] + late @ readout)


class _HandView(NamedTuple):
    """The part of a picture around a hand, as a pinhole camera sees it."""

    corner: Integers  # (2,): of the part [px]
    view: Camera  # of the whole picture
    colors: Bytes
    truth: Geometry  # what is drawn there


class _Outline(NamedTuple):
    """Points on the line where a drawn hand ends and the background begins."""

    pixels: Doubles
    normals: Doubles
    points: Doubles
    outward: Doubles
    bones: Integers


class Outlines:
    """Finds the edges of a take's hands in the pictures of a bundle's video."""

    def __init__(self, bundle: Bundle) -> None:
        self._bundle, (width, height), take = bundle, bundle.size, bundle.take
        self._scale = min(1.0, _WIDEST / max(width, height))
        self._size = round(self._scale * width), max(1, round(self._scale * height))
        self._skin_of = functools.lru_cache(2 * len(take.hands))(lambda fit: PosableSkin(fit.model, bony=0.5))
        self._bodies = [BodyFigure(body, (0.5, 0.5, 0.5)) for body in take.bodies]
        self._seen = np.zeros((len(take.hands), *3 * [_LEVELS]), np.float32)  # counts of the hands' colors

    def shrunk(self, picture: Bytes) -> Bytes:
        """A picture as it is looked at."""
        return np.asarray(cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA))

    def edges(
        self, state: State, looks: Iterable[tuple[int, Bytes]], reach: float
    ) -> tuple[Samples | None, Seen]:
        """Edges with unit normals within `reach` [widths] in numbered frames, and how well they are seen.

        None stands for no outline.
        """
        bundle, take = self._bundle, self._bundle.take
        times, cameras = bundle.times(state), bundle.cameras(state)
        spans = state.spans(np.arange(len(times)))
        moments = shutter_times(take, times, [cameras[span] for span in spans], state.values[READOUT])
        qpos = np.stack([poses_at(take, moments + late) for late in (0.0, -_STEP, _STEP)], axis=2)
        bodies = between_poses(take.times, times, take.body_poses, take.rate)
        matrix = np.diag([self._scale, self._scale, 1.0])
        views = [dataclasses.replace(one, size=self._size, K=matrix @ one.K) for one in cameras]
        maps, flat, parts = straightening(views[0]), [straight(one) for one in views], []
        radius, seen = max(3, round(reach * self._size[0])), np.full((5, *moments.shape), np.nan)
        for frame, picture in looks:
            there = np.flatnonzero(np.isfinite(qpos[frame, :, :, 0]).all(axis=1)).tolist()
            worn = take.hands_at(int(np.searchsorted(take.times, times[frame], "right")) - 1)
            room = 2 * radius + _AROUND
            drawn = [self._hand(hand, worn[hand], qpos[frame, hand, 0]) for hand in there]
            parts_of = self._looks(picture, maps, flat[spans[frame]], drawn, bodies[frame], room)
            for hand, look in zip(there, parts_of, strict=False):
                outline = _outline(look, hand, worn[hand], qpos[frame, hand, 0]) if look.colors.size else None
                if outline is None:
                    continue
                chosen, offsets, odds = self._across(look, hand, outline, radius)
                tried, away = len(outline.pixels), offsets / self._scale
                outline = _Outline._make(values[chosen] for values in outline)
                middle, most = np.quantile(np.abs(away), (0.5, _WITHIN)) if len(away) else (np.nan, np.nan)
                seen[:, frame, hand] = tried, len(away), middle, most, odds
                places = look.corner + outline.pixels + offsets[:, None] * outline.normals
                pixels, normals = self._pictured(views[0], places, outline.normals)
                velocities = self._moved(worn[hand], qpos[frame, hand], outline)
                kept = np.isfinite(normals[:, 0])  # others are beyond what the lens sees
                here, then = np.full(len(away), frame), np.full(len(away), moments[frame, hand])
                larger = outline.points - outline.points.sum(axis=0) / max(len(away), 1)
                found = here, pixels, normals, outline.outward, larger, outline.points, velocities, then
                parts.append([values[kept] for values in found])
        if not parts:
            return None, Seen(*seen)
        *lines, points, velocities, then = map(np.concatenate, zip(*parts, strict=True))
        edges = Samples._make([*lines, lambda times: points + velocities * (times - then)[:, None]])
        return edges, Seen(*seen)

    def _looks(
        self, picture: Bytes, maps: Floats, view: Camera, drawn: list[Triangles], bodies: Doubles, room: int
    ) -> list[_HandView]:
        """The parts of a picture with each drawn hand and room around it; none if all are elsewhere."""
        pixels = [view.project(one.vertices[: skin_atlas().num_hand]) for one in drawn]  # without forearms
        low = [np.fmin.reduce(one, initial=np.inf) - room for one in pixels]
        high = [np.fmax.reduce(one, initial=-np.inf) + room for one in pixels]
        ends = np.clip(np.reshape([low, high], (2, -1, 2)), 0, self._size)
        boxes, looks = np.maximum.accumulate(ends).astype(int).swapaxes(0, 1), []
        first, last = boxes.min(axis=(0, 1), initial=max(self._size)), boxes.max(axis=(0, 1), initial=0)
        if (last - first).min() < 8:
            return []
        for number, T_world_body in enumerate(pose_matrices(bodies)):
            if np.isfinite(T_world_body).all():
                instance = 1 + len(self._bundle.take.hands) + number
                drawn += [one.triangles for one in self._bodies[number].drawn(T_world_body, instance)]
        colors = cv2.remap(picture, maps[first[1] : last[1], first[0] : last[0]], None, cv2.INTER_LINEAR)
        truth = see(view.part(*first.tolist(), *(last - first).tolist()), drawn, with_normals=False)
        for corner, box in zip(boxes[:, 0], boxes - first, strict=True):
            part = tuple(slice(*ends) for ends in box.T[::-1])
            there = Geometry(truth.depth[part], None, *(one[part] for one in truth[2:]))
            looks.append(_HandView(corner, view, np.asarray(colors)[part], there))
        return looks

    def _hand(self, hand: int, fit: GloveFit, qpos: Doubles) -> Triangles:
        """A drawn hand, without normals."""
        skin = self._skin_of(fit)
        vertices, count = skin.surface(qpos), len(skin.faces)
        ids = (1 + PARTS_A_HAND * hand + face_parts(), np.full(count, 1 + hand), np.zeros(count))
        return Triangles(vertices, skin.faces, vertices, *(one.astype(np.uint8) for one in ids))

    def _pictured(self, camera: Camera, pixels: Doubles, normals: Doubles) -> tuple[Doubles, Doubles]:
        """Pixels (N, 2) and unit normals of straightened edges, in the video's pictures."""
        focal, center = camera.focal_lengths, camera.K[:2, 2]
        flat = (np.stack([pixels, pixels + normals[:, ::-1] * [-1.0, 1.0]]) - center) / focal
        points = camera.lens.distort(np.insert(flat, 2, 1.0, axis=2)) * focal + center
        along = points[1] - points[0]
        return points[0] / self._scale, unit(along[:, ::-1] * [1.0, -1.0])

    def _moved(self, fit: GloveFit, qpos: Doubles, outline: _Outline) -> Doubles:
        """Velocities (N, 3) [m/s] of an outline's points by central differences.

        The hand's poses (3, 27) are those of the moment, of `_STEP` before it, and of `_STEP` after it.
        """
        bones = fit.model.forward_kinematics(qpos)[:, outline.bones]  # (3, N, 4, 4)
        now, step = bones[0], (bones[2] - bones[1]) / (2.0 * _STEP)
        local = np.einsum("nji,nj->ni", now[:, :3, :3], outline.points - now[:, :3, 3])
        return np.asarray(np.einsum("nij,nj->ni", step[:, :3, :3], local) + step[:, :3, 3])

    def _across(
        self, look: _HandView, hand: int, found: _Outline, reach: int
    ) -> tuple[Integers, Doubles, float]:
        """Points of an outline with an edge, its distance from them [px]; and the least log-odds."""
        mine, free = look.truth.instances == 1 + hand, look.truth.instances == 0
        inside = cv2.distanceTransform(mine.view(np.uint8), cv2.DIST_L2, 3)
        table = self._odds(look, hand, inside, reach)
        if table is None:
            return np.empty(0, np.int64), np.empty(0), np.nan
        within = mine & (inside > 1.5)
        bones = look.truth.parts[within].astype(np.int64) - 1 - PARTS_A_HAND * hand
        count = np.bincount(bones, minlength=PARTS_A_HAND)[:FOREARM]
        total = np.bincount(bones, table[within], minlength=PARTS_A_HAND)[:FOREARM]
        least = float((total / np.maximum(count, 1))[count >= _FEWEST_PIXELS].min(initial=_SUREST))
        places = _along(found.pixels, found.normals, reach)
        across, in_me, in_free = (
            cv2.remap(one, places, None, how, borderMode=cv2.BORDER_CONSTANT)
            for one, how in (
                (table, cv2.INTER_LINEAR),
                (mine.view(np.uint8), cv2.INTER_NEAREST),
                (free.view(np.uint8), cv2.INTER_NEAREST),
            )
        )
        chosen, offsets = _edge(across, in_me > 0, in_free > 0, reach)
        if not len(chosen):
            return chosen, offsets, least
        normals = found.normals[chosen]
        places = _along(found.pixels[chosen] + offsets[:, None] * normals, normals, _BESIDE)
        light = cv2.remap(
            cv2.LUT(look.colors, _LINEAR), places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        sharp, beyond = _sharpened(light)
        return chosen[sharp], (offsets + beyond)[sharp], least

    def _odds(self, look: _HandView, hand: int, inside: Floats, reach: int) -> Floats | None:
        """Log-odds (h, w) that colors are the hand's and not those around it; None for a tiny hand."""
        outside = cv2.distanceTransform((inside == 0.0).view(np.uint8), cv2.DIST_L2, 3)
        deep = inside > min(0.7 * reach, 0.5 * float(inside.max()))
        around = (outside > min(0.7 * reach, 6.0)) & (outside < reach + _AROUND)
        around &= look.truth.instances == 0
        if deep.sum() < _FEWEST_PIXELS or around.sum() < _FEWEST_PIXELS:
            return None
        here, beside = (
            cv2.calcHist([look.colors], [0, 1, 2], mask.view(np.uint8), 3 * [_LEVELS], 3 * [0, 256])
            for mask in (deep, around)
        )
        self._seen[hand] += here
        odds = np.log(_shares(self._seen[hand]) / _shares(beside)).clip(-_SUREST, _SUREST)
        red, green, blue = cv2.split(look.colors // (256 // _LEVELS))
        return np.asarray(odds[red, green, blue])


def _along(pixels: Doubles, normals: Doubles, reach: int) -> Floats:
    """Pixels (N, 2 R + 1, 2), as OpenCV counts, along normals."""
    steps = np.arange(-reach, reach + 1)[:, None] * normals[:, None]
    return np.asarray(pixels[:, None] + steps - 0.5, dtype=np.float32)


def _outline(look: _HandView, hand: int, fit: GloveFit, qpos: Doubles) -> _Outline | None:
    """Points of a drawn hand's outline, without its wrist and what is beside markers and other things."""
    truth, camera = look.truth, look.view
    mine, free = truth.instances == 1 + hand, truth.instances == 0
    arm = truth.parts == 1 + PARTS_A_HAND * hand + FOREARM
    nearby = cv2.dilate(free.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    rim = mine & nearby & ~arm
    if rim.sum() < _FEWEST_POINTS:
        return None
    scale = camera.focal_length / float(truth.depth[mine].mean())  # [px/m]
    for away, flags in ((_ARM * scale, arm), (_OTHER, ~mine & ~free)):
        if flags.any():
            rim &= cv2.distanceTransform((~flags).astype(np.uint8), cv2.DIST_L2, 3) > away
    rows, columns = np.nonzero(rim)
    some = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _MOST_POINTS)).astype(int))
    rows, columns = rows[some], columns[some]
    soft = cv2.GaussianBlur(mine.astype(np.float32), (0, 0), 1.0)
    gradient = np.stack(
        [cv2.Sobel(soft, cv2.CV_64F, *order, ksize=3)[rows, columns] / 8.0 for order in ((1, 0), (0, 1))],
        axis=1,
    )
    size = np.maximum(np.linalg.norm(gradient, axis=1), 1e-9)
    normals = -gradient / size[:, None]
    beyond = np.clip((soft[rows, columns] - 0.5) / size, -1.0, 1.0)
    pixels = np.stack([columns, rows], axis=1) + 0.5 + beyond[:, None] * normals
    places = pixels + look.corner
    centers = fit.attachment.centers(fit.model, fit.model.forward_kinematics(qpos[None]))[0]
    balls = places[:, None] - camera.project(centers)
    good = (np.linalg.norm(balls, axis=2) > (fit.layout.radius + _BALL) * scale).all(axis=1) & (size > 0.1)
    good &= ((places > _EDGE) & (places < np.array(camera.size) - _EDGE)).all(axis=1)
    if good.sum() < _FEWEST_POINTS:
        return None
    pixels, places, normals, rows, columns = (one[good] for one in (pixels, places, normals, rows, columns))
    rotation, place = camera.T_world_camera[:3, :3], camera.T_world_camera[:3, 3]
    rays, beside = (camera.unproject(one) for one in (places, places + normals))
    rays, beside = rays / rays[:, 2:], beside / beside[:, 2:]
    points = rays * truth.depth[rows, columns, None].astype(np.float64) @ rotation.T + place
    bones = truth.parts[rows, columns].astype(np.int64) - 1 - PARTS_A_HAND * hand
    return _Outline(pixels, normals, points, unit(beside - rays) @ rotation.T, bones)


def _shares(counts: Floats) -> Floats:
    """Shares of colors, smoothed, of their counts."""
    smooth = cv2.GaussianBlur(counts, (0, 0), _SMOOTH, borderType=cv2.BORDER_REPLICATE)
    flat = smooth.reshape(-1, _LEVELS)  # OpenCV does not blur along the last axis, that of its channels
    smooth = cv2.GaussianBlur(flat, (0, 1), _SMOOTH, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(smooth.reshape(counts.shape) / smooth.sum() + np.float32(3e-5))


def _edge(odds: Floats, in_me: Flags, in_free: Flags, reach: int) -> tuple[Integers, Doubles]:
    """Which log-odds (N, 2 R + 1) of the hand's colors, outwards, change their sign, and where [px]."""
    valid = np.ones(odds.shape, dtype=bool)
    valid[:, : reach - 1] = np.logical_and.accumulate(in_me[:, : reach - 1][:, ::-1], axis=1)[:, ::-1]
    valid[:, reach + 2 :] = np.logical_and.accumulate(in_free[:, reach + 2 :], axis=1)
    sums = np.cumsum(np.where(valid, odds, 0.0), axis=1, dtype=np.float64)
    at = np.arange(-reach, reach) + 0.5  # an edge is half a pixel beyond the last pixel of the hand
    score = 2.0 * _PIXEL_INDEPENDENCE * sums[:, :-1] - 0.5 * (at / (0.7 * reach)) ** 2
    score = np.where(valid[:, :-1] & valid[:, 1:], score, -np.inf)
    padded = np.pad(sums, ((0, 0), (1, 0)))
    best, rows = score.argmax(axis=1) + 1, np.arange(len(odds))
    first, last = np.maximum(best - _BESIDE, 0), np.minimum(best + _BESIDE, odds.shape[1])
    good = padded[rows, best] - padded[rows, first] > _CONTRAST * _BESIDE
    good &= padded[rows, best] - padded[rows, last] > _CONTRAST * _BESIDE
    offsets = at[best - 1]
    good &= np.abs(offsets) < reach - 1.0
    return np.flatnonzero(good), offsets[good]


def _sharpened(colors: Floats) -> tuple[Flags, Doubles]:
    """Which edges of linear colors (N, 2 B + 1, 3), outwards, are sharp, and how far from the middle [px].

    An edge is where its pixels' light is shared between the colors on both sides.
    """
    inner, outer = (one.mean(axis=1, keepdims=True) for one in (colors[:, :_FLAT], colors[:, -_FLAT:]))
    step = outer - inner
    size = np.maximum((step**2).sum(axis=2), 1e-9)
    share = ((colors - inner) * step).sum(axis=2) / size
    flat = np.concatenate([share[:, :_FLAT], share[:, -_FLAT:] - 1.0], axis=1)
    inside = 1.0 - share[:, _FLAT:-_FLAT].clip(-0.2, 1.2)
    beyond = inside.sum(axis=1) - 0.5 * inside.shape[1]
    sharp = (np.sqrt((flat**2).mean(axis=1)) < _NOISIEST) & (np.abs(beyond) < 0.4 * inside.shape[1])
    return sharp, beyond.astype(np.float64)


def straightening(camera: Camera) -> Floats:
    """Where `cv2.remap` finds the pixels (H, W, 2) of a pinhole camera in a camera's picture."""
    bent = camera.at(np.eye(4))
    return np.asarray(bent.project(straight(bent).rays()) - 0.5, dtype=np.float32)


def straight(camera: Camera) -> Camera:
    """The camera without its lens."""
    return dataclasses.replace(camera, lens=Lens())
