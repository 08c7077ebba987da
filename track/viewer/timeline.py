"""Time in the page: playback of a recording, with texts and plots, or a live tracker."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from gloves.fit import GloveFit
from handsim.arrays import Doubles
from handsim.callbacks import Closing
from handsim.space.transforms import UpAxis
from track.bodies.rigid_body import RigidTemplate
from track.frames import StreamedFrame, TrackedFrame
from track.viewer.recordings import LiveRecording, Recording, ShownFrame
from track.viewer.stage import FrameView, set_stage

if TYPE_CHECKING:
    from viser import GuiButtonHandle, GuiFolderHandle, GuiUplotHandle, ViserServer, uplot

    from handsim.space.rig import CameraRig

PICTURES: Final = 60.0
"""Highest rate of shown frames [Hz]."""
_SPEED_FACTORS: Final = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "4 x": 4.0}
_SLIDER_PERIOD: Final = 0.1  # [s] least time between moves of the slider while playing
_LONGEST_IDLE: Final = 0.2  # [s] longest interval between calls of `ended`
_TEXT_PERIOD: Final = 0.1  # [s] least time between texts while playing
_LIVE_TEXT_PERIOD: Final = 0.2  # [s] least time between texts of a live view
_STROKES: Final = ("#b8572b", "#3f7396", "#5b8c5a", "#7a5ba0")

Key = Literal["space", "arrowleft", "arrowright", "home", "end", "pageup", "pagedown"]


class Timeline:
    """Selects frames: `run` calls `show` with their indices; all other methods only request a frame."""

    def __init__(self, server: ViserServer, times: Doubles, show: Callable[[int], None]) -> None:
        self._times, self._show = times, show
        self._wake = threading.Event()
        self.index, self.playing = 0, False
        """The last requested frame, and whether the recording is playing."""
        self._shown = -1
        self._anchor = (0.0, 0.0)  # clock and time of the recording at the start of playing [s]
        self._slider_due = 0.0
        last = max(len(times) - 1, 1)
        gui = server.gui
        with gui.add_folder("Time"):
            self._slider = gui.add_slider("frame", 0, last, 1, 0, disabled=len(times) < 2)
            self._button = gui.add_button("Play", hint="Space")
            self._step = gui.add_button_group("step", ("-10", "-1", "+1", "+10"))
            self._speed = gui.add_dropdown("speed", tuple(_SPEED_FACTORS), initial_value="1 x")
        self._button.on_click(lambda _: self.toggle())
        self._step.on_click(lambda event: self.step(int(event.target.value)))
        self._speed.on_update(lambda _: self._set_anchor())
        keys: dict[Key, tuple[str, Callable[[], None]]] = {
            "space": ("Play or pause", self.toggle),
            "arrowleft": ("One frame back", lambda: self.step(-1)),
            "arrowright": ("One frame on", lambda: self.step(1)),
            "pageup": ("Ten frames back", lambda: self.step(-10)),
            "pagedown": ("Ten frames on", lambda: self.step(10)),
            "home": ("First frame", lambda: self.go_to(0)),
            "end": ("Last frame", lambda: self.go_to(len(self._times) - 1)),
        }
        for key, (label, action) in keys.items():

            @gui.add_command(label, hotkey=key).on_trigger
            def _(_event: object, action: Callable[[], None] = action) -> None:
                action()

        @self._slider.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # moved by a person, not by `update`
                self.go_to(self._slider.value)

    def go_to(self, index: int) -> None:
        """Request a frame; indices beyond the ends select the first or last frame."""
        self.index = int(np.clip(index, 0, len(self._times) - 1))
        self._set_anchor()
        self._wake.set()

    def jump(self, index: int) -> None:
        """Stop playing and go to a frame."""
        self.play(False)
        self.go_to(index)

    def step(self, frames: int) -> None:
        """Stop playing, and go some frames forward or back."""
        self.jump(self.index + frames)

    def toggle(self) -> None:
        """Start or stop playing."""
        self.play(not self.playing)

    def play(self, playing: bool) -> None:
        """Start or stop playing; after its end the recording starts again."""
        if playing != self.playing:
            self._button.label = "Pause" if playing else "Play"
        self.playing = playing and len(self._times) > 1
        self._set_anchor()
        self._wake.set()

    def run(self, ended: Callable[[], bool]) -> None:
        """Show the requested frames until `ended`."""
        due = time.perf_counter()
        while not ended():
            if self.playing:
                self._advance()
            self.update()
            now = time.perf_counter()
            due = max(due + 1.0 / PICTURES, now)
            self._wake.wait(due - now if self.playing else _LONGEST_IDLE)
            self._wake.clear()

    def refresh(self) -> None:
        """Request the same frame again after its content changed."""
        self._shown = -1
        self._wake.set()

    def update(self) -> None:
        """Show the requested frame, unless it is shown already."""
        index = self.index
        if index == self._shown:
            return
        self._shown = index
        self._show(index)
        now = time.perf_counter()
        if not self.playing or now >= self._slider_due:
            self._slider.value = index  # type: ignore[misc]  # viser sets it through __setattr__
            self._slider_due = now + _SLIDER_PERIOD

    def _advance(self) -> None:
        clock, begin = self._anchor
        now = begin + (time.perf_counter() - clock) * _SPEED_FACTORS[self._speed.value]
        if now >= 2.0 * self._times[-1] - self._times[-2]:  # The last frame is shown for one interval.
            self.index = 0
            self._set_anchor()
            return
        self.index = max(int(np.searchsorted(self._times, now, side="right")) - 1, 0)

    def _set_anchor(self) -> None:
        self._anchor = (time.perf_counter(), float(self._times[self.index]))


class StatusPanel:
    """Text on the shown frame, plots, and buttons that lead to doubtful frames."""

    def __init__(self, server: ViserServer, recording: Recording) -> None:
        self._server, self._recording, self._due = server, recording, 0.0
        self.text = server.gui.add_markdown("")
        self._jump_to: Callable[[int], None] = lambda frame: None
        self._rows: GuiFolderHandle | None = None
        self._buttons: list[GuiButtonHandle] = []
        self._plots: list[tuple[GuiUplotHandle, list[str]]] = []

    def add_doubts(self, go_to: Callable[[int], None]) -> None:
        """Add buttons that call `go_to` with a doubtful frame, if there are any."""
        self._jump_to = go_to
        if self._recording.suspects:
            self._rows = self._server.gui.add_folder("Doubtful frames")
            self._add_rows()

    def add_plots(self) -> None:
        """Add one plot of the curves with a unit and one of the others, if there are any."""
        gui, recording = self._server.gui, self._recording
        if not recording.curves or recording.num_frames < 2:
            return
        groups: dict[bool, list[str]] = {}
        for name in recording.curves:
            groups.setdefault(name.endswith("]"), []).append(name)
        with gui.add_folder("Over time", expand_by_default=True):
            for names in groups.values():
                series: list[uplot.Series] = [{"label": "time [s]"}]
                for name, stroke in zip(names, _STROKES, strict=False):
                    series.append({"label": name, "stroke": stroke, "width": 1.2, "spanGaps": False})
                columns = _columns(recording, names)
                plot = gui.add_uplot(columns, tuple(series), scales={"x": {"time": False}}, aspect=2.2)
                self._plots.append((plot, names))

    def renew(self) -> None:
        """Renew buttons and plots after the recording changed."""
        for row in self._buttons:
            row.remove()
        self._add_rows()
        for plot, names in self._plots:
            plot.data = _columns(self._recording, names)

    def _add_rows(self) -> None:
        self._buttons = []
        if self._rows is None:
            return
        for doubt in self._recording.suspects:
            span = f"{doubt.first}" if doubt.first == doubt.last else f"{doubt.first}-{doubt.last}"
            with self._rows:
                row = self._server.gui.add_button(f"{span}: {doubt.words}", color="gray")
            self._buttons.append(row)

            @row.on_click
            def _(_event: object, frame: int = doubt.worst) -> None:
                self._jump_to(frame)

    def show(self, index: int, frame: ShownFrame, *, hurried: bool) -> None:
        """Show the state of a frame; with `hurried`, at most ten times a second."""
        now = time.perf_counter()
        if hurried and now < self._due:
            return
        self._due = now + _TEXT_PERIOD
        head = f"**frame {index}** of {self._recording.num_frames}, {frame.time:.3f} s"
        self.text.content = "\n\n".join((head, *frame.words))


def _columns(recording: Recording, names: list[str]) -> tuple[np.ndarray, ...]:
    """Decimated times, and the decimated values of some curves."""
    columns = [thinned(recording.times, recording.curves[name]) for name in names]
    return (columns[0][0], *(values for _, values in columns))


def thinned(times: Doubles, values: Doubles) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a curve (T,), which may hold NaN, to the columns of a plot: their times and largest values."""
    step = -(-len(times) // 600)
    starts = np.arange(0, len(times), step)
    return times[starts], np.fmax.reduceat(values, starts)


class LiveView(Closing):
    """A `FrameOutput` that shows a tracker's newest frame, from its own thread."""

    def __init__(self, server: ViserServer, rig: CameraRig | None = None, up: UpAxis = "z") -> None:
        self._server, self._rig, self._up = server, rig, up
        self._newest: tuple[StreamedFrame, TrackedFrame] | None = None
        self._came, self._ending = threading.Event(), False
        self._thread: threading.Thread | None = None
        self.frames = self.pictures = 0
        """Numbers of tracked and of shown frames."""

    @property
    def counts(self) -> dict[str, int]:
        """Empty, as frames that are not shown do not count as dropped."""
        return {}

    def start(self, hands: Sequence[GloveFit], bodies: Sequence[RigidTemplate]) -> None:
        """Set the tracker's hands and bodies; called again when their size changes."""
        self._recording = LiveRecording(hands, bodies, self._rig)
        if self._thread is not None:
            return
        self._view = FrameView(self._server, self._recording)
        self._text = self._server.gui.add_markdown("waiting for the first frame")
        self._thread = threading.Thread(target=self._draw, name="live view", daemon=True)
        self._thread.start()

    def send(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Replace the newest frame, within microseconds."""
        if not frame.silent:
            self.frames += 1
            self._newest = (frame, tracked)
            self._came.set()

    def notes(self) -> tuple[str, ...]:
        """A line with the number of shown frames."""
        return (f"{self.frames} frames tracked, {self.pictures} of them shown",)

    def close(self) -> None:
        """End the thread."""
        self._ending = True
        self._came.set()
        if self._thread is not None:
            self._thread.join()

    def _draw(self) -> None:
        due = text_due = 0.0
        is_staged = False
        while not self._ending:
            self._came.wait()
            self._came.clear()
            newest, self._newest = self._newest, None
            if newest is None:
                continue
            shown = self._recording.frame_of(*newest)
            self._view.show(shown)
            self.pictures += 1
            if not is_staged and len(shown.points) and np.isfinite(shown.qpos).any():
                set_stage(self._server, shown.points, up=self._up)
                is_staged = True
            now = time.perf_counter()
            if now >= text_due:
                text_due = now + _LIVE_TEXT_PERIOD
                self._text.content = "\n\n".join((f"**live** frame {newest[0].number}", *shown.words))
            due = max(due + 1.0 / PICTURES, now)
            time.sleep(due - now)
