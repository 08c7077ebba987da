"""The web server of the viewer: on this machine's own address, without a tunnel to the outside."""

from __future__ import annotations

import contextlib
import io
import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from handsim.errors import ArgumentError, HandSimError

if TYPE_CHECKING:
    from viser import ViserServer

"""The address that only this machine reaches."""
_HINT: Final = "install it with: pip install 'handsim[view]'"
_DARK_OR_LIGHT: Final = """<!doctype html><html><script>
location.replace("/?" + (matchMedia("(prefers-color-scheme: dark)").matches ? "darkMode" : "light"))
</script></html>
"""
"""What `/` answers: only a browser knows whether it is dark, and viser reads that from the address."""
_PORTS: Final = range(8080, 8100)
"""Ports that are tried in this order where none is named."""


@contextmanager
def opened_server(host: str, port: int | None, title: str) -> Iterator[ViserServer]:
    """A running web server; the end of the block closes it and its pages.

    Args:
        port: Port to listen at; the first free one from 8080 on when None, any free one when 0.
        title: Title of the page's panel.

    Raises:
        HandSimError: The package viser is not installed.
        ArgumentError: There is no such address here, or the port is taken or not allowed.
    """
    try:
        import viser
    except ImportError as error:
        raise HandSimError(f"the viewer needs the package viser; {_HINT}") from error

    class Server(viser.ViserServer):
        """A server that never opens viser's public tunnel: any page could ask for it."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    free = _free_port(host, port)
    with contextlib.redirect_stdout(io.StringIO()), _guarded(host):  # viser prints a panel of its own
        server = Server(host=host, port=free, label=title, verbose=False)
    try:
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def address_of(server: ViserServer) -> str:
    """The address of the page, for a browser on this machine."""
    host = server.get_host()
    if host in ("0.0.0.0", "::"):
        host = "localhost"
    return f"http://[{host}]:{server.get_port()}" if ":" in host else f"http://{host}:{server.get_port()}"


def is_own_page(origin: str | None, asked: str | None, host: str) -> bool:
    """Whether a connection comes from the page itself, or from a program that is no browser.

    A browser tells which page opens a connection, and any page may open one to this machine. A page that has
    a name of its own for this machine's address (DNS rebinding) gives that name twice, so at a loopback
    address only names of loopback count.

    Args:
        origin: The header Origin, such as `http://127.0.0.1:8080`; None from what is no browser.
        asked: The header Host, such as `127.0.0.1:8080`.
        host: Address that the server listens at.
    """
    if origin is None:
        return True
    parts = urlsplit(origin)
    if asked is None or parts.netloc.lower() != asked.lower():
        return False
    return not _is_loopback(host) or _is_loopback(parts.hostname or "")


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@contextmanager
def _guarded(host: str) -> Iterator[None]:
    """Servers of websockets that are started in the block refuse other pages, and follow a dark browser.

    viser passes nothing on that could do this.
    """
    import websockets.asyncio.server as websockets_server
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    serve = websockets_server.serve

    def guarded(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: ServerConnection, request: Request) -> Response | None:
            headers = request.headers
            if not is_own_page(headers.get("Origin"), headers.get("Host"), host):
                return connection.respond(HTTPStatus.FORBIDDEN, "another page's connection is refused\n")
            if request.path == "/" and headers.get("Upgrade") != "websocket":
                page = connection.respond(HTTPStatus.OK, _DARK_OR_LIGHT)
                del page.headers["Content-Type"]  # plain text; assigning would add a second one
                page.headers["Content-Type"] = "text/html; charset=utf-8"
                return page
            answer: Response | None = process_request(connection, request)
            return answer

        return serve(*arguments, process_request=process, **options)

    websockets_server.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets_server.serve = serve  # type: ignore[misc]


def _free_port(host: str, port: int | None) -> int:
    """A port that can be listened at; viser itself would search on without a word."""
    if port is not None and not 0 <= port <= 65535:
        raise ArgumentError(f"--port is {port}, expected 0 to 65535")
    reason = ""
    for number in _PORTS if port is None else (port,):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            with socket.create_server((host, number), family=family) as probe:
                return int(probe.getsockname()[1])
        except OSError as error:
            reason = error.strerror or str(error)
    named = f"--host {host}" if port is None else f"--host {host} --port {port}"
    raise ArgumentError(f"{named} cannot be listened at ({reason}), expected an own address and a free port")
