"""Camera poses for each frame of a take: still, in orbit, on a head, anywhere, or on a rig.

Paths are computed once for a whole take, from the motion of its hands, so that any frame can be drawn
alone.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from gloves.takes.take import Take
from handsim.errors import ArgumentError, HandSimWarning, RigError
from handsim.hand.model import hand_keypoints
from handsim.settings import Limits, Settings
from handsim.space.camera import Camera, look_at, preset
from handsim.space.rig import load_rig
from handsim.space.rig_formats import load_cameras
from handsim.space.transforms import quaternion_matrix
from render.frames import Doubles, Flags, Floats, Integers

_KEPT: Final = (0, 2, 4, 5, 6, 8, 10, 12, 14, 16, 17, 18, 20)  # keypoints that a hand's outline depends on
_CHUNK: Final = 2048  # frames whose keypoints are computed at once
_SKIN: Final = 0.012  # [m] around keypoints
_BORDER: Final = 0.04  # of half a picture, which hands keep free
_NEAREST: Final = 0.15  # [m] between a camera and the nearest keypoint, at least
_WIDEST: Final = 2.0  # tangent of half the angle of view that is made use of


class Framing:
    """The hands of a take as cameras have to show them."""

    def __init__(self, take: Take) -> None:
        shape = (take.num_frames, len(take.hands), len(_KEPT), 3)
        self.points: Float32[np.ndarray, "T H P 3"] = np.full(shape, np.nan, dtype=np.float32)
        """Keypoints of all hands in the world [m]; NaN where a hand is absent."""
        for number, hand in enumerate(take.hands):
            there = np.flatnonzero(np.isfinite(take.qpos[:, number]).all(axis=1))
            for first in range(0, len(there), _CHUNK):
                rows = there[first : first + _CHUNK]
                self.points[rows, number] = hand_keypoints(hand.model, take.qpos[rows, number])[:, _KEPT]
        self._there = np.isfinite(self.points[..., 0, 0])
        self.centers: Float[np.ndarray, "T 3"] = self._centers()
        """Middle of the box around all hands of each frame [m]; interpolated over frames without hands."""
        self._window = max(1, round(0.5 * take.rate))

    def _centers(self) -> Doubles:
        known = np.flatnonzero(self._there.any(axis=1))
        flat = self.points[known].reshape(len(known), -1, 3).astype(np.float64)
        middles = 0.5 * (np.nanmin(flat, axis=1) + np.nanmax(flat, axis=1))
        frames = np.arange(len(self.points))
        return np.stack([np.interp(frames, known, middles[:, axis]) for axis in range(3)], axis=1)

    def middle(self) -> Float[np.ndarray, "3"]:
        """Middle of all places where the hands are [m]."""
        return np.asarray(0.5 * (self.centers.min(axis=0) + self.centers.max(axis=0)))

    def followed(self) -> Float[np.ndarray, "T 3"]:
        """The centers as a person with a camera follows them [m]: without what is quicker than a second."""
        return np.asarray(uniform_filter1d(self.centers, self._window, axis=0, mode="nearest"))

    def held(self, distances: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        """Distances that change slowly and are nowhere shorter than these [m]."""
        longest = maximum_filter1d(distances, 2 * (self._window // 2) + 1, mode="nearest")
        return np.asarray(uniform_filter1d(longest, 2 * (self._window // 2) + 1, mode="nearest"))

    def sides(
        self, rotations: Float[np.ndarray, "F 3 3"], frames: Int[np.ndarray, "F"] | None = None
    ) -> Float[np.ndarray, "F"]:
        """Longer side of a hand in each frame from afar, the mean of its hands [m]; NaN without hands."""
        points, there = self._rows(frames)
        local = self._turned(points, rotations)[..., :2]
        longer = np.ptp(local, axis=2).max(axis=-1)
        count = there.sum(axis=1)
        total = np.where(there, longer, 0.0).sum(axis=1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def shares(
        self,
        camera: Camera,
        poses: Float[np.ndarray, "F 4 4"],
        most: float,
        frames: Int[np.ndarray, "F"] | None = None,
    ) -> Float[np.ndarray, "F"]:
        """Share of the picture's height that a hand's longer side has, the mean of a frame's hands.

        Two hands before one another count for less, by how much of the smaller one's box the other covers.
        """
        points, there = self._rows(frames)
        rotations, positions = poses[:, :3, :3], poses[:, None, None, :3, 3]
        local = self._turned(points - positions.astype(np.float32), rotations)
        pixels = local[..., :2] / np.maximum(local[..., 2:], 1e-3) * camera.K[1, 1] / camera.size[1]
        low, high = pixels.min(axis=2), pixels.max(axis=2)
        longer = np.where(there, np.minimum((high - low).max(axis=-1), most), 0.0)
        total: Doubles = longer.sum(axis=1) / np.maximum(there.sum(axis=1), 1)
        if points.shape[1] == 2:
            common = np.clip(high.min(axis=1) - low.max(axis=1), 0.0, None).prod(axis=-1)
            covered = common / np.maximum((high - low).prod(axis=-1).min(axis=1), 1e-9)
            total = total * (1.0 - np.nan_to_num(covered))
        return np.where(there.any(axis=1), total, np.nan)

    def shortest(
        self,
        camera: Camera,
        centers: Float[np.ndarray, "F 3"],
        rotations: Float[np.ndarray, "F 3 3"],
        frames: Int[np.ndarray, "F"] | None = None,
    ) -> Float[np.ndarray, "F"]:
        """Shortest distance of a camera from the place that it looks at with all hands in its picture [m]."""
        points, there = self._rows(frames)
        around = points - centers[:, None, None].astype(np.float32)
        local = self._turned(around, rotations).reshape(len(centers), -1, 3)
        needed = ((np.abs(local[..., :2]) + _SKIN) / half_view(camera)).max(axis=-1)
        distances = np.maximum(needed, _NEAREST) - local[..., 2]
        return np.where(there.any(axis=1), np.nan_to_num(distances, nan=-np.inf).max(axis=1), 0.0)

    def centered(
        self,
        centers: Float[np.ndarray, "T 3"],
        rotations: Float[np.ndarray, "T 3 3"],
        distances: Float[np.ndarray, "T"],
    ) -> Float[np.ndarray, "T 3"]:
        """Places to look at [m] with all hands in the middle of the picture, as near these as may be."""
        around = self.points - centers[:, None, None].astype(np.float32)
        local = self._turned(around, rotations).reshape(len(centers), -1, 3)
        there = self._there.any(axis=1)
        rays = local[there, :, :2] / np.maximum(local[there, :, 2:] + distances[there, None, None], _NEAREST)
        shifts = np.zeros((len(centers), 2))
        shifts[there] = 0.5 * distances[there, None] * (np.nanmin(rays, axis=1) + np.nanmax(rays, axis=1))
        shifts = uniform_filter1d(shifts, self._window, axis=0, mode="nearest")
        return np.asarray(centers + np.einsum("tij,tj->ti", rotations[..., :2], shifts))

    def _rows(self, frames: Integers | None) -> tuple[Floats, Flags]:
        if frames is None:
            return self.points, self._there
        return self.points[frames], self._there[frames]

    @staticmethod
    def _turned(points: Floats, rotations: Doubles) -> Doubles:
        """Points (T, H, P, 3) in the axes of cameras (T, 3, 3)."""
        flat = points.reshape(len(points), -1, 3)
        return (flat @ rotations).reshape(points.shape)


def half_view(camera: Camera) -> Float[np.ndarray, "2"]:
    """Tangents of half the angles of view across and down that hands may fill."""
    (width, height), (cx, cy) = camera.size, camera.K[:2, 2]
    rays = camera.unproject(np.array([[0.0, cy], [width, cy], [cx, 0.0], [cx, height]]))
    ahead = np.where(rays[:, 2] > 0.0, rays[:, 2], np.nan)
    tangents = np.nan_to_num(np.abs(rays[:, :2]).max(axis=1) / ahead, nan=_WIDEST)
    return np.asarray((1.0 - _BORDER) * np.minimum(tangents.reshape(2, 2).min(axis=1), _WIDEST))


def looking(directions: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Axes of upright cameras in these unit directions from what they look at, as columns."""
    forward = -directions
    steep = np.abs(forward[:, 2:]) >= 0.999
    up = np.where(steep, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=2)


