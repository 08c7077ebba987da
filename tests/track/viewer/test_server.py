"""The page is served to this machine alone, and never through a tunnel."""

from __future__ import annotations

import socket
import sys
import urllib.request

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from handsim import HandSimError
from handsim.errors import ArgumentError
from tests.sentences import error_names
from track.streams import LOOPBACK
from track.viewer import address_of, is_own_page, opened_server


def test_the_page_is_served_here_until_the_end(capsys):
    with opened_server(LOOPBACK, 0, "title") as server:
        address = address_of(server)
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address) as choice:
            assert choice.headers.get_all("Content-Type") == ["text/html; charset=utf-8"]
            assert b'"darkMode" : "light"' in choice.read(), "the browser knows"
        for asked in ("darkMode", "light"):
            assert b"viser" in urllib.request.urlopen(f"{address}/?{asked}").read().lower()
    with pytest.raises(OSError):
        urllib.request.urlopen(address, timeout=2.0)
    assert capsys.readouterr().out == ""


def test_no_page_can_ask_for_a_public_address(server, page_of):
    page = page_of(server)
    page.send("ShareUrlRequest")
    page.settle()
    assert server.request_share_url() is None
    assert page.counts["ShareUrlUpdated"] == 0


def test_only_the_own_page_is_connected():
    with opened_server(LOOPBACK, 0, "title") as server:
        port = server.get_port()
        address, protocol = f"ws://127.0.0.1:{port}", [f"viser-v{viser.__version__}"]
        for origin in (None, f"http://127.0.0.1:{port}"):
            connect(address, subprotocols=protocol, origin=origin).close()
        connect(f"ws://localhost:{port}", subprotocols=protocol, origin=f"http://localhost:{port}").close()
        for origin in ("http://example.com", "null", f"http://localhost:{port}", "http://127.0.0.1:1"):
            with pytest.raises(InvalidStatus) as caught:
                connect(address, subprotocols=protocol, origin=origin)
            assert caught.value.response.status_code == 403, origin


def test_a_name_for_this_machine_that_a_page_brings_is_no_own_page():
    rebound = ("http://example.com:8080", "example.com:8080")
    assert not is_own_page(*rebound, "127.0.0.1") and not is_own_page(*rebound, "localhost")
    assert is_own_page(*rebound, "0.0.0.0"), "there the machine has names that nobody here knows"
    assert is_own_page("http://[::1]:8080", "[::1]:8080", "::1")
    assert is_own_page("https://Lab.example", "lab.example", "0.0.0.0"), "behind a proxy with encryption"
    assert not is_own_page("http://127.0.0.1:8080", None, "127.0.0.1")


def test_a_port_that_is_taken_or_none_is_told():
    with socket.create_server((LOOPBACK, 0)) as other:
        port = other.getsockname()[1]
        with error_names(ArgumentError, f"--port {port} cannot be listened at | own address and a free"):
            opened_server(LOOPBACK, port, "").__enter__()
    with pytest.raises(ArgumentError, match=r"--host 192\.0\.2\.1 cannot be listened at"):
        opened_server("192.0.2.1", None, "").__enter__()


def test_without_viser_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(HandSimError, match=r"pip install 'handsim\[view\]'"):
        opened_server(LOOPBACK, 0, "").__enter__()
