"""Live streams of points: addresses `scheme://host:port?option=value`, and the settings of a replay."""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final
from urllib.parse import parse_qsl, urlsplit

from handsim.errors import ArgumentError, CaptureError, choices
from handsim.settings import Limits, Settings

LOOPBACK: Final = "127.0.0.1"
COMMAND_PORT: Final = 1510
"""NatNet's port for commands."""


class NoServerError(CaptureError):
    """No server answers at an address; it may be started later."""


@dataclass(frozen=True, slots=True)
class ReplaySettings(Settings):
    """How a capture is played: keyword arguments of `ReplayServer`, and options of `handsim replay`."""

    loop: bool = False
    """Start again at the end, with later numbers and times, and with points of new IDs."""
    rate: Annotated[float | None, Limits(0.0, above=True)] = None
    """Frames per second [Hz]; the capture's own when not given."""
    host: str = LOOPBACK
    """Address of this machine to listen at; the default cannot be reached from other machines."""
    port: Annotated[int, Limits(0, 65535)] = 0
    """UDP port to listen at; 0 takes a free one."""


def split_address(
    address: str, *, options: Mapping[str, Sequence[str]], port: int | None = None, any_port: bool = False
) -> tuple[str, int, Mapping[str, str]]:
    """Split `scheme://host:port?option=value` into host, port and options.

    An address without a host means this machine.

    Args:
        options: The valid values of each option, the default first.
        port: The default port; if None, the address must name one.
        any_port: Whether port 0 is allowed, for any free port.
    """
    scheme = address.partition("://")[0]
    try:
        parts = urlsplit(address)
        given = dict(parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query)))
        host, number = parts.hostname or LOOPBACK, port if parts.port is None else parts.port
    except ValueError:
        number = None
    if number is None or parts.path not in ("", "/") or parts.fragment or parts.username is not None:
        suffix = "" if port is None else f" or {scheme}://host"
        suffix += f" without '{parts.path}'" if number is not None and parts.path else ""
        raise ArgumentError(f"'{address}' is not an address, expected {scheme}://host:port{suffix}")
    if number == 0 and not any_port:
        raise ArgumentError(f"'{address}' is not an address, expected a port from 1 to 65535")
    for name, value in given.items():
        if name not in options:
            nothing = f"unknown option '{name}', there are none"
            raise ArgumentError(f"{address}: {choices(name, options, noun='option') if options else nothing}")
        if value not in options[name]:
            raise ArgumentError(f"{address}: {choices(value, options[name], noun=name)}")
    return host, number, {name: given.get(name, valid[0]) for name, valid in options.items()}


def find_host(url: str, host: str, family: int = 0) -> str:
    """The numeric address of a stream's host."""
    try:
        return str(socket.getaddrinfo(host, None, family)[0][4][0])
    except (OSError, UnicodeError) as error:
        raise CaptureError(
            f"{url}: '{host}' cannot be reached ({getattr(error, 'strerror', None) or error}), expected the "
            "name or address of the camera system's machine, such as 192.168.1.5"
        ) from error