def poses_at(
    positions: Float[np.ndarray, "T 3"], rotations: Float[np.ndarray, "T 3 3"]
) -> Float[np.ndarray, "T 4 4"]:
    """Poses of cameras at these positions [m] with these axes."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, positions
    return poses


Placement = Literal["still", "orbit", "head", "anywhere", "rig"]
PLACEMENTS: Final[tuple[Placement, ...]] = ("still", "orbit", "head", "anywhere", "rig")
_EYES: Final = (0.32, 0.38)  # [m] of the head's camera behind and above the hands
_HEAD_CLEARANCE: Final = np.deg2rad(50.0)  # between a head's line of sight and a forearm, at least
_ORBIT_PERIOD: Final = 12.0  # [s] of one revolution of a camera in orbit
_LOWEST, _HIGHEST = np.deg2rad(-20.0), np.deg2rad(75.0)  # elevation of cameras that stand anywhere
_TRIES: Final = 60
_CLOSER: Final = 1.35  # largest share of a hand over `ViewConfig.share`
_ENOUGH: Final = 1.05  # by how much smaller than the share hands may be before other places are tried
_SKIN_CLEARANCE: Final = 0.08  # [m] between a camera around hands and the nearest keypoint, at least
_FREE: Final = 0.8  # of the room around hands in a picture, which they are shifted within
_ROUNDS: Final = 8
_NEARLY_ALL: Final = 0.97  # of the frames: what a lens of one length shows whole
_PLACES: Final = 16  # in front of the hands, and orbits, that are tried
_AROUND: Final = 36  # azimuths of an orbit whose views are compared,
_SAMPLES: Final = 48  # in so many frames
_CENTERED: Final = 2  # times that a camera is turned to the middle of what it sees
_LINGER: Final = 20.0  # power of their share that an orbit's time where hands are small falls with
_QUICKEST: Final = 0.02  # of the longest time, at least
_ASIDE: Final = np.deg2rad(90.0)  # farther from the front, at most
_HIDDEN: Final = 10.0  # what a view from behind an arm counts as, times the distance of the share
_ARM: Final = 0.5  # [m] of a forearm that views keep clear of
_ARM_DISTANCE: Final = 0.2  # [m] between its middle and a camera, at least
_ARM_CLEARANCE: Final = np.deg2rad(35.0)  # between a view and a forearm, at least


@dataclass(frozen=True, slots=True)
class ViewConfig(Settings):
    """Cameras of a take.

    Raises:
        ArgumentError: The placement is unknown, there is no camera, or the distances are out of range.
    """

    placement: Placement = "still"
    """Position of the cameras. still: in front of the hands, following them only where they leave the
    picture. orbit: around them, for less time where hands far apart are small. head: at the user's eyes.
    anywhere: at another position in every frame. rig: at the cameras of a rig, turned to the hands, with
    lenses as long as it takes, which zoom where hands would be small."""
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
        """Refuse a placement, a camera or views beside your own cameras, and a rig that is not used."""
        if self.cameras is not None and (self.placement, self.camera, self.views) != ("still", "vga", 1):
            raise ArgumentError(
                f"the cameras are those of {self.own_cameras}; leave out the placement, the camera and the "
                "views"
            )
        if self.cameras == ():
            raise ArgumentError("cameras is empty, expected at least one camera")
        if self.placement != "rig" and self.rig != "six":
            raise ArgumentError(
                f"the rig is '{self.rig}' and the placement '{self.placement}', expected the placement rig"
            )

    @property
    def own_cameras(self) -> str:
        """What messages call your own cameras: their file, or their names."""
        if isinstance(self.cameras, tuple):
            return " ".join(camera.name for camera in self.cameras)
        return str(self.cameras)


class _Path(NamedTuple):
    """A camera on its way."""

    camera: Camera
    poses: Doubles  # (T, 4, 4)
    zoom: Doubles | None = None  # factor on its focal lengths (T,); None: it keeps them

    def at(self, frame: int) -> Camera:
        """The camera of one frame."""
        camera = self.camera.at(self.poses[frame])
        if self.zoom is None:
            return camera
        return zoomed(camera, float(self.zoom[frame]))


class Viewpoints:
    """Cameras of every frame."""

    def __init__(self, config: ViewConfig, take: Take, *, rng: np.random.Generator) -> None:
        framing, own = Framing(take), config.cameras
        if own is not None:
            cameras = list(load_cameras(own) if isinstance(own, str) else own)
            stay = (take.num_frames, 4, 4)
            self._paths = [_Path(one, np.broadcast_to(one.T_world_camera, stay)) for one in cameras]
        else:
            paths = _PATHS[config.placement](config, take, framing, rng)
            cameras = [dataclasses.replace(path.camera, name=f"view{n}") for n, path in enumerate(paths)]
            self._paths = [path._replace(camera=camera) for path, camera in zip(paths, cameras, strict=True)]
        self._centers = framing.centers

    @property
    def num_cameras(self) -> int:
        """Number of cameras."""
        return len(self._paths)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the first camera's pictures [px]."""
        return self._paths[0].camera.size

    def positions(self) -> Float[np.ndarray, "P 3"]:
        """All positions of the cameras, and of the hands' centers, over the whole take [m]."""
        return np.concatenate([self._centers, *(path.poses[:, :3, 3] for path in self._paths)])

    def cameras(self, frame: int) -> list[Camera]:
        """The cameras of one frame: `view0`, `view1`, ..., or those of the file with their own names."""
        return [path.at(frame) for path in self._paths]


