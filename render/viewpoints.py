"""Camera poses for each frame of a take: still, in orbit, on a head, or on a rig.

Paths are computed once for a whole take, from the motion of its hands, so that any frame can be drawn
alone.
"""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from gloves.takes.take import Take
from handsim.errors import ArgumentError, HandSimWarning, RigError
from handsim.hand.model import hand_keypoints
from handsim.settings import Limits, Settings
from handsim.space.camera import Camera, look_at, preset
from handsim.space.rig import check_near, load_rig
from handsim.space.rig_formats import load_cameras
from handsim.space.transforms import UpAxis, quaternion_matrix, rigid, room_axes
from render.arms import MOST_HIDDEN, SeenHands
from render.frames import Doubles, Flags, Floats, Integers
from render.user_body import UserBody

_OUTLINE: Final = (0, 2, 4, 5, 6, 8, 10, 12, 14, 16, 17, 18, 20)  # keypoints that span a hand's outline
_CHUNK: Final = 2048  # frames whose keypoints are computed at once
_SKIN: Final = 0.012  # thickness of the skin around keypoints [m]
_SLEEVE: Final = 0.1  # distance from a forearm's axis to the outside of a sleeve or an upper arm [m]
_ALONG_ARM: Final = np.linspace(0.0, 0.6, 13)  # distances from the wrist, beyond the elbow, too [m]
_BESIDE: Final = 0.15  # border beside a picture that arms are seen in, as a share of its size
_BORDER: Final = 0.04  # border of a picture that hands keep free, as a share of half its width or height
_NEAREST_KEYPOINT: Final = 0.15  # least depth of a keypoint before a camera [m]
_WIDEST_TANGENT: Final = 2.0  # largest tangent of half an angle of view that hands may fill
_MOUNTED: Final = 0.03  # largest distance of a head's camera from the eyes along each axis [m]
_LEANS: Final = np.array([*itertools.product((0.0, 0.1, 0.2, 0.3), (0.0, -0.1, 0.1), (0.0, 0.08))])
"""Distances [m] that a head is moved by: back, to the right, and upwards."""
_EFFORT: Final = 0.3  # share of pictures with free hands that a head is moved a meter for
_ORBIT_PERIOD: Final = 12.0  # time of one revolution of a camera in orbit [s]
_TRIES: Final = 60  # random directions that are tried for one camera
_CLOSER: Final = 1.35  # largest ratio between a hand's share and `ViewConfig.share`
_ENOUGH: Final = 1.05  # ratio of the wanted share to the hands' up to which no other place is tried
_SKIN_CLEARANCE: Final = 0.08  # least depth of a keypoint before a camera around hands [m]
SHIFT_SHARE: Final = 0.8  # share of the room around hands in a picture that they are shifted within
_LENS_SEEN_SHARE: Final = 0.97  # share of the frames that a lens without zoom shows whole
_PLACES: Final = 16  # places, or orbits, that are tried for hands that are far apart
_AZIMUTHS: Final = 36  # azimuths of an orbit whose views are compared
_SAMPLES: Final = 48  # frames in which they are compared
_CENTERINGS: Final = 2  # times that a camera is turned to the middle of what it sees
_LINGER: Final = 20.0  # exponent of the hands' share in the time that an orbit spends on a view
_QUICKEST: Final = 0.02  # shortest time at an azimuth of an orbit, as a share of the longest
_CLEAR_SHARE: Final = 0.97  # Other places are tried until this share of the pictures shows all hands.
_GIVES_WAY: Final = 3.0  # power of that share that outweighs the size of the hands
_ASIDE: Final = np.deg2rad(90.0)  # largest angle that is added to the usual one from the front
_ARM_CLEARANCE: Final = np.deg2rad(35.0)  # least angle between a view and a forearm
_PLACING: Final = ("placement", "camera", "views", "share", "distance", "rig")
"""Options that place cameras, which your own cameras do not need."""
_UNUSED: Final = {
    "still": ("rig",),
    "orbit": ("rig",),
    "head": ("share", "distance", "rig"),
    "rig": ("views", "share", "distance"),
}
"""Options that a placement has no use for."""


