"""Which frames of a stream go on: all that were sent, in their order, and none with a wild time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from track import StreamedFrame
from track.streams.live_stream import FrameOrder

INTERVAL = 1.0 / 120.0


def frame(number: int, time: float, at: float) -> StreamedFrame:
    return StreamedFrame(number, time, np.empty((0, 3)), np.empty(0, dtype=np.int64), arrived=at)


def passed(order: FrameOrder, packets: list[tuple[int, float, float]]) -> list[tuple[int, float]]:
    """Number and time of the frames that go on, of packets (number, time, arrival)."""
    gone = []
    for number, time, at in packets:
        gone += [*order.expire(at), *order.add(frame(number, time, at))]
    gone += order.end()
    assert order.received == len(packets)
    assert order.received == order.passed + order.doubled + order.late + order.wild
    return [(one.number, one.time) for one in gone]


def regular(numbers: range, *, start: float = 0.0) -> list[tuple[int, float, float]]:
    return [(number, number * INTERVAL, start + number * INTERVAL) for number in numbers]


@pytest.mark.parametrize("time", [1e17, 1e9, 40.0, 0.3, -1e9, 1e300])
@pytest.mark.parametrize("place", [0, 1, 5, 19])
def test_a_wild_time_is_left_out_and_takes_nothing_with_it(time, place):
    packets, order = regular(range(20)), FrameOrder()
    packets.insert(place, (place, time, packets[place][2]))
    gone = passed(order, packets)
    assert [number for number, told in gone if told != time] == list(range(20))
    assert (order.wild, order.missed, order.restarts) == (1, 0, 0)
    assert len(gone) == 20


def test_missing_frames_are_counted():
    order = FrameOrder()
    sent = [packet for packet in regular(range(50)) if packet[0] not in (3, 20, 21, 22)]
    assert passed(order, sent) == [packet[:2] for packet in sent]
    assert (order.missed, order.late, order.wild, order.restarts) == (4, 0, 0, 0)


@pytest.mark.parametrize("number", [400, 1000, 11_409_641])
def test_a_damaged_header_whose_number_and_time_agree_is_left_out(number):
    packets, order = regular(range(20)), FrameOrder()
    packets[12] = (number, number * INTERVAL, packets[12][2])
    assert [told for told, _ in passed(order, packets)] == [told for told in range(20) if told != 12]
    assert (order.wild, order.missed, order.restarts) == (1, 1, 0)


def test_a_reader_that_was_held_up_misses_frames_and_sees_no_restart():
    """The socket kept the first frames; those that came later were lost, and all are read at once."""
    order, numbers = FrameOrder(), [*range(600), *range(1200, 1300)]
    packets = [(number, number * INTERVAL, 10.0 + 1e-4 * at) for at, number in enumerate(numbers)]
    packets[:10] = regular(range(10))
    assert [number for number, _ in passed(order, packets)] == numbers
    assert (order.missed, order.wild, order.late, order.restarts) == (600, 0, 0, 0)


def test_a_frame_that_was_overtaken_goes_first():
    order, packets = FrameOrder(), regular(range(30))
    for at in (0, 7, 15):
        packets[at], packets[at + 1] = packets[at + 1], packets[at]
    assert [number for number, _ in passed(order, packets)] == list(range(30))
    assert (order.missed, order.late) == (0, 0)


def test_a_gap_holds_a_frame_for_a_moment_only():
    order = FrameOrder()
    passed(order, regular(range(5)))
    assert list(order.add(frame(6, 6 * INTERVAL, 6 * INTERVAL))) == []
    assert 0.0 < order.deadline - 6 * INTERVAL < 5.01 * INTERVAL
    assert [one.number for one in order.expire(order.deadline)] == [6]


def test_a_server_that_starts_again_is_followed():
    order = FrameOrder()
    packets = regular(range(40)) + [(n, n * INTERVAL, 3.0 + n * INTERVAL) for n in range(20)]
    packets += [(n, 5e8 + n * INTERVAL, 6.0 + n * INTERVAL) for n in range(20)]
    gone = passed(order, packets)
    assert [number for number, _ in gone] == [*range(40), *range(20), *range(20)]
    assert (order.restarts, order.wild, order.late) == (2, 0, 0)


@pytest.mark.parametrize(("number", "time"), [(10, 9.15), (12, 10.0)])
def test_a_frame_with_a_damaged_header_does_not_look_like_a_restart(number, time):
    """Time or number of the tenth frame are a little wrong: it passes, and the next ones do not fit it."""
    order, packets = FrameOrder(), regular(range(30))
    packets[10] = (number, time * INTERVAL, packets[10][2])
    gone = passed(order, packets)
    assert [told for _, told in gone[-19:]] == [told for _, told, _ in packets[11:]]
    assert order.restarts == 0


@pytest.mark.parametrize(
    "damaged",
    [
        # A number that runs ahead, before two frames that were swapped.
        [(10, 9.0, 9), (12, 10.0, 10), (11, 11.0, 11), (13, 13.0, 13), (12, 12.0, 14)],
        # A number that runs ahead of one dropped frame: the next number goes back.
        [(10, 9.0, 9), (13, 11.0, 11), (10, 10.0, 12), (12, 12.0, 13), (13, 13.0, 14)],
        # A time that falls short: the frame after the next arrives first.
        [(9, 9.0, 9), (10, 9.355, 10), (12, 12.0, 12), (11, 11.0, 13), (13, 13.0, 14)],
    ],
)
def test_a_damaged_header_takes_no_frame_with_it(damaged):
    order, before = FrameOrder(), regular(range(9))
    after = [(number, time, at + INTERVAL) for number, time, at in regular(range(14, 30))]
    packets = [*before, *((number, time * INTERVAL, at * INTERVAL) for number, time, at in damaged), *after]
    gone = [round(told / INTERVAL, 3) for _, told in passed(order, packets)]
    assert set(range(11, 30)) <= set(gone)
    assert gone == sorted(gone)
    assert order.restarts == 0


@pytest.mark.parametrize("ahead", [(163, 141.75), (120, 119.0), (64, 63.9)])
def test_a_stream_goes_on_behind_a_header_that_runs_ahead(ahead):
    """It waits for the frames before it, which come one after the other."""
    order, packets = FrameOrder(), regular(range(150))
    packets[61] = (3000, 600.0 * INTERVAL, packets[61][2])
    packets[62] = (ahead[0], ahead[1] * INTERVAL, packets[62][2])
    gone = {number for number, _ in passed(order, packets)}
    assert set(range(150)) - {61, 62} <= gone
    assert gone <= {*range(150), ahead[0]}
    assert (order.restarts, order.late) == (0, 0)


def test_a_pause_a_burst_and_another_rate_lose_nothing():
    order, packets = FrameOrder(), regular(range(20))
    packets += [(n, 5.0 + n * INTERVAL, 5.0 + n * INTERVAL) for n in range(20, 40)]  # the server paused
    packets += [(n, 5.0 + n * INTERVAL, 7.0) for n in range(40, 80)]  # the network paused
    packets += [(80 + n, 5.0 + 80 * INTERVAL + n / 30.0, 7.0 + n / 30.0) for n in range(20)]
    assert [number for number, _ in passed(order, packets)] == list(range(100))
    assert (order.wild, order.late, order.restarts) == (0, 0, 0)


def test_servers_without_frame_numbers_are_heard():
    order = FrameOrder()
    packets = [(0, n * INTERVAL, n * INTERVAL) for n in range(50)]
    assert passed(order, packets) == [packet[:2] for packet in packets]
    assert order.missed == 0


FATES = st.sampled_from(["good"] * 15 + ["drop", "double", "swap", "wild"])


@settings(deadline=None, max_examples=200)
@given(st.lists(FATES, min_size=3, max_size=300), st.randoms(use_true_random=False))
def test_whatever_happens_to_some_packets_the_others_go_on(fates, random):
    order, packets, expected = FrameOrder(), [], []
    fates = ["good", "good", "good", *fates, "good", "good"]
    swapped = False
    for number, fate in enumerate(fates):
        packet = (number, number * INTERVAL, 0.0)
        if fate == "drop":
            continue
        if fate == "wild":
            # Within a second it could be the time of a frame after a loss; nothing tells them apart.
            off = random.choice([-1.0, 1.0]) * random.uniform(1.0, 1e6)
            time = random.choice([1e17, 1e9, number * INTERVAL + 100.0, number * INTERVAL + off])
            packets.append((number, time, 0.0))
            continue
        expected.append(number)
        swapped = fate == "swap" and not swapped and fates[number - 1] == "good" and number > 3
        packets.insert(len(packets) - swapped, packet)
        packets += [packet] * (fate == "double")
    timed = [(number, time, at * INTERVAL) for at, (number, time, _) in enumerate(packets)]
    gone = [number for number, _ in passed(order, timed)]
    assert gone == expected