def _along(take: Take) -> Doubles:
    """Direction (T, H, 3) from each wrist to its fingers; NaN where there is no hand."""
    return quaternion_matrix(take.qpos[..., 3:7])[..., 0]


def _towards_user(take: Take) -> Doubles:
    """Level unit direction (3,) from the hands to the user's body: where the forearms point."""
    level = np.append(np.nanmean(-_along(take)[..., :2].reshape(-1, 2), axis=0), 0.0)
    length = float(np.linalg.norm(level))
    return level / length if length > 1e-3 else np.array([0.0, -1.0, 0.0])


def _spherical(azimuth: float, elevation: float) -> Doubles:
    return np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


def _still(config: ViewConfig, take: Take, framing: Framing, rng: np.random.Generator) -> list[_Path]:
    """In front of the user; several cameras form a fan.

    Hands that are far apart are large only from a side, or from above: other places are tried then.
    """
    user = _towards_user(take)
    front = np.arctan2(-user[1], -user[0])
    spread = np.deg2rad(40.0) * (np.arange(config.views) - 0.5 * (config.views - 1))

    def places(azimuth: float) -> Iterator[Doubles]:
        for wider in np.linspace(0.0, 1.0, _PLACES):
            aside = rng.uniform(0.15 * (1.0 - wider), 0.15 + _ASIDE * wider) * rng.choice([-1.0, 1.0])
            direction = _spherical(front + azimuth + aside, rng.uniform(0.1, 0.6 + 0.4 * wider))
            yield np.tile(direction, (take.num_frames, 1))

    return [_largest(config, framing, places(azimuth), rng) for azimuth in spread]


