"""The timeline: which frame is shown, by slider, keys, playing and rows of doubtful frames."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from viser import ViserServer

PICTURES: Final = 60.0
"""Pictures per second while playing, at most [Hz]."""
_SPEEDS: Final = {"0.1 x": 0.1, "0.25 x": 0.25, "0.5 x": 0.5, "1 x": 1.0, "2 x": 2.0, "4 x": 4.0}
_SLIDER: Final = 0.1  # [s] between two moves of the slider while playing
_IDLE: Final = 0.2  # [s] between two looks at whether the viewer shall end

Key = Literal["space", "arrowleft", "arrowright", "home", "end", "pageup", "pagedown"]


class Timeline:
    """Chooses frames; `run` shows them in the thread that calls it, everything else only asks for one.

    Args:
        times: Time of each frame [s], increasing.
        show: Called with the index of each frame that is to be shown.
    """

    def __init__(
        self, server: ViserServer, times: Float[np.ndarray, "T"], show: Callable[[int], None]
    ) -> None:
        self._times, self._show = times, show
        self._wake = threading.Event()
        self._index, self._shown, self._playing = 0, -1, False
        self._anchor = (0.0, 0.0)  # clock and time of the take at which playing began
        self._slider_due = 0.0
        last = max(len(times) - 1, 1)
        gui = server.gui
        with gui.add_folder("Time"):
            self._slider = gui.add_slider("frame", 0, last, 1, 0, disabled=len(times) < 2)
            self._button = gui.add_button("Play", hint="Space")
            self._step = gui.add_button_group("step", ("-10", "-1", "+1", "+10"))
            self._speed = gui.add_dropdown("speed", tuple(_SPEEDS), initial_value="1 x")
        self._slider.on_update(self._slide)
        self._button.on_click(lambda _: self.toggle())
        self._step.on_click(lambda event: self.step(int(event.target.value)))
        self._speed.on_update(lambda _: self._set_anchor())
        self._add_keys(server)

    @property
    def index(self) -> int:
        """The frame that was asked for last."""
        return self._index

    @property
    def playing(self) -> bool:
        """Whether frames follow each other by themselves."""
        return self._playing

    def go_to(self, index: int) -> None:
        """Ask for a frame; one beyond an end is the one at that end."""
        self._index = int(np.clip(index, 0, len(self._times) - 1))
        self._set_anchor()
        self._wake.set()

    def jump(self, index: int) -> None:
        """Stop playing and go to a frame."""
        self.play(False)
        self.go_to(index)

    def step(self, frames: int) -> None:
        """Stop playing and go so many frames on, or back."""
        self.play(False)
        self.go_to(self._index + frames)

    def toggle(self) -> None:
        """Play, or stop playing."""
        self.play(not self._playing)

    def play(self, playing: bool) -> None:
        """Play, or stop playing; at the end it begins anew."""
        if playing != self._playing:
            self._button.label = "Pause" if playing else "Play"
        self._playing = playing and len(self._times) > 1
        self._set_anchor()
        self._wake.set()

    def run(self, ended: Callable[[], bool]) -> None:
        """Show what is asked for until `ended`."""
        due = time.perf_counter()
        while not ended():
            if self._playing:
                self._advance()
            self.update()
            now = time.perf_counter()
            due = max(due + 1.0 / PICTURES, now)
            self._wake.wait(due - now if self._playing else _IDLE)
            self._wake.clear()

    def refresh(self) -> None:
        """Ask for the frame again: what it shows has changed."""
        self._shown = -1
        self._wake.set()

    def update(self) -> None:
        """Show the frame that was asked for, unless it is shown."""
        index = self._index
        if index == self._shown:
            return
        self._shown = index
        self._show(index)
        now = time.perf_counter()
        if not self._playing or now >= self._slider_due:
            self._slider.value = index  # type: ignore[misc]  # viser sets it through __setattr__
            self._slider_due = now + _SLIDER

    def _advance(self) -> None:
        clock, begin = self._anchor
        now = begin + (time.perf_counter() - clock) * _SPEEDS[self._speed.value]
        if now >= 2.0 * self._times[-1] - self._times[-2]:  # the last frame has its time too
            self._index = 0
            self._set_anchor()
            return
        self._index = max(int(np.searchsorted(self._times, now, side="right")) - 1, 0)

    def _set_anchor(self) -> None:
        self._anchor = (time.perf_counter(), float(self._times[self._index]))

    def _slide(self, event: Any) -> None:
        if event.client is not None:  # moved by a person, not by `update`
            self.go_to(self._slider.value)

    def _add_keys(self, server: ViserServer) -> None:
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
            server.gui.add_command(label, hotkey=key).on_trigger(partial(_call, action))


def _call(action: Callable[[], None], _event: object) -> None:
    action()
