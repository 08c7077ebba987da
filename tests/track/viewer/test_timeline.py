"""Playing keeps the take's own time, and every way of asking leads to a frame that exists."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from track.viewer import timeline as module
from track.viewer.timeline import Timeline, thinned

TIMES = np.arange(400) / 200.0


@pytest.fixture
def shown():
    return []


@pytest.fixture
def clock(monkeypatch):
    """The timeline's clock [s], which stands still unless it waits."""
    now = [100.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    return now


@pytest.fixture
def timeline(server, shown, clock, monkeypatch):
    def wait(seconds: float) -> None:
        clock[0] += seconds

    one = Timeline(server, TIMES, shown.append)
    monkeypatch.setattr(one._wake, "wait", wait)
    return one


def test_playing_keeps_the_time_of_the_take(timeline, shown, clock):
    timeline.play(True)
    begin = clock[0]
    timeline.run(lambda: clock[0] - begin > 1.0)
    elapsed = clock[0] - begin
    assert shown == sorted(set(shown))
    assert elapsed - 2 / 60 < TIMES[shown[-1]] <= elapsed
    assert len(shown) <= 60 * elapsed + 2, "no more pictures than a screen shows"


def test_the_end_is_followed_by_the_beginning(timeline, shown, clock):
    timeline.go_to(399)
    timeline.play(True)
    begin = clock[0]
    timeline.run(lambda: 0 in shown or clock[0] - begin > 5.0)
    assert shown[0] == 399 and shown[-1] == 0


def test_steps_stop_playing_and_stay_within_the_take(timeline):
    timeline.play(True)
    timeline.step(-10)
    assert (timeline.index, timeline.playing) == (0, False)
    timeline.step(1)
    timeline.go_to(10**9)
    assert timeline.index == 399
    timeline.play(True)
    timeline.jump(7)
    assert (timeline.index, timeline.playing) == (7, False)


def test_a_frame_is_shown_once(timeline, shown):
    for _ in range(3):
        timeline.go_to(5)
        timeline.update()
    assert shown == [5]


def test_keys_and_buttons_of_the_page_step(server, page_of, timeline):
    page = page_of(server)
    (uuid,) = [uuid for uuid, props in page.panel.items() if props["label"] == "Ten frames on"]
    page.send("CommandTriggerMessage", uuid=uuid)
    page.wait(lambda: timeline.index == 10)
    page.press("step", "-1")
    page.wait(lambda: timeline.index == 9)
    page.press("Play")
    page.wait(lambda: timeline.playing)


def test_a_thinned_curve_keeps_its_peaks():
    values = np.zeros(10_000)
    values[7777], values[:100] = 3.0, np.nan
    times, kept = thinned(np.arange(10_000.0), values)
    assert len(times) == len(kept) <= 600 and np.nanmax(kept) == 3.0
    assert np.isnan(kept[0]) and abs(times[np.nanargmax(kept)] - 7777) < 17
