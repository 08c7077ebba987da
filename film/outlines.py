"""`Outlines`: finds the outlines of a take's hands in pictures, near their projections.

The tracked hand is drawn to count its colors and those around it. An edge is searched along the normal of
each point of the drawn outline: it lies where the picture's colors change from the hand's to the others
(region-based tracking: Prisacariu and Reid 2012, Int. J. Comput. Vis. 98:335; Stoiber et al. 2022,
Int. J. Comput. Vis. 130:1008).
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
_VELOCITY_STEP: Final = 0.004  # [s] step of the central differences that give velocities
_LEVELS: Final = 32  # of each color channel in the histograms
_HISTOGRAM_BLUR: Final = 1.0  # [levels] standard deviation of the histograms' smoothing
_MOST_LOG_ODDS: Final = 3.0  # largest log-odds of one color
_PIXEL_INDEPENDENCE: Final = 0.5  # factor on log-odds, because neighboring pixels are correlated
_CONTRAST: Final = 0.6  # least mean log-odds on both sides of an edge
_CONTRAST_WIDTH: Final = 5  # [px] width of each side for this mean
_END_PIXELS: Final = 3  # number of pixels at each end that show the colors of the two sides
_MOST_END_DEVIATION: Final = 0.25  # largest deviation of those colors, over the difference of the two sides
_LINEAR_LIGHT: Final = (np.linspace(0.0, 1.0, 256, dtype=np.float32) ** 2.2)[:, None]
_FEWEST_POINTS: Final = 10  # least number of points of an outline
_FEWEST_PIXELS: Final = 30  # least number of pixels of a region whose colors are counted
_RING_WIDTH: Final = 14  # [px] width of the ring around the reach whose colors are the background's
# The outline is left out within these distances of the forearm, where the wrist bends, of a marker, which the
# glove may shift, of the picture's border, and of other hands and things.
_WRIST_MARGIN, _MARKER_MARGIN = 0.02, 0.004  # [m]
_BORDER_MARGIN, _OTHER_THING_MARGIN = 3.0, 4.0  # [px]
_EDGE_QUANTILE: Final = 0.8  # quantile of the edges' distances that is reported


class OutlineSight(NamedTuple):
    """Statistics of the edges along each hand's outline in each frame (F, H); NaN without a hand."""

    tried: Doubles  # number of points at which an edge was searched
    found: Doubles  # number of edges
    middle: Doubles  # median distance of the edges from the drawn outline [px]
    most: Doubles  # quantile `_EDGE_QUANTILE` of these distances [px]
    odds: Doubles  # least mean log-odds of a bone's colors


def poses_at(take: Take, moments: Doubles) -> Doubles:
    """Interpolate the pose (F, H, 27) of each hand at its own times (F, H) [s]; NaN outside of the take."""
    poses = np.empty((*moments.shape, take.qpos.shape[2]))
    for hand, times in enumerate(moments.T):
        poses[:, [hand]] = between_poses(take.times, times, take.qpos[:, [hand]], take.rate)
    poses[(moments < take.times[0]) | (moments > take.times[-1])] = np.nan
    return poses


def shutter_times(take: Take, times: Doubles, cameras: Sequence[Camera], readout: Doubles) -> Doubles:
    """Times (F, H) [s] at which a rolling shutter reads each hand, given those of the pictures' middles."""
    wrists = between_poses(take.times, times, take.qpos, take.rate)[..., :3]
    pixels = np.array([camera.project(one) for camera, one in zip(cameras, wrists, strict=True)])
    late = np.clip(np.nan_to_num(pixels / cameras[0].size - 0.5), -0.5, 0.5)
    return np.asarray(times[:, None] + late @ readout)


class _HandCrop(NamedTuple):
    """The part of a picture around a hand, without the distortion of the lens."""

    corner: Integers  # upper left corner (2,) of the part in the whole picture [px]
    view: Camera  # pinhole camera of the whole picture
    colors: Bytes
    truth: Geometry  # ids and depth of the drawn hand in this part


class _Outline(NamedTuple):
    """Points on the border between a drawn hand and the background."""

    pixels: Doubles  # positions (N, 2) in the hand's crop [px]
    normals: Doubles  # unit normals (N, 2) that point away from the hand
    points: Doubles  # positions (N, 3) in the world [m]
    outward: Doubles  # the normals in the world (N, 3)
    bones: Integers  # bone (N,) of each point


