"""The command `handsim replay`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
import tyro

from handsim._checks import check_count
from handsim.app.messages import LiveStatus, print_line
from handsim.errors import ArgumentError
from handsim.files.signals import interrupt_flag
from track.streams import LOOPBACK
from track.streams.natnet import COMMAND_PORT

if TYPE_CHECKING:
    from track.streams.natnet_server import ReplayServer

_LOOK: Final = 0.1  # [s] between two looks at whether it shall end
_MOST_PORT: Final = 65535


def replay(
    capture: Annotated[Path, tyro.conf.Positional],
    *,
    loop: bool = False,
    rate: float | None = None,
    host: str = LOOPBACK,
    port: int = COMMAND_PORT,
) -> None:
    """Play a capture as a NatNet server, for handsim track --live; Ctrl-C ends it.

    It plays while a client listens, and waits without one. After the last frame it ends.

    Args:
        capture: A .trc, .c3d, .csv or .tsv file, whose names are not sent, or a take (.npz), of which only
            points and IDs are sent.
        loop: Start again at the end.
        rate: Frames per second [Hz]; the capture's own when not given.
        host: Address of this machine to listen at; other machines do not reach the default.
        port: Port to listen at; 0 takes a free one.
    """
    from track.streams.natnet_server import ReplayServer

    if rate is not None and not 0.0 < rate < np.inf:
        raise ArgumentError(f"--rate is {rate:g}, expected a positive number")
    check_count("--port", port, 0, _MOST_PORT)
    with (
        ReplayServer(capture, rate=rate, host=host, port=port, loop=loop) as server,
        interrupt_flag() as ended,
    ):
        print_line(f"{capture}: {server.num_frames} frames at {server.rate:g} Hz on {server.url}")
        with LiveStatus() as status:
            while not (ended() or server.finished):
                status.show(_status_line(server))
                time.sleep(_LOOK)
        print_line(f"{server.sent} frames played")


def _status_line(server: ReplayServer) -> str:
    if not server.num_clients:
        return f"waiting for a client at frame {server.sent}; Ctrl-C ends it"
    played, frame = divmod(server.sent, server.num_frames)
    word = "client" if server.num_clients == 1 else "clients"
    again = f", round {played + 1}" if played else ""
    return f"frame {frame} of {server.num_frames}{again}, {server.num_clients} {word}; Ctrl-C ends it"
