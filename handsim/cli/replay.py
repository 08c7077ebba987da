"""The command `handsim replay`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import tyro

from handsim.app.messages import LiveStatus, print_line
from handsim.files.signals import interrupt_flag
from track.streams import COMMAND_PORT, ReplaySettings

if TYPE_CHECKING:
    from track.streams.natnet import ReplayServer

_DEFAULT_SETTINGS: Final = ReplaySettings(port=COMMAND_PORT)


def replay(
    capture: Annotated[Path, tyro.conf.Positional],
    settings: Annotated[ReplaySettings, tyro.conf.arg(name="")] = _DEFAULT_SETTINGS,
) -> None:
    """Play a capture as a NatNet server, for handsim track --live; Ctrl-C ends it.

    It plays while a client listens, and waits without one. After the last frame it ends.

    Args:
        capture: A .trc, .c3d, .csv or .tsv file, whose names are not sent, or a take (.npz), of which only
            points and IDs are sent.
        settings: How to play it.
    """
    from track.streams.natnet import ReplayServer

    with ReplayServer(capture, settings) as server, interrupt_flag() as ended:
        print_line(f"{capture}: {server.num_frames} frames at {server.rate:g} Hz on {server.url}")
        with LiveStatus() as status:
            while not (ended() or server.finished):
                status.show(_status_line(server))
                time.sleep(0.1)
        print_line(f"{server.sent} frames played")


def _status_line(server: ReplayServer) -> str:
    if not server.num_clients:
        return f"waiting for a client at frame {server.sent}; Ctrl-C ends it"
    played, frame = divmod(server.sent, server.num_frames)
    word = "client" if server.num_clients == 1 else "clients"
    again = f", round {played + 1}" if played else ""
    return f"frame {frame} of {server.num_frames}{again}, {server.num_clients} {word}; Ctrl-C ends it"
