"""`Studio`, which draws single moments of a take for one camera, with their ground truth."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy.typing import NDArray

from gloves.fit import GloveFit
from gloves.takes.take import RigidBody, Take
from handsim.errors import HandSimError
from handsim.hand.model import KEYPOINT_DIGITS, KEYPOINT_NAMES, hand_keypoints
from handsim.hand.shape import DIGITS, PALM, bones_of
from handsim.kernels import kernel
from handsim.space.camera import Camera
from handsim.space.transforms import pose_matrices
from render.color_sensor import Exposure, Shutter, combine, expose, linear_of, shutter_times
from render.depth_sensor import DepthNoise, TimeOfFlight, apply_depth_noise, reflectance_of
from render.frames import (
    FOREARM,
    PARTS_A_HAND,
    PASSES,
    BodyTruth,
    Bytes,
    Doubles,
    Floats,
    Geometry,
    HandTruth,
    Pictures,
    RenderedFrame,
)
from render.painting.figures import Appearance, BodyFigure, Drawn, HandFigure
from render.painting.painter import Painter, paint, put_before
from render.painting.rasterizer import NEAR, faces_for, see, warp
from render.painting.shading import GAMMA, light_behind
from render.scenery.backgrounds import Background, Enclosure, draw_surroundings, enlarged, kept_background
from render.scenery.lights import Lighting
from render.skin.look import SkinLook, upper_arms

_PALM_SIDE: Final = [name == "wrist" or name.endswith(("CMC", "MCP")) for name in KEYPOINT_NAMES]
"""Which keypoints lie in the palm, too."""


def hand_truth(
    figure: HandFigure,
    qpos: Float[np.ndarray, "27"],
    number: int,
    camera: Camera,
    pictures: Geometry,
    *,
    recorded: bool = True,
) -> HandTruth:
    """Ground truth of a hand, by its number among those in the picture, from the camera's depth and parts.

    Vertices are computed where it is recorded.
    """
    model = figure.fit.model
    keypoints = hand_keypoints(model, qpos[None])[0]
    pixels = camera.project(keypoints)
    worn = figure.look.glove is not None
    return HandTruth(
        shape=model.shape,
        qpos=qpos,
        keypoints=pixels,
        keypoints_world=keypoints,
        visible=_visible(keypoints, pixels, figure.thickness, number, camera, pictures),
        box=_box(pictures.parts, number),
        vertices=model.skin(qpos[None])[0].astype(np.float32) if recorded else np.empty((0, 3), np.float32),
        marker_names=figure.fit.layout.names if worn else (),
        markers=figure.markers(qpos) if worn else np.empty((0, 3)),
    )


def _visible(
    keypoints: Doubles, pixels: Doubles, thickness: Doubles, number: int, camera: Camera, pictures: Geometry
) -> Bool[np.ndarray, "21"]:
    """Keypoints whose pixel shows the finger that they are in.

    The pixel is one of this hand, of the keypoint's digit (or of the palm, where it is at its edge), and the
    keypoint is no deeper under the surface there than the finger is thick.
    """
    width, height = camera.size
    inside = (pixels >= 0.0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    columns, rows = np.where(inside[:, None], pixels, 0.0).astype(np.int64).T
    bones = pictures.parts[rows, columns].astype(np.int64) - 1 - PARTS_A_HAND * number
    own = inside & (pictures.instances[rows, columns] == 1 + number) & (bones >= 0) & (bones < PARTS_A_HAND)
    own &= _ALLOWED[np.arange(len(keypoints)), np.where(own, bones, 0)]
    local = camera.local(keypoints)
    ahead = local[:, 2] > 0.0
    slant = np.linalg.norm(local, axis=1) / np.where(ahead, local[:, 2], np.inf)
    under = slant * (local[:, 2] - pictures.depth[rows, columns])
    # Fisheyes see sideways and back, where there is no depth: the hand's own surface must do.
    return np.asarray(own & np.where(ahead, under <= thickness, True))


def _allowed_parts() -> Bool[np.ndarray, "21 32"]:
    """Parts of the hand that may show each keypoint: those of its digit; the wrist's the palm and forearm."""
    allowed = np.zeros((len(KEYPOINT_NAMES), PARTS_A_HAND), dtype=bool)
    for keypoint, digit in enumerate(KEYPOINT_DIGITS):
        allowed[keypoint, list(bones_of(DIGITS[digit])) if digit >= 0 else [FOREARM]] = True
        allowed[keypoint, PALM] = _PALM_SIDE[keypoint]
    return allowed


_ALLOWED: Final = _allowed_parts()


