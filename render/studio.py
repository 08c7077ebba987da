"""`Studio`, which draws single moments of a take for one camera, with their ground truth."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.fit import GloveFit
from gloves.takes.bodies import RigidBody
from gloves.takes.take import STATUSES, Take
from handsim.errors import HandSimError
from handsim.hand.model import KEYPOINT_DIGITS, KEYPOINT_NAMES, hand_keypoints
from handsim.hand.shape import DIGITS, PALM, bones_of
from handsim.kernels import kernel
from handsim.motion_files.motion import joint_poses
from handsim.space.camera import Camera
from handsim.space.transforms import pose_matrices
from render.arms import Arms, bend_arms
from render.color_sensor import GAMMA, Exposure, combine, expose, light_of, linear_of, shutter_times
from render.conditions import Conditions
from render.config import RenderConfig
from render.depth_sensor import DepthNoise, TimeOfFlight, apply_depth_noise, reflectance_of
from render.frames import (
    FOREARM,
    PARTS_A_HAND,
    BodyTruth,
    Bytes,
    Doubles,
    Flags,
    Floats,
    Footage,
    Geometry,
    HandTruth,
    Integers,
    Pictures,
    RenderedFrame,
)
from render.mano import mano_fit
from render.painting.figures import BodyFigure, Drawn, HandFigure, sample_appearance
from render.painting.painter import paint, paint_blurred, put_before
from render.painting.rasterizer import NEAR, see
from render.painting.shading import level_behind, light_behind
from render.person import person_figure
from render.scenery.backgrounds import (
    Background,
    Surroundings,
    draw_surroundings,
    enlarged,
    kept_background,
    surroundings_of_picture,
)
from render.skin.look import SkinLook
from render.user_body import UserBody

_PALM_JOINTS: Final = {0: (0, 0), **{first: (0, first) for first in range(5, 21, 4)}}
_OPENXR_KEYPOINTS: Final = np.array([n for point in range(21) for n in _PALM_JOINTS.get(point, (point,))])
"""Keypoint at each of `OPENXR_JOINTS`; the wrist for those in the palm."""


@functools.cache
def _allowed_parts() -> Flags:
    """Parts (21, 32) whose pixels may show each keypoint: its digit's; palm or forearm for the wrist."""
    allowed = np.zeros((len(KEYPOINT_NAMES), PARTS_A_HAND), dtype=bool)
    for keypoint, (name, digit) in enumerate(zip(KEYPOINT_NAMES, KEYPOINT_DIGITS, strict=True)):
        allowed[keypoint, list(bones_of(DIGITS[digit])) if digit >= 0 else [FOREARM]] = True
        allowed[keypoint, PALM] = name == "wrist" or name.endswith(("CMC", "MCP"))
    return allowed


def hand_truth(
    figure: HandFigure,
    qpos: Doubles,
    number: int,
    camera: Camera,
    pictures: Geometry,
    tracking: Mapping[str, Any] | None = None,
    *,
    recorded: bool = True,
    openxr: bool = False,
    mano: str | None = None,
) -> HandTruth:
    """Ground truth of a hand with this number in the picture; mask and vertices only where `recorded`."""
    model = figure.fit.model
    keypoints = hand_keypoints(model, qpos[None])[0]
    poses = joint_poses(model, qpos[None])[0] if openxr else np.empty((0, 4, 4))
    points = np.concatenate([keypoints, poses[:, :3, 3]])
    pixels = camera.project(points)
    keypoint_numbers = np.append(np.arange(len(keypoints)), _OPENXR_KEYPOINTS[: len(poses)])
    thickness = figure.thickness[keypoint_numbers]
    visible = _are_visible(points, keypoint_numbers, thickness, number, camera, pictures)
    worn = figure.look.glove is not None
    seen_from = np.linalg.inv(camera.T_world_camera)
    return HandTruth(
        shape=model.shape,
        qpos=qpos,
        keypoints=pixels[: len(keypoints)],
        keypoints_world=keypoints,
        visible=visible[: len(keypoints)],
        box=_box(pictures.parts, number),
        mask=_mask(pictures, number) if recorded else np.empty((0, 0), dtype=bool),
        vertices=model.skin(qpos[None])[0].astype(np.float32) if recorded else np.empty((0, 3), np.float32),
        openxr=poses,
        openxr_visible=visible[len(keypoints) :],
        tracking=tracking,
        mano=mano_fit(mano, model.shape).records(qpos[None], seen_from)[0] if mano and recorded else None,
        marker_names=figure.fit.layout.names if worn else (),
        markers=figure.fit.markers(qpos[None])[0][0] if worn else np.empty((0, 3)),
    )


