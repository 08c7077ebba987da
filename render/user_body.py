"""The person behind a take's hands: eyes, shoulders, and arms that bend as arms do.

A take knows hands alone. The person is placed where the arms of all frames are most comfortable and hide the
least of the hands, which people who work with them look at from above. Lengths are shares of the stature in
Drillis and Contini (1966), Body segment parameters, over that of the hand.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from gloves import Take
from handsim.hand.model import hand_keypoints
from handsim.space.camera import Camera
from handsim.space.transforms import quaternion_matrix
from render.arms import (
    HIDING,
    Arms,
    SeenHands,
    bend_arms,
    bending_costs,
    forearm_axes,
    hiding_costs,
    turning,
)
from render.frames import Doubles, Integers
from render.skin.look import ELBOW, REACH, Forearm

_HAND: Final = 0.108  # length of a hand, as a share of the stature
UPPER_ARM: Final = 0.186 / _HAND
"""Length of an upper arm in hand lengths, as the next two."""
_SHOULDER: Final = 0.129 / _HAND  # distance of a shoulder from the neck's axis
_EYES: Final = (0.5, 0.118 / _HAND)  # before and above the shoulders; a head that looks down leans forward
_TRUNK: Final = (
    *([[side, 0.0, -0.03], [side, 0.0, -0.288]] for side in (-0.06, -0.02, 0.02, 0.06)),
    [[-0.129, 0.0, -0.01], [0.129, 0.0, -0.01]],
)
"""Axes (5, 2, 3) that fill a trunk from the shoulders to the hips if they are as thick as arms, to the right,
ahead and upwards from the neck, as shares of the stature."""
_HEAD: Final = (
    [[0.0, 0.0, 0.0], [0.0, 0.0, 0.09]],
    *([[side, 0.005, 0.09], [side, 0.005, 0.155]] for side in (-0.018, 0.018)),
)
"""Axes (3, 2, 3) of the neck and the head, as in `_TRUNK`."""
_WRIST: Final = np.deg2rad([[54.0, 60.0], [40.0, 17.0]])
"""Largest flexion and extension, ulnar and radial deviation of a wrist [rad]: those of daily work (Ryu et al.
1991, J. Hand Surg. 16A:409), about three quarters of what wrists can."""

_SHORT: Final = 0.35  # length of an upper arm before a short sleeve, as a share for the tightest one

_FRAMES: Final = 8  # frames that places of the person are compared in
_COARSE: Final = (np.deg2rad(np.arange(0.0, 360.0, 20.0)), [0.5, 0.65], np.deg2rad([35.0]), [0.0])
"""Places that are tried: azimuths of the line of sight [rad], distances of the eyes from the hands [m], and
angles of that line below the horizon and from where the chest points [rad]."""
_TURNS: Final = np.deg2rad([-25.0, 0.0, 25.0])
_FINE: Final = (np.deg2rad([-13.0, 0.0, 13.0]), [0.4, 0.5, 0.6, 0.7], np.deg2rad([15.0, 35.0, 55.0]), _TURNS)
"""Places that are tried next, around the best azimuth, as in `_COARSE`."""
_NATURAL: Final = (0.5, np.deg2rad(40.0), 0.0)  # distance and angles of people at work, as in `_COARSE`
_SPREADS: Final = (0.12, np.deg2rad(15.0), np.deg2rad(30.0))  # spreads of these
_UNUSUAL: Final = 0.15  # weight of the cost of other distances and angles

_SWIVELS: Final = np.deg2rad(np.arange(-100.0, 101.0, 20.0))
"""Angles of the elbow about the line from the wrist to the shoulder that are tried [rad]; 0 is the lowest."""
_SWIVEL: Final = np.deg2rad(50.0)  # spread of these angles
_OUTWARDS: Final = (0.0, -0.4, 0.4, -0.8, 0.8)
"""Angles that shoulders turn forearms by when they give way [rad]."""
_OUTWARD: Final = 0.4  # spread of these angles [rad]
_SOFTNESS: Final = 0.3  # difference of costs within which elbows are averaged for placing cameras
_CHOSEN: Final = 0.2  # time between frames of a motion whose arms are chosen [s]
_CHUNK: Final = 512  # such frames that are chosen at once
_STRETCH: Final = 0.05  # difference between an upper arm's length and the drawn one whose cost is 1 [m]
_NEAR: Final = (0.36, 0.06)  # distance of an arm before the eyes that takes up the view, and its spread [m]
_RISE: Final = 0.1  # spread of the tangent by which elbows are seen above the middle of the view
_VIEW: Final = np.cos(np.deg2rad(40.0))  # cosine of half the angle of the view that arms take up
_ALONG: Final = np.linspace(0.25, 1.0, 4)  # places along forearms and hands that are looked at
_WORST: Final = 12.0  # largest cost of an arm that counts


class UserBody:
    """Eyes and shoulders of the person whose hands a take has."""

    eyes: Doubles
    """Position between the eyes (3,) [m]."""
    shoulders: Doubles
    """Position of each hand's shoulder (H, 3) [m]."""
    right: Doubles
    """Level unit direction (3,) to the person's right."""
    neck: Doubles
    """Position (3,) of the neck between the shoulders [m]."""
    mirrors: Doubles
    """1 for each right hand, -1 for each left one (H,)."""
    trunk: Doubles
    """Axes (B, 2, 3) of the trunk, the neck and the head [m]; see `_TRUNK`."""
    forearms: Doubles
    """Unit directions from wrists to elbows in all frames (T, H, 3); NaN where there is no hand."""

    def __init__(
        self, take: Take, cameras: Float[np.ndarray, "C 3"] | None = None, *, sees: bool = False
    ) -> None:
        """Place the person where no hand is hidden from the eyes, nor from cameras at these positions [m].

        Arms count as obstacles before eyes that a camera `sees` from; they give way to others.
        """
        self._cameras: Doubles = np.empty((0, 3)) if cameras is None else cameras
        self._lengths = np.array([hand.shape.length for hand in take.hands])
        self.mirrors = np.array([-1.0 if hand.side == "left" else 1.0 for hand in take.hands])
        there = np.flatnonzero(np.isfinite(take.qpos[..., 0]).any(axis=1))
        frames = there[np.linspace(0, len(there) - 1, min(_FRAMES, len(there))).astype(int)]
        wrists, axes = take.qpos[frames, :, :3], quaternion_matrix(take.qpos[frames, :, 3:7])
        palms = self._palms(wrists, axes)
        middle = _middle(palms.reshape(-1, 3))
        self._tracked = _tracked_forearms(take)
        others = np.broadcast_to(self._cameras, (len(frames), *self._cameras.shape))
        best, azimuth, seen = np.inf, 0.0, SeenHands(take, frames)
        for azimuths, distances, downs, facings in (_COARSE, _FINE):
            grids = np.meshgrid(azimuth + azimuths, distances, downs, facings)
            tried = np.stack([grid.ravel() for grid in grids], axis=1)
            eyes, neck, right = self._stand(middle, *tried.T)
            shoulders, trunk = self._shoulders(neck, right), self._trunk(neck, right)
            ways, costs = self._elbows(wrists, axes, shoulders[:, None], eyes[:, None])
            means = np.nanmean(np.minimum(costs.min(axis=-1), _WORST * (1 + len(self._cameras))), axis=(1, 2))
            means += _UNUSUAL * np.square((tried[:, 1:] - _NATURAL) / _SPREADS).sum(axis=1)
            ways = np.take_along_axis(ways, costs.argmin(axis=-1)[..., None, None], axis=3)[..., 0, :]
            elbows = self._elbows_of(wrists, ways)
            for row, eye in enumerate(eyes):
                body = _axes(wrists, elbows[row], shoulders[row], trunk[row])
                near = body[:, 0 if sees else -trunk.shape[1] : -len(_HEAD)]
                own = seen.most_hidden(near, np.broadcast_to(eye, (len(frames), 1, 3)))
                behind = seen.most_hidden(body[:, -trunk.shape[1] :], others).sum()
                means[row] += (
                    HIDING * ((np.minimum(2.0 * own, 1.0) if sees else own).sum() + behind) / len(frames)
                )
            first = int(means.argmin())
            if means[first] < best:
                best, azimuth = float(means[first]), float(tried[first, 0])
                self.eyes, self.shoulders, self.right = eyes[first], shoulders[first], right[first]
                self.trunk, self.neck = trunk[first], neck[first]
        self.forearms = _where_known(self._tracked, self._forearms(take.qpos))

    def axes(self, wrists: Float[np.ndarray, "T H 3"], forearms: Float[np.ndarray, "T H 3"]) -> Doubles:
        """Axes (T, 2 H + B, 2, 3) of forearms in these directions, of upper arms, and of the trunk [m]."""
        return _axes(wrists, self._elbows_of(wrists, forearms), self.shoulders, self.trunk)

    def hidden(
        self,
        take: Take,
        seen: SeenHands,
        frames: Integers,
        trials: Iterable[Sequence[Sequence[Camera]]],
    ) -> list[Doubles]:
        """Share (F, C) of a hand's keypoints that each trial's cameras do not see, of the more hidden hand.

        A trial has C cameras in each of F frames, which are in the head, and to which arms give way.
        """
        (arms, points, hands), wrists = self._arms_of(take, frames, whole=False), take.qpos[frames, :, :3]
        shares, ways = [], np.full((2, *wrists.shape), np.nan)
        for cameras in trials:
            ways[:, :, hands] = bend_arms(arms, points, cameras)
            elbows = self._elbows_of(wrists, ways[0])
            axes = _axes(wrists, elbows, elbows + ways[1], self.trunk[: len(_TRUNK)])
            eyes = np.array([[one.T_world_camera[:3, 3] for one in viewing] for viewing in cameras])
            shares.append(seen.most_hidden(axes, eyes))
        return shares

    def _arms_of(self, take: Take, frames: Integers, *, whole: bool) -> tuple[Arms, Doubles, list[int]]:
        """Where arms can be in these frames, keypoints (K, N, 3) [m], and the hands that ever come.

        Hands that are away wait at the nearest place where they are.
        """
        present = np.isfinite(take.qpos).all(axis=2)
        qpos, points, hands = take.qpos[frames], list[Doubles](), np.flatnonzero(present.any(axis=0)).tolist()
        for number in hands:
            there = np.flatnonzero(present[:, number])
            nearest = np.rint(np.interp(frames, there, np.arange(len(there)))).astype(int)
            qpos[:, number] = take.qpos[there[nearest], number]
            points.append(hand_keypoints(take.hands[number].model, qpos[:, number]))
        return self.arms(qpos, hands, frames, whole=whole), np.concatenate(points, axis=1), hands

    def arms(
        self,
        qpos: Float[np.ndarray, "K H 27"],
        hands: Sequence[int],
        frames: Int[np.ndarray, "K"],
        *,
        whole: bool = False,
    ) -> Arms:
        """Where the arms can be of the hands with these numbers, in these poses of all in these frames."""
        wrists, axes = qpos[..., :3], quaternion_matrix(qpos[..., 3:7])
        tried = [self._elbows(wrists, axes, self.shoulders, self.eyes, tilt) for tilt in _OUTWARDS]
        ways, costs = (np.concatenate(parts, axis=2) for parts in zip(*tried, strict=True))
        costs += np.repeat(np.square(np.array(_OUTWARDS) / _OUTWARD), len(_SWIVELS))
        ways = _where_known(self._tracked[frames, :, None], ways)
        elbows = wrists[..., None, :] + (ELBOW * self._lengths)[:, None, None] * ways
        near = (wrists[:, hands], ways[:, hands], elbows[:, hands], costs[:, hands])
        return Arms(*near, self.shoulders[hands], whole)

    def moving_arms(
        self, take: Take, cameras: Callable[[int], Sequence[Camera]], *, whole: bool
    ) -> tuple[Doubles, Doubles]:
        """Unit directions of forearms, and upper arms [m], (T, H, 3) each, in all frames of a motion.

        They are bent for cameras, and end at the shoulders if they are whole. Hands that never come have NaN.
        """
        step, chosen = max(1, round(_CHOSEN * take.rate)), []
        frames = np.arange(0, take.num_frames, step)
        for first in range(0, len(frames), _CHUNK):
            some = frames[first : first + _CHUNK]
            arms, points, hands = self._arms_of(take, some, whole=whole)
            chosen.append(bend_arms(arms, points, [*map(cameras, some.tolist())]))
        fore, upper = np.full((2, take.num_frames, len(take.hands), 3), np.nan)
        for directions, ways in zip((fore, upper), zip(*chosen, strict=True), strict=True):
            directions[:, hands] = turning(np.concatenate(ways), step, take.num_frames)
        fore, _ = _bent_wrists(fore, quaternion_matrix(take.qpos[..., 3:7]), self.mirrors)
        fore = _where_known(self._tracked, fore)
        return fore, self.shoulders - self._elbows_of(take.qpos[..., :3], fore) if whole else REACH * upper

    def _elbows_of(self, wrists: Doubles, forearms: Doubles) -> Doubles:
        """Positions (..., H, 3) of the elbows [m], from wrists [m] and unit directions of forearms."""
        return np.asarray(wrists + (ELBOW * self._lengths)[:, None] * forearms)

    def _stand(
        self, middle: Doubles, azimuth: Doubles, distance: Doubles, down: Doubles, facing: Doubles
    ) -> tuple[Doubles, Doubles, Doubles]:
        """Eyes, neck and right, (K, 3) each, of people who look at a point from these."""
        flat, length = np.cos(down), float(self._lengths.mean())
        sight = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), -np.sin(down)], axis=1)
        ahead = np.stack([np.cos(azimuth + facing), np.sin(azimuth + facing), 0.0 * facing], axis=1)
        right = np.stack([ahead[:, 1], -ahead[:, 0], ahead[:, 2]], axis=1)
        eyes = middle - distance[:, None] * sight
        return eyes, eyes - length * (_EYES[0] * ahead + [0.0, 0.0, _EYES[1]]), right

    def _shoulders(self, neck: Doubles, right: Doubles) -> Doubles:
        """Shoulders (K, H, 3) of people with these necks."""
        aside = (_SHOULDER * self._lengths * self.mirrors)[:, None]
        return np.asarray(neck[:, None] + aside * right[:, None])

    def _trunk(self, neck: Doubles, right: Doubles) -> Doubles:
        """Axes (K, B, 2, 3) of trunks, necks and heads of people with these necks."""
        places = self.stature * np.array([*_TRUNK, *_HEAD])
        return np.asarray(neck[:, None, None] + np.einsum("bei,kij->kbej", places, _directions(right)))

    @property
    def stature(self) -> float:
        """Height of the person [m]."""
        return float(self._lengths.mean()) / _HAND

    def dressed(self, arm: Forearm) -> Forearm:
        """The arm up to the shoulder, with a wrist that `axes` bend; a bare one has a short sleeve."""
        elbow, shoulder = float(self._lengths.mean()) * np.cumsum([ELBOW, UPPER_ARM])
        short = elbow + (shoulder - elbow) * _SHORT * arm.looseness
        sleeve = arm.sleeve if arm.sleeve < arm.length else float(short)
        return dataclasses.replace(arm, length=float(shoulder), sleeve=sleeve, flexion=0.0, deviation=0.0)

    @property
    def directions(self) -> Doubles:
        """Unit directions (3, 3) to the person's right, ahead and upwards, as rows."""
        return _directions(self.right)

    def _palms(self, wrists: Doubles, axes: Doubles) -> Doubles:
        return np.asarray(wrists + 0.5 * self._lengths[:, None] * axes[..., 0])

    def _forearms(self, qpos: Float[np.ndarray, "T H 27"]) -> Doubles:
        """Average the directions to all tried elbows; the less an elbow costs, the more it counts."""
        axes = quaternion_matrix(qpos[..., 3:7])
        ways, costs = self._elbows(qpos[..., :3], axes, self.shoulders, self.eyes)
        weights = np.exp((costs.min(axis=-1, keepdims=True) - costs) / _SOFTNESS)
        mean = (weights[..., None] * ways).sum(axis=-2)
        return np.asarray(mean / np.linalg.norm(mean, axis=-1, keepdims=True))

    def _elbows(
        self, wrists: Doubles, axes: Doubles, shoulders: Doubles, eyes: Doubles, outwards: float = 0.0
    ) -> tuple[Doubles, Doubles]:
        """Unit directions (..., H, S, 3) from wrists to the elbows that are tried, and their costs.

        Forearms are turned outwards [rad] from where they reach shoulders that do not move.
        """
        fore, upper = ELBOW * self._lengths, UPPER_ARM * self._lengths
        line = shoulders - wrists
        distance = np.linalg.norm(line, axis=-1)
        line /= distance[..., None]
        span = np.clip(distance, np.abs(upper - fore) + 0.05, 0.995 * (upper + fore))
        along = (fore**2 - upper**2 + span**2) / (2.0 * span * fore)
        down = line * line[..., 2:] - [0.0, 0.0, 1.0]
        down /= np.maximum(np.linalg.norm(down, axis=-1, keepdims=True), 1e-6)
        swivel = _SWIVELS[:, None]
        circle = np.cos(swivel) * down[..., None, :] + np.sin(swivel) * np.cross(line, down)[..., None, :]
        radius = np.sqrt(np.maximum(1.0 - along**2, 0.0))
        if outwards:
            angle = np.arctan2(radius, along) + outwards
            along, radius = np.cos(angle), np.sin(angle)
        ways = (along[..., None] * line)[..., None, :] + radius[..., None, None] * circle
        ways, load = _bent_wrists(ways, axes[..., None, :, :], self.mirrors[:, None])
        costs = load**2 + np.square(_SWIVELS / _SWIVEL)
        lines = shoulders[..., None, :] - wrists[..., None, :] - fore[:, None, None] * ways
        lengths = np.linalg.norm(lines, axis=-1)
        costs += np.abs(lengths - upper[:, None]) / _STRETCH
        costs += bending_costs(ways, lines / lengths[..., None])
        return ways, costs + self._in_view(ways, wrists, self._palms(wrists, axes), eyes, shoulders)

    def _in_view(
        self, ways: Doubles, wrists: Doubles, palms: Doubles, eyes: Doubles, shoulders: Doubles
    ) -> Doubles:
        """Costs (..., H, S) of arms that hide a hand from the eyes or take up much of their view."""
        reach = (ELBOW * self._lengths)[:, None, None, None] * _ALONG[:, None]
        places = wrists[..., None, None, :] + reach * ways[..., None, :] - eyes[..., None, None, None, :]
        far = np.linalg.norm(places, axis=-1)
        ahead = _middle(palms) - eyes
        ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
        above = np.eye(3)[2] - ahead[..., 2:] * ahead
        elbows = places[..., -1, :]
        rise = (elbows * above[..., None, None, :]).sum(axis=-1) / (elbows * ahead[..., None, None, :]).sum(
            axis=-1
        ).clip(0.1)
        costs = np.square(np.maximum(rise, 0.0) / _RISE)
        near = np.maximum(_NEAR[0] - far, 0.0) / _NEAR[1]
        for hand in range(palms.shape[-2]):
            sight = palms[..., hand, :] - eyes
            sight = np.nan_to_num(sight / np.linalg.norm(sight, axis=-1, keepdims=True))
            depth = (places * sight[..., None, None, None, :]).sum(axis=-1)
            costs += np.square(np.where(depth > _VIEW * far, near, 0.0)).max(axis=-1)
        return np.asarray(costs) + self._hiding(ways, wrists, 2.0 * palms - wrists, eyes, shoulders)

    def _hiding(
        self, ways: Doubles, wrists: Doubles, tips: Doubles, eyes: Doubles, shoulders: Doubles
    ) -> Doubles:
        """Costs (..., H, S) of arms that hide hands, from wrists to tips of flat ones."""
        elbows = wrists[..., None, :] + (ELBOW * self._lengths)[:, None, None] * ways
        batch, (hands, tried) = ways.shape[:-3], ways.shape[-3:-1]
        along = (wrists[..., None, :] + _ALONG[:, None] * (tips - wrists)[..., None, :]).reshape(
            *wrists.shape[:-2], -1, 3
        )
        upper = np.stack(np.broadcast_arrays(elbows, shoulders[..., None, :]), axis=-2)
        axes = np.concatenate([forearm_axes(wrists[..., None, :], elbows), upper], axis=-3)
        axes = axes.reshape(-1, hands * 2 * tried, 2, 3)
        points = np.array(np.broadcast_to(along, (*batch, *along.shape[-2:])), order="C")
        points = points.reshape(-1, *along.shape[-2:])
        eyes = np.array(np.broadcast_to(eyes, (*batch, 3)), order="C").reshape(-1, 1, 3)
        others = np.broadcast_to(self._cameras, (len(eyes), *self._cameras.shape))
        eyes = np.ascontiguousarray(np.concatenate([eyes, others], axis=1))  # one type for the compiler
        return np.asarray(hiding_costs(axes, eyes, points).reshape(*batch, hands, 2, tried).sum(axis=-2))