def _orbit(config: ViewConfig, take: Take, framing: Framing, rng: np.random.Generator) -> list[_Path]:
    """Around the hands, and around hands that are far apart more slowly where they are large."""
    turned = 2.0 * np.pi * (take.times - take.times[0]) / _ORBIT_PERIOD

    def orbits(first: float) -> Iterator[Doubles]:
        for attempt in range(_PLACES):
            azimuths = first + rng.uniform(-np.pi, np.pi) + turned
            elevation = rng.uniform(0.0, 0.8)
            if attempt:
                azimuths = _lingering(config, framing, azimuths, elevation)
            level = np.cos(elevation) * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
            yield np.column_stack([level, np.full(len(level), np.sin(elevation))])

    first = 2.0 * np.pi * np.arange(config.views) / config.views
    return [_largest(config, framing, orbits(one), rng) for one in first]


def _largest(
    config: ViewConfig, framing: Framing, ways: Iterator[Doubles], rng: np.random.Generator
) -> _Path:
    """The first of some cameras that shows hands as large as asked for; if none does, the best of them.

    Of the directions (T, 3) the first is taken where hands have one distance.
    """
    best, chosen = np.inf, None
    for directions in ways:
        farther, path = _followed(config, framing, directions, rng)
        if chosen is None and (config.distance or farther <= _ENOUGH):
            return path
        shares = framing.shares(path.camera, path.poses, _CLOSER * config.share)
        smaller = config.share / max(float(np.nanmedian(shares)), 1e-6)
        if smaller < best:
            best, chosen = smaller, path
        if best <= _ENOUGH:
            break
    assert chosen is not None
    return chosen