def _are_visible(
    points: Doubles,
    keypoint_numbers: Integers,
    thickness: Doubles,
    number: int,
    camera: Camera,
    pictures: Geometry,
) -> Flags:
    """Tell which points (K, 3) [m] are visible: their pixels show their digit, or the palm at its edge.

    A visible point is no deeper under the surface at its pixel than the finger is thick.
    """
    pixels = camera.project(points)
    inside = np.all((pixels >= 0.0) & (pixels < camera.size), axis=1)
    columns, rows = np.where(inside[:, None], pixels, 0.0).astype(np.int64).T
    bones = pictures.parts[rows, columns].astype(np.int64) - 1 - PARTS_A_HAND * number
    own = inside & (pictures.instances[rows, columns] == 1 + number) & (bones >= 0) & (bones < PARTS_A_HAND)
    own &= _allowed_parts()[keypoint_numbers, np.where(own, bones, 0)]
    local = camera.local(points)
    ahead = local[:, 2] > 0.0
    slant = np.linalg.norm(local, axis=1) / np.where(ahead, local[:, 2], np.inf)
    under = slant * (local[:, 2] - pictures.depth[rows, columns])
    # Pictures have no depth where a fisheye sees sideways and back: only the part is compared there.
    return np.asarray(own & np.where(ahead, under <= thickness, True))


def _box(parts: Bytes, number: int) -> Doubles:
    """Left, top, width, height [px] of the visible hand without its forearm; NaN where none is visible."""
    first = 1 + PARTS_A_HAND * number
    left, top, width, height = cv2.boundingRect(cv2.inRange(parts, first, first + FOREARM - 1))
    return np.array([left, top, width, height], np.float64) if width else np.full(4, np.nan)


