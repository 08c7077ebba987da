"""The scene in the page: light, ground, first look, cameras, skins, points and bodies."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int

from handsim.arrays import Doubles, Integers
from handsim.hand.model import HandModel
from handsim.hand.shape import NUM_QPOS
from handsim.hand.skin import all_weights
from handsim.space.rig import ROOM_CENTER, CameraRig
from handsim.space.transforms import UpAxis, room_axes, rotation_quaternions
from track.viewer.recordings import Recording, ShownFrame, label_colors

if TYPE_CHECKING:
    from viser import (
        BatchedMeshHandle,
        FrameHandle,
        LabelHandle,
        MeshHandle,
        MeshSkinnedHandle,
        SceneNodeHandle,
        SceneNodePointerEvent,
        ViserServer,
    )

    from handsim.hand.shape import Side

_FIRST_DIRECTION: Final = np.array([0.62, -0.62, 0.48])  # from the target of the first look to the eye
_LEAST_DISTANCE: Final = 0.22  # [m] least distance between the eye and its target
_HALF_CUBE: Final = 0.3  # [m] half side of the cube in which wrists move in training sets
_GRID_SPACING: Final = 0.2  # [m] spacing of the points at which the page counts the cameras that see them
_MOST_POINTS: Final = 40_000  # largest number of grid points
_FRUSTUM_SIZE: Final = 0.12  # [m] size of a camera's frustum
_FEW_CAMERAS_COLOR, _ALL_CAMERAS_COLOR = np.array([214, 96, 60]), np.array([40, 120, 180])
_SKIN_COLORS: Final[dict[Side, tuple[int, int, int]]] = {"right": (214, 170, 140), "left": (150, 172, 200)}
_UNSEEN_SCALE: Final = 0.45  # relative size of an unseen marker
_BODY_COLOR: Final = (120, 124, 132)
_RAY_COLOR: Final = (235, 170, 60)


def set_stage(
    server: ViserServer, points: Float[np.ndarray, "N 3"], *, ground: float | None = None, up: UpAxis = "z"
) -> None:
    """Set light, ground and a first look at points [m]; the ground is at a height or below the points."""
    turn = room_axes(up).T  # from the axes of the stage to those of the points
    there = points[np.isfinite(points).all(axis=1)] @ turn
    low, high = np.percentile(there, [2, 98], axis=0) if len(there) else np.tile([[-0.1], [0.1]], 3)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    height = float(low[2]) - 0.02 - 0.1 * size if ground is None else ground
    cell = 0.01 if size < 0.5 else 0.1
    scene = server.scene
    scene.set_up_direction(turn[:, 2])
    # Soft light preserves the colors of labels.
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map("studio", environment_intensity=0.12)
    sky, floor = (255, 255, 255), (150, 140, 130)
    scene.add_light_hemisphere("/light/sky", sky_color=sky, ground_color=floor, intensity=0.55)
    for name, intensity, place in (("key", 1.3, (1.5, -1.0, 2.5)), ("fill", 0.3, (-2.0, 1.5, 1.0))):
        x, y, z = (turn @ place).tolist()
        scene.add_light_directional(f"/light/{name}", intensity=intensity, position=(x, y, z))
    scene.add_grid(
        "/ground",
        width=200 * cell,
        height=200 * cell,
        cell_size=cell,
        section_size=10 * cell,
        cell_color=(180, 180, 180),  # visible on white and on black
        section_color=(140, 140, 140),
        cell_thickness=0.6,
        section_thickness=1.0,
        fade_distance=30.0,
        plane_opacity=0.0,
        position=turn @ (round(float(middle[0]), 1), round(float(middle[1]), 1), height),
        wxyz=rotation_quaternions(turn[None])[0],
    )
    away = max(size, _LEAST_DISTANCE)
    camera = server.initial_camera
    camera.position = turn @ (middle + away * _FIRST_DIRECTION / np.linalg.norm(_FIRST_DIRECTION))
    camera.look_at, camera.up = turn @ middle, turn[:, 2]
    camera.near, camera.far = 0.005, 100.0


def show_rig(server: ViserServer, rig: CameraRig) -> None:
    """Show cameras as frusta with their numbers."""
    quaternions = rotation_quaternions(rig.T_world_camera[:, :3, :3])
    for number, (camera, quaternion) in enumerate(zip(rig.cameras, quaternions, strict=True), 1):
        width, height = camera.angles
        server.scene.add_camera_frustum(
            f"/cameras/{number}",
            fov=height,
            aspect=float(np.tan(width / 2) / np.tan(height / 2)),
            scale=_FRUSTUM_SIZE,
            thickness=0.004,
            color=(60, 66, 76),
            position=camera.T_world_camera[:3, 3],
            wxyz=quaternion,
        )
        server.scene.add_label(
            f"/cameras/{number}/number", str(number), font_screen_scale=0.8, anchor="bottom-center"
        )


def show_volume(server: ViserServer, rig: CameraRig) -> None:
    """Show the cube in which wrists move, and dots colored by the number of cameras that see them."""
    side = 2 * _HALF_CUBE
    server.scene.add_box("/volume", (40, 120, 60), (side, side, side), wireframe=True, position=ROOM_CENTER)
    places, counts = camera_counts(rig)
    share = (counts / len(rig.positions))[:, None]
    colors = np.round((1.0 - share) * _FEW_CAMERAS_COLOR + share * _ALL_CAMERAS_COLOR).astype(np.uint8)
    server.scene.add_point_cloud("/coverage", places, colors, point_size=0.012, point_shape="circle")


def camera_counts(rig: CameraRig) -> tuple[Doubles, Integers]:
    """Grid points (N, 3) [m] seen by at least two cameras, and their numbers of cameras (N,)."""
    low, high = rig.positions.min(axis=0), rig.positions.max(axis=0)
    low[2] = min(0.0, low[2])
    spacing = max(_GRID_SPACING, float((np.prod(high - low + _GRID_SPACING) / _MOST_POINTS) ** (1 / 3)))
    axes = [np.arange(low[axis], high[axis] + spacing / 2, spacing) for axis in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    counts = rig.in_view(grid).sum(axis=1)
    return grid[counts >= 2], counts[counts >= 2]


def switch(server: ViserServer, words: str, node: SceneNodeHandle, *, visible: bool = True) -> None:
    """Add a checkbox to the panel that shows and hides a node of the scene."""
    box = server.gui.add_checkbox(words, node.visible, visible=visible)
    box.on_update(lambda _: setattr(node, "visible", box.value))


class HandSkin:
    """The skin of one hand, by default in the color of its side.

    The mesh moves with the wrist, and bones move within it: moving a whole hand takes two small messages.
    """

    def __init__(
        self,
        server: ViserServer,
        name: str,
        *,
        color: tuple[int, int, int] | None = None,
        opacity: float | None = None,
    ) -> None:
        self._server, self._name, self._color, self._opacity = server, name, color, opacity
        self._model: HandModel | None = None
        self.mesh: MeshSkinnedHandle | None = None
        """The mesh in the page, once there is a hand."""

    def show(self, model: HandModel, qpos: Float[np.ndarray, "27"]) -> None:
        """Show a hand in a pose [m, rad]; hide it if the pose is NaN."""
        there = bool(np.isfinite(qpos).all())
        if there:
            if self.mesh is None or model is not self._model:
                self.mesh, self._model = self._send(model), model
            local = np.zeros((1, NUM_QPOS))
            local[0, 3], local[0, 7:] = 1.0, qpos[7:]
            positions, quaternions = _split_poses(model.forward_kinematics(local)[0])
            for bone, position, quaternion in zip(self.mesh.bones, positions, quaternions, strict=True):
                bone.position, bone.wxyz = position, quaternion
            self.mesh.position, self.mesh.wxyz = qpos[:3], qpos[3:7] / np.linalg.norm(qpos[3:7])
        if self.mesh is not None:
            self.mesh.visible = there

    def _send(self, model: HandModel) -> MeshSkinnedHandle:
        surface = model.surface
        positions, quaternions = _split_poses(model.rest_transforms)
        return self._server.scene.add_mesh_skinned(
            self._name,
            surface.vertices,
            surface.faces,
            bone_wxyzs=quaternions,
            bone_positions=positions,
            skin_weights=all_weights(surface.bone_indices, surface.bone_weights),
            color=self._color or _SKIN_COLORS[model.shape.side],
            opacity=self._opacity,
        )


def _split_poses(transforms: Float[np.ndarray, "L 4 4"]) -> tuple[Doubles, Doubles]:
    """Positions (L, 3) and quaternions (L, 4), wxyz."""
    return transforms[:, :3, 3], rotation_quaternions(transforms[:, :3, :3])


class PointBalls:
    """Up to `most` balls with a radius [m], updated in one message per frame."""

    def __init__(
        self, server: ViserServer, name: str, label_names: tuple[str, ...], *, most: int, radius: float
    ) -> None:
        self._server, self._name, self._names = server, name, label_names
        self._palette = label_colors(label_names)  # Label -1 selects the last row.
        self._texts: dict[int, LabelHandle] = {}
        self._chosen: frozenset[int] = frozenset()
        ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
        self._most = max(most, 1)
        self._points, self._labels = np.empty((0, 3)), np.empty(0, dtype=np.int64)
        self.balls = server.scene.add_batched_meshes_simple(
            name,
            np.asarray(ball.vertices),
            np.asarray(ball.faces),
            batched_wxyzs=np.tile(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (self._most, 1)),
            batched_positions=np.zeros((self._most, 3), dtype=np.float32),
            batched_scales=np.zeros(self._most, dtype=np.float32),
            batched_colors=np.zeros((self._most, 3), dtype=np.uint8),
            lod="off",
            cast_shadow=False,
        )
        """All balls; unused ones have size 0."""

    def show(
        self, points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"], seen: Bool[np.ndarray, "N"]
    ) -> None:
        """Show points [m]; unseen ones are small."""
        count = min(len(points), self._most)
        self._points, self._labels = points[:count], labels[:count]
        positions, colors = self.balls.batched_positions.copy(), self.balls.batched_colors.copy()
        scales = np.zeros(self._most, dtype=np.float32)
        positions[:count] = self._points
        scales[:count] = np.where(seen[:count], 1.0, _UNSEEN_SCALE)
        colors[:count] = self._palette[self._labels]
        self.balls.batched_positions, self.balls.batched_scales = positions, scales
        self.balls.batched_colors = colors
        self._show_names()

    def name(self, labels: frozenset[int]) -> None:
        """Show the names of these labels beside their points, and hide all others."""
        self._chosen = labels
        self._show_names()

    def nearest(self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> int | None:
        """The index of the shown point nearest to a ray; None without points."""
        if not len(self._points):
            return None
        unit = direction / np.linalg.norm(direction)
        offsets = self._points - origin
        away = np.linalg.norm(offsets - (offsets @ unit)[:, None] * unit, axis=1)
        return int(away.argmin())

    def _show_names(self) -> None:
        places = {int(label): point for label, point in zip(self._labels, self._points, strict=True)}
        for label in self._chosen & places.keys():
            if label not in self._texts:
                self._texts[label] = self._server.scene.add_label(
                    f"{self._name}/names/{label}",
                    self._names[label].rsplit(":", 1)[-1],
                    font_screen_scale=0.7,
                    anchor="bottom-left",
                )
            self._texts[label].position = places[label]
        for label, text in self._texts.items():
            text.visible = label in self._chosen and label in places


class FrameView:
    """Scene of a recording, with switches for its parts."""

    def __init__(self, server: ViserServer, recording: Recording) -> None:
        self._server, self._recording = server, recording
        self.skins: list[HandSkin] = []
        self.balls = PointBalls(
            server, "/points", recording.label_names, most=recording.most_points, radius=recording.radius
        )
        self.bodies: list[MeshHandle | FrameHandle] = []
        for body in recording.bodies:
            name, thing = f"/bodies/{body.name.replace('/', '_')}", body.shape
            if thing is None:
                self.bodies.append(server.scene.add_frame(name, axes_length=0.05, axes_radius=0.002))
            else:
                surface = thing.vertices, thing.faces
                mesh = server.scene.add_mesh_simple(name, *surface, color=_BODY_COLOR, opacity=0.6)
                self.bodies.append(mesh)
        self._clicked: frozenset[int] = frozenset()
        self._kept = np.empty(0, dtype=np.int64)  # indices of the shown points in the frame
        self.on_pick: Callable[[int], None] = lambda index: None
        """Called with the index of a clicked point of the frame."""
        self._frame: ShownFrame | None = None
        self._lock = threading.RLock()  # viser runs switches in other threads
        self._add_switches(recording)
        if recording.rig is not None:
            show_rig(server, recording.rig)
        self.balls.balls.on_click(self._click)

    def show(self, frame: ShownFrame) -> None:
        """Show a frame, in one message."""
        with self._lock, self._server.atomic():
            while len(self.skins) < len(frame.hands):
                self.skins.append(HandSkin(self._server, f"/hands/{len(self.skins)}"))
            for skin, model, qpos in zip(self.skins, frame.hands, frame.qpos, strict=True):
                skin.show(model, qpos)
            for body, pose in zip(self.bodies, frame.bodies, strict=True):
                body.visible = bool(np.isfinite(pose).all())
                if body.visible:
                    body.position, body.wxyz = pose[:3], pose[3:]
            self._frame = frame
            self._rays.points = frame.rays
            self._show_points()

    def _add_switches(self, recording: Recording) -> None:
        server, first = self._server, recording.frame(0) if recording.num_frames else ShownFrame(0.0)
        self._rays = server.scene.add_line_segments(
            "/rays", first.rays, _RAY_COLOR, thickness=1.0, thickness_units="screen", visible=False
        )
        with server.gui.add_folder("Show"):
            self._names = server.gui.add_checkbox("names", False, hint="A click on a point names it.")
            self._ghosts = server.gui.add_checkbox("unlabeled points", True)
            self._filled = server.gui.add_checkbox("filled-in markers", True, visible=recording.has_filled)
            hands, cameras = (
                server.scene.add_frame(name, show_axes=False) for name in ("/hands", "/cameras")
            )
            switch(server, "skin", hands, visible=recording.has_hands)
            switch(server, "cameras", cameras, visible=recording.rig is not None)
            center = server.gui.add_button("Look at the hands", color="gray", hint="C")
            switch(server, "lines of sight", self._rays, visible=len(first.rays) > 0)
        for box in (self._names, self._ghosts, self._filled):
            box.on_update(lambda _: self._show_points())
        center.on_click(self._look)
        server.gui.add_command("Center the hands", hotkey="C").on_trigger(self._look)

    def _look(self, event: Any) -> None:
        """Move the eye of the requesting page, without turning it, so that the hands are in the center."""
        frame, client = self._frame, event.client
        if frame is None or client is None:
            return
        points = np.concatenate([frame.qpos[:, :3], frame.points[frame.labels >= 0]])
        points = points[np.isfinite(points).all(axis=1)]
        points = points if len(points) else frame.points
        if len(points):
            camera = client.camera
            camera.position = camera.position + points.mean(axis=0) - camera.look_at

    def _show_points(self) -> None:
        """Show the points of the frame and the requested names, in one message."""
        # Switches run in their own threads, so the last one to draw must read all of them.
        with self._lock:
            frame = self._frame
            if frame is None:
                return
            kept = (self._ghosts.value | (frame.labels >= 0)) & (self._filled.value | frame.seen)
            every = frozenset(range(len(self._recording.label_names)))
            self._kept = np.flatnonzero(kept)
            with self._server.atomic():
                self.balls.show(frame.points[kept], frame.labels[kept], frame.seen[kept])
                self.balls.name(every if self._names.value else self._clicked)

    def _click(self, event: SceneNodePointerEvent[BatchedMeshHandle]) -> None:
        """Show or hide the name of the clicked marker."""
        index = self.balls.nearest(np.array(event.ray_origin), np.array(event.ray_direction))
        if index is None or self._frame is None:
            return
        if (label := int(self._frame.labels[self._kept[index]])) >= 0:
            self._clicked ^= {label}
            self._show_points()
        self.on_pick(int(self._kept[index]))
