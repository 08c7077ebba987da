"""Streams: their addresses, which frames go on, and every contradiction of docs/marker_files.md."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves import Capture, read_capture, write_capture
from handsim import HandSimError, HandSimWarning
from handsim.errors import CaptureError
from tests.sentences import error_names
from tests.track.streams.test_frame_source import Slow
from track import LiveStream, StreamedFrame, open_source
from track.streams.frame_source import SourceStream
from track.streams.live_stream import VALID, FrameOrder

SOURCE = """
import numpy as np
from track import StreamedFrame

class Counting:
    def __init__(self, frames="2"):
        self.frames = int(frames)
    def __iter__(self):
        for number in range(self.frames):
            yield StreamedFrame(number, 0.01 * number, np.zeros((1, 3)), np.array([0]))
    def close(self):
        pass

class NoSource:
    pass
"""
RATE = 120.0
INTERVAL = 1.0 / RATE
FATES = st.sampled_from(["good"] * 15 + ["drop", "double", "swap", "wild"])
FRAMES = 120


PAGE = Path(__file__).parents[3] / "docs" / "marker_files.md"


@pytest.mark.parametrize("address", ["own_code:Counting", "own_code:Counting?frames=5"])
def test_a_class_of_the_user_s_own(own, address):
    count = 5 if "frames" in address else 2
    assert [frame.number for frame in open_source(address)] == list(range(count))


def test_a_source_may_be_an_object():
    own = {}
    exec(SOURCE, own)
    assert [frame.number for frame in open_source(own["Counting"](3))] == [0, 1, 2]
    for wrong, words in ((own["NoSource"](), "address"), (5, "address | 5"), (iter([]), "close")):
        with error_names(HandSimError, words):
            open_source(wrong)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        *((one, f"'{one}' | {' | '.join(VALID)}") for one in ("", "host", "http://host", "natnet", "a b:c")),
        ("9module:name", "'9module:name' | natnet://host"),
        ("natnet://localhost:99999", "natnet://host:port"),
        ("natnet://localhost:0", "port from 1 to 65535"),
        ("natnet://localhost:x", "natnet://host"),
        ("natnet://localhost/take", "natnet://host"),
        ("natnet://[::1", "natnet://host"),
        ("own_code:Nothing", "own_code"),
        ("own_code:NoSource", "no method __iter__"),
        ("own_code:Counting?frames=many", "many"),
        ("own_code:Counting?speed=2", "speed"),
        ("not_there:Source", "not_there"),
        ("qtm://host:port", "expected qtm://host:port or qtm://host"),
        ("qtm://host?rate=2", "unknown option 'rate', there are none"),
    ],
)
def test_a_wrong_one_is_one_sentence(own, address, words):
    with error_names(HandSimError, words):
        open_source(address)


def frame(number: int, time: float, at: float, points: object = ((0.0, 0.0, 0.0),)) -> StreamedFrame:
    return StreamedFrame(number, time, np.asarray(points), np.arange(len(points)), arrived=at)


def passed(order: FrameOrder, packets: list[tuple[int, float, float]]) -> list[tuple[int, float]]:
    """Number and time of the frames that go on, of packets (number, time, arrival)."""
    gone = []
    for number, time, at in packets:
        gone += [*order.expire(at), *order.add(frame(number, time, at))]
    gone += order.end()
    assert order.received == len(packets)
    assert order.received == order.passed + order.doubled + order.late + order.wild
    return [(one.number, one.time) for one in gone]


def numbers_of(order: FrameOrder, packets: list[tuple[int, float, float]]) -> list[int]:
    return [number for number, _ in passed(order, packets)]


def regular(numbers: range, *, jump: int = 0) -> list[tuple[int, float, float]]:
    return [(number + jump, (number + jump) / RATE, number / RATE) for number in numbers]


@pytest.mark.parametrize("time", [1e17, 1e9, 40.0, 0.3, -1e9, 1e300])
@pytest.mark.parametrize("place", [0, 1, 5, 19])
def test_a_wild_time_is_left_out_and_takes_nothing_with_it(time, place):
    packets, order = regular(range(20)), FrameOrder()
    packets.insert(place, (place, time, packets[place][2]))
    gone = passed(order, packets)
    assert [number for number, told in gone if told != time] == list(range(20))
    assert (order.wild, order.missed, order.restarts) == (1, 0, 0)
    assert len(gone) == 20


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
    arrivals = np.maximum.accumulate([number for number, _, _ in packets])  # a dropped packet takes its time
    timed = [(number, time, at * INTERVAL) for (number, time, _), at in zip(packets, arrivals, strict=True)]
    gone = [number for number, _ in passed(order, timed)]
    assert gone == expected


class Trc:
    """A file of 120 frames at 120 Hz, whose columns of numbers and times and whose header can be changed."""

    def __init__(self, folder: Path) -> None:
        rng = np.random.default_rng(0)
        positions = rng.normal(0.0, 0.05, (FRAMES, 8, 3)) + np.linspace(0.0, 0.1, FRAMES)[:, None, None]
        self.path = folder / "take.trc"
        write_capture(self.path, Capture(tuple("abcdefgh"), positions, RATE))
        lines = self.path.read_text().split("\n")
        self.header, self.rows = lines[:6], [line.split("\t") for line in lines[6:-1]]
        self.numbers, self.times = np.arange(1, FRAMES + 1), np.arange(FRAMES) / RATE
        self.rate, self.count = "120", str(FRAMES)
        self.kept = np.ones(FRAMES, dtype=bool)

    def read(self) -> tuple[Capture, list[str]]:
        """The capture, and what was told."""
        values = self.header[2].split("\t")
        values[0], values[2] = self.rate, self.count
        rows = [
            "\t".join([str(number), f"{time:.6f}", *row[2:]])
            for number, time, row, kept in zip(self.numbers, self.times, self.rows, self.kept, strict=True)
            if kept
        ]
        lines = [*self.header[:2], "\t".join(values), *self.header[3:], *rows]
        self.path.write_text("\n".join(lines) + "\n")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", HandSimWarning)
            read = read_capture(self.path)
        return read, [str(one.message) for one in caught]

    def refused(self) -> str:
        with pytest.raises(CaptureError) as caught:
            self.read()
        return str(caught.value)


def gaps(trc: Trc) -> None:
    trc.kept[40:80] = False
    for numbers in (trc.numbers, np.cumsum(trc.kept)):
        trc.numbers = numbers
        capture, told = trc.read()
        missing = np.isnan(capture.positions[..., 0]).all(axis=1)
        assert capture.num_frames == FRAMES and np.flatnonzero(missing).tolist() == list(range(40, 80))
        assert len(told) == 1 and "40 of 120 frames are missing (41 to 80)" in told[0]


def cut(trc: Trc) -> None:
    path = trc.path.with_suffix(".csv")
    write_capture(path, trc.read()[0])
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-40]))
    with pytest.raises(CaptureError, match="truncated: Total Exported Frames is 120, and 80 frames are"):
        read_capture(path)


def shortened(trc: Trc) -> None:
    trc.kept[80:] = False
    capture, told = trc.read()
    assert capture.num_frames == 80 and "NumFrames is 120, and 80 frames are there" in told[0]


def more_than_stated(trc: Trc) -> None:
    trc.count = "100"
    capture, told = trc.read()
    assert capture.num_frames == FRAMES and "NumFrames is 100, and 120 frames are there" in told[0]


def another_rate(trc: Trc) -> None:
    trc.rate = "60"
    assert "DataRate is 60 Hz, and by their times the frames are at 120" in trc.refused()
    for decimals in (2, 3):  # rounded times are no contradiction, and tell it still
        trc.times = np.round(np.arange(FRAMES) / RATE, decimals)
        trc.rate = "120"
        assert trc.read()[1] == []
        trc.rate = "60"
        assert "DataRate is 60 Hz" in trc.refused()


def no_rate(trc: Trc) -> None:
    trc.rate = "0"
    capture, told = trc.read()
    assert capture.rate == pytest.approx(RATE, rel=1e-3) and "by the column of times it is 120" in told[0]


def wild_rate(trc: Trc) -> None:
    for trc.rate in ("0.5", "1e6", "1e17", "1e308"):
        assert f"DataRate is {float(trc.rate):g} Hz, expected 1 to 5000 frames per second" in trc.refused()


def two_rates(trc: Trc) -> None:
    path = trc.path.with_suffix(".c3d")
    write_capture(path, trc.read()[0])
    data = bytearray(path.read_bytes())
    data[20:24] = np.float32(60.0).tobytes()
    path.write_bytes(data)
    with pytest.raises(CaptureError, match="POINT:RATE is 120 Hz and the header's rate 60 Hz"):
        read_capture(path)


def times_back(trc: Trc) -> None:
    trc.times = trc.times[::-1]
    assert "the time goes back from" in trc.refused()
    trc.times = np.full(FRAMES, 0.5)
    assert "all 120 frames have the time 0.5 s, and DataRate is 120" in trc.refused()


def numbers_back(trc: Trc) -> None:
    trc.numbers[60:] -= 1
    assert "frame 60 follows frame 60" in trc.refused()


def numbers_ahead(trc: Trc) -> None:
    trc.numbers[60:] += 5
    said = trc.refused()
    assert "the frame's number goes on by 6" in said and "from 0.491667 s to 0.5 s, by 1 frames" in said


def far_jump(trc: Trc) -> None:
    trc.times[60:] += 100.0
    assert "12000 frames are missing behind frame 60, from 0.491667 s to 100.5 s" in trc.refused()


def short_jump() -> None:
    order, packets = FrameOrder(), regular(range(480))
    wild = [(n + 10**6, n / RATE + 8000.0, n / RATE) for n in range(100, 104)]
    assert numbers_of(order, [*packets[:100], *wild, *packets[100:]]) == list(range(480))
    assert (order.wild, order.missed, order.restarts) == (4, 0, 0)


def lasting_jump() -> None:
    order = FrameOrder()
    packets = [*regular(range(100)), *regular(range(100, 105), jump=960_000)]
    assert numbers_of(order, packets) == [packet[0] for packet in packets]
    assert (order.wild, order.missed, order.restarts) == (0, 0, 1), "as many could not have been sent"
    order = FrameOrder()
    assert numbers_of(order, [*regular(range(100)), *regular(range(400, 405))])[-5:] == list(range(400, 405))
    assert (order.wild, order.missed, order.restarts) == (0, 300, 0)


def out_of_order() -> None:
    for places in range(1, 9):
        order = FrameOrder()
        numbers = list(range(2400))
        for at in (10, *range(20, 2380, 20)):  # the first by one: how late others are shows later
            numbers.insert(at + (places if at > 10 else 1), numbers.pop(at))
        packets = [(number, number / RATE, at / RATE) for at, number in enumerate(numbers)]
        assert numbers_of(order, packets) == list(range(2400))
        assert order.reordered == 119 and (order.missed, order.late) == (0, 0)


def twice() -> None:
    order = FrameOrder()
    assert numbers_of(order, [packet for packet in regular(range(100)) for _ in range(2)]) == list(range(100))
    assert (order.doubled, order.late) == (100, 0)


def lost_end() -> None:
    order = FrameOrder()
    numbers_of(order, regular(range(460)))
    assert order.missing_at_end(479 / RATE + 0.001) == 20


class Source:
    """Frames of one point far away, and one in the room."""

    def __iter__(self):
        for number in range(10):
            yield frame(number, number / RATE, np.nan, [[0.1, 0.2, 0.3], [900.0, -1200.0, 0.0]])

    def close(self) -> None:
        pass


def far_points() -> None:
    with LiveStream(SourceStream(Source(), "mine")) as stream:
        assert [len(frame.points) for frame in stream] == [1] * 10
        assert stream.counts["points_out_of_range"] == 10 and stream.points == 20


def not_kept_up_with() -> None:
    with LiveStream(Slow(500)) as stream:
        assert next(stream).number == 499
        counts = [stream.counts[f"{kind}_frames"] for kind in ("received", "dropped", "missing")]
        assert counts == [500, 499, 0]


CASES: dict[str, tuple[Callable[..., None], ...]] = {
    "a gap in the numbers of the frames, or in their times where numbers go on": (gaps,),
    "more frames than the header states, or fewer in a .trc": (more_than_stated, shortened),
    "no stated rate, but evenly spaced times": (no_rate,),
    "a stated rate that is not that of the times, two rates in a C3D that differ, "
    "a rate below 1 or above 5,000 Hz": (another_rate, two_rates, wild_rate),
    "times or numbers that go back or come twice; times that are all the same; "
    "numbers that go on by more frames than the times": (times_back, numbers_back, numbers_ahead),
    "more than ten times as many missing frames as frames; "
    "gaps, and fewer frames than the header of a .csv or .tsv states": (far_jump, cut),
    "in a stream: a number or a time that jumps in fewer than five frames in a row": (short_jump,),
    "in a stream: a jump that lasts for five frames in a row": (lasting_jump,),
    "in a stream: frames out of order by up to eight, or that come twice": (out_of_order, twice),
    "in a stream: no frame before its end": (lost_end,),
    "in a stream: points 1,000 m or more from the origin": (far_points,),
    "in a stream: frames that are not kept up with": (not_kept_up_with,),
}


def test_every_row_of_the_table_has_a_case():
    table = PAGE.read_text("utf-8").split("| what contradicts | what happens |\n|---|---|\n")[1]
    rows = re.findall(r"^\| (.*?) \| .* \|$", table.split("\n\n")[0], re.MULTILINE)
    assert rows == list(CASES)


@pytest.mark.parametrize(("row", "case"), [(row, case) for row, cases in CASES.items() for case in cases])
def test_what_contradicts_happens_as_the_table_says(row, case, tmp_path):
    case() if row.startswith("in a stream") else case(Trc(tmp_path))


def test_what_is_legitimate_is_read_without_a_word(tmp_path):
    for change in (
        {"numbers": np.arange(5017, 5017 + FRAMES), "times": 41.8 + np.arange(FRAMES) / RATE},
        {"times": np.arange(FRAMES) / 119.88},
        {"rate": "119.88"},
        {"numbers": 2 * np.arange(FRAMES)},
        {"times": np.arange(FRAMES) / RATE + np.random.default_rng(1).uniform(0.0, 0.002, FRAMES)},
    ):
        trc = Trc(tmp_path)
        for name, value in change.items():
            setattr(trc, name, value)
        capture, told = trc.read()
        assert capture.num_frames == FRAMES and told == []