def _lingering(config: ViewConfig, framing: Framing, turned: Doubles, elevation: float) -> Doubles:
    """Azimuths (T,) in the place of those of an even turn, that pass quickly where hands would be small."""
    camera, azimuths = preset(config.camera), np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    frames = np.unique(np.linspace(0, len(turned) - 1, _SAMPLES).astype(int))
    shares = []
    for azimuth in azimuths:
        directions = np.tile(_spherical(azimuth, elevation), (len(frames), 1))
        centers, rotations = framing.centers[frames], looking(directions)
        away = framing.shortest(camera, centers, rotations, frames)[:, None] * directions
        poses = poses_at(centers + away, rotations)
        shares.append(np.nanmedian(framing.shares(camera, poses, _CLOSER * config.share, frames)))
    time = np.minimum(np.array(shares) / config.share, 1.0) ** _LINGER
    time = np.maximum(time, _QUICKEST * time.max())
    passed = np.concatenate([[0.0], np.cumsum(time)]) / time.sum() * 2.0 * np.pi
    laps, rest = np.divmod(turned, 2.0 * np.pi)
    slow: Doubles = 2.0 * np.pi * laps
    slow += np.interp(rest, passed, np.append(azimuths, 2.0 * np.pi))
    return slow


def _followed(
    config: ViewConfig, framing: Framing, directions: Doubles, rng: np.random.Generator
) -> tuple[float, _Path]:
    """A camera in these directions (T, 3) of the hands that shows them all, and moves as little as it can.

    Before it comes how much farther away it is than the share takes (the median).
    """
    camera, rotations = preset(config.camera), looking(directions)
    kept = np.broadcast_to(framing.middle(), directions.shape)
    enough = framing.shortest(camera, kept, rotations).max()
    if config.distance is None:
        side = float(np.nanmedian(framing.sides(rotations)))
        farthest = _distance_of(camera, side, config.share)
        usual = farthest / float(rng.uniform(1.0, _CLOSER))
    else:
        farthest = usual = float(rng.uniform(*config.distance))
    if enough <= _ENOUGH * farthest:
        centers, distances = kept, np.full(len(kept), usual if config.distance else max(usual, enough))
    else:
        centers = framing.followed()
        distances = np.full(len(centers), usual)
        if config.distance is None:
            for _ in range(_CENTERED):
                shortest = framing.shortest(camera, centers, rotations)
                distances = framing.held(np.maximum(shortest, usual))
                centers = framing.centered(centers, rotations, distances)
            distances = framing.held(np.maximum(framing.shortest(camera, centers, rotations), usual))
    poses = poses_at(centers + distances[:, None] * directions, rotations)
    return float(np.median(distances)) / farthest, _Path(camera, poses)


def _distance_of(camera: Camera, side: Doubles | float, share: Doubles | float) -> Any:
    """Distance [m] at which something as long as this [m] has this share of the picture's height."""
    return camera.K[1, 1] * side / (share * camera.size[1])


def _head(config: ViewConfig, take: Take, framing: Framing, rng: np.random.Generator) -> list[_Path]:
    """At the eyes, following the hands with a delay; several cameras are side by side, as two eyes are."""
    centers = framing.followed()
    user = _towards_user(take)
    back, up = _EYES[0] + rng.uniform(-0.05, 0.05), _EYES[1] + rng.uniform(-0.05, 0.05)
    direction = _past_forearms(take, back * user + [0.0, 0.0, up])
    aside = np.cross(user, [0.0, 0.0, 1.0])
    paths = []
    for number in range(config.views):
        eyes = centers + direction
        eyes += 0.064 * (number - 0.5 * (config.views - 1)) * aside
        away = eyes - centers
        directions = away / np.linalg.norm(away, axis=1, keepdims=True)
        paths.append(_Path(preset(config.camera), poses_at(eyes, looking(directions))))
    return paths