def _mask(pictures: Geometry, number: int) -> Flags:
    """Mask (H, W) of a hand with its markers, without its forearm."""
    forearm = 1 + PARTS_A_HAND * number + FOREARM
    return np.asarray((pictures.instances == 1 + number) & (pictures.parts != forearm))


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One frame of a take, with the motion before and after it for shutters that blur."""

    take: Take
    frame: int
    person: Int[np.ndarray, "T"] | None = None
    """Number of the person in each frame; motion is not interpolated from one person to another."""
    upper_arms: Float[np.ndarray, "H 3"] | None = None
    """Vector from each elbow to the end of the upper arm [m]; see `Studio.with_arms`."""
    forearms: Float[np.ndarray, "H 3"] | None = None
    """Unit direction of each hand's forearm; None for wrists at rest."""

    def hands(self, shift: float = 0.0) -> dict[int, Doubles]:
        """Poses (27,), `shift` seconds after the frame, of the hands that the frame has, by their numbers."""
        there = np.flatnonzero(np.isfinite(self.take.qpos[self.frame]).all(axis=1))
        return {int(number): self._hand_pose(self.take.qpos[:, number], shift) for number in there}

    def _hand_pose(self, rows: Doubles, shift: float) -> Doubles:
        """Interpolate the pose (27,) of a hand, from its poses in all frames (T, 27)."""
        pose: Doubles = rows[self.frame].copy()
        if shift != 0.0:
            (before, after), share = self._neighbors(rows, shift)
            if before[3:7] @ after[3:7] < 0.0:
                after = np.concatenate([after[:3], -after[3:7], after[7:]])
            pose = before + share * (after - before)
        pose[3:7] /= np.linalg.norm(pose[3:7])
        return pose

    def bodies(self, shift: float = 0.0) -> dict[int, Doubles]:
        """Poses (4, 4) of the frame's rigid bodies by their numbers, `shift` seconds after the frame."""
        there = np.flatnonzero(np.isfinite(self.take.body_poses[self.frame]).all(axis=1))
        return {int(number): self._body_pose(self.take.body_poses[:, number], shift) for number in there}

    def _body_pose(self, rows: Doubles, shift: float) -> Doubles:
        """Interpolate the pose (4, 4) of a rigid body, from its poses in all frames (T, 7)."""
        poses, share = self._neighbors(rows, shift)
        before, after = pose_matrices(poses)
        T_world_body: Doubles = before + share * (after - before)
        left, _, right = np.linalg.svd(T_world_body[:3, :3])
        T_world_body[:3, :3] = left @ right
        return T_world_body

    def _neighbors(self, rows: Doubles, shift: float) -> tuple[Doubles, float]:
        """The rows before and after a time, and the time's position between them, from 0 to 1.

        The frame's own row replaces rows with NaN and rows of other people.
        """
        frames = shift * self.take.rate
        step = int(np.floor(frames))
        indices = np.clip([self.frame + step, self.frame + step + 1], 0, len(rows) - 1)
        usable = np.isfinite(rows[indices]).all(axis=1)
        if self.person is not None:
            usable &= self.person[indices] == self.person[self.frame]
        return rows[np.where(usable, indices, self.frame)], frames - step


