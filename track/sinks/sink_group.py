"""Several sinks of one tracker: a frame goes to each, and none that fails stops the tracker."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Self

from gloves.fit import GloveFit
from handsim.errors import HandSimWarning
from track.bodies.rigid_body import RigidTemplate
from track.sinks.message import LiveSink, MessageEncoder
from track.streams.frame_source import StreamedFrame
from track.tracked_frame import TrackedFrame


class SinkGroup:
    """Sends frames to sinks; the end of a `with` block closes them.

    Args:
        sinks: The sinks by the addresses that opened them.
    """

    def __init__(self, sinks: Mapping[str, LiveSink]) -> None:
        self._sinks = dict(sinks)
        self._all = dict(sinks)
        self._encoder: MessageEncoder | None = None
        self._sent = 0

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self._sinks)

    def start(self, hands: Sequence[GloveFit], bodies: Sequence[RigidTemplate]) -> None:
        """Take on a tracker's hands and bodies."""
        self._encoder = MessageEncoder(hands, bodies)

    def send(self, frame: StreamedFrame, tracked: TrackedFrame) -> None:
        """Send a frame to every sink."""
        if self._encoder is None or not self._sinks:
            return
        message = self._encoder.encode(frame, tracked)
        self._sent += 1
        for address, sink in list(self._sinks.items()):
            try:
                sink.send(message)
            except Exception as error:  # of the user's code: any; the recording goes on
                self._leave_out(address, error)

    @property
    def counts(self) -> dict[str, int]:
        """Frames that each sink has dropped, by its address."""
        return {address: getattr(sink, "dropped", 0) for address, sink in self._all.items()}

    def notes(self) -> tuple[str, ...]:
        """What is to be told at the end, one line each."""
        told = [f"{self._sent} frames sent to {', '.join(self._sinks)}"] if self._sinks and self._sent else []
        told += [f"{address}: {count} frames dropped" for address, count in self.counts.items() if count]
        return tuple(told)

    def close(self) -> None:
        """Close all sinks."""
        sinks, self._sinks = self._sinks, {}
        for address, sink in sinks.items():
            self._close(address, sink)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _leave_out(self, address: str, error: Exception) -> None:
        warnings.warn(
            f"{address} failed and gets no further frame ({type(error).__name__}: {error})",
            HandSimWarning,
            stacklevel=3,
        )
        self._close(address, self._sinks.pop(address))

    def _close(self, address: str, sink: LiveSink) -> None:
        try:
            sink.close()
        except Exception as error:  # of the user's code: any
            warnings.warn(
                f"{address} could not be closed ({type(error).__name__}: {error})",
                HandSimWarning,
                stacklevel=3,
            )
