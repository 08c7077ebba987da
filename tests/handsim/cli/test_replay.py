"""`handsim replay`: a capture becomes a live stream that `handsim track` reads."""

from __future__ import annotations

import functools
import re
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack

import numpy as np
import pytest

from gloves import load_take
from handsim.cli.main import main
from tests.waiting import LONG
from track import LiveStream
from track.streams import LOOPBACK
from track.streams.natnet import open_stream

RUN = "import sys; from handsim.cli.main import main; sys.exit(main(sys.argv[1:]))"
FRAMES = 60


@pytest.fixture
def replay():
    """The command in a process of its own, ended with the test."""
    with ExitStack() as stack:
        yield functools.partial(_replay, stack)


def _replay(stack, path, *options):
    """The command in a process of its own, and the address of its server."""
    command = [sys.executable, "-u", "-c", RUN, "replay", str(path), "--port", "0", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    stack.callback(process.kill)
    assert process.stdout is not None
    told = process.stdout.readline()
    url = re.search(r"natnet://\S+", told)
    assert url, process.communicate()
    return process, told, url[0]


@pytest.mark.parametrize("ending", [".c3d", ".truth.npz"])
def test_a_capture_is_tracked_as_a_stream(capture, ending, tmp_path, replay):
    process, told, url = replay(capture.with_name("take" + ending))
    assert f"{FRAMES} frames at 120 Hz on {url}" in told
    out = tmp_path / "live.npz"
    assert main(["track", "--live", url, "--size", "M", "--seconds", "0.3", "--out", str(out)]) == 0
    process.terminate()  # it may have played the last frame already
    process.communicate(timeout=LONG)
    take, truth = load_take(out), load_take(capture.with_name("take.truth.npz"))
    for numbers, points in zip(take.numbers, take.points, strict=True):
        true = truth.points[numbers]
        seen = true[np.isfinite(true[:, 0])]
        got = points[np.isfinite(points[:, 0])]
        nearest = np.linalg.norm(got[:, None] - seen, axis=2).min(axis=1)
        assert len(got) == len(seen) and nearest.max() < 1e-5


def test_a_loop_goes_on_with_new_numbers_and_ids(capture, replay):
    process, _, url = replay(capture, "--loop", "--rate", "600")
    stream = LiveStream(open_stream(url))
    frames = [next(stream) for _ in range(3 * FRAMES)]
    stream.close()
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=LONG)
    assert process.returncode == 0 and re.search(r"\d+ frames played", out)
    numbers = np.array([frame.number for frame in frames])
    assert (np.diff(numbers) >= 1).all() and numbers[-1] >= 2 * FRAMES
    times = np.array([frame.time for frame in frames])
    np.testing.assert_allclose(times, numbers / 600.0, atol=1e-6)
    rounds = numbers // FRAMES
    of = {
        one: {i for frame, n in zip(frames, rounds, strict=True) if n == one for i in frame.ids}
        for one in (0, 1)
    }
    assert of[0] and of[1] and not of[0] & of[1]


def test_it_waits_for_a_client_until_it_is_ended(capture, replay):
    process, _, _ = replay(capture)
    assert process.stderr is not None
    assert "waiting for a client at frame 0" in process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=LONG)
    assert process.returncode == 0 and "0 frames played" in out


def test_a_port_that_is_taken_is_one_sentence(capture, capsys):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind((LOOPBACK, 0))
        port = one.getsockname()[1]
        assert main(["replay", str(capture), "--port", str(port)]) == 1
    told = capsys.readouterr().err
    assert f"port {port} cannot be listened at on 127.0.0.1" in told and len(told.strip().splitlines()) == 1
