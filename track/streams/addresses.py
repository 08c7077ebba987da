"""Opens the stream that an address names: `natnet://host`, `qtm://host`, `module:name`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, Protocol

from handsim._plugins import is_plugin, list_plugins, make_plugin
from handsim.errors import ArgumentError
from track.network_address import split_address
from track.streams.frame_source import SILENCE, FrameSource, StreamedFrame
from track.streams.point_stream import open_stream
from track.streams.qualisys import PORT, QualisysSource
from track.streams.source_stream import SourceStream

VALID: Final = ("natnet://host", "natnet://host:port", "qtm://host", "qtm://host:port", "module:name")
"""What an address may be."""
GROUP: Final = "handsim.frame_sources"
"""Entry points of packages that bring frame sources."""


class LiveStream(Protocol):
    """The frames of a stream, with silences; it ends by itself when it shall end."""

    @property
    def counts(self) -> dict[str, int]:
        """What became of the frames so far, by name."""
        ...

    def __iter__(self) -> Iterator[StreamedFrame]:
        """The stream itself."""
        ...

    def __next__(self) -> StreamedFrame:
        """Wait for the next frame; after each period of silence a silent frame."""
        ...

    def close(self) -> None:
        """End the stream."""
        ...


def open_source(
    address: str, *, silence: float = SILENCE, ended: Callable[[], bool] = lambda: False
) -> LiveStream:
    """Open a stream.

    Args:
        address: As in `VALID`; `module:name?option=value` gives options to a source of the user's own.
        silence: Time without a frame after which the stream yields a silent frame [s].
        ended: The stream ends when this is true; it is asked several times a second.

    Raises:
        ArgumentError: The address is invalid, or there is no such source.
        CaptureError: No server answers.
    """
    scheme = address.partition("://")[0] if "://" in address else ""
    if scheme == "natnet":
        return open_stream(address, silence=silence, ended=ended)
    if scheme == "qtm":
        parts = split_address(address, options={}, port=PORT)
        return _read(QualisysSource(parts.host, parts.port), address, silence, ended)
    name = address.partition("?")[0]
    if scheme or not (is_plugin(name) or name in list_plugins(GROUP)):
        raise ArgumentError(f"'{address}' is not an address of a stream, expected {', '.join(VALID)}")
    return _read(make_plugin(address, group=GROUP, noun="frame source"), name, silence, ended)


def _read(source: FrameSource, name: str, silence: float, ended: Callable[[], bool]) -> SourceStream:
    return SourceStream(source, name, silence=silence, ended=ended)
