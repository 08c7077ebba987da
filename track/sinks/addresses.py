"""The sinks that addresses name: `osc://host:port`, `ws://:8765`, `lsl:NAME`, `module:name`.

A frame goes to each of them, and none that fails stops the tracker.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, Final

from gloves.fit import GloveFit
from handsim._checks import check_type
from handsim._plugins import is_plugin, list_plugins, make_plugin
from handsim.callbacks import Closing
from handsim.errors import ArgumentError, HandSimWarning
from track.bodies.rigid_body import RigidTemplate
from track.frames import TrackedFrame
from track.network_address import split_address
from track.sinks.datagrams import document_sink, osc_sink
from track.sinks.documents import FORMATS, encoder_of
from track.sinks.lab_streaming import LabStreamingSink
from track.sinks.message import LiveSink, MessageEncoder
from track.sinks.websocket import WebSocketSink
from track.streams.frame_source import StreamedFrame

VALID: Final = (
    "osc://host:port",
    "udp://host:port",
    "ws://host:port",
    "lsl:NAME",
    "module:name",
)
"""What an address may be."""
GROUP: Final = "handsim.sinks"
"""Entry points of packages that bring sinks."""
_DOCUMENTS: Final = {"format": FORMATS, "points": ("no", "yes")}


class SinkGroup(Closing):
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
                warnings.warn(
                    f"{address} failed and gets no further frame ({type(error).__name__}: {error})",
                    HandSimWarning,
                    stacklevel=3,
                )
                self._close(address, self._sinks.pop(address))

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

    def _close(self, address: str, sink: LiveSink) -> None:
        try:
            sink.close()
        except Exception as error:  # of the user's code: any
            warnings.warn(
                f"{address} could not be closed ({type(error).__name__}: {error})",
                HandSimWarning,
                stacklevel=3,
            )


def open_sinks(addresses: str | Sequence[str]) -> SinkGroup:
    """Open a sink for each address, which gets positions in [m] and angles in [rad].

    Args:
        addresses: One, or several, each as in `VALID`; `udp://` and `ws://` take `?format=json`,
            `?format=msgpack` and `?points=yes`.

    Raises:
        ArgumentError: An address is invalid or is given twice, a package is missing, or a port is taken.
    """
    addresses = (addresses,) if isinstance(addresses, str) else addresses
    check_type("addresses", addresses, Sequence, f"a list of {', '.join(VALID)}")
    sinks: dict[str, LiveSink] = {}
    with ExitStack() as stack:
        for address in addresses:
            if address in sinks:
                raise ArgumentError(f"--send {address} is given twice, expected once")
            sinks[address] = open_sink(address)
            stack.callback(sinks[address].close)
        stack.pop_all()
    return SinkGroup(sinks)


def open_sink(address: str) -> LiveSink:
    """Open the sink that an address names, see `open_sinks`."""
    scheme, _, rest = address.partition(":")
    if scheme in _NETWORK and rest.startswith("//"):
        return _NETWORK[scheme](address)
    if scheme == "lsl" and rest and not rest.startswith("//"):
        return LabStreamingSink(rest)
    name = address.partition("?")[0]
    if not (is_plugin(name) or name in list_plugins(GROUP)):
        raise ArgumentError(f"'{address}' is not an address to send to, expected {', '.join(VALID)}")
    sink: Any = make_plugin(address, group=GROUP, noun="sink")
    for method in ("send", "close"):
        if not callable(getattr(sink, method, None)):
            raise ArgumentError(
                f"{address} has no method {method}, expected the methods send and close of a sink"
            )
    made: LiveSink = sink
    return made


def _osc(address: str) -> LiveSink:
    parts = split_address(address, options={})
    return osc_sink(parts.host, _receiver(address, parts.port))


def _udp(address: str) -> LiveSink:
    parts = split_address(address, options=_DOCUMENTS)
    encode, points = encoder_of(parts.options["format"]), parts.options["points"] == "yes"
    return document_sink(parts.host, _receiver(address, parts.port), encode, points=points)


def _websocket(address: str) -> LiveSink:
    parts = split_address(address, options=_DOCUMENTS)
    kind = parts.options["format"]
    encode, points = encoder_of(kind), parts.options["points"] == "yes"
    return WebSocketSink(parts.host, parts.port, encode, text=kind == "json", points=points)


def _receiver(address: str, port: int) -> int:
    if port == 0:
        raise ArgumentError(f"'{address}' is not an address, expected a port from 1 to 65535")
    return port


_NETWORK: Final[dict[str, Callable[[str], LiveSink]]] = {"osc": _osc, "udp": _udp, "ws": _websocket}
