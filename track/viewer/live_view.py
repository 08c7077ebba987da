"""A live tracker in the page: the newest frame, as often as the page can take it."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.takes.take import label_names
from handsim.hand.shape import NUM_QPOS
from track.frames import StreamedFrame, TrackedFrame
from track.tracker import Tracker
from track.viewer.frame_view import FrameView
from track.viewer.recordings import Recording, ShownFrame, shown_body
from track.viewer.stage import set_stage
from track.viewer.timeline import PICTURES

if TYPE_CHECKING:
    from viser import ViserServer

    from handsim.space.rig import CameraRig


_MOST_POINTS: Final = 400
_TEXT_EVERY: Final = 0.2  # [s]


class LiveRecording(Recording):
    """The frames of a tracker that runs: there is only the newest one."""

    def __init__(self, tracker: Tracker, rig: CameraRig | None = None) -> None:
        self._hands = tracker.hands
        self._offsets = np.cumsum([0, *(hand.layout.num_markers for hand in tracker.hands)])
        super().__init__(
            np.zeros(1),
            label_names(tracker.hands, tracker.bodies),
            most_points=_MOST_POINTS,
            radius=tracker.hands[0].layout.radius,
            bodies=tuple(shown_body(body) for body in tracker.bodies),
            rig=rig,
        )

    def frame(self, index: int) -> ShownFrame:
        """An empty one: nothing has been tracked."""
        return ShownFrame(0.0)

    def of(self, frame: StreamedFrame, tracked: TrackedFrame) -> ShownFrame:
        """A tracked frame as it is shown."""
        filled = [hand.markers[hand.filled] for hand in tracked.hands]
        labels = [offset + hand.filled for offset, hand in zip(self._offsets, tracked.hands, strict=False)]
        bodies = [np.concatenate([body.translation, body.rotation]) for body in tracked.bodies]
        count = len(frame.points)
        words = [
            f"**{hand.side}** {hand.status}"
            + (f", RMS {1e3 * hand.rms:.2f} mm" if np.isfinite(hand.rms) else "")
            for hand in tracked.hands
        ]
        words += [f"**{body.name}** {body.status}" for body in tracked.bodies]
        return ShownFrame(
            time=frame.time,
            words=(*words, f"{count} points", *tracked.notes),
            hands=tuple(hand.model for hand in self._hands),
            qpos=np.array([hand.qpos for hand in tracked.hands]).reshape(-1, NUM_QPOS),
            points=np.concatenate([frame.points, *filled]),
            labels=np.concatenate([tracked.labels, *labels]).astype(np.int64),
            seen=np.repeat([True, False], [count, sum(map(len, filled))]),
            bodies=np.array(bodies).reshape(-1, 7),
        )


class LiveView:
    """Shows the newest frame of a tracker from a thread of its own; frames in between are left out."""

    def __init__(self, server: ViserServer, tracker: Tracker, rig: CameraRig | None = None) -> None:
        self._server, self._recording = server, LiveRecording(tracker, rig)
        self._view = FrameView(server, self._recording)
        self._text = server.gui.add_markdown("waiting for the first frame")
        self._newest: tuple[StreamedFrame, TrackedFrame] | None = None
        self._come, self._ending = threading.Event(), False
        self._staged = False
        self.frames = self.pictures = 0
        """Frames that came, and pictures that were made of them."""
        self._thread = threading.Thread(target=self._draw, name="live view", daemon=True)
        self._thread.start()

    def offer(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Give the newest frame; this takes microseconds, whatever the page does."""
        self.frames += 1
        self._newest = (frame, tracked)
        self._come.set()

    def close(self) -> None:
        """End the thread."""
        self._ending = True
        self._come.set()
        self._thread.join()

    def _draw(self) -> None:
        due = text_due = 0.0
        while not self._ending:
            self._come.wait()
            self._come.clear()
            newest, self._newest = self._newest, None
            if newest is None:
                continue
            shown = self._recording.of(*newest)
            self._view.show(shown)
            self.pictures += 1
            if not self._staged and len(shown.points) and np.isfinite(shown.qpos).any():
                set_stage(self._server, shown.points)
                self._staged = True
            now = time.perf_counter()
            if now >= text_due:
                text_due = now + _TEXT_EVERY
                self._text.content = "\n\n".join((f"**live** frame {newest[0].number}", *shown.words))
            due = max(due + 1.0 / PICTURES, now)
            time.sleep(due - now)
