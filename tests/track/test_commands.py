"""`handsim track` through the command line, on captures and on a live stream."""

from __future__ import annotations

import functools
import json
import os
import signal
import threading
import time

import numpy as np
import pytest
import torch

from gloves.captures import read_capture
from gloves.take import load_take
from gloves.tracked_take import LOST, load_tracked_take
from handsim.cli import main
from track.natnet_server import ReplayServer
from track.streaming import open_stream

FRAMES = 60


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    out = tmp_path_factory.mktemp("take") / "take.c3d"
    assert (
        main(["simulate", "--kind", "hand-controller", "--num-frames", str(FRAMES), "--out", str(out)]) == 0
    )
    return out


def test_a_capture_becomes_a_take_and_is_told_of(capture, tmp_path, capsys):
    out, labelled = tmp_path / "new" / "tracked.npz", tmp_path / "labelled.trc"
    assert main(["track", str(capture), "--out", str(out), "--labelled", str(labelled), "--size", "L"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{out}: {FRAMES} frames, 0.5 s at 120 Hz"
    assert lines[1].startswith("right hand: tracked 98.3 %, found 1.7 %, coasting 0.0 %, lost 0.0 %; median")
    assert lines[2].startswith("left hand: ") and " mm, " in lines[2]
    assert lines[3].endswith("points are no markers") and lines[4].endswith(" ms a frame")
    take, truth = load_tracked_take(out), load_take(capture.with_suffix(".truth.npz"))
    assert take.sides == ("right", "left")
    assert take.settings["capture"] == "take.c3d" and take.settings["size"] == "L"
    json.dumps(take.settings)
    true = np.where(truth.labels < 38, truth.labels, -1)
    assert np.mean(take.labels == true) > 0.95
    columns = read_capture(labelled)
    assert columns.names[:38] == take.label_names
    seen = columns.positions[:, :19]
    np.testing.assert_allclose(seen, take.observed("right"), atol=1e-6)
    unlabelled = np.isfinite(columns.positions[:, 38:, 0]).sum()
    assert f"{unlabelled} of " in lines[3]


def test_the_same_command_writes_the_same_bytes(capture, tmp_path):
    for name in ("one.npz", "two.npz"):
        assert main(["track", str(capture), "--out", str(tmp_path / name), "--hands", "right"]) == 0
    take = load_tracked_take(tmp_path / "one.npz")
    assert take.sides == ("right",) and (take.status != LOST).all()
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


def test_a_stream_is_tracked_for_some_seconds(capture, tmp_path, capsys):
    out = tmp_path / "live.npz"
    with ReplayServer.of_take(load_take(capture.with_suffix(".truth.npz"))) as server:
        assert main(["track", "--live", server.url, "--seconds", "0.3", "--out", str(out)]) == 0
    take = load_tracked_take(out)
    assert take.num_frames == 37 and take.rate == pytest.approx(120.0, rel=1e-3)
    assert take.settings["capture"] == server.url
    assert (take.status[-1] != LOST).all()
    assert "right hand: tracked" in capsys.readouterr().out


def test_an_interrupt_writes_what_there_is(capture, tmp_path):
    out = tmp_path / "live.npz"
    with ReplayServer.of_take(load_take(capture.with_suffix(".truth.npz"))) as server:

        def interrupt() -> None:
            while not server._clients:
                time.sleep(0.01)
            time.sleep(0.3)
            os.kill(os.getpid(), signal.SIGINT)

        thread = threading.Thread(target=interrupt, daemon=True)
        thread.start()
        assert main(["track", "--live", server.url, "--out", str(out)]) == 0
        thread.join()
    assert 2 <= load_tracked_take(out).num_frames <= FRAMES


def test_a_stream_without_frames_is_told(capture, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("track.commands.open_stream", functools.partial(open_stream, silence=0.2))
    take = load_take(capture.with_suffix(".truth.npz"))
    with ReplayServer(take.points[:1], take.ids[:1], 120.0) as server:
        arguments = ["track", "--live", server.url, "--seconds", "0.5", "--out", str(tmp_path / "live.npz")]
        assert main(arguments) == 1
    assert "1 frames came, wanted two or more" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