def _directions(right: Doubles) -> Doubles:
    """Unit directions (..., 3, 3) to the right (..., 3), ahead and upwards, as rows."""
    up = np.broadcast_to(np.eye(3)[2], right.shape)
    return np.stack([right, np.cross(up, right), up], axis=-2)


def _axes(wrists: Doubles, elbows: Doubles, shoulders: Doubles, trunk: Doubles) -> Doubles:
    """Axes (T, 2 H + B, 2, 3) of forearms, upper arms, and of a trunk and a head [m]."""
    upper = np.stack(np.broadcast_arrays(elbows, shoulders), axis=-2)
    body = np.broadcast_to(trunk, (len(wrists), *trunk.shape))
    return np.concatenate([forearm_axes(wrists, elbows), upper, body], axis=1)


def _tracked_forearms(take: Take) -> Doubles:
    """Unit directions (T, H, 3) from wrists to elbows of forearms with axes; NaN elsewhere."""
    found = np.full((*take.status.shape, 3), np.nan)
    for number, side in enumerate(take.sides):
        body = take.forearm_index(side)
        if body is not None and take.bodies[body].has_axes:
            found[:, number] = -quaternion_matrix(take.body_poses[:, body, 3:])[..., 0]
    return np.asarray(np.where(np.isfinite(take.qpos[..., :1]), found, np.nan))