class Studio:
    """Draws moments of the same person and rigid bodies."""

    def __init__(
        self,
        hands: Sequence[GloveFit],
        config: RenderConfig,
        bodies: Sequence[RigidBody] = (),
        *,
        rng: np.random.Generator,
        user: UserBody | None = None,
        shows_person: bool = False,
        light: bool = False,
        footage: Footage | None = None,
    ) -> None:
        """Choose looks at random; the configuration must be resolved.

        A `UserBody` bends the wrists, and is drawn if `shows_person`. With `light`, frames have the linear
        light of their colors, which only our own painter computes.
        """
        assert config.painter != "auto"
        self._config, self._passes, self._painter = config, set(config.passes), config.painter
        self._footage = footage
        self._light = light and footage is None and config.painter == "compiled"
        look = sample_appearance(config.dress == "glove", tones=config.tones, rng=rng)
        if user is not None:
            look = dataclasses.replace(look, forearm=user.dressed(look.forearm))
        self._look, self._people = look, [dataclasses.asdict(look)] * len(hands)
        first = np.cumsum([0, *(len(fit.attachment.points) for fit in hands)])
        self._hands = [
            HandFigure(fit, look, first_marker=int(number)) for fit, number in zip(hands, first, strict=False)
        ]
        self._colors = tuple(tuple(rng.uniform(0.05, 0.9, 3).tolist()) for _ in bodies)
        self._bodies = [BodyFigure(body, color) for body, color in zip(bodies, self._colors, strict=True)]
        self._person = [person_figure(user, look)] if user is not None and shows_person else []
        self._last_surfaces: tuple[Moment, list[Drawn]] | None = None

    @property
    def skin(self) -> SkinLook | None:
        """The person's skin; None where gloves hide it."""
        return self._look.skin if self._look.glove is None else None

    def photograph(
        self, moment: Moment, camera: Camera, conditions: Conditions, *, recorded: bool = True
    ) -> RenderedFrame:
        """Draw one moment of the hands and bodies.

        Only where `recorded`, the frame has its choices as JSON and the hands' vertices: both take time.
        """
        take, frame, rng = moment.take, moment.frame, np.random.default_rng(conditions.seed)
        drawn = self.surfaces(moment)
        nearest = _clearance(camera, drawn)
        if nearest < 2.0 * NEAR:
            raise HandSimError(
                f"camera '{camera.name}' is {1e3 * nearest:.0f} mm from a hand or object in frame {frame}, "
                f"expected {2e3 * NEAR:.0f} mm or more; place it elsewhere"
            )
        sensor = conditions.depth_noise if "depth" in self._passes else None
        surfaces = [one.triangles for one in drawn]
        truth = see(camera, surfaces, with_normals=sensor is not None or "normals" in self._passes)
        footage = self._footage
        rgb = noisy_rgb = noisy_depth = None
        if "rgb" in self._passes:
            rgb = self._paint(camera, drawn, conditions) if footage is None else footage.picture(frame)
            noisy_rgb = self._sensor_picture(moment, camera, rgb, conditions, rng)
        light = None if rgb is None or not self._light else self._light_of(rgb, camera, drawn, conditions)
        if self._config.room_depth and footage is None and {"depth", "normals"} & self._passes:
            _surroundings_of(camera, drawn, conditions).put_behind(truth)
        elif self._person:
            for picture in truth[:2]:  # only hands and objects have depth and normals
                if picture is not None:
                    picture[truth.instances == 0] = 0.0
        if sensor is not None:
            noisy_depth = self._noisy_depth(truth, rgb, len(moment.hands()), camera, sensor, rng)
        seen_points = take.point_list.of(frame)
        return RenderedFrame(
            number=frame,
            time=float(take.times[frame]),
            camera=camera,
            hands=self._hand_truths(moment, camera, truth, recorded),
            bodies=_body_truths(take, frame),
            ideal=self._requested_pictures(truth, rgb, light),
            noisy=Pictures(rgb=noisy_rgb, depth=noisy_depth),
            points=take.point_list.points[seen_points],
            labels=take.point_list.labels[seen_points],
            label_names=take.label_names,
            choices=self._record(conditions) if recorded else {},
        )

    def with_arms(self, moment: Moment, cameras: Sequence[Camera], user: UserBody | None = None) -> Moment:
        """Add arms to a moment, the user's if known, that hide little of the hands and leave the pictures.

        This is for single poses; `UserBody.moving_arms` has the arms of a motion.
        """
        there = moment.hands()
        if not there:
            return moment
        numbers = [*there]
        if user is None:
            lines = [self._hands[number].skin.forearm_line(pose) for number, pose in there.items()]
            elbows, ways = (np.array(one)[None, :, None] for one in zip(*lines, strict=True))
            arms = Arms(np.stack([*there.values()])[None, :, :3], ways, elbows, np.zeros(ways.shape[:3]))
        else:
            arms = user.arms(moment.take.qpos[None, moment.frame], numbers, np.array([moment.frame]))
        found = np.full((2, len(self._hands), 3), np.nan)
        forearms, upper_arms = bend_arms(arms, np.concatenate(self.keypoints(moment))[None], [cameras])
        found[:, numbers] = forearms[0], upper_arms[0]
        return dataclasses.replace(moment, upper_arms=found[1], forearms=None if user is None else found[0])

    def keypoints(self, moment: Moment) -> list[Doubles]:
        """Keypoints (21, 3) in the world [m] of each hand in the frame."""
        hands = moment.hands().items()
        return [hand_keypoints(self._hands[number].fit.model, pose[None])[0] for number, pose in hands]

    def is_clear(self, moment: Moment, cameras: Sequence[Camera]) -> bool:
        """Whether all cameras are outside of hands and objects, so that the moment can be drawn."""
        return all(_clearance(camera, self.surfaces(moment)) >= 2.0 * NEAR for camera in cameras)

    def surfaces(self, moment: Moment) -> list[Drawn]:
        """Surfaces of a moment: those of its hands, then of its bodies."""
        if self._last_surfaces is None or self._last_surfaces[0] is not moment:
            self._last_surfaces = moment, self._surfaces_at(moment, 0.0)
        return self._last_surfaces[1]

    def _surfaces_at(self, moment: Moment, shift: float) -> list[Drawn]:
        """Surfaces of the hands and bodies that the frame has, at their poses `shift` seconds later."""
        drawn, poses = list[Drawn](), moment.hands(shift)
        several = poses if len(poses) > 1 else {}
        flesh = {index: self._hands[index].skin.flesh(pose) for index, pose in several.items()}
        for number, (index, pose) in enumerate(poses.items()):
            upper_arm = None if moment.upper_arms is None else moment.upper_arms[index]
            forearm = None if moment.forearms is None else moment.forearms[index]
            others = [one for other, one in flesh.items() if other != index]
            drawn += self._hands[index].drawn(pose, number, upper_arm, forearm, others)
        for number, (index, T_world_body) in enumerate(moment.bodies(shift).items(), 1 + len(poses)):
            drawn += self._bodies[index].drawn(T_world_body, number)
        return drawn + self._person

    def _hand_truths(
        self, moment: Moment, camera: Camera, pictures: Geometry, recorded: bool
    ) -> tuple[HandTruth, ...]:
        """Ground truth of the hands that the frame has."""
        take, frame, config = moment.take, moment.frame, self._config
        return tuple(
            hand_truth(
                self._hands[index], take.qpos[frame, index], number, camera, pictures,
                _tracking(take, frame, index), recorded=recorded, openxr=config.openxr, mano=config.mano,
            )
            for number, index in enumerate(moment.hands())
        )  # fmt: skip

    def _light_of(
        self, rgb: Bytes, camera: Camera, drawn: Sequence[Drawn], conditions: Conditions
    ) -> NDArray[np.float16]:
        """Linear light of a color picture, with highlights beyond white."""
        # `rgb` clips each part of a pixel at white before it mixes them; the light must agree.
        most = np.where(rgb < 255, rgb + 1.0, np.inf)
        levels = np.clip(self._paint(camera, drawn, conditions, bright=True), rgb - 1.0, most)
        return light_of(levels).astype(np.float16)

    def _noisy_depth(
        self,
        truth: Geometry,
        rgb: Bytes | None,
        num_hands: int,
        camera: Camera,
        sensor: DepthNoise,
        rng: np.random.Generator,
    ) -> Floats:
        """Simulate the depth that a sensor measures."""
        assert truth.normals is not None
        light = None
        if isinstance(sensor, TimeOfFlight):
            light = np.ones(truth.depth.shape, np.float32) if rgb is None else reflectance_of(rgb)
            if self.skin is not None:
                light[(truth.instances > 0) & (truth.instances <= num_hands)] = self.skin.infrared
        return apply_depth_noise(
            truth.depth, truth.normals, sensor, camera=camera, reflectance=light, rng=rng
        )

    def _paint(
        self, camera: Camera, drawn: Sequence[Drawn], conditions: Conditions, *, bright: bool = False
    ) -> NDArray[Any]:
        """Paint the perfect color picture as bytes or, if `bright`, as levels that may exceed 255."""
        background = conditions.background
        lighting, painter = conditions.lighting, "bright" if bright else self._painter
        whole = paint(camera, drawn, lighting, painter)
        plain, light = picture_behind(camera, conditions, bright=bright), None
        shadows = background.backdrop.shadows and conditions.enclosure is None
        if shadows and camera.lens.kind == "pinhole":
            light = light_behind(camera, drawn, conditions.lighting, background.backdrop)
        if light is not None:
            shade = cv2.cvtColor(cv2.pow(light, 1.0 / GAMMA), cv2.COLOR_GRAY2RGB)
            plain = np.asarray(cv2.multiply(plain, shade, dst=shade))
        if self._person and painter != "opengl":
            plain = put_before(paint_blurred(camera, drawn, lighting, painter), plain)
        return put_before(whole, plain)

    def _sensor_picture(
        self, moment: Moment, camera: Camera, rgb: Bytes, conditions: Conditions, rng: np.random.Generator
    ) -> Bytes | None:
        """Simulate the color picture of shutter and sensor; None if both are perfect."""
        if conditions.exposure is None and conditions.shutter is None:
            return None
        if conditions.shutter is None:
            light = linear_of(rgb)
        else:
            one = conditions.shutter
            times, weights = shutter_times(one.exposure, one.readout, one.sub_frames, camera.size[1])
            moments = (self._paint(camera, self._surfaces_at(moment, time), conditions) for time in times)
            light = combine(moments, weights)
        return expose(light, conditions.exposure or Exposure(), rng=rng)

    def _requested_pictures(self, truth: Geometry, rgb: Bytes | None, light: NDArray[Any] | None) -> Pictures:
        """The pictures of the requested passes."""
        kinds = {"depth": ("depth",), "normals": ("normals",), "ids": ("parts", "instances", "markers")}
        names = [name for kind in kinds if kind in self._passes for name in kinds[kind]]
        return Pictures(rgb, light, **{name: getattr(truth, name) for name in names})

    def _record(self, conditions: Conditions) -> dict[str, Any]:
        if self._footage is not None:
            return self._footage.record
        return {"people": self._people, "body_colors": self._colors, **conditions.record()}


