"""Correcting labels in the page: a point, a span of frames, the right label."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from gloves.takes.corrections import NO_MARKER
from handsim.errors import CaptureError
from track.viewer.corrector import Corrector, label_of
from track.viewer.recordings import TakeRecording

if TYPE_CHECKING:
    from viser import ViserServer


_NOTHING: Final = "choose"
_HALO: Final = 2.5  # radius around the chosen point, in radii of a marker
_HALO_COLOR: Final = (255, 190, 0)
_LISTED: Final = 12  # corrections


class LabelEditor:
    """The folder of the panel in which labels are corrected, and a halo around the chosen point.

    Args:
        changed: Called when the take has changed.
    """

    def __init__(
        self,
        server: ViserServer,
        recording: TakeRecording,
        corrector: Corrector,
        changed: Callable[[], None],
    ) -> None:
        self._recording, self._corrector, self._changed = recording, corrector, changed
        self._frame, self._rows = 0, dict[str, int]()
        self.chosen: tuple[int, int] | None = None
        """Frame and column of the chosen point."""
        self.halo = server.scene.add_icosphere(
            "/chosen", _HALO * recording.radius, _HALO_COLOR, opacity=0.5, cast_shadow=False, visible=False
        )
        """Around the chosen point."""
        self._add_controls(server)
        self._list()

    def show(self, index: int, *, hurried: bool) -> None:
        """Follow the page to a frame; where `hurried`, without the list of its points."""
        self._frame = index
        self._show_halo()
        if not hurried:
            self._show_points()

    def pick(self, index: int) -> None:
        """Choose a point of the shown frame, counted as in `ShownFrame.points`."""
        columns = self._columns()
        if index < len(columns):
            self.choose(self._frame, int(columns[index]))
        else:
            self.state.content = "That marker was not seen: it has no point whose label could be wrong."

    def choose(self, frame: int, column: int) -> None:
        """Choose a point by its column in a frame; the span becomes that of its label."""
        points = self._corrector.take.point_list
        self.chosen = (frame, column)
        _set(self.span, self._corrector.span_of(frame, column))
        _set(self.label, label_of(self._corrector.take, frame, column))
        self._show_halo()
        self._show_points()
        first, last = self.span.value
        sure = points.confidence[points.at(frame, column)]
        self.state.content = (
            f"**{self._name(frame, column)}**, {100 * float(sure):.0f} %, "
            f"with this label in frames {first} to {last}"
        )

    def correct(self) -> None:
        """Give the chosen point the chosen label over the chosen span, or say why not."""
        if self.chosen is None:
            self.state.content = "Choose a point first: click on it, or take it from the list."
            return
        first, last = (int(value) for value in self.span.value)
        try:
            correction = self._corrector.add(*self.chosen, (first, last), self.label.value)
        except CaptureError as error:
            self.state.content = str(error)
            return
        self._renew()
        self.state.content = f"corrected: {correction}"

    def save(self) -> None:
        """Save the corrections and the take, or say why not."""
        try:
            self.state.content = self._corrector.save()
        except CaptureError as error:
            self.state.content = str(error)
        self._list()

    def _add_controls(self, server: ViserServer) -> None:
        gui, last = server.gui, self._recording.num_frames - 1
        with gui.add_folder("Correct labels"):
            self.state = gui.add_markdown("Click on a point whose label is wrong, or take it from the list.")
            """What is chosen, or what was done."""
            self.points = gui.add_dropdown("point", (_NOTHING,), hint="ID and label of each point")
            """The points of the shown frame."""
            self.span = gui.add_multi_slider(
                "frames", 0, max(last, 1), 1, (0, last), disabled=last == 0, hint="First and last frame"
            )
            """The first and the last frame."""
            ends = gui.add_button_group("shown frame is", ("first", "last"))
            self.label = gui.add_dropdown("right label", (NO_MARKER, *self._recording.label_names))
            """The label that the point shall have."""
            gui.add_button("Correct").on_click(lambda _: self.correct())
            gui.add_button("Undo", color="gray", hint="What was not saved").on_click(lambda _: self._undo())
            saves = gui.add_button("Save take", color="gray", hint=f"Writes {self._corrector.path}")
            saves.on_click(lambda _: self.save())
            self.list = gui.add_markdown("")
            """The corrections."""
        self.points.on_update(self._pick_row)
        ends.on_click(lambda event: self._set_end(event.target.value))

    def _undo(self) -> None:
        self._corrector.undo()
        self._renew()
        self.state.content = "taken back"

    def _renew(self) -> None:
        """Show what the corrector has made."""
        self._recording.replace(self._corrector.take)
        self._list()
        self._changed()

    def _pick_row(self, event: Any) -> None:
        if event.client is not None and self.points.value in self._rows:
            self.choose(self._frame, self._rows[self.points.value])

    def _set_end(self, end: str) -> None:
        first, last = self.span.value
        frame = self._frame
        _set(self.span, (frame, max(frame, last)) if end == "first" else (min(first, frame), frame))

    def _columns(self) -> np.ndarray:
        """Columns of the points of the shown frame."""
        points = self._corrector.take.point_list
        return points.columns[points.of(self._frame)]

    def _name(self, frame: int, column: int) -> str:
        take = self._corrector.take
        number = int(take.point_list.ids[take.point_list.at(frame, column)])
        return f"{'ID ' if number >= 0 else 'column '}{number if number >= 0 else column}: " + label_of(
            take, frame, column
        )

    def _show_points(self) -> None:
        """The points of the shown frame as rows of a list, the chosen one selected."""
        self._rows = {self._name(self._frame, int(column)): int(column) for column in self._columns()}
        rows = (_NOTHING, *self._rows)
        if rows != self.points.options:
            self.points.options = rows
        column = self._chosen_column()
        value = _NOTHING if column is None else self._name(self._frame, column)
        if self.points.value != value:
            _set(self.points, value)

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
        if self.halo.visible != (column is not None):
            self.halo.visible = column is not None

    def _list(self) -> None:
        corrector = self._corrector
        lines = [f"{correction}: no longer fits" for correction in corrector.unfitting]
        lines += [f"{correction}, not saved" for correction in reversed(corrector.added)]
        lines += [str(correction) for correction in reversed(corrector.saved)]
        more = [f"and {len(lines) - _LISTED} more"] if len(lines) > _LISTED else []
        self.list.content = "\n\n".join((*lines[:_LISTED], *more))


def _set(handle: Any, value: object) -> None:
    """Give an element of the panel a value, as the program and not a person."""
    handle.value = value
