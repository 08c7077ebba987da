"""Web server of the viewer, which listens on this machine's own address and opens no public tunnel."""

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

from handsim._plugins import import_extra
from handsim.errors import ArgumentError

if TYPE_CHECKING:
    from viser import ViserServer

# The page at `/` forwards to viser's dark or light address, because only the browser knows its theme.
_DARK_OR_LIGHT: Final = """<!doctype html><html><script>
location.replace("/?" + (matchMedia("(prefers-color-scheme: dark)").matches ? "darkMode" : "light"))
</script></html>
"""
_PORTS: Final = range(8080, 8100)  # tried in this order when --port is not given


@contextmanager
def opened_server(host: str, port: int | None, title: str) -> Iterator[ViserServer]:
    """Run a web server in the block; port None selects the first free port from 8080 on, 0 any free one."""
    import_extra("viser", "the viewer", "view")
    import viser

    class Server(viser.ViserServer):
        """A server that never opens viser's public tunnel, which any page could request."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    free = _free_port(host, port)
    with contextlib.redirect_stdout(io.StringIO()), _guarded(host):  # hide viser's own messages
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
    host = "localhost" if server.get_host() in ("0.0.0.0", "::") else server.get_host()
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def is_own_page(origin: str | None, asked: str | None, host: str) -> bool:
    """Whether a connection with these Origin and Host (`asked`) headers is from our page or no browser.

    Any page may connect to this machine; browsers send the page's origin, other programs send none.
    """
    if origin is None:
        return True
    parts = urlsplit(origin)
    if asked is None or parts.netloc.lower() != asked.lower():
        return False
    # With DNS rebinding both headers hold a foreign page's own name for us, which is no loopback name.
    return not _is_loopback(host) or _is_loopback(parts.hostname or "")


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@contextmanager
def _guarded(host: str) -> Iterator[None]:
    """Make websockets servers started in the block refuse other pages, for which viser has no option."""
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
    """The port to listen at; viser itself would silently replace a given one that is taken."""
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