def picture_behind(camera: Camera, conditions: Conditions, *, bright: bool = False) -> NDArray[Any]:
    """Levels (H, W, 3) of sRGB behind hands and objects, from 0 to 255, without their shadows."""
    if conditions.enclosure is not None:
        return draw_surroundings(conditions.background, conditions.enclosure, camera, bright=bright).rgb
    return _background_levels(conditions.background, camera.size)


def _clearance(camera: Camera, drawn: Sequence[Drawn]) -> float:
    """Distance of a camera from the nearest vertex [m]."""
    x, y, z = camera.T_world_camera[:3, 3].tolist()
    return min((_distance(one.triangles.vertices, x, y, z) for one in drawn), default=np.inf)


@kernel
def _distance(vertices: NDArray[Any], x: float, y: float, z: float) -> float:
    """Distance [m] from a position to the nearest of some vertices (V, 3)."""
    least = np.inf
    for vertex in range(len(vertices)):
        dx, dy, dz = vertices[vertex, 0] - x, vertices[vertex, 1] - y, vertices[vertex, 2] - z
        least = min(least, dx * dx + dy * dy + dz * dz)
    return float(np.sqrt(least))


def _body_truths(take: Take, frame: int) -> tuple[BodyTruth, ...]:
    """Ground truth of the rigid bodies that the frame has."""
    poses = zip(take.bodies, pose_matrices(take.body_poses[frame]), strict=True)
    return tuple(BodyTruth(body.name, pose) for body, pose in poses if np.isfinite(pose).all())


