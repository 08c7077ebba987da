"""Frames in the page: skins, points, bodies and rays, of which only what changed is sent."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from track.viewer.hand_skin import HandSkin
from track.viewer.point_balls import PointBalls
from track.viewer.recordings import Recording, ShownBody, ShownFrame
from track.viewer.stage import show_rig

if TYPE_CHECKING:
    from viser import (
        BatchedMeshHandle,
        FrameHandle,
        LineSegmentsHandle,
        MeshHandle,
        SceneNodePointerEvent,
        ViserServer,
    )

_BODY_COLOR: Final = (120, 124, 132)
_RAY_COLOR: Final = (235, 170, 60)


class FrameView:
    """The scene of a recording, with switches of what is shown."""

    def __init__(self, server: ViserServer, recording: Recording) -> None:
        self._server, self._recording = server, recording
        self._cameras_node = server.scene.add_frame("/cameras", show_axes=False)
        self._hands_node = server.scene.add_frame("/hands", show_axes=False)
        self.skins: list[HandSkin] = []
        """The skins of the hands, in their order."""
        self.balls = PointBalls(
            server,
            "/points",
            recording.label_names,
            most=recording.most_points,
            radius=recording.radius,
        )
        """The points."""
        self.bodies = [_add_body(server, body) for body in recording.bodies]
        """The rigid bodies, in their order."""
        self._rays: LineSegmentsHandle | None = None
        self._clicked: frozenset[int] = frozenset()
        self._kept = np.empty(0, dtype=np.int64)  # indices of the shown points among the frame's
        self.on_pick: Callable[[int], None] = lambda index: None
        """Called with the index of a point of the frame that was clicked."""
        self._frame: ShownFrame | None = None
        self._lock = threading.RLock()  # switches are pressed in threads of viser's pool
        self._add_switches()
        if recording.rig is not None:
            show_rig(server, recording.rig)
        self.balls.balls.on_click(self._click)

    def show(self, frame: ShownFrame) -> None:
        """Show a frame; all of it appears at once."""
        with self._lock, self._server.atomic():
            while len(self.skins) < len(frame.hands):
                self.skins.append(HandSkin(self._server, f"/hands/{len(self.skins)}"))
            for skin, model, qpos in zip(self.skins, frame.hands, frame.qpos, strict=True):
                skin.show(model, qpos)
            for body, pose in zip(self.bodies, frame.bodies, strict=True):
                there = bool(np.isfinite(pose).all())
                if there:
                    body.position, body.wxyz = pose[:3], pose[3:]
                if body.visible != there:
                    body.visible = there
            self._frame = frame
            self._update_points()
            self._update_rays()

    def _add_switches(self) -> None:
        with self._server.gui.add_folder("Show"):
            self._names = self._server.gui.add_checkbox("names", False, hint="A click on a point names it.")
            self._ghosts = self._server.gui.add_checkbox("unlabeled points", True)
            self._filled = self._server.gui.add_checkbox(
                "filled-in markers", True, visible=self._recording.has_filled
            )
            self._hands = self._server.gui.add_checkbox("skin", True, visible=self._recording.has_hands)
            cameras = self._server.gui.add_checkbox("cameras", True, visible=self._recording.rig is not None)
            center = self._server.gui.add_button("Look at the hands", color="gray", hint="C")
            rays = self._recording.frame(0).rays if self._recording.num_frames else np.empty((0, 2, 3))
            self._sight = self._server.gui.add_checkbox("lines of sight", False, visible=len(rays) > 0)
        for switch in (self._names, self._ghosts, self._filled, self._sight):
            switch.on_update(lambda _: self._refresh())
        center.on_click(self._look)
        self._server.gui.add_command("Center the hands", hotkey="C").on_trigger(self._look)
        cameras.on_update(lambda _: setattr(self._cameras_node, "visible", cameras.value))
        self._hands.on_update(lambda _: setattr(self._hands_node, "visible", self._hands.value))

    def _look(self, event: Any) -> None:
        """Move the eye of the page that asks, so that the hands are in the middle; it keeps its direction."""
        frame, client = self._frame, event.client
        if frame is None or client is None:
            return
        points = np.concatenate([frame.qpos[:, :3], frame.points[frame.labels >= 0]])
        points = points[np.isfinite(points).all(axis=1)]
        points = points if len(points) else frame.points
        if len(points):
            camera = client.camera
            camera.position = camera.position + points.mean(axis=0) - camera.look_at

    def _refresh(self) -> None:
        with self._lock, self._server.atomic():
            self._update_points()
            self._update_rays()

    def _update_points(self) -> None:
        if self._frame is None:
            return
        frame = self._frame
        kept = (self._ghosts.value | (frame.labels >= 0)) & (self._filled.value | frame.seen)
        self._kept = np.flatnonzero(kept)
        self.balls.show(frame.points[kept], frame.labels[kept], frame.seen[kept])
        every = frozenset(range(len(self._recording.label_names)))
        self.balls.name(every if self._names.value else self._clicked)

    def _update_rays(self) -> None:
        rays = self._frame.rays if self._frame is not None and self._sight.value else np.empty((0, 2, 3))
        if self._rays is not None:
            if np.array_equal(self._rays.points, rays.astype(np.float32)):
                return
            self._rays.remove()
            self._rays = None
        if len(rays):
            self._rays = self._server.scene.add_line_segments(
                "/rays", points=rays, colors=_RAY_COLOR, thickness=1.0, thickness_units="screen"
            )

    def _click(self, event: SceneNodePointerEvent[BatchedMeshHandle]) -> None:
        """Name the clicked marker, or leave it without a name again."""
        index = self.balls.nearest(np.array(event.ray_origin), np.array(event.ray_direction))
        if index is None:
            return
        if (label := self.balls.label_at(index)) >= 0:
            self._clicked ^= {label}
            self._refresh()
        self.on_pick(int(self._kept[index]))


def _add_body(server: ViserServer, body: ShownBody) -> MeshHandle | FrameHandle:
    name = f"/bodies/{body.name.replace('/', '_')}"
    if body.vertices is None or body.faces is None:
        return server.scene.add_frame(name, axes_length=0.05, axes_radius=0.002)
    return server.scene.add_mesh_simple(name, body.vertices, body.faces, color=_BODY_COLOR, opacity=0.6)