def _where_known(known: Doubles, others: Doubles) -> Doubles:
    """The known directions, and others where these are NaN."""
    return np.asarray(np.where(np.isfinite(known), known, others))


def _middle(points: Doubles) -> Doubles:
    """Mean (..., 3) of the points (..., N, 3) that are there; NaN where none is."""
    there = np.isfinite(points)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(there, points, 0.0).sum(axis=-2) / there.sum(axis=-2))


def _bent_wrists(ways: Doubles, axes: Doubles, mirrors: Doubles) -> tuple[Doubles, Doubles]:
    """Directions of forearms, turned to where wrists can bend, and the bends over the largest possible."""
    local = np.einsum("...ij,...i->...j", axes, ways)
    flexion = np.arctan2(-local[..., 2], -local[..., 0])
    radial = np.arcsin(np.clip(mirrors * local[..., 1], -1.0, 1.0))
    most = np.where(flexion > 0.0, *_WRIST[0]), np.where(radial < 0.0, *_WRIST[1])
    load = np.hypot(flexion / most[0], radial / most[1])
    kept = 1.0 / np.maximum(load, 1.0)
    straight = -np.broadcast_to(axes[..., 0], ways.shape)
    angle = np.arccos(np.clip((straight * ways).sum(axis=-1), -1.0, 1.0))
    sine = np.maximum(np.sin(angle), 1e-6)
    shares = np.sin((1.0 - kept) * angle) / sine, np.sin(kept * angle) / sine
    turned = shares[0][..., None] * straight + shares[1][..., None] * ways
    return np.asarray(np.where(angle[..., None] > 1e-5, turned, straight)), load
