"""A take whose hands move in all directions, a camera that films it, and what a detector would find."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from film.bundle import FoundFrame
from film.detector import FoundHand
from gloves.fit import settle_glove
from gloves.layout import load_layout
from gloves.takes.take import Take
from handsim import Camera, HandModel, Lens, look_at
from handsim.hand.model import between_poses
from handsim.hand.shape import Side
from handsim.space.camera import camera_matrix
from handsim.space.transforms import rigid
from render import RenderConfig, draw

SIZE = (640, 480)
OTHER: dict[Side, Side] = {"left": "right", "right": "left"}


def moving_take(
    seconds: float = 16.0, *, sides: tuple[Side, ...] = ("right",), still: bool = False, seed: int = 0
) -> Take:
    """Hands that sway, turn and bend their fingers; `still`, without a motion in any direction."""
    rng, rate = np.random.default_rng(seed), 60.0
    times = np.arange(int(seconds * rate)) / rate
    fit = settle_glove(load_layout("dense19"), HandModel.named("M"))

    def waves(count: int, size: float) -> np.ndarray:
        pace, phase = rng.uniform(0.15, 0.7, (3, count)), rng.uniform(0.0, 6.28, (3, count))
        return size * np.sin(2.0 * np.pi * pace * times[:, None, None] + phase).mean(axis=1)

    qpos = np.empty((len(times), len(sides), 27))
    for number in range(len(sides)):
        sway = 0.0 if still else 1.0
        qpos[:, number, :3] = [0.3 * number, 0.0, 1.0] + sway * waves(3, 0.45)
        turns = Rotation.from_rotvec([0.0, 0.0, 1.5] + sway * waves(3, 0.9))
        qpos[:, number, 3:7] = turns.as_quat(scalar_first=True)
        qpos[:, number, 7:] = 0.4 + sway * waves(20, 0.4)
    return Take.of_poses([fit.with_side(side) for side in sides], qpos, rate=rate)


@dataclass(frozen=True)
class Filming:
    """How a camera films, and how well a detector finds hands."""

    seed: int = 0
    seconds: float = 12.0
    rate: float = 30.0
    noise: float = 3.0  # [px]
    outliers: float = 0.05
    missing: float = 0.1
    swapped: float = 0.05
    readout: tuple[float, float] = (0.0, 0.015)  # [s] across and down
    offset: float = 2.345  # [s]
    bump: float = np.inf  # [s]
    stranger: bool = False

    def cameras(self) -> tuple[Camera, Camera]:
        """The camera, and where it is after a push."""
        rng = np.random.default_rng(self.seed)
        focal, around = 640.0 * rng.uniform(0.8, 1.2), rng.uniform(0.0, 6.28)
        place = np.array([0.1 + 1.0 * np.cos(around), 1.0 * np.sin(around), 1.0 + rng.uniform(0.0, 0.4)])
        lens = Lens("brown", (0.04, -0.02, 0.0, 0.0, 0.0))
        matrix = camera_matrix(focal, focal, *rng.normal((320.0, 240.0), 1.5))
        camera = Camera("hidden", SIZE, matrix, look_at(place, [0.1, 0.0, 1.0]), lens)
        push = rigid(Rotation.from_rotvec([0.02, -0.04, 0.01]).as_matrix(), np.array([0.01, 0.0, 0.005]))
        return camera, camera.at(camera.T_world_camera @ push)

    def found(self, take: Take) -> list[FoundFrame]:
        """What the detector finds."""
        rng, before_and_after = np.random.default_rng(self.seed + 1), self.cameras()
        times = np.arange(int(self.seconds * self.rate)) / self.rate
        points = {late: self._points(take, times + late) for late in (0.0, 1e-3)}
        strange = self._points(moving_take(seed=77), times) + [0.25, 0.1, 0.0]
        frames = []
        for number, time in enumerate(times):
            camera, hands = before_and_after[int(time >= self.bump)], []
            for hand, side in enumerate(take.sides):
                velocity = (points[1e-3][number, hand] - points[0.0][number, hand]) / 1e-3
                pixels = camera.project(points[0.0][number, hand])
                late = (pixels / SIZE - 0.5) @ self.readout
                pixels = camera.project(points[0.0][number, hand] + velocity * late[:, None])
                pixels = pixels + rng.normal(0.0, self.noise, pixels.shape)
                if rng.random() < self.outliers:
                    pixels = pixels + rng.normal(0.0, 50.0, pixels.shape)
                told = OTHER[side] if rng.random() < self.swapped else side
                if np.isfinite(pixels).all() and rng.random() >= self.missing:
                    hands.append(found_hand(told, pixels))
            if self.stranger:
                hands.append(found_hand("right", camera.project(strange[number, 0])))
            frames.append(FoundFrame(float(time), hands))
        return frames

    def pictures(self, take: Take, dress: str = "glove") -> list[np.ndarray]:
        """What the camera sees."""
        times = np.arange(int(self.seconds * self.rate)) / self.rate
        qpos = between_poses(take.times, self.offset + times, take.qpos, take.rate)
        config = RenderConfig(passes=("rgb",), dress=dress, painter="compiled", seed=self.seed, vary="shard")
        shown, drawn = Take.of_poses(take.hands, qpos, rate=self.rate, times=times), []
        for camera, chosen in zip(self.cameras(), (times < self.bump, times >= self.bump), strict=True):
            some = np.flatnonzero(chosen)
            frames = draw(shown, camera=camera, frames=some, config=config)
            drawn += [frame.rgb if frame.noisy.rgb is None else frame.noisy.rgb for frame in frames]
        return drawn

    def _points(self, take: Take, times: np.ndarray) -> np.ndarray:
        qpos = between_poses(take.times, self.offset + times, take.qpos, take.rate)
        return Take.of_poses(take.hands, qpos, rate=self.rate).keypoints()


def found_hand(side: Side, pixels: np.ndarray) -> FoundHand:
    """A hand with these keypoints."""
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    return FoundHand(side, np.concatenate([low, high - low]), 0.9, pixels, np.full(len(pixels), 0.9))


def pose_of(camera: Camera) -> np.ndarray:
    """Rotation vector and place (6,) of a camera, as a state of the bundle has them."""
    turn = Rotation.from_matrix(camera.T_world_camera[:3, :3]).as_rotvec()
    return np.concatenate([turn, camera.T_world_camera[:3, 3]])