def _past_forearms(take: Take, offset: Doubles) -> Doubles:
    """The offset (3,) [m] from the hands, rotated until no forearm usually lies in the line of sight."""
    length = float(np.linalg.norm(offset))
    direction = offset / length
    medians = np.nanmedian(-_along(take), axis=0)
    medians /= np.linalg.norm(medians, axis=1, keepdims=True)
    for arm in [*medians] * 2:  # twice: avoiding one arm may lead into the other
        if direction @ arm > np.cos(_HEAD_CLEARANCE):
            across = direction - (direction @ arm) * arm
            if np.linalg.norm(across) < 1e-3:
                across = np.cross(arm, [1.0, 0.0, 0.0])
            direction = np.cos(_HEAD_CLEARANCE) * arm + np.sin(_HEAD_CLEARANCE) * across / np.linalg.norm(
                across
            )
    return length * direction


def _anywhere(config: ViewConfig, take: Take, framing: Framing, rng: np.random.Generator) -> list[_Path]:
    centers, paths, camera = framing.centers, [], preset(config.camera)
    for _ in range(config.views):
        best, chosen = np.full(take.num_frames, np.inf), np.tile([0.0, 0.0, 1.0], (take.num_frames, 1))
        distances = np.ones(take.num_frames)
        closer = rng.uniform(1.0, _CLOSER, take.num_frames)
        remaining = np.arange(take.num_frames)
        for attempt in range(_TRIES):
            count, middles = len(remaining), centers[remaining]
            azimuths = rng.uniform(-np.pi, np.pi, count)
            rise = np.arcsin(rng.uniform(np.sin(_LOWEST), np.sin(_HIGHEST), count))
            level = np.cos(rise)[:, None] * np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
            directions = np.column_stack([level, np.sin(rise)])
            rotations = looking(directions)
            if config.distance is None:
                usual = _distance_of(camera, framing.sides(rotations, remaining), config.share)
                shortest = framing.shortest(camera, middles, rotations, remaining)
                distance = np.maximum(usual / closer[remaining], shortest)
                smaller = distance / usual
                if attempt:
                    poses = poses_at(middles + distance[:, None] * directions, rotations)
                    shares = framing.shares(camera, poses, _CLOSER * config.share, remaining)
                    smaller = config.share / np.maximum(shares, 1e-6)
                bad = np.maximum(np.nan_to_num(smaller, nan=1.0), _ENOUGH)
            else:
                distance, bad = rng.uniform(*config.distance, count), np.ones(count)
            bad = bad + _HIDDEN * _behind_arms(take.qpos[remaining], middles + distance[:, None] * directions)
            better = bad < best[remaining]
            rows = remaining[better]
            best[rows], chosen[rows], distances[rows] = bad[better], directions[better], distance[better]
            remaining = remaining[best[remaining] > _ENOUGH]
            if not len(remaining):
                break
        distances = np.where(np.isfinite(distances), distances, 1.0)  # of frames without hands
        paths.append(_Path(camera, poses_at(centers + distances[:, None] * chosen, looking(chosen))))
    return paths


def _behind_arms(qpos: Doubles, positions: Doubles) -> Flags:
    """Whether each frame's position (T, 3) [m] is behind a forearm, where little else is seen, or beside one.

    NaN, where there is no hand, never is.
    """
    away = np.nan_to_num(positions)[:, None] - qpos[..., :3]
    along = quaternion_matrix(qpos[..., 3:7])[..., 0]
    back = -(away * along).sum(axis=-1)
    behind = back > np.cos(_ARM_CLEARANCE) * np.linalg.norm(away, axis=-1)
    beside = np.linalg.norm(away + np.clip(back, 0.0, _ARM)[..., None] * along, axis=-1) < _ARM_DISTANCE
    return np.asarray((behind | beside).any(axis=1))


