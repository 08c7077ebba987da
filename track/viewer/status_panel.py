"""The panel beside the scene: the state of the frame, plots over time, doubtful frames."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from track.viewer.recordings import Recording, ShownFrame

if TYPE_CHECKING:
    from viser import GuiButtonHandle, GuiFolderHandle, GuiUplotHandle, ViserServer, uplot

_EVERY: Final = 0.1  # [s] between two texts while frames follow each other quickly
_COLUMNS: Final = 600  # of a plot
_STROKES: Final = ("#b8572b", "#3f7396", "#5b8c5a", "#7a5ba0")


class StatusPanel:
    """Text of the shown frame, plots, and rows that lead to doubtful frames."""

    def __init__(self, server: ViserServer, recording: Recording) -> None:
        self._server, self._recording, self._due = server, recording, 0.0
        self.text = server.gui.add_markdown("")
        """The state of the frame."""
        self._go_to: Callable[[int], None] = lambda frame: None
        self._rows: GuiFolderHandle | None = None
        self._buttons: list[GuiButtonHandle] = []
        self._plots: list[tuple[GuiUplotHandle, list[int]]] = []

    def add_doubts(self, go_to: Callable[[int], None]) -> None:
        """Add the rows of doubtful frames, if there are any.

        Args:
            go_to: Called with a frame whose row was clicked.
        """
        self._go_to = go_to
        if self._recording.doubts:
            self._rows = self._server.gui.add_folder("Doubtful frames")
            self._add_rows(self._rows)

    def add_plots(self) -> None:
        """Add the plots, if there is anything to plot."""
        server, recording = self._server, self._recording
        if recording.curves and recording.num_frames > 1:
            with server.gui.add_folder("Over time", expand_by_default=True):
                groups: dict[bool, list[int]] = {}
                for number, curve in enumerate(recording.curves):
                    groups.setdefault(curve.name.endswith("]"), []).append(number)
                plots = []
                for numbers in groups.values():
                    series: list[uplot.Series] = [{"label": "time [s]"}]
                    for number, stroke in zip(numbers, _STROKES, strict=False):
                        name = recording.curves[number].name
                        series.append({"label": name, "stroke": stroke, "width": 1.2, "spanGaps": False})
                    plot = server.gui.add_uplot(
                        _columns(recording, numbers), tuple(series), scales={"x": {"time": False}}, aspect=2.2
                    )
                    plots.append((plot, numbers))
                self._plots = plots

    def renew(self) -> None:
        """Show the rows and the plots of a recording that was changed."""
        if self._rows is not None:
            for row in self._buttons:
                row.remove()
            self._add_rows(self._rows)
        for plot, numbers in self._plots:
            plot.data = _columns(self._recording, numbers)

    def _add_rows(self, folder: GuiFolderHandle) -> None:
        self._buttons = []
        with folder:
            for doubt in self._recording.doubts:
                span = f"{doubt.first}" if doubt.first == doubt.last else f"{doubt.first}-{doubt.last}"
                row = self._server.gui.add_button(f"{span}: {doubt.words}", color="gray")
                row.on_click(partial(_jump, self._go_to, doubt.worst))
                self._buttons.append(row)

    def show(self, index: int, frame: ShownFrame, *, hurried: bool) -> None:
        """Show the state of a frame; where `hurried`, not more than ten times a second."""
        now = time.perf_counter()
        if hurried and now < self._due:
            return
        self._due = now + _EVERY
        head = f"**frame {index}** of {self._recording.num_frames}, {frame.time:.3f} s"
        self.text.content = "\n\n".join((head, *frame.words))


def _jump(go_to: Callable[[int], None], frame: int, _event: object) -> None:
    go_to(frame)


def _columns(recording: Recording, numbers: list[int]) -> tuple[np.ndarray, ...]:
    """Times, and the values of some curves."""
    columns = [thinned(recording.times, recording.curves[number].values) for number in numbers]
    return (columns[0][0], *(values for _, values in columns))


def thinned(times: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[np.ndarray, np.ndarray]:
    """A curve of at most as many values as a plot has columns: the largest of each column.

    Args:
        times: (T,) [s].
        values: (T,); NaN where there is none.
    """
    step = -(-len(times) // _COLUMNS)
    starts = np.arange(0, len(times), step)
    return times[starts], np.fmax.reduceat(values, starts)