def _tracking(take: Take, frame: int, number: int) -> dict[str, Any] | None:
    """Status and uncertainty of a tracked pose; None for true poses and a user's own."""
    spreads = {"angle_spread": take.angle_spread, "keypoint_spread": take.keypoint_spread}
    known = {name: spread[frame, number] for name, spread in spreads.items() if spread is not None}
    if not known and np.isnan(take.rms[:, number]).all():
        return None
    return {"status": STATUSES[take.status[frame, number]], "rms": float(take.rms[frame, number]), **known}


def _surroundings_of(camera: Camera, drawn: Sequence[Drawn], conditions: Conditions) -> Surroundings:
    """Picture, depth and normals of what is behind the hands and bodies."""
    background = conditions.background
    if conditions.enclosure is not None:
        return draw_surroundings(background, conditions.enclosure, camera, bright=False)
    return surroundings_of_picture(background, camera, level_behind(background.backdrop, camera, drawn))


@functools.lru_cache(maxsize=2)
def _background_levels(background: Background, size: tuple[int, int]) -> Floats:
    """A background (H, W, 3) in sRGB, from 0 to 255."""
    display = cv2.pow(kept_background(background, size), 1.0 / GAMMA)
    return enlarged(np.multiply(display, np.float32(255.0), out=display), size)