def _rig(config: ViewConfig, take: Take, framing: Framing, rng: np.random.Generator) -> list[_Path]:
    """At the cameras of a rig, with the lens that the share takes, or one that shows nearly all hands.

    Where that makes them small, cameras follow the hands, and where it still does, they zoom too.
    """
    middle, paths = framing.middle(), []
    for T_world_camera in load_rig(config.rig).T_world_camera:
        camera, position, zoom = preset(config.camera), T_world_camera[:3, 3], None
        followed = framing.followed()
        for _ in range(_CENTERED):
            _, distances, rotations = _turned_to(position, followed)
            followed = framing.centered(followed, rotations, distances)
        for centers in (np.broadcast_to(middle, followed.shape), followed):
            away, distances, rotations = _turned_to(position, centers)
            if camera.lens.kind != "pinhole":
                break
            share = config.share * rng.uniform(1.0, _CLOSER)
            side = float(np.nanmedian(framing.sides(rotations) / distances))
            wanted = 1.0 / _distance_of(camera, side, share)
            longest = distances / framing.shortest(camera, centers, rotations).clip(1e-6)
            lens = min(wanted, float(np.quantile(longest, 1.0 - _NEARLY_ALL)))
            if lens >= wanted / _ENOUGH:
                break
        else:
            zoom = 1.0 / framing.held(1.0 / np.minimum(wanted, longest)) / lens
        if camera.lens.kind == "pinhole":
            camera = zoomed(camera, lens)
        paths.append(_Path(camera, poses_at(np.broadcast_to(position, away.shape), rotations), zoom))
    return paths


_PATHS: Final = {"still": _still, "orbit": _orbit, "head": _head, "anywhere": _anywhere, "rig": _rig}


def _turned_to(position: Doubles, centers: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Ways (T, 3) [m] from places to a camera, their lengths (T,) [m], and its axes (T, 3, 3) then."""
    away = position - centers
    distances = np.linalg.norm(away, axis=1)
    return away, distances, looking(away / distances[:, None])


def zoomed(camera: Camera, zoom: float) -> Camera:
    """The camera with so many times its focal lengths."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= zoom
    return dataclasses.replace(camera, K=K)


def check_hands_in_view(config: ViewConfig, viewpoints: Viewpoints, take: Take) -> None:
    """Refuse the user's own cameras if none has a hand in its pictures, and warn of those that have none."""
    if config.cameras is None:
        return
    cameras, name = viewpoints.cameras(0), config.own_cameras
    blind = list(cameras)
    for hand, qpos in zip(take.hands, np.swapaxes(take.qpos, 0, 1), strict=True):
        there = qpos[np.isfinite(qpos).all(axis=1)]
        for first in range(0, len(there), _CHUNK):
            points = hand_keypoints(hand.model, there[first : first + _CHUNK])
            blind = [camera for camera in blind if not _any_inside(camera, points)]
            if not blind:
                return
    if len(blind) == len(cameras):
        one = blind[0]
        middle, place = np.nanmedian(take.qpos[..., :3], axis=(0, 1)), one.T_world_camera[:3, 3]
        raise RigError(
            f"{name}: no camera has a hand in its picture in any of {take.num_frames} frames: wrists are "
            f"around {_shown(middle)} m, and camera '{one.name}' stands at {_shown(place)} m and looks along "
            f"{_shown(one.T_world_camera[:3, 2])}"
        )
    for camera in blind:
        told = f"{name}: camera '{camera.name}' has no hand in its picture in any frame"
        warnings.warn(told, HandSimWarning, stacklevel=2)


def _any_inside(camera: Camera, points: Doubles) -> bool:
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
    """A camera at a random place around hands, turned at random about its axis, not behind their forearms.

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
    shift = np.array([0.0, 0.0, 4.0 * nearest])  # of the hands in the camera's axes
    room = rng.uniform(-0.5, 0.5, 2) * _FREE
    for _ in range(_ROUNDS):  # perspective widens what is near
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
    """A pinhole camera at the place of another one that sees a square of `size` pixels around hands.

    The keypoints of all hands, in the world [m], span this share of its side, somewhere in it.
    """
    pixels = camera.project(keypoints)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    side = float((high - low).max()) / share
    corner = 0.5 * (low + high - side) + _FREE * rng.uniform(-0.5, 0.5, 2) * (side - (high - low))
    K = camera.K.copy()
    K[:2, 2] -= corner
    K[:2] *= size / side
    return dataclasses.replace(camera, size=(size, size), K=K)
