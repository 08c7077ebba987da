"""`handsim view` through the command line, on files and on a live stream."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import urllib.request

import cv2
import numpy as np
import pytest

from gloves import load_take
from handsim.app import messages
from handsim.cli.main import main
from tests.limits import file_size_limit
from tests.waiting import signal_once
from track import ReplayServer
from track.viewer.recordings import chosen_frames
from track.viewer.timeline import LiveView

FRAMES = 60


def test_a_file_is_served_until_ctrl_c(capture, capfd):
    said: list[str] = []
    pages: list[bytes] = []

    def served() -> bool:
        said.append(capfd.readouterr().out)
        found = re.search(r"http://\S+", "".join(said))
        if found is None:
            return False
        pages.append(urllib.request.urlopen(found[0]).read())
        return True

    thread = signal_once(served)
    assert main(["view", str(capture), "--port", "0"]) == 0
    thread.join()
    assert "".join(said).startswith(f"{capture} (capture): http://127.0.0.1:")
    assert b"<html" in pages[0]


def test_a_live_tracker_is_shown_and_recorded_and_frames_are_never_dropped(
    capture, tmp_path, capsys, monkeypatch
):
    shown: list[LiveView] = []
    offered: list[int] = []
    plain = LiveView.send

    def send(self, frame, tracked):
        shown.append(self)
        if not frame.silent:
            offered.append(frame.number)
        plain(self, frame, tracked)

    monkeypatch.setattr(LiveView, "send", send)
    with ReplayServer(capture.with_suffix(".truth.npz"), loop=True) as server:
        thread = signal_once(lambda: len(offered) > 60 and shown[-1].pictures > 5)
        out = tmp_path / "take.npz"
        assert main(["view", "--live", server.url, "--size", "L", "--port", "0", "--out", str(out)]) == 0
        thread.join()
    assert offered == sorted(set(offered)), "a slow machine drops frames, and no frame comes twice"
    said = capsys.readouterr().out
    told = re.search(r"(\d+) frames tracked, (\d+) of them", said)
    frames, pictures = map(int, told.groups())
    assert frames == len(offered) and 5 < pictures < frames
    take = load_take(out)
    assert list(take.numbers) == offered and f"{out}: {frames} frames" in said
    assert take.settings["stream"]["missing_frames"] == 0


@pytest.mark.parametrize("fault", [signal.SIGTERM, signal.SIGHUP, "full disk"])
def test_a_live_view_ends_by_any_signal_and_goes_on_without_its_recording(
    fault, capture, tmp_path, capsys, monkeypatch
):
    frames, said, plain, say = [], [], LiveView.send, messages.LiveStatus.say

    def send(self, frame, tracked):
        frames.append(frame.number)
        plain(self, frame, tracked)

    def is_enough() -> bool:
        ended = next((count for line, count in said if "tracking goes on" in line), None)
        return len(frames) > 60 and (fault != "full disk" or (ended is not None and len(frames) > ended + 30))

    monkeypatch.setattr(LiveView, "send", send)
    monkeypatch.setattr(
        messages.LiveStatus, "say", lambda status, line: (said.append((line, len(frames))), say(status, line))
    )
    number, limit = fault, contextlib.nullcontext()
    if fault == "full disk":
        number, limit = signal.SIGINT, file_size_limit(300_000)
    out = tmp_path / "take.npz"
    with ReplayServer(capture.with_suffix(".truth.npz"), loop=True) as server, limit:
        thread = signal_once(is_enough, number)
        code = main(["view", "--live", server.url, "--size", "L", "--port", "0", "--out", str(out)])
        thread.join()
    assert code == (fault == "full disk")
    assert os.listdir(tmp_path) == [f"take.npz{'.part' * code}"]
    if code:
        assert "frames after them were not recorded" in capsys.readouterr().err
    else:
        assert load_take(out).num_frames > 60


def test_a_video_is_drawn_without_a_page(capture, tmp_path, capsys):
    out = tmp_path / "take.mp4"
    truth = capture.with_suffix(".truth.npz")
    assert main(["view", str(truth), "--video", str(out)]) == 0
    assert f"{out}: {FRAMES // 4} pictures of {truth} (take)" in capsys.readouterr().out
    video = cv2.VideoCapture(str(out))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (FRAMES // 4, 30)
    pictures = [video.read()[1].astype(int) for _ in range(FRAMES // 4)]
    paper = pictures[0][0, 0]
    drawn = [(np.abs(picture - paper).max(axis=-1) > 40).mean() for picture in pictures]
    assert min(drawn) > 0.01, "a hand is in every picture"
    assert np.abs(pictures[0] - pictures[-1]).max() > 100, "and it moves"


def test_a_video_keeps_the_time_of_the_take():
    assert chosen_frames(np.arange(120) / 120.0) == (30.0, list(range(0, 120, 4)))
    rate, frames = chosen_frames(np.arange(5) / 4.0)
    assert (rate, frames) == (4.0, [0, 1, 2, 3, 4])
    gap = np.concatenate([np.arange(12), 60 + np.arange(12)]) / 120.0
    rate, frames = chosen_frames(gap)
    assert frames == [0, 4, 8, *[11] * 12, 12, 16, 20], "while nothing came, the last frame stays"
    assert chosen_frames(np.array([3.0])) == (30.0, [0])
