"""Editors in the page: a person corrects labels of a take, or moves markers of a layout, and saves."""

from __future__ import annotations

import dataclasses
import itertools
import math
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gloves.fit import GloveFit, attach, place_marker
from gloves.layout import MarkerLayout, moved_text
from gloves.takes.corrections import (
    NO_MARKER,
    Correction,
    applied_corrections,
    corrections_of,
    corrections_path,
    follow_point,
    save_corrections,
)
from gloves.takes.take import Take
from handsim.errors import CaptureError, LayoutError, errors_of
from handsim.files.inputs import read_bytes
from handsim.files.outputs import write_text, writing
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import NUM_JOINTS
from track.takes.corrected_take import BAD_RMS, correct_take
from track.viewer.recordings import TakeRecording
from track.viewer.stage import HandSkin, PointBalls, set_stage

if TYPE_CHECKING:
    from viser import SceneNodePointerEvent, ViserServer

_NO_POINT: Final = "choose"
_HALO: Final = 2.5  # radius of the halo around the chosen point, in radii of a marker
_HALO_COLOR: Final = (255, 190, 0)
_MOST_LISTED: Final = 12  # largest number of corrections in the list
HEIGHT: Final = 0.06  # [m] height of the wrist above the ground
_GIZMO: Final = 0.03  # size of the handle that moves a marker [m]


class Corrector:
    """A take that is open for corrections, with those of the file beside it."""

    def __init__(self, path: Path, take: Take) -> None:
        self.path, self._base, self._lock = path, take, threading.Lock()
        self.take = take
        """The take with all corrections."""
        self.saved: tuple[Correction, ...] = corrections_of(path)
        self.added: tuple[Correction, ...] = ()
        """Corrections that are not saved yet."""
        self.unfitting: tuple[Correction, ...] = ()
        """Saved corrections that match no point."""
        self._state = _file_state(path)
        records = applied_corrections(take)
        if any(correction.record() not in records for correction in self.saved):
            with errors_of(corrections_path(path), CaptureError):
                self._make(())

    @property
    def is_busy(self) -> bool:
        """Whether labels are being corrected."""
        return self._lock.locked()

    def span_of(self, frame: int, column: int) -> tuple[int, int]:
        """First and last frame around a frame in which its point keeps ID and label without a gap."""
        take, points = self.take, self.take.point_list
        point = points.at(frame, column)
        if points.ids[point] < 0:
            return frame, frame
        same = (points.ids == points.ids[point]) & (points.labels == points.labels[point])
        ends = np.setdiff1d(np.arange(take.num_frames), points.frames[same])
        position = np.searchsorted(ends, frame)
        first = int(ends[position - 1]) + 1 if position else 0
        last = int(ends[position]) - 1 if position < len(ends) else take.num_frames - 1
        return first, last

    def add(self, frame: int, column: int, span: tuple[int, int], label: str) -> Correction:
        """Correct a point's label, to a marker's name or `NO_MARKER`, in the frames of a span."""
        with self._lock:
            points, (first, last) = self.take.point_list, sorted(span)
            point, start = points.at(frame, column), frame
            if points.ids[point] >= 0:
                within = (points.frames >= first) & (points.frames <= last)
                same = np.flatnonzero((points.ids == points.ids[point]) & within)
                if not len(same):
                    where = f"frames {first} to {last}"
                    raise CaptureError(f"the point is not there in {where}, expected a frame with it")
                point = int(same[0])
                start, last = points.frames[same[[0, -1]]].tolist()
            x, y, z = points.points[point].tolist()
            correction = Correction(start, max(start, last), (x, y, z), label)
            followed = points.frames[follow_point(points, correction)]
            correction = dataclasses.replace(correction, last=int(followed[-1]))
            self._make((*self.added, correction))
        return correction

    def undo(self) -> None:
        """Remove the last unsaved correction."""
        with self._lock:
            if self.added:
                self._make(self.added[:-1])

    def save(self) -> str:
        """Write the corrections and the take; returns a message."""
        with self._lock:
            if _file_state(self.path) != self._state or corrections_of(self.path) != self.saved:
                raise CaptureError(
                    f"{self.path} or its corrections have changed since they were opened, expected the same "
                    "files; open it again"
                )
            beside, every = corrections_path(self.path), (*self.saved, *self.added)
            save_corrections(beside, every)
            self.saved, self.added = corrections_of(self.path), ()
            with writing(self.path, CaptureError):
                self.take.save(self.path)
            self._base, self._state = self.take, _file_state(self.path)
        return f"saved {self.path} and {beside}"

    def _make(self, added: Sequence[Correction]) -> None:
        """Apply the saved and these corrections; a `CaptureError` if they contradict each other."""
        every = (*self.saved, *added)
        corrected = correct_take(self._base, every)
        self.added, self.unfitting = tuple(added), corrected.unfitting
        self.take = corrected.take if every else self._base