def _box(parts: UInt8[np.ndarray, "H W"], number: int) -> Float[np.ndarray, "4"]:
    """Left, top, width, height [px] of the visible hand without its forearm; NaN where none is visible."""
    first = 1 + PARTS_A_HAND * number
    mine = (parts >= first) & (parts < first + FOREARM)
    columns, rows = np.flatnonzero(mine.any(axis=0)), np.flatnonzero(mine.any(axis=1))
    if not len(columns):
        return np.full(4, np.nan)
    left, top = float(columns[0]), float(rows[0])
    return np.array([left, top, columns[-1] + 1.0 - left, rows[-1] + 1.0 - top])


_AROUND: Final = 8
"""Pixels around a surface that a depth sensor's windows look at, and more."""


@dataclass(frozen=True, slots=True)
class FrameChoices:
    """Random choices of one picture, apart from people and camera."""

    lighting: Lighting
    background: Background
    exposure: Exposure | None  # None for a perfect color sensor
    shutter: Shutter | None  # None for a picture of a moment
    depth_noise: DepthNoise | None  # None for a perfect depth sensor
    seed: int  # seed of the sensors' noise
    enclosure: Enclosure | None = None
    """The box whose walls have the background, for several cameras; None: a picture without depth."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One frame of a take, and the time around it, which shutters blur."""

    take: Take
    frame: int
    person: Int[np.ndarray, "T"] | None = None
    """Who is in each frame, where that changes: the time around a frame ends where another person comes."""
    upper_arms: Float[np.ndarray, "H 3"] | None = None
    """Unit direction of each hand's upper arm; see `Studio.reaching`."""

    def hand(self, number: int, shift: float = 0.0) -> Float[np.ndarray, "27"] | None:
        """Pose of a hand `shift` seconds after the frame; None where the frame has none."""
        rows = self.take.qpos[:, number]
        if not np.isfinite(rows[self.frame]).all():
            return None
        (before, after), share = self._around(rows, shift)
        if before[3:7] @ after[3:7] < 0.0:
            after = np.concatenate([after[:3], -after[3:7], after[7:]])
        pose: Doubles = before + share * (after - before)
        pose[3:7] /= np.linalg.norm(pose[3:7])
        return pose

    def body(self, number: int, shift: float = 0.0) -> Float[np.ndarray, "4 4"] | None:
        """Pose of a rigid body `shift` seconds after the frame; None where the frame has none."""
        rows = self.take.body_poses[:, number]
        if not np.isfinite(rows[self.frame]).all():
            return None
        poses, share = self._around(rows, shift)
        before, after = pose_matrices(poses)
        T_world_body: Doubles = before + share * (after - before)
        left, _, right = np.linalg.svd(T_world_body[:3, :3])
        T_world_body[:3, :3] = left @ right
        return T_world_body

    def _around(self, rows: Float[np.ndarray, "T ..."], shift: float) -> tuple[Doubles, float]:
        """The rows before and after a time, and the share of the way between them.

        Rows without numbers, and those of others than the frame's person, count as the frame's own.
        """
        frames = shift * self.take.rate
        step = int(np.floor(frames))
        indices = np.clip([self.frame + step, self.frame + step + 1], 0, len(rows) - 1)
        others = [self.person is not None and self.person[i] != self.person[self.frame] for i in indices]
        kept = [
            self.frame if other or not np.isfinite(rows[index]).all() else index
            for index, other in zip(indices, others, strict=True)
        ]
        return rows[kept], frames - step


