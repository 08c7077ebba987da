"""The panel beside the scene: the state of the frame, plots over time, doubtful frames."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from track.viewer.recordings.recording import Curve, Recording, ShownFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from viser import ViserServer, uplot

_EVERY: Final = 0.1  # [s] between two texts while frames follow each other quickly
_COLUMNS: Final = 600  # of a plot
_STROKES: Final = ("#b8572b", "#3f7396", "#5b8c5a", "#7a5ba0")


class StatusPanel:
    """Text of the shown frame, plots, and rows that lead to doubtful frames.

    Args:
        server: Where the page is.
        recording: What is shown.
    """

    def __init__(self, server: ViserServer, recording: Recording) -> None:
        self._server, self._recording, self._due = server, recording, 0.0
        self.text = server.gui.add_markdown("")
        """The state of the frame."""

    def add_lists(self, go_to: Callable[[int], None]) -> None:
        """Add the rows and the plots.

        Args:
            go_to: Called with a frame whose row was clicked.
        """
        server, recording = self._server, self._recording
        if recording.doubts:
            with server.gui.add_folder("Doubtful frames"):
                for doubt in recording.doubts:
                    row = server.gui.add_button(f"{doubt.frame}: {doubt.words}", color="gray")
                    row.on_click(partial(_jump, go_to, doubt.frame))
        if recording.curves and recording.num_frames > 1:
            with server.gui.add_folder("Over time", expand_by_default=True):
                _add_plots(server, recording)

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


def _add_plots(server: ViserServer, recording: Recording) -> None:
    """One plot for the curves of each unit."""
    groups: dict[bool, list[Curve]] = {}
    for curve in recording.curves:
        groups.setdefault(curve.name.endswith("]"), []).append(curve)
    for curves in groups.values():
        columns = [thinned(recording.times, curve.values) for curve in curves]
        data = (columns[0][0], *(values for _, values in columns))
        series: list[uplot.Series] = [{"label": "time [s]"}]
        for curve, stroke in zip(curves, _STROKES, strict=False):
            series.append({"label": curve.name, "stroke": stroke, "width": 1.2, "spanGaps": False})
        server.gui.add_uplot(
            data,
            tuple(series),
            scales={"x": {"time": False}},
            aspect=2.2,
        )


def thinned(times: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[np.ndarray, np.ndarray]:
    """A curve of at most as many values as a plot has columns: the largest of each column.

    Args:
        times: (T,) [s].
        values: (T,); NaN where there is none.
    """
    step = -(-len(times) // _COLUMNS)
    starts = np.arange(0, len(times), step)
    return times[starts], np.fmax.reduceat(values, starts)