def label_of(take: Take, frame: int, column: int) -> str:
    """Name of a point's marker, or `NO_MARKER`."""
    label = int(take.point_list.labels[take.point_list.at(frame, column)])
    return take.label_names[label] if label >= 0 else NO_MARKER


def doubt_of(before: Take, after: Take, correction: Correction) -> str:
    """A sentence on hands that no longer fit their markers after a correction; empty if all fit."""
    frames = slice(correction.first, correction.last + 1)
    rms = np.array([np.fmax.reduce(take.rms[frames], axis=0) for take in (before, after)])
    worse = np.flatnonzero((rms[0] < BAD_RMS) & (rms[1] > BAD_RMS))
    told = [f"{after.sides[n]} RMS was {1e3 * rms[0, n]:.1f}, is {1e3 * rms[1, n]:.1f} mm" for n in worse]
    return f"; **{', '.join(told)}; Undo takes it back**" if told else ""


def _file_state(path: Path) -> tuple[int, int] | None:
    """Time and size of a file, to notice changes; None if it is gone."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


class LabelEditor:
    """Panel folder in which labels are corrected, and a halo around the chosen point."""

    def __init__(
        self, server: ViserServer, recording: TakeRecording, corrector: Corrector, changed: Callable[[], None]
    ) -> None:
        self._recording, self._corrector, self._changed = recording, corrector, changed
        self._frame, self._rows = 0, dict[str, int]()
        self.chosen: tuple[int, int] | None = None
        """Frame and column of the chosen point."""
        self.halo = server.scene.add_icosphere(
            "/chosen", _HALO * recording.radius, _HALO_COLOR, opacity=0.5, cast_shadow=False, visible=False
        )
        self._add_controls(server)
        self._list()

    def show(self, index: int, *, hurried: bool) -> None:
        """Show a frame, without the list of its points if `hurried`."""
        self._frame = index
        self._show_halo()
        if not hurried:
            self._show_points()

    def pick(self, index: int) -> None:
        """Choose a point of the shown frame by its index in `ShownFrame.points`."""
        columns = self._columns()
        if index < len(columns):
            self.choose(self._frame, int(columns[index]))
        else:
            self.state.content = "That marker was not seen: it has no point whose label could be wrong."

    def choose(self, frame: int, column: int) -> None:
        """Choose a point by its column in a frame, and the span in which it has its label."""
        points = self._corrector.take.point_list
        self.chosen = (frame, column)
        _set_value(self.span, self._corrector.span_of(frame, column))
        _set_value(self.label, label_of(self._corrector.take, frame, column))
        self._show_halo()
        self._show_points()
        first, last = self.span.value
        sure = points.confidence[points.at(frame, column)]
        self.state.content = (
            f"**{self._name(frame, column)}**, {100 * float(sure):.0f} %, "
            f"with this label in frames {first} to {last}"
        )

    def correct(self) -> None:
        """Give the chosen point the chosen label in the chosen span, or show why that is impossible."""
        if self.chosen is None:
            self.state.content = "Choose a point first: click on it, or take it from the list."
            return
        if self._corrector.is_busy:
            return  # The click before is still being worked on.
        first, last = (int(value) for value in self.span.value)
        before, self.state.content = self._corrector.take, "working: poses are fitted to the corrected labels"
        try:
            correction = self._corrector.add(*self.chosen, (first, last), self.label.value)
        except CaptureError as error:
            self.state.content = str(error)
            return
        self._renew()
        self.state.content = f"corrected: {correction}{doubt_of(before, self._corrector.take, correction)}"

    def save(self) -> None:
        """Save the corrections and the take, or show why that is impossible."""
        try:
            self.state.content = self._corrector.save()
        except CaptureError as error:
            self.state.content = str(error)
        self._list()

    def _add_controls(self, server: ViserServer) -> None:
        gui, last = server.gui, self._recording.num_frames - 1
        with gui.add_folder("Correct labels"):
            self.state = gui.add_markdown("Click on a point whose label is wrong, or take it from the list.")
            self.points = gui.add_dropdown("point", (_NO_POINT,), hint="ID and label of each point")
            self.span = gui.add_multi_slider(
                "frames", 0, max(last, 1), 1, (0, last), disabled=last == 0, hint="First and last frame"
            )
            ends = gui.add_button_group("shown frame is", ("first", "last"))
            self.label = gui.add_dropdown("right label", (NO_MARKER, *self._recording.label_names))
            gui.add_button("Correct").on_click(lambda _: self.correct())
            gui.add_button("Undo", color="gray", hint="What was not saved").on_click(lambda _: self._undo())
            saves = gui.add_button("Save take", color="gray", hint=f"Writes {self._corrector.path}")
            saves.on_click(lambda _: self.save())
            self.list = gui.add_markdown("")

        @self.points.on_update
        def _(event: Any) -> None:
            if event.client is not None and self.points.value in self._rows:
                self.choose(self._frame, self._rows[self.points.value])

        @ends.on_click
        def _(event: Any) -> None:
            (first, last), frame = self.span.value, self._frame
            is_first = event.target.value == "first"
            _set_value(self.span, (frame, max(frame, last)) if is_first else (min(first, frame), frame))

    def _undo(self) -> None:
        self._corrector.undo()
        self._renew()
        self.state.content = "taken back"

    def _renew(self) -> None:
        """Show the take with the current corrections."""
        self._recording.replace(self._corrector.take)
        self._list()
        self._changed()

    def _columns(self) -> np.ndarray:
        """Columns of the points of the shown frame."""
        points = self._corrector.take.point_list
        return points.columns[points.of(self._frame)]

    def _name(self, frame: int, column: int) -> str:
        take = self._corrector.take
        number = int(take.point_list.ids[take.point_list.at(frame, column)])
        name = f"ID {number}" if number >= 0 else f"column {column}"
        return f"{name}: {label_of(take, frame, column)}"

    def _show_points(self) -> None:
        """List the points of the shown frame, with the chosen one selected."""
        self._rows = {self._name(self._frame, int(column)): int(column) for column in self._columns()}
        if (rows := (_NO_POINT, *self._rows)) != self.points.options:
            self.points.options = rows
        column = self._chosen_column()
        _set_value(self.points, _NO_POINT if column is None else self._name(self._frame, column))

    def _chosen_column(self) -> int | None:
        """The column of the chosen point in the shown frame."""
        if self.chosen is None:
            return None
        points, (frame, column) = self._corrector.take.point_list, self.chosen
        number = points.ids[points.at(frame, column)]
        if number < 0:
            return column if frame == self._frame else None
        shown = points.of(self._frame)
        there = points.columns[shown][points.ids[shown] == number]
        return int(there[0]) if len(there) else None

    def _show_halo(self) -> None:
        column = self._chosen_column()
        if column is not None:
            points = self._corrector.take.point_list
            self.halo.position = points.points[points.at(self._frame, column)]
        self.halo.visible = column is not None

    def _list(self) -> None:
        corrector = self._corrector
        lines = [f"{correction}: no longer fits" for correction in corrector.unfitting]
        lines += [f"{correction}, not saved" for correction in reversed(corrector.added)]
        lines += [str(correction) for correction in reversed(corrector.saved)]
        more = [f"and {len(lines) - _MOST_LISTED} more"] if len(lines) > _MOST_LISTED else []
        self.list.content = "\n\n".join((*lines[:_MOST_LISTED], *more))


def _set_value(handle: Any, value: object) -> None:
    """Set the value of a GUI element, whose viser handle hides its setter from type checkers."""
    handle.value = value


class LayoutEditor:
    """Markers of a layout file on one hand, which can be moved and saved to `out`."""

    def __init__(
        self, server: ViserServer, path: Path, layout: MarkerLayout, model: HandModel, out: Path
    ) -> None:
        self._path, self._out, self._lock = path, out, threading.Lock()
        self.shift = np.array([0.0, 0.0, HEIGHT])
        """Wrist position in the page [m]."""
        self.fit: GloveFit = attach(layout, model)
        """The hand in the glove with all changes."""
        self._chosen: int | None = None
        self.skin = HandSkin(server, "/hand")
        self.skin.show(model, join_qpos(np.zeros((1, NUM_JOINTS)), position=self.shift)[0])
        count = layout.num_markers
        self.balls = PointBalls(server, "/markers", layout.names, most=count, radius=layout.radius)
        self.gizmo = server.scene.add_transform_controls(
            "/move", scale=_GIZMO, disable_rotations=True, depth_test=False, visible=False, line_width=3.0
        )
        gui = server.gui
        self.state = gui.add_markdown(f"**{layout.name}**: click a marker, then drag its arrows.")
        self.names = gui.add_dropdown("marker", layout.names)
        every = gui.add_checkbox("names", False)
        labels = frozenset(range(count))
        every.on_update(lambda _: self.balls.name(labels if every.value else frozenset()))
        saves = gui.add_button("Save layout", hint=f"Writes {out}")

        @saves.on_click
        def _(_event: object) -> None:
            try:
                self.state.content = self.save()
            except LayoutError as error:
                self.state.content = str(error)

        @self.names.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                self.choose(layout.names.index(self.names.value))

        self.balls.balls.on_click(self._click)
        self.gizmo.on_update(self._drag)
        self._show()
        set_stage(server, model.surface.vertices + self.shift, ground=0.0)

    def choose(self, index: int) -> None:
        """Choose the marker that the gizmo moves."""
        with self._lock:
            self._chosen = index
            self.gizmo.position = self.fit.attachment.points[index] + self.shift
            self.gizmo.visible = True
            _set_value(self.names, self.fit.layout.names[index])
            self._describe_chosen()

    def move(self, index: int, point: np.ndarray) -> None:
        """Move a marker to the skin near a point of the page [m], if there is any."""
        with self._lock:
            try:
                layout = place_marker(self.fit.layout, index, self.fit.model, point - self.shift, stays=False)
            except LayoutError as error:
                self.state.content = str(error)
                return
            self.fit = attach(layout, self.fit.model)
            self._show()
            self._describe_chosen()

    def save(self) -> str:
        """Write the layout; returns a message."""
        with self._lock:
            given = read_bytes(self._path, error=LayoutError).decode("utf-8", "replace")
            text, kept = moved_text(given, self.fit.layout)
            with writing(self._out, LayoutError):
                write_text(self._out, text)
        return f"saved {self._out}" if kept else f"saved {self._out}, without the comments of {self._path}"

    def _click(self, event: SceneNodePointerEvent[Any]) -> None:
        index = self.balls.nearest(np.array(event.ray_origin), np.array(event.ray_direction))
        if index is not None:
            self.choose(index)

    def _drag(self, event: Any) -> None:
        chosen = self._chosen
        if chosen is None or (event.phase != "end" and self._lock.locked()):
            return  # The previous step is still being computed.
        self.move(chosen, np.array(self.gizmo.position))
        if event.phase == "end":
            self.choose(chosen)  # moves the gizmo onto the marker

    def _show(self) -> None:
        count = self.fit.layout.num_markers
        points = self.fit.attachment.points + self.shift
        self.balls.show(points, np.arange(count), np.ones(count, dtype=np.bool_))

    def _describe_chosen(self) -> None:
        if self._chosen is None:
            return
        marker = self.fit.layout.markers[self._chosen]
        across = f", across {marker.across:.3f}" if marker.across else ""
        self.state.content = (
            f"**{marker.name}** on {marker.bone}: along {marker.along:.3f}, "
            f"around {math.degrees(marker.around):.1f}°{across}"
        )


def edited_path(path: Path) -> Path:
    """The first unused name beside a file: `glove-edited.toml`, `glove-edited-2.toml`, ..."""
    endings = itertools.chain([""], (f"-{number}" for number in itertools.count(2)))
    candidates = (path.with_name(f"{path.stem}-edited{ending}{path.suffix}") for ending in endings)
    return next(candidate for candidate in candidates if not candidate.exists())