class Outlines:
    """Finds the edges of a take's hands in the pictures of a bundle's video."""

    def __init__(self, bundle: Bundle) -> None:
        self._bundle, (width, height), take = bundle, bundle.size, bundle.take
        self._scale = min(1.0, _WIDEST / max(width, height))
        self._size = round(self._scale * width), max(1, round(self._scale * height))
        cached = functools.lru_cache(2 * len(take.hands))
        self._skin_of = cached(lambda fit: PosableSkin(fit.model, bone_relief=0.5))
        self._bodies = [BodyFigure(body, (0.5, 0.5, 0.5)) for body in take.bodies]
        self._seen = np.zeros((len(take.hands), *3 * [_LEVELS]), np.float32)  # counts of the hands' colors

    def shrunk(self, picture: Bytes) -> Bytes:
        """A picture at the size in which edges are searched."""
        return np.asarray(cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA))

    def edges(
        self, state: State, looks: Iterable[tuple[int, Bytes]], reach: float
    ) -> tuple[Samples | None, OutlineSight]:
        """Find edges within `reach` [widths] of the outlines in numbered frames, with unit normals.

        Returns:
            The edges, None if no outline is seen, and statistics of each hand in each frame.
        """
        bundle, take = self._bundle, self._bundle.take
        times, cameras = bundle.times(state), bundle.cameras(state)
        spans = state.spans(np.arange(len(times)))
        moments = shutter_times(take, times, [cameras[span] for span in spans], state.values[READOUT])
        qpos = np.stack(
            [poses_at(take, moments + late) for late in (0.0, -_VELOCITY_STEP, _VELOCITY_STEP)], axis=2
        )
        bodies = between_poses(take.times, times, take.body_poses, take.rate)
        matrix = np.diag([self._scale, self._scale, 1.0])
        views = [dataclasses.replace(one, size=self._size, K=matrix @ one.K) for one in cameras]
        maps, pinholes, parts = _undistortion_map(views[0]), [without_lens(one) for one in views], []
        radius, seen = max(3, round(reach * self._size[0])), np.full((5, *moments.shape), np.nan)
        for frame, picture in looks:
            there = np.flatnonzero(np.isfinite(qpos[frame, :, :, 0]).all(axis=1)).tolist()
            worn = take.hands_at(int(np.searchsorted(take.times, times[frame], "right")) - 1)
            room = 2 * radius + _RING_WIDTH
            drawn = [self._hand_triangles(hand, worn[hand], qpos[frame, hand, 0]) for hand in there]
            crops = self._hand_crops(picture, maps, pinholes[spans[frame]], drawn, bodies[frame], room)
            for hand, crop in zip(there, crops, strict=False):
                outline = _outline(crop, hand, worn[hand], qpos[frame, hand, 0]) if crop.colors.size else None
                if outline is None:
                    continue
                chosen, offsets, odds = self._find_edges(crop, hand, outline, radius)
                tried, count, distances = len(outline.pixels), len(offsets), np.abs(offsets / self._scale)
                outline = _Outline._make(values[chosen] for values in outline)
                middle, most = np.quantile(distances, (0.5, _EDGE_QUANTILE)) if count else (np.nan, np.nan)
                seen[:, frame, hand] = tried, count, middle, most, odds
                edges = crop.corner + outline.pixels + offsets[:, None] * outline.normals
                pixels, normals = self._with_lens(views[0], edges, outline.normals)
                velocities = self._velocities(worn[hand], qpos[frame, hand], outline)
                kept = np.isfinite(normals[:, 0])  # The lens does not see the others.
                numbers, times_of = np.full(count, frame), np.full(count, moments[frame, hand])
                from_middle = outline.points - outline.points.sum(axis=0) / max(count, 1)
                columns = numbers, pixels, normals, outline.outward, from_middle, outline.points, velocities
                parts.append([values[kept] for values in (*columns, times_of)])
        if not parts:
            return None, OutlineSight(*seen)
        *lines, points, velocities, then = map(np.concatenate, zip(*parts, strict=True))
        samples = Samples._make([*lines, lambda times: points + velocities * (times - then)[:, None]])
        return samples, OutlineSight(*seen)

    def _hand_crops(
        self, picture: Bytes, maps: Floats, view: Camera, drawn: list[Triangles], bodies: Doubles, room: int
    ) -> list[_HandCrop]:
        """Crop a picture to each drawn hand and room around it; no crops if all hands are elsewhere."""
        pixels = [view.project(one.vertices[: skin_atlas().num_hand]) for one in drawn]  # without forearms
        low = [np.fmin.reduce(one, initial=np.inf) - room for one in pixels]
        high = [np.fmax.reduce(one, initial=-np.inf) + room for one in pixels]
        ends = np.clip(np.reshape([low, high], (2, -1, 2)), 0, self._size)
        boxes, crops = np.maximum.accumulate(ends).astype(int).swapaxes(0, 1), []
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
            crops.append(_HandCrop(corner, view, np.asarray(colors)[part], there))
        return crops

    def _hand_triangles(self, hand: int, fit: GloveFit, qpos: Doubles) -> Triangles:
        """Triangles of a hand for drawing ids and depth; their normals are not used."""
        skin = self._skin_of(fit)
        vertices, count = skin.surface(qpos), len(skin.faces)
        ids = (1 + PARTS_A_HAND * hand + face_parts(), np.full(count, 1 + hand), np.zeros(count))
        return Triangles(vertices, skin.faces, vertices, *(one.astype(np.uint8) for one in ids))

    def _with_lens(self, camera: Camera, pixels: Doubles, normals: Doubles) -> tuple[Doubles, Doubles]:
        """Pixels (N, 2) and unit normals in the video's pictures of edges in undistorted ones."""
        focal, center = camera.focal_lengths, camera.K[:2, 2]
        flat = (np.stack([pixels, pixels + normals[:, ::-1] * [-1.0, 1.0]]) - center) / focal
        distorted = camera.lens.distort(np.insert(flat, 2, 1.0, axis=2)) * focal + center
        along = distorted[1] - distorted[0]
        return distorted[0] / self._scale, unit(along[:, ::-1] * [1.0, -1.0])

    def _velocities(self, fit: GloveFit, qpos: Doubles, outline: _Outline) -> Doubles:
        """Velocities (N, 3) [m/s] of an outline's points by central differences.

        The poses (3, 27) are those at the frame's time, and `_VELOCITY_STEP` before and after it.
        """
        bones = fit.model.forward_kinematics(qpos)[:, outline.bones]  # (3, N, 4, 4)
        now, step = bones[0], (bones[2] - bones[1]) / (2.0 * _VELOCITY_STEP)
        local = np.einsum("nji,nj->ni", now[:, :3, :3], outline.points - now[:, :3, 3])
        return np.asarray(np.einsum("nij,nj->ni", step[:, :3, :3], local) + step[:, :3, 3])

    def _find_edges(
        self, crop: _HandCrop, hand: int, outline: _Outline, reach: int
    ) -> tuple[Integers, Doubles, float]:
        """Points of an outline with an edge, their distances from it [px], and a bone's least log-odds."""
        own, free = (np.uint8(crop.truth.instances == number) for number in (1 + hand, 0))
        inside = cv2.distanceTransform(own, cv2.DIST_L2, 3)
        odds = self._color_log_odds(crop, hand, inside, reach)
        if odds is None:
            return np.empty(0, np.int64), np.empty(0), np.nan
        within = inside > 1.5
        bones = crop.truth.parts[within].astype(np.int64) - 1 - PARTS_A_HAND * hand
        count = np.bincount(bones, minlength=PARTS_A_HAND)[:FOREARM]
        total = np.bincount(bones, odds[within], minlength=PARTS_A_HAND)[:FOREARM]
        least = float((total / np.maximum(count, 1))[count >= _FEWEST_PIXELS].min(initial=_MOST_LOG_ODDS))
        pixels = _pixels_along_normals(outline.pixels, outline.normals, reach)
        across = cv2.remap(odds, pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        in_own, in_free = (
            cv2.remap(mask, pixels, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0
            for mask in (own, free)
        )
        chosen, offsets = _best_edge(across, in_own, in_free, reach)
        if not len(chosen):
            return chosen, offsets, least
        normals = outline.normals[chosen]
        edges = outline.pixels[chosen] + offsets[:, None] * normals
        pixels, light = (
            _pixels_along_normals(edges, normals, _CONTRAST_WIDTH),
            cv2.LUT(crop.colors, _LINEAR_LIGHT),
        )
        light = cv2.remap(light, pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        sharp, beyond = _refine_edges(light)
        return chosen[sharp], (offsets + beyond)[sharp], least

    def _color_log_odds(self, crop: _HandCrop, hand: int, inside: Floats, reach: int) -> Floats | None:
        """Log-odds (h, w) that colors are the hand's and not those around it; None for a tiny hand."""
        outside = cv2.distanceTransform((inside == 0.0).view(np.uint8), cv2.DIST_L2, 3)
        deep = inside > min(0.7 * reach, 0.5 * float(inside.max()))
        around = (outside > min(0.7 * reach, 6.0)) & (outside < reach + _RING_WIDTH)
        around &= crop.truth.instances == 0
        if deep.sum() < _FEWEST_PIXELS or around.sum() < _FEWEST_PIXELS:
            return None
        here, beside = (
            cv2.calcHist([crop.colors], [0, 1, 2], mask.view(np.uint8), 3 * [_LEVELS], 3 * [0, 256])
            for mask in (deep, around)
        )
        self._seen[hand] += here
        odds = np.log(_color_shares(self._seen[hand]) / _color_shares(beside)).clip(
            -_MOST_LOG_ODDS, _MOST_LOG_ODDS
        )
        red, green, blue = cv2.split(crop.colors // (256 // _LEVELS))
        return np.asarray(odds[red, green, blue])


def _pixels_along_normals(pixels: Doubles, normals: Doubles, reach: int) -> Floats:
    """Pixels (N, 2 R + 1, 2) along normals, counted from the first pixel's center as OpenCV does."""
    steps = np.arange(-reach, reach + 1)[:, None] * normals[:, None]
    return np.asarray(pixels[:, None] + steps - 0.5, dtype=np.float32)


def _outline(crop: _HandCrop, hand: int, fit: GloveFit, qpos: Doubles) -> _Outline | None:
    """Points of a drawn hand's outline, except near its wrist, its markers and other things."""
    truth, camera = crop.truth, crop.view
    own, free = truth.instances == 1 + hand, truth.instances == 0
    arm = truth.parts == 1 + PARTS_A_HAND * hand + FOREARM
    nearby = cv2.dilate(free.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    rim = own & nearby & ~arm
    if rim.sum() < _FEWEST_POINTS:
        return None
    scale = camera.focal_length / float(truth.depth[own].mean())  # [px/m]
    for margin, flags in ((_WRIST_MARGIN * scale, arm), (_OTHER_THING_MARGIN, ~own & ~free)):
        if flags.any():
            rim &= cv2.distanceTransform((~flags).astype(np.uint8), cv2.DIST_L2, 3) > margin
    rows, columns = np.nonzero(rim)
    some = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _MOST_POINTS)).astype(int))
    rows, columns = rows[some], columns[some]
    soft = cv2.GaussianBlur(own.astype(np.float32), (0, 0), 1.0)
    gradient = np.stack(
        [cv2.Sobel(soft, cv2.CV_64F, *order, ksize=3)[rows, columns] / 8.0 for order in ((1, 0), (0, 1))],
        axis=1,
    )
    size = np.maximum(np.linalg.norm(gradient, axis=1), 1e-9)
    normals = -gradient / size[:, None]
    beyond = np.clip((soft[rows, columns] - 0.5) / size, -1.0, 1.0)
    pixels = np.stack([columns, rows], axis=1) + 0.5 + beyond[:, None] * normals
    whole = pixels + crop.corner  # in the whole picture
    centers = fit.attachment.centers(fit.model, fit.model.forward_kinematics(qpos[None]))[0]
    distances = np.linalg.norm(whole[:, None] - camera.project(centers), axis=2)
    good = (distances > (fit.layout.radius + _MARKER_MARGIN) * scale).all(axis=1) & (size > 0.1)
    good &= ((whole > _BORDER_MARGIN) & (whole < np.array(camera.size) - _BORDER_MARGIN)).all(axis=1)
    if good.sum() < _FEWEST_POINTS:
        return None
    pixels, whole, normals, rows, columns = (one[good] for one in (pixels, whole, normals, rows, columns))
    rotation, position = camera.T_world_camera[:3, :3], camera.T_world_camera[:3, 3]
    rays, beside = (camera.unproject(one) for one in (whole, whole + normals))
    rays, beside = rays / rays[:, 2:], beside / beside[:, 2:]
    points = rays * truth.depth[rows, columns, None].astype(np.float64) @ rotation.T + position
    bones = truth.parts[rows, columns].astype(np.int64) - 1 - PARTS_A_HAND * hand
    return _Outline(pixels, normals, points, unit(beside - rays) @ rotation.T, bones)


def _color_shares(counts: Floats) -> Floats:
    """Smoothed frequencies of colors from their counts (32, 32, 32)."""
    smooth = cv2.GaussianBlur(counts, (0, 0), _HISTOGRAM_BLUR, borderType=cv2.BORDER_REPLICATE)
    flat = smooth.reshape(-1, _LEVELS)  # OpenCV does not blur along the last axis, that of its channels
    smooth = cv2.GaussianBlur(flat, (0, 1), _HISTOGRAM_BLUR, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(smooth.reshape(counts.shape) / smooth.sum() + np.float32(3e-5))


def _best_edge(odds: Floats, in_own: Flags, in_free: Flags, reach: int) -> tuple[Integers, Doubles]:
    """Points where the log-odds (N, 2 R + 1) along outward normals change their sign, and where [px].

    Only pixels that `in_own` and `in_free` connect to the outline count inside and outside of it.
    """
    valid = np.ones(odds.shape, dtype=bool)
    valid[:, : reach - 1] = np.logical_and.accumulate(in_own[:, : reach - 1][:, ::-1], axis=1)[:, ::-1]
    valid[:, reach + 2 :] = np.logical_and.accumulate(in_free[:, reach + 2 :], axis=1)
    sums = np.cumsum(np.where(valid, odds, 0.0), axis=1, dtype=np.float64)
    at = (
        np.arange(-reach, reach) + 0.5
    )  # The edge is half a pixel beyond the center of the hand's last pixel.
    score = 2.0 * _PIXEL_INDEPENDENCE * sums[:, :-1] - 0.5 * (at / (0.7 * reach)) ** 2
    score = np.where(valid[:, :-1] & valid[:, 1:], score, -np.inf)
    padded = np.pad(sums, ((0, 0), (1, 0)))
    best, rows = score.argmax(axis=1) + 1, np.arange(len(odds))
    first, last = np.maximum(best - _CONTRAST_WIDTH, 0), np.minimum(best + _CONTRAST_WIDTH, odds.shape[1])
    good = padded[rows, best] - padded[rows, first] > _CONTRAST * _CONTRAST_WIDTH
    good &= padded[rows, best] - padded[rows, last] > _CONTRAST * _CONTRAST_WIDTH
    offsets = at[best - 1]
    good &= np.abs(offsets) < reach - 1.0
    return np.flatnonzero(good), offsets[good]


def _refine_edges(colors: Floats) -> tuple[Flags, Doubles]:
    """Select sharp edges of linear colors (N, 2 B + 1, 3) along outward normals, and locate them [px].

    The pixels at an edge mix the colors of both sides; the sum of the hand's shares locates the edge.
    """
    inner, outer = (
        one.mean(axis=1, keepdims=True) for one in (colors[:, :_END_PIXELS], colors[:, -_END_PIXELS:])
    )
    step = outer - inner
    size = np.maximum((step**2).sum(axis=2), 1e-9)
    share = ((colors - inner) * step).sum(axis=2) / size
    flat = np.concatenate([share[:, :_END_PIXELS], share[:, -_END_PIXELS:] - 1.0], axis=1)
    inside = 1.0 - share[:, _END_PIXELS:-_END_PIXELS].clip(-0.2, 1.2)
    beyond = inside.sum(axis=1) - 0.5 * inside.shape[1]
    sharp = (np.sqrt((flat**2).mean(axis=1)) < _MOST_END_DEVIATION) & (np.abs(beyond) < 0.4 * inside.shape[1])
    return sharp, beyond.astype(np.float64)


def _undistortion_map(camera: Camera) -> Floats:
    """Pixels (H, W, 2) of a camera's picture that `cv2.remap` moves to an undistorted picture."""
    at_origin = camera.at(np.eye(4))
    return np.asarray(at_origin.project(without_lens(at_origin).rays()) - 0.5, dtype=np.float32)


def without_lens(camera: Camera) -> Camera:
    """A camera without distortion that has the same matrix and pose."""
    return dataclasses.replace(camera, lens=Lens())
