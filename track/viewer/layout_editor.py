"""A marker layout on the flat hand: markers are dragged over the skin, and the layout is saved."""

from __future__ import annotations

import itertools
import math
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gloves.fit import GloveFit, attach, place_marker
from gloves.layout import MarkerLayout, moved_text
from handsim.errors import LayoutError
from handsim.files.inputs import read_bytes
from handsim.files.outputs import atomic_write
from handsim.hand.model import HandModel
from handsim.hand.shape import NUM_QPOS
from track.viewer.hand_skin import HandSkin
from track.viewer.point_balls import PointBalls
from track.viewer.stage import set_stage

if TYPE_CHECKING:
    from viser import SceneNodePointerEvent, ViserServer

_HEIGHT: Final = 0.06  # of the wrist above the ground [m]
_GIZMO: Final = 0.03  # [m]


class LayoutEditor:
    """The markers of a layout on one hand.

    Args:
        layout: What it says.
        out: Where the changed layout is saved.
    """

    def __init__(
        self, server: ViserServer, path: Path, layout: MarkerLayout, model: HandModel, out: Path
    ) -> None:
        self._server, self._path, self._out, self._lock = server, path, out, threading.Lock()
        self.shift = np.array([0.0, 0.0, _HEIGHT])
        """Where the wrist is in the page [m]."""
        self.fit: GloveFit = attach(layout, model)
        """The hand in its glove as it is now."""
        self.changed = False
        """Whether a marker was moved since the layout was read or saved."""
        self._chosen: int | None = None
        qpos = np.zeros(NUM_QPOS)
        qpos[2], qpos[3] = _HEIGHT, 1.0
        self.skin = HandSkin(server, "/hand")
        self.skin.show(model, qpos)
        count = layout.num_markers
        self.balls = PointBalls(server, "/markers", layout.names, most=count, radius=layout.radius)
        self.gizmo = server.scene.add_transform_controls(
            "/move", scale=_GIZMO, disable_rotations=True, depth_test=False, visible=False, line_width=3.0
        )
        """The handle of the chosen marker."""
        self._add_controls(layout)
        self.balls.balls.on_click(self._click)
        self.gizmo.on_update(self._drag)
        self._show()
        set_stage(server, self.skin_points(), ground=0.0)

    def skin_points(self) -> np.ndarray:
        """The vertices of the skin in the page [m]."""
        points: np.ndarray = self.fit.model.surface.vertices + self.shift
        return points

    def choose(self, index: int) -> None:
        """Choose the marker that the gizmo moves."""
        with self._lock:
            self._chosen = index
            self.gizmo.position = self.fit.attachment.points[index] + self.shift
            self.gizmo.visible = True
            self.names.value = self.fit.layout.names[index]  # type: ignore[misc]  # viser sets it itself
            self._tell()

    def move(self, index: int, point: np.ndarray) -> None:
        """Move a marker to the skin near a point of the page [m]; where there is none it stays."""
        with self._lock:
            try:
                layout = place_marker(self.fit.layout, index, self.fit.model, point - self.shift)
            except LayoutError as error:
                self.state.content = str(error)
                return
            self.fit = attach(layout, self.fit.model)
            self.changed = True
            self._show()
            self._tell()

    def save(self) -> str:
        """Write the layout, and say so.

        Raises:
            LayoutError: A file cannot be read or written.
        """
        with self._lock:
            given = read_bytes(self._path, error=LayoutError).decode("utf-8", "replace")
            text, kept = moved_text(given, self.fit.layout)
            try:
                with atomic_write(self._out) as temporary:
                    temporary.write_text(text, "utf-8")
            except OSError as error:
                raise LayoutError(f"{self._out}: cannot be written: {error.strerror or error}") from error
        self.changed = False
        return f"saved {self._out}" if kept else f"saved {self._out}, without the comments of {self._path}"

    def _add_controls(self, layout: MarkerLayout) -> None:
        gui = self._server.gui
        self.state = gui.add_markdown(f"**{layout.name}**: click a marker, then drag its arrows.")
        """What is chosen, or what was done."""
        self.names = gui.add_dropdown("marker", layout.names)
        self.names.on_update(self._pick)
        every = gui.add_checkbox("names", False)
        labels = frozenset(range(layout.num_markers))
        every.on_update(lambda _: self.balls.name(labels if every.value else frozenset()))
        button = gui.add_button("Save layout", hint=f"Writes {self._out}")
        button.on_click(lambda _: self._save())

    def _save(self) -> None:
        try:
            self.state.content = self.save()
        except LayoutError as error:
            self.state.content = str(error)

    def _pick(self, event: Any) -> None:
        if event.client is not None:
            self.choose(self.fit.layout.names.index(self.names.value))

    def _click(self, event: SceneNodePointerEvent[Any]) -> None:
        index = self.balls.nearest(np.array(event.ray_origin), np.array(event.ray_direction))
        if index is not None:
            self.choose(index)

    def _drag(self, event: Any) -> None:
        chosen = self._chosen
        if chosen is None or (event.phase != "end" and self._lock.locked()):
            return  # a step of the drag that comes too early; the last one counts
        self.move(chosen, np.array(self.gizmo.position))
        if event.phase == "end":
            self.choose(chosen)  # the gizmo goes where the marker is

    def _show(self) -> None:
        count = self.fit.layout.num_markers
        points = self.fit.attachment.points + self.shift
        self.balls.show(points, np.arange(count), np.ones(count, dtype=np.bool_))

    def _tell(self) -> None:
        if self._chosen is None:
            return
        marker = self.fit.layout.markers[self._chosen]
        across = f", across {marker.across:.3f}" if marker.across else ""
        self.state.content = (
            f"**{marker.name}** on {marker.bone}: along {marker.along:.3f}, "
            f"around {math.degrees(marker.around):.1f}°{across}"
        )


def edited_path(path: Path) -> Path:
    """A name beside a file that no file has yet: `glove-edited.toml`, `glove-edited-2.toml`, ..."""
    endings = itertools.chain([""], (f"-{number}" for number in itertools.count(2)))
    candidates = (path.with_name(f"{path.stem}-edited{ending}{path.suffix}") for ending in endings)
    return next(candidate for candidate in candidates if not candidate.exists())