class Studio:
    """Draws moments of the same people and rigid bodies."""

    def __init__(
        self,
        hands: Sequence[GloveFit],
        people: Sequence[Appearance],
        bodies: Sequence[RigidBody] = (),
        body_colors: Sequence[tuple[float, float, float]] = (),
        passes: Sequence[str] = PASSES,
        painter: Painter = "compiled",
    ) -> None:
        self.passes, self.painter = tuple(passes), painter
        self._people = tuple(people)
        self._looks = [dataclasses.asdict(look) for look in people]
        first = np.cumsum([0, *(len(fit.attachment.points) for fit in hands)])
        self._hands = [
            HandFigure(fit, look, first_marker=int(number))
            for fit, look, number in zip(hands, people, first, strict=False)
        ]
        self._bodies = [BodyFigure(body, color) for body, color in zip(bodies, body_colors, strict=True)]
        self._colors = tuple(body_colors)
        self._posed: tuple[Moment, list[Drawn]] | None = None  # the last moment's, seen by several cameras

    @property
    def skin(self) -> SkinLook | None:
        """The people's skin; None where gloves hide it."""
        return self._people[0].skin if self._people[0].glove is None else None

    def photograph(
        self, moment: Moment, camera: Camera, choices: FrameChoices, *, recorded: bool = True
    ) -> RenderedFrame:
        """Draw one moment of the studio's hands and bodies, with all other choices.

        Where `recorded`, the frame has its choices as JSON and the hands' vertices, which take time.
        """
        take, frame, rng = moment.take, moment.frame, np.random.default_rng(choices.seed)
        drawn = self._still(moment)
        _check_outside(camera, drawn, frame)
        present = [number for number in range(len(self._hands)) if moment.hand(number) is not None]
        sensor = choices.depth_noise if "depth" in self.passes else None
        surfaces = [one.triangles for one in drawn]
        truth = see(camera, surfaces, with_normals=sensor is not None or "normals" in self.passes)
        rgb = noisy_rgb = noisy_depth = None
        if "rgb" in self.passes:
            rgb = self._colors_of(camera, drawn, choices)
            noisy_rgb = self._exposed(moment, camera, rgb, choices, rng)
        seen = truth
        if choices.enclosure is not None:
            seen = draw_surroundings(choices.background, choices.enclosure, camera).put_behind(truth, camera)
        if sensor is not None:
            noisy_depth = self._noisy_depth(seen, rgb, present, camera, sensor, rng)
        hands = tuple(
            hand_truth(self._hands[number], take.qpos[frame, number], index, camera, truth, recorded=recorded)
            for index, number in enumerate(present)
        )
        bodies = tuple(
            BodyTruth(body.name, T_world_body)
            for body, T_world_body in zip(take.bodies, pose_matrices(take.body_poses[frame]), strict=True)
            if np.isfinite(T_world_body).all()
        )
        seen_points = take.point_list.of(frame)
        return RenderedFrame(
            number=frame,
            time=float(take.times[frame]),
            camera=camera,
            hands=hands,
            bodies=bodies,
            ideal=self._requested(seen, rgb),
            noisy=Pictures(rgb=noisy_rgb, depth=noisy_depth),
            points=take.point_list.points[seen_points],
            labels=take.point_list.labels[seen_points],
            label_names=take.label_names,
            choices=self._record(choices) if recorded else {},
        )

    def reaching(self, moment: Moment, cameras: Sequence[Camera]) -> Moment:
        """The moment with arms that leave the pictures of these cameras."""
        found = np.full((len(self._hands), 3), np.nan)
        there, elbows, forearms = [], [], []
        for number, hand in enumerate(self._hands):
            pose = moment.hand(number)
            if pose is not None:
                elbow, forearm = hand.skin.forearm_line(pose)
                there.append(number)
                elbows.append(elbow)
                forearms.append(forearm)
        if there:
            found[there] = upper_arms(np.array(elbows), np.array(forearms), cameras)
        return dataclasses.replace(moment, upper_arms=found)

    def is_clear(self, moment: Moment, cameras: Sequence[Camera]) -> bool:
        """Whether all cameras are outside of hands and objects, so that the moment can be drawn."""
        drawn = self._still(moment)
        return all(_clearance(camera, drawn) >= 2.0 * NEAR for camera in cameras)

    def _still(self, moment: Moment) -> list[Drawn]:
        """Surfaces of a moment."""
        if self._posed is None or self._posed[0] is not moment:
            self._posed = moment, self._drawn(moment, 0.0)
        return self._posed[1]

    def _drawn(self, moment: Moment, shift: float) -> list[Drawn]:
        """Surfaces of the hands and bodies that are there, `shift` seconds later."""
        drawn: list[Drawn] = []
        number = 0
        for index, hand in enumerate(self._hands):
            pose = moment.hand(index, shift)
            if pose is not None:
                upper_arm = None if moment.upper_arms is None else moment.upper_arms[index]
                drawn += hand.drawn(pose, number, upper_arm)
                number += 1
        for index, body in enumerate(self._bodies):
            T_world_body = moment.body(index, shift)
            if T_world_body is not None:
                number += 1
                drawn += body.drawn(T_world_body, number)
        return drawn

    def _noisy_depth(
        self,
        truth: Geometry,
        rgb: Bytes | None,
        present: Sequence[int],
        camera: Camera,
        sensor: DepthNoise,
        rng: np.random.Generator,
    ) -> Float32[np.ndarray, "H W"]:
        """Depth as the sensor has it; only the part of the picture that has depth takes time."""
        assert truth.normals is not None
        noisy = np.zeros_like(truth.depth)
        left, top, width, height = cv2.boundingRect((truth.depth > 0.0).view(np.uint8))
        if width == 0:
            return noisy
        right, bottom = (
            min(end + _AROUND, side)
            for end, side in zip((left + width, top + height), camera.size, strict=True)
        )
        left, top = max(0, left - _AROUND), max(0, top - _AROUND)
        part = np.s_[top:bottom, left:right]
        light = None
        if isinstance(sensor, TimeOfFlight):  # others need none
            light = self._infrared(truth.instances[part], None if rgb is None else rgb[part], present)
        noisy[part] = apply_depth_noise(
            truth.depth[part],
            truth.normals[part],
            sensor,
            camera=camera.part(left, top, right - left, bottom - top),
            reflectance=light,
            rng=rng,
        )
        return noisy

    def _infrared(self, instances: Bytes, rgb: Bytes | None, present: Sequence[int]) -> Floats:
        """Infrared reflectance of each pixel (H, W), from its color; bare skin has its own."""
        infrared = np.ones(instances.shape, dtype=np.float32) if rgb is None else reflectance_of(rgb)
        for index, number in enumerate(present):
            if self._people[number].glove is None:
                infrared[instances == index + 1] = self._people[number].skin.infrared
        return infrared

    def _colors_of(
        self, camera: Camera, drawn: Sequence[Drawn], choices: FrameChoices
    ) -> UInt8[np.ndarray, "H W 3"]:
        """The perfect color picture."""
        painted = [paint(face, drawn, choices.lighting, self.painter) for face in faces_for(camera)]
        whole = warp(camera, painted, cv2.INTER_LINEAR)
        if choices.enclosure is None:
            return put_before(whole, self._behind(camera, drawn, choices))
        behind = draw_surroundings(choices.background, choices.enclosure, camera)
        return put_before(whole, behind.rgb.astype(np.float32))

    def _behind(
        self, camera: Camera, drawn: Sequence[Drawn], choices: FrameChoices
    ) -> Float32[np.ndarray, "H W 3"]:
        """The background with what shadows fall on it, sRGB from 0 to 255."""
        plain, backdrop = _background(choices.background, camera.size), choices.background.backdrop
        if backdrop is None or camera.lens.kind != "pinhole":
            return plain
        light = light_behind(camera, drawn, choices.lighting, backdrop)
        if light is None:
            return plain
        return np.asarray(cv2.multiply(plain, cv2.merge([cv2.pow(light, 1.0 / GAMMA)] * 3)))

    def _exposed(
        self, moment: Moment, camera: Camera, rgb: Bytes, choices: FrameChoices, rng: np.random.Generator
    ) -> UInt8[np.ndarray, "H W 3"] | None:
        """The color picture of shutter and sensor; None when they change nothing."""
        if choices.exposure is None and choices.shutter is None:
            return None
        if choices.shutter is None:
            light = linear_of(rgb)
        else:
            one = choices.shutter
            times, weights = shutter_times(one.exposure, one.readout, one.sub_frames, camera.size[1])
            moments = (self._colors_of(camera, self._drawn(moment, time), choices) for time in times)
            light = combine(moments, weights)
        return expose(light, choices.exposure or Exposure(), rng=rng)

    def _requested(self, truth: Geometry, rgb: Bytes | None) -> Pictures:
        ids = "ids" in self.passes
        return Pictures(
            rgb,
            truth.depth if "depth" in self.passes else None,
            truth.normals if "normals" in self.passes else None,
            truth.parts if ids else None,
            truth.instances if ids else None,
            truth.markers if ids else None,
        )

    def _record(self, choices: FrameChoices) -> dict[str, Any]:
        noise = choices.depth_noise
        kind = {} if noise is None else {"depth_sensor": type(noise).__name__}
        chosen = dataclasses.asdict(choices)
        if choices.enclosure is None:
            del chosen["enclosure"]
        return {"people": self._looks, "body_colors": self._colors, **kind, **chosen}


