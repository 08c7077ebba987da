"""Opens the stream that an address names: `natnet://host`, `qtm://host`, `module:name`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from handsim._checks import check_type
from handsim._plugins import is_plugin, list_plugins, make_plugin
from handsim.errors import ArgumentError
from track.streams import split_address
from track.streams.live_stream import SILENCE, LiveStream, SourceStream
from track.streams.point_stream import open_stream
from track.streams.qualisys import PORT, QualisysSource

VALID: Final = ("natnet://host", "natnet://host:port", "qtm://host", "qtm://host:port", "module:name")
"""What an address may be."""
GROUP: Final = "handsim.frame_sources"
"""Entry points of packages that bring frame sources."""


def check_address(address: str) -> None:
    """Refuse by an `ArgumentError` what is not an address of a stream; nothing is asked for it."""
    check_type("address", address, str, f"one of {', '.join(VALID)}")
    scheme, _, rest = address.rpartition("://")
    name = rest.partition("?")[0]
    if scheme not in ("natnet", "qtm") and (scheme or not (is_plugin(name) or name in list_plugins(GROUP))):
        raise ArgumentError(f"'{address}' is not an address of a stream, expected {', '.join(VALID)}")


def open_source(
    address: str, *, silence: float = SILENCE, ended: Callable[[], bool] = lambda: False
) -> LiveStream:
    """Open a live stream, the frames of which are iterated in a `with` block.

    A frame has `points` (N, 3) [m], `ids` (N,) and a `time` [s] that never goes back, as `Tracker.step` takes
    them. Frames that are not kept up with are dropped, oldest first, see `LiveStream`.

    Args:
        address: As in `VALID`; `module:name?option=value` gives options to a source of the user's own.
        silence: Time without a frame after which the stream yields a silent frame [s].
        ended: The stream ends when this is true; it is asked before each frame, and several times a second
            while none comes.

    Raises:
        ArgumentError: The address is invalid, or there is no such source.
        CaptureError: No server answers.
    """
    check_address(address)
    if address.startswith("natnet://"):
        return LiveStream(open_stream(address), silence=silence, ended=ended)
    if address.startswith("qtm://"):
        parts = split_address(address, options={}, port=PORT)
        source = SourceStream(QualisysSource(parts.host, parts.port), address, waits=False)
        return LiveStream(source, silence=silence, ended=ended)
    source = SourceStream(make_plugin(address, group=GROUP, noun="frame source"), address.partition("?")[0])
    return LiveStream(source, silence=silence, ended=ended)
