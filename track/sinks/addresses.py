"""Opens the sinks that addresses name: `osc://host:port`, `ws://:8765`, `lsl:NAME`, `module:name`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, Final

from handsim._plugins import is_plugin, list_plugins, make_plugin
from handsim.errors import ArgumentError
from track.network_address import split_address
from track.sinks.datagrams import document_sink, osc_sink
from track.sinks.documents import FORMATS, encoder_of
from track.sinks.lab_streaming import LabStreamingSink
from track.sinks.message import LiveSink
from track.sinks.sink_group import SinkGroup
from track.sinks.websocket import WebSocketSink

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


def open_sinks(addresses: Sequence[str]) -> SinkGroup:
    """Open a sink for each address, which gets positions in [m] and angles in [rad].

    Args:
        addresses: Each as in `VALID`; `udp://` and `ws://` take `?format=json`, `?format=msgpack` and
            `?points=yes`.

    Raises:
        ArgumentError: An address is invalid or is given twice, a package is missing, or a port is taken.
    """
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
    """Open the sink that an address names, see `open_sinks`.

    Raises:
        ArgumentError: The address is invalid, a package is missing, or a port is taken.
    """
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