def _clearance(camera: Camera, drawn: Sequence[Drawn]) -> float:
    """Distance of a camera from the nearest vertex [m]."""
    x, y, z = camera.T_world_camera[:3, 3].tolist()
    return min((_distance(one.triangles.vertices, x, y, z) for one in drawn), default=np.inf)


@kernel
def _distance(vertices: NDArray[Any], x: float, y: float, z: float) -> float:
    """Distance [m] of the nearest of some vertices (V, 3) from a place."""
    least = np.inf
    for vertex in range(len(vertices)):
        dx, dy, dz = vertices[vertex, 0] - x, vertices[vertex, 1] - y, vertices[vertex, 2] - z
        least = min(least, dx * dx + dy * dy + dz * dz)
    return float(np.sqrt(least))


def _check_outside(camera: Camera, drawn: Sequence[Drawn], frame: int) -> None:
    nearest = _clearance(camera, drawn)
    if nearest < 2.0 * NEAR:
        raise HandSimError(
            f"camera '{camera.name}' is {1e3 * nearest:.0f} mm from a hand or object in frame {frame}, "
            f"expected {2e3 * NEAR:.0f} mm or more; place it elsewhere"
        )


@functools.lru_cache(maxsize=2)
def _background(background: Background, size: tuple[int, int]) -> Float32[np.ndarray, "H W 3"]:
    """SRGB from 0 to 255."""
    display = cv2.pow(kept_background(background, size), 1.0 / GAMMA)
    return enlarged(np.multiply(display, np.float32(255.0), out=display), size)
