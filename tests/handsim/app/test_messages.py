"""One line of status: it fits into a terminal, and a log gets one now and then."""

from __future__ import annotations

import fcntl
import io
import os
import select
import struct
import sys
import termios

import pytest

from handsim.app import messages
from handsim.app.messages import LiveStatus

LINE = "frame 1234: right tracked, left tracked, controller tracked, 12 missing; Ctrl-C ends it"


@pytest.mark.parametrize("columns", [20, 200])
def test_a_terminal_shows_what_fits_into_its_line(columns, monkeypatch):
    reader, writer = os.openpty()
    fcntl.ioctl(writer, termios.TIOCSWINSZ, struct.pack("4H", 24, columns, 0, 0))
    with os.fdopen(writer, "w") as terminal, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", terminal)
        with LiveStatus() as status:
            status.say("recording")
            status.show(LINE)
            assert not status.due
            status.show("not yet")
        shown = b""
        while select.select([reader], [], [], 0.2)[0]:
            shown += os.read(reader, 10_000)
    os.close(reader)
    assert shown.decode() == f"recording\r\n\r{LINE[: columns - 1]}\x1b[K\r\x1b[K"


def test_a_log_gets_a_line_every_ten_seconds(monkeypatch, capsys):
    now = [50.0]
    monkeypatch.setattr(messages.time, "monotonic", lambda: now[0])
    with LiveStatus() as status:
        for _ in range(200):
            status.show(f"{now[0]:.1f}")
            now[0] += 0.125
        status.show("writing", now=True)
    assert capsys.readouterr().err == "50.0\n60.0\n70.0\nwriting\n"


def test_a_terminal_that_is_gone_ends_nothing(monkeypatch):
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(5, "Input/output error")

    monkeypatch.setattr(sys, "stderr", Gone())
    with LiveStatus() as status:
        status.say("recording")
        status.show("frame 1")