class Framing:
    """Distances and directions at which cameras show the hands of a take."""

    def __init__(self, take: Take, user: UserBody | None = None) -> None:
        self.user, self._take = user, take
        straight = -quaternion_matrix(take.qpos[..., 3:7])[..., 0]
        self.forearms: Doubles = straight if user is None else user.forearms
        """Unit direction (T, H, 3) from each wrist to its elbow; NaN where there is no hand."""
        shape = (take.num_frames, len(take.hands), len(_OUTLINE), 3)
        self.points: Floats = np.full(shape, np.nan, dtype=np.float32)
        """Keypoints of all hands in the world (T, H, P, 3) [m]; NaN where a hand is absent."""
        for span, number, hand in ((s, *one) for s, hands in take.worn() for one in enumerate(hands)):
            there = span.start + np.flatnonzero(np.isfinite(take.qpos[span, number]).all(axis=1))
            for first in range(0, len(there), _CHUNK):
                rows = there[first : first + _CHUNK]
                self.points[rows, number] = hand_keypoints(hand.model, take.qpos[rows, number])[:, _OUTLINE]
        self._there = np.isfinite(self.points[..., 0, 0])
        self.trunk: Doubles = np.empty((0, 3)) if user is None else user.trunk.reshape(-1, 3)
        """Positions (N, 3) of the person's trunk and head [m]; none of nobody."""
        self.sampled: Integers = np.unique(np.linspace(0, take.num_frames - 1, _SAMPLES).astype(int))
        """Some frames, in which views are compared."""
        if user is not None:
            self._arms = user.axes(take.qpos[self.sampled, :, :3], user.forearms[self.sampled])
        known = np.flatnonzero(self._there.any(axis=1))
        flat = self.points[known].reshape(len(known), -1, 3).astype(np.float64)
        middles = 0.5 * (np.nanmin(flat, axis=1) + np.nanmax(flat, axis=1))
        frames = np.arange(take.num_frames)
        self.centers = np.stack([np.interp(frames, known, middles[:, axis]) for axis in range(3)], axis=1)
        """Middle of the box around all hands of each frame (T, 3) [m], interpolated where there are none."""
        self._window = max(1, round(0.5 * take.rate))

    def middle(self) -> Doubles:
        """Middle (3,) of the box around the centers of all frames [m]."""
        return np.asarray(0.5 * (self.centers.min(axis=0) + self.centers.max(axis=0)))

    def followed(self) -> Doubles:
        """The centers (T, 3) [m] averaged over half a second, as a person with a camera follows them."""
        from scipy.ndimage import uniform_filter1d

        return np.asarray(uniform_filter1d(self.centers, self._window, axis=0, mode="nearest"))

    def held(self, distances: Doubles) -> Doubles:
        """Distances (T,) that change slowly and are nowhere shorter than these [m]."""
        from scipy.ndimage import maximum_filter1d, uniform_filter1d

        longest = maximum_filter1d(distances, 2 * (self._window // 2) + 1, mode="nearest")
        return np.asarray(uniform_filter1d(longest, 2 * (self._window // 2) + 1, mode="nearest"))

    def longer_sides(self, rotations: Doubles) -> Doubles:
        """Longer side of the hands seen from far away, the mean of each frame (T,) [m]; NaN without hands."""
        there = self._there
        longer = np.ptp(self._rotated(self.points, rotations)[..., :2], axis=2).max(axis=-1)
        count = there.sum(axis=1)
        total = np.where(there, longer, 0.0).sum(axis=1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def shares(self, camera: Camera, poses: Doubles, most: float, frames: Integers | None = None) -> Doubles:
        """Mean share (F,) of the picture's height that the hands' longer sides have, each at most `most`.

        Where two hands overlap, it is less by the covered share of the smaller one's box.
        """
        points, there = self._rows(frames)
        rotations, positions = poses[:, :3, :3], poses[:, None, None, :3, 3]
        local = self._rotated(points - positions.astype(np.float32), rotations)
        pixels = local[..., :2] / np.maximum(local[..., 2:], 1e-3) * camera.K[1, 1] / camera.size[1]
        low, high = pixels.min(axis=2), pixels.max(axis=2)
        longer = np.where(there, np.minimum((high - low).max(axis=-1), most), 0.0)
        total: Doubles = longer.sum(axis=1) / np.maximum(there.sum(axis=1), 1)
        if points.shape[1] == 2:
            common = np.clip(high.min(axis=1) - low.max(axis=1), 0.0, None).prod(axis=-1)
            covered = common / np.maximum((high - low).prod(axis=-1).min(axis=1), 1e-9)
            total = total * (1.0 - np.nan_to_num(covered))
        return np.where(there.any(axis=1), total, np.nan)

    @cached_property
    def seen(self) -> SeenHands:
        """The hands in the sampled frames."""
        return SeenHands(self._take, self.sampled)

    def clear_share(self, positions: Float[np.ndarray, "F 3"]) -> float:
        """Share of the sampled frames that hide less than `MOST_HIDDEN` of each hand's keypoints.

        The cameras are at these positions [m]. Nobody has arms if their user is not known.
        """
        if self.user is None:
            return 1.0
        hidden = self.seen.most_hidden(self._arms, positions[:, None])
        return float((hidden < MOST_HIDDEN).mean())

    def shortest(
        self, camera: Camera, centers: Doubles, rotations: Doubles, frames: Integers | None = None
    ) -> Doubles:
        """Shortest distance (F,) from these centers at which a camera sees all hands [m]."""
        points, there = self._rows(frames)
        around = points - centers[:, None, None].astype(np.float32)
        local = self._rotated(around, rotations).reshape(len(centers), -1, 3)
        needed = ((np.abs(local[..., :2]) + _SKIN) / half_view(camera)).max(axis=-1)
        distances = np.maximum(needed, _NEAREST_KEYPOINT) - local[..., 2]
        return np.where(there.any(axis=1), np.nan_to_num(distances, nan=-np.inf).max(axis=1), 0.0)

    def centered(self, centers: Doubles, rotations: Doubles, distances: Doubles) -> Doubles:
        """Points near these centers (T, 3) [m] to look at with all hands in the middle of the picture."""
        from scipy.ndimage import uniform_filter1d

        around = self.points - centers[:, None, None].astype(np.float32)
        local = self._rotated(around, rotations).reshape(len(centers), -1, 3)
        there = self._there.any(axis=1)
        depths = np.maximum(local[there, :, 2:] + distances[there, None, None], _NEAREST_KEYPOINT)
        rays = local[there, :, :2] / depths
        shifts = np.zeros((len(centers), 2))
        shifts[there] = 0.5 * distances[there, None] * (np.nanmin(rays, axis=1) + np.nanmax(rays, axis=1))
        shifts = uniform_filter1d(shifts, self._window, axis=0, mode="nearest")
        return np.asarray(centers + np.einsum("tij,tj->ti", rotations[..., :2], shifts))

    def _rows(self, frames: Integers | None) -> tuple[Floats, Flags]:
        return (self.points, self._there) if frames is None else (self.points[frames], self._there[frames])

    @staticmethod
    def _rotated(points: Floats, rotations: Doubles) -> Doubles:
        """Points (T, H, P, 3) in the axes of cameras (T, 3, 3)."""
        return (points.reshape(len(points), -1, 3) @ rotations).reshape(points.shape)


def half_view(camera: Camera) -> Doubles:
    """Tangents (2,) of half the angles of view across and down that hands may fill."""
    (width, height), (cx, cy) = camera.size, camera.K[:2, 2]
    rays = camera.unproject(np.array([[0.0, cy], [width, cy], [cx, 0.0], [cx, height]]))
    ahead = np.where(rays[:, 2] > 0.0, rays[:, 2], np.nan)
    tangents = np.nan_to_num(np.abs(rays[:, :2]).max(axis=1) / ahead, nan=_WIDEST_TANGENT)
    return np.asarray((1.0 - _BORDER) * np.minimum(tangents.reshape(2, 2).min(axis=1), _WIDEST_TANGENT))


def looking(directions: Doubles) -> Doubles:
    """Axes (T, 3, 3), as columns, of upright cameras in these unit directions from their targets."""
    forward = -directions
    steep = np.abs(forward[:, 2:]) >= 0.999
    right = np.cross(forward, np.where(steep, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=2)


Placement = Literal["still", "orbit", "head", "rig"]


@dataclass(frozen=True, slots=True)
class ViewConfig(Settings):
    """Cameras of a take.

    Raises:
        ArgumentError: The placement is unknown, there is no camera, or the distances are out of range.
    """

    placement: Placement = "still"
    """Position of the cameras. still: in front of the hands, following them only where they leave the
    picture. orbit: around them, for less time where hands far apart are small. head: at the user's eyes.
    rig: at the cameras of a rig, turned to the hands, with lenses as long as it takes, which zoom where hands
    would be small."""
    camera: str = "vga"
    """Camera: vga, vga_wide, sr300, kinect2, azure_kinect, d435, headset_fisheye."""
    views: Annotated[int, Limits(1)] = 1
    """Number of cameras; a rig has its own number."""
    share: Annotated[float, Limits(0.01, 1.0)] = 1.0 / 3.0
    """Share of the picture's height that a hand's longer side has, or a little more; less where all hands of
    a frame do not fit into the picture otherwise. Cameras at the eyes keep their distance."""
    distance: Annotated[tuple[float, float] | None, Limits(0.05, 20.0, ascends=True)] = None
    """Instead of the share, nearest and farthest distance from the center of the hands [m], drawn
    uniformly."""
    rig: str = "six"
    """Rig for the placement rig: a shipped name or the path of a .toml file."""
    cameras: str | tuple[Camera, ...] | None = None
    """Your own cameras, fixed in the world, instead of all these; or a file of them: ours (.toml), OpenCV's
    (.yml, .json), or COLMAP's (the folder of cameras.txt and images.txt)."""

    def check(self) -> None:
        """Refuse options that would do nothing beside your own cameras or with this placement."""
        given = self.changed(*_PLACING)
        if self.cameras is not None and given:
            raise ArgumentError(
                f"the cameras are those of {self.cameras_name}; leave out the placement, the camera, the "
                "views, the share, the distance and the rig"
            )
        unused = [name for name in _UNUSED[self.placement] if name in given]
        if unused:
            raise ArgumentError(
                f"given {', '.join(unused)} and the placement {self.placement}, expected another placement"
            )
        if self.distance is not None and "share" in given:
            raise ArgumentError(
                f"given share {self.share} and distance {self.distance}, expected one of them"
            )
        if self.cameras == ():
            raise ArgumentError("cameras is empty, expected at least one camera")
        for one in self.cameras if isinstance(self.cameras, tuple) else ():
            check_near(f"camera '{one.name}'", one)

    @property
    def cameras_name(self) -> str:
        """What messages call your own cameras: their file, or their names."""
        if isinstance(self.cameras, tuple):
            return " ".join(camera.name for camera in self.cameras)
        return str(self.cameras)

    def own_cameras(self) -> tuple[Camera, ...]:
        """Your own cameras, from their file where it is given."""
        return load_cameras(self.cameras) if isinstance(self.cameras, str) else self.cameras or ()


class _Path(NamedTuple):
    """A camera and its poses."""

    camera: Camera
    poses: Doubles  # pose of each frame (T, 4, 4)
    zoom: Doubles | None = None  # factor on the focal lengths in each frame (T,)

    def at(self, frame: int) -> Camera:
        """The camera of one frame."""
        camera = self.camera.at(self.poses[frame])
        return camera if self.zoom is None else zoomed(camera, float(self.zoom[frame]))


class Viewpoints:
    """Cameras of every frame."""

    def __init__(
        self,
        config: ViewConfig,
        take: Take,
        *,
        rng: np.random.Generator,
        up: UpAxis = "z",
        user: UserBody | None = None,
        poses: Float[np.ndarray, "T 4 4"] | None = None,
    ) -> None:
        """Place the cameras; `poses` move the first of the user's own cameras."""
        framing = Framing(take, user)
        if config.cameras is not None:
            cameras, turn = _own_cameras(config, up), rigid(room_axes(up), np.zeros(3))
            stay = (take.num_frames, 4, 4)
            self._paths = [_Path(one, np.broadcast_to(one.T_world_camera, stay)) for one in cameras]
            if poses is not None:
                self._paths = [_Path(cameras[0], turn @ poses)]
        else:
            paths = _PATHS[config.placement](config, take, framing, rng)
            cameras = [dataclasses.replace(path.camera, name=f"view{n}") for n, path in enumerate(paths)]
            self._paths = [path._replace(camera=camera) for path, camera in zip(paths, cameras, strict=True)]
        self._config, self._take, self._framing = config, take, framing
        self.viewer: Doubles = looking(-_towards_user(framing.forearms)[None])[0]
        """Axes of somebody before the user, as columns in the world's; light is drawn for them."""

    def check_hands_in_view(self) -> None:
        """Refuse own cameras if none has a hand in its pictures, and warn of those that have none."""
        if self._config.cameras is None:
            return
        cameras, name, points = self.cameras(0), self._config.cameras_name, self._framing.points
        blind = list(cameras)
        for first in range(0, len(points), _CHUNK):
            blind = [one for one in blind if not _any_inside(one, points[first : first + _CHUNK])]
        if len(blind) == len(cameras):
            one, qpos = blind[0], self._take.qpos
            middle, place = np.nanmedian(qpos[..., :3], axis=(0, 1)), one.T_world_camera[:3, 3]
            raise RigError(
                f"{name}: no camera has a hand in its picture in any of {len(qpos)} frames: wrists are "
                f"around {_shown(middle)} m, and camera '{one.name}' stands at {_shown(place)} m and looks "
                f"along {_shown(one.T_world_camera[:3, 2])}"
            )
        for camera in blind:
            told = f"{name}: camera '{camera.name}' has no hand in its picture in any frame"
            warnings.warn(told, HandSimWarning, stacklevel=2)

    @property
    def num_cameras(self) -> int:
        """Number of cameras."""
        return len(self._paths)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the first camera's pictures [px]."""
        return self._paths[0].camera.size

    @property
    def moves(self) -> bool:
        """Whether a camera moves, turns or zooms."""
        return any(path.zoom is not None or bool(np.ptp(path.poses, axis=0).any()) for path in self._paths)

    def nearest(self, normal: Float[np.ndarray, "3"], *, arms: bool = False) -> float:
        """Least position along a direction in the first camera's axes of all frames' hands, or arms [m]."""
        hands, camera = self._framing.points, self.cameras(0)[0]
        along = hands[:, :, :1] + self._framing.forearms[:, :, None] * _ALONG_ARM[:, None]
        points = (along if arms else hands).reshape(-1, 3)
        if arms:
            points = np.concatenate([points, self._framing.trunk])
        seen = (np.abs(camera.project(points) / camera.size - 0.5) < 0.5 + _BESIDE).all(axis=1) | (not arms)
        places = camera.local(points[seen]) @ normal
        return float(np.nanmin(places, initial=0.0)) - (_SLEEVE if arms else _SKIN)

    def positions(self) -> Float[np.ndarray, "P 3"]:
        """Positions [m] that a room must hold: hands and cameras in all frames, and the person's trunk."""
        return np.concatenate([self._framing.centers, self._framing.trunk, self.eyes()])

    def eyes(self) -> Float[np.ndarray, "P 3"]:
        """Positions of the cameras in all frames [m]."""
        return np.concatenate([path.poses[:, :3, 3] for path in self._paths])

    def cameras(self, frame: int) -> list[Camera]:
        """The cameras of one frame: `view0`, `view1`, ..., or those of the file with their own names."""
        return [path.at(frame) for path in self._paths]


def _towards_user(forearms: Doubles) -> Doubles:
    """Level unit direction (3,) from the hands to the user's body: where the forearms (T, H, 3) point."""
    level = np.append(np.nanmean(forearms[..., :2].reshape(-1, 2), axis=0), 0.0)
    length = float(np.linalg.norm(level))
    return level / length if length > 1e-3 else np.array([0.0, -1.0, 0.0])


def _spherical(azimuth: Doubles | float, elevation: Doubles | float) -> Doubles:
    """Unit vectors (..., 3) at these angles [rad]."""
    level = np.cos(elevation)
    parts = level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def _still(config: ViewConfig, take: Take, framing: Framing, rng: np.random.Generator) -> list[_Path]:
    """In front of the user; several cameras form a fan.

    Hands that are far apart look large only from a side or from above, so several places are tried.
    """
    user = _towards_user(framing.forearms)
    front = np.arctan2(-user[1], -user[0])
    spread = np.deg2rad(40.0) * (np.arange(config.views) - 0.5 * (config.views - 1))

    def places(azimuth: float) -> Iterator[Doubles]:
        for wider in np.linspace(0.0, 1.0, _PLACES):
            aside = rng.uniform(0.15 * (1.0 - wider), 0.15 + _ASIDE * wider) * rng.choice([-1.0, 1.0])
            direction = _spherical(front + azimuth + aside, rng.uniform(0.1, 0.6 + 0.4 * wider))
            yield np.tile(direction, (take.num_frames, 1))

    return [_largest(config, framing, places(azimuth), rng) for azimuth in spread]


def _orbit(config: ViewConfig, take: Take, framing: Framing, rng: np.random.Generator) -> list[_Path]:
    """Around the hands; hands that are far apart are passed more slowly where they look large."""
    turned = 2.0 * np.pi * (take.times - take.times[0]) / _ORBIT_PERIOD

    def orbits(first: float) -> Iterator[Doubles]:
        for attempt in range(_PLACES):
            azimuths = first + rng.uniform(-np.pi, np.pi) + turned
            elevation = rng.uniform(0.0, 0.8)
            if attempt:
                azimuths = _lingering(config, framing, azimuths, elevation)
            yield _spherical(azimuths, elevation)

    first = 2.0 * np.pi * np.arange(config.views) / config.views
    return [_largest(config, framing, orbits(one), rng) for one in first]


def _largest(
    config: ViewConfig, framing: Framing, ways: Iterator[Doubles], rng: np.random.Generator
) -> _Path:
    """A camera in the first of these directions (T, 3) that shows hands large enough, or in the best one."""
    best, chosen, frames = np.inf, None, framing.sampled
    for directions in ways:
        farther, path = _followed(config, framing, directions, rng)
        free = framing.clear_share(path.poses[frames, :3, 3])
        if chosen is None and (config.distance or farther <= _ENOUGH) and free >= _CLEAR_SHARE:
            return path
        shares = framing.shares(path.camera, path.poses, _CLOSER * config.share)
        smaller = 1.0 if config.distance else config.share / max(float(np.nanmedian(shares)), 1e-6)
        smaller /= max(min(free / _CLEAR_SHARE, 1.0), 1e-6) ** _GIVES_WAY
        if smaller < best:
            best, chosen = smaller, path
        if best <= _ENOUGH:
            break
    assert chosen is not None
    return chosen


def _lingering(config: ViewConfig, framing: Framing, turned: Doubles, elevation: float) -> Doubles:
    """Azimuths (T,) of an even turn, changed so that they pass quickly where hands would be small."""
    camera, azimuths = preset(config.camera), np.linspace(0.0, 2.0 * np.pi, _AZIMUTHS, endpoint=False)
    frames, shares = framing.sampled, []
    for azimuth in azimuths:
        directions = np.tile(_spherical(azimuth, elevation), (len(frames), 1))
        centers, rotations = framing.centers[frames], looking(directions)
        away = framing.shortest(camera, centers, rotations, frames)[:, None] * directions
        poses = rigid(rotations, centers + away)
        share = np.nanmedian(framing.shares(camera, poses, _CLOSER * config.share, frames))
        shares.append(min(share, config.share) * framing.clear_share(poses[:, :3, 3]))
    time = (np.array(shares) / config.share) ** _LINGER
    time = np.maximum(time, _QUICKEST * time.max())
    passed = np.concatenate([[0.0], np.cumsum(time)]) / time.sum() * 2.0 * np.pi
    laps, rest = np.divmod(turned, 2.0 * np.pi)
    return np.asarray(2.0 * np.pi * laps + np.interp(rest, passed, np.append(azimuths, 2.0 * np.pi)))


def _followed(
    config: ViewConfig, framing: Framing, directions: Doubles, rng: np.random.Generator
) -> tuple[float, _Path]:
    """A camera in these directions (T, 3) that shows all hands and moves as little as it can.

    The first value is its median distance over the one at which the hands have the wanted share.
    """
    camera, rotations = preset(config.camera), looking(directions)
    kept = np.broadcast_to(framing.middle(), directions.shape)
    enough = framing.shortest(camera, kept, rotations).max()
    if config.distance is None:
        side = float(np.nanmedian(framing.longer_sides(rotations)))
        farthest = _distance_of(camera, side, config.share)
        usual = farthest / float(rng.uniform(1.0, _CLOSER))
    else:
        farthest = usual = float(rng.uniform(*config.distance))
    if enough <= _ENOUGH * farthest:
        centers, distances = kept, np.full(len(kept), usual if config.distance else max(usual, enough))
    else:
        centers, distances = framing.followed(), np.full(len(kept), usual)
        if config.distance is None:
            for _ in range(_CENTERINGS):
                shortest = framing.shortest(camera, centers, rotations)
                distances = framing.held(np.maximum(shortest, usual))
                centers = framing.centered(centers, rotations, distances)
            distances = framing.held(np.maximum(framing.shortest(camera, centers, rotations), usual))
    poses = rigid(rotations, centers + distances[:, None] * directions)
    return float(np.median(distances)) / farthest, _Path(camera, poses)


def _distance_of(camera: Camera, side: Doubles | float, share: Doubles | float) -> Any:
    """Distance [m] at which something as long as this [m] has this share of the picture's height."""
    return camera.K[1, 1] * side / (share * camera.size[1])


def _head(config: ViewConfig, take: Take, framing: Framing, rng: np.random.Generator) -> list[_Path]:
    """At the user's eyes, turned to the hands; several cameras stand side by side, as two eyes do."""
    user = UserBody(take, sees=True) if framing.user is None else framing.user
    camera, eyes = preset(config.camera), user.eyes + rng.uniform(-_MOUNTED, _MOUNTED, 3)
    frames, followed, tried = framing.sampled, framing.followed(), list[tuple[Doubles, Doubles, float]]()
    _, rotations = _turned_to(eyes, followed)
    axes = np.stack([-rotations[..., 2].mean(axis=0), user.right, [0.0, 0.0, 1.0]])
    for place in eyes + _LEANS @ axes:
        distances, turned = _turned_to(place, followed)
        needed = (framing.shortest(camera, followed, turned) / distances)[frames]
        inside = (needed <= 1.0) + np.clip(2.0 - needed, 0.0, 1.0)  # hands that leave pictures do so little
        tried.append((place, rigid(turned, place)[frames], float(inside.mean())))
    trials = ([[camera.at(pose)] for pose in poses] for _, poses, _ in tried)
    hidden = user.hidden(take, framing.seen, frames, trials)
    clear = np.array([(share < MOST_HIDDEN).mean() for share in hidden])
    worth = clear + [inside for *_, inside in tried]
    eyes = tried[int(np.argmax(worth - _EFFORT * np.linalg.norm(_LEANS, axis=1)))][0]
    paths = []
    for number in range(config.views):
        aside = 0.064 * (number - 0.5 * (config.views - 1)) * user.right
        _, rotations = _turned_to(eyes + aside, framing.followed())
        paths.append(_Path(camera, rigid(rotations, eyes + aside)))
    return paths


def known_positions(config: ViewConfig, up: UpAxis) -> Float[np.ndarray, "C 3"]:
    """Positions [m] of a rig's and of the user's own cameras, which are known before the person's place."""
    if config.cameras is not None:
        return np.array([one.T_world_camera[:3, 3] for one in _own_cameras(config, up)])
    if config.placement == "rig":
        return np.asarray(load_rig(config.rig).T_world_camera[:, :3, 3])
    return np.empty((0, 3))


def _own_cameras(config: ViewConfig, up: UpAxis) -> list[Camera]:
    """The user's own cameras in a world with z up."""
    turn = rigid(room_axes(up), np.zeros(3))
    return [one if up == "z" else one.at(turn @ one.T_world_camera) for one in config.own_cameras()]


def _rig(config: ViewConfig, take: Take, framing: Framing, rng: np.random.Generator) -> list[_Path]:
    """At the cameras of a rig, with lenses as long as the share takes, if they show nearly all hands.

    If no such lens does, cameras turn to follow the hands, and if that is not enough either, they zoom.
    """
    middle, paths = framing.middle(), []
    for T_world_camera in load_rig(config.rig).T_world_camera:
        camera, position, zoom = preset(config.camera), T_world_camera[:3, 3], None
        followed = framing.followed()
        for _ in range(_CENTERINGS):
            distances, rotations = _turned_to(position, followed)
            followed = framing.centered(followed, rotations, distances)
        for centers in (np.broadcast_to(middle, followed.shape), followed):
            distances, rotations = _turned_to(position, centers)
            if camera.lens.kind != "pinhole":
                break
            share = config.share * rng.uniform(1.0, _CLOSER)
            side = float(np.nanmedian(framing.longer_sides(rotations) / distances))
            wanted = 1.0 / _distance_of(camera, side, share)
            longest = distances / framing.shortest(camera, centers, rotations).clip(1e-6)
            lens = min(wanted, float(np.quantile(longest, 1.0 - _LENS_SEEN_SHARE)))
            if lens >= wanted / _ENOUGH:
                break
        else:
            zoom = 1.0 / framing.held(1.0 / np.minimum(wanted, longest)) / lens
        if camera.lens.kind == "pinhole":
            camera = zoomed(camera, lens)
        paths.append(_Path(camera, rigid(rotations, position), zoom))
    return paths


_PATHS: Final = {"still": _still, "orbit": _orbit, "head": _head, "rig": _rig}


def _turned_to(position: Doubles, centers: Doubles) -> tuple[Doubles, Doubles]:
    """Distances (T,) [m] of a camera from its targets, and its axes (T, 3, 3)."""
    away = position - centers
    distances = np.linalg.norm(away, axis=1)
    return distances, looking(away / distances[:, None])


def zoomed(camera: Camera, zoom: float) -> Camera:
    """The camera with its focal lengths multiplied."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= zoom
    return dataclasses.replace(camera, K=K)


def _any_inside(camera: Camera, points: Floats) -> bool:
    pixels = camera.project(points)
    return bool(((pixels >= 0.0) & (pixels < camera.size)).all(axis=-1).any())  # never so for NaN


def _shown(vector: Doubles) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in vector + 0.0) + ")"


def around_hands(
    camera: Camera,
    keypoints: Float[np.ndarray, "K 3"],
    qpos: Float[np.ndarray, "H 27"],
    share: float,
    *,
    rng: np.random.Generator,
) -> Camera:
    """A camera at a random place around hands, not behind their forearms, with a random roll.

    The keypoints of all hands, in the world [m], span this share of the picture's shorter side.
    """
    center = 0.5 * (keypoints.min(axis=0) + keypoints.max(axis=0))
    along = quaternion_matrix(qpos[:, 3:7])[..., 0]
    for _ in range(_TRIES):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        if (along @ direction > -np.cos(_ARM_CLEARANCE)).all():
            break
    turn = rng.uniform(-np.pi, np.pi)
    roll = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    pose = look_at(center + direction, center)
    pose[:3, :3] = pose[:3, :3] @ roll
    local = (keypoints - center) @ pose[:3, :3]
    focal, size = camera.K[[0, 1], [0, 1]], np.array(camera.size, dtype=np.float64)
    nearest = _SKIN_CLEARANCE - float(local[:, 2].min())
    shift = np.array([0.0, 0.0, 4.0 * nearest])  # position of the hands in the camera's axes
    room = rng.uniform(-0.5, 0.5, 2) * SHIFT_SHARE
    for _ in range(8):  # several times, because perspective widens what is near
        pixels = focal * (local + shift)[:, :2] / (local + shift)[:, 2:]
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        target = 0.5 * size - camera.K[:2, 2] + room * np.maximum(size - (high - low), 0.0)
        shift[:2] += (target - 0.5 * (low + high)) / focal * shift[2]
        shift[2] = max(nearest, shift[2] * float((high - low).max()) / (share * float(size.min())))
    pose[:3, 3] = center - pose[:3, :3] @ shift
    return camera.at(pose)


def crop_around(
    camera: Camera, keypoints: Float[np.ndarray, "K 3"], share: float, size: int, *, rng: np.random.Generator
) -> Camera:
    """The pinhole camera that sees a square of `size` pixels around hands, cut out of a camera's picture.

    The keypoints of all hands, in the world [m], span this share of its side, at a random place in it.
    """
    pixels = camera.project(keypoints)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    side = float((high - low).max()) / share
    corner = 0.5 * (low + high - side) + SHIFT_SHARE * rng.uniform(-0.5, 0.5, 2) * (side - (high - low))
    K = camera.K.copy()
    K[:2, 2] -= corner
    K[:2] *= size / side
    return dataclasses.replace(camera, size=(size, size), K=K)
