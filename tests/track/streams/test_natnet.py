"""NatNet: what is packed is read, everything else is refused, and the real client gets every frame."""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import socket
import struct
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from gloves import Capture, Take
from handsim import HandSimError
from handsim.errors import CaptureError
from tests.sentences import error_names
from tests.waiting import LONG, wait_for
from track import LiveStream, ReplayServer, StreamedFrame
from track.streams import LOOPBACK, natnet
from track.streams.natnet import (
    DamagedPacket,
    Kind,
    PointStream,
    ServerInfo,
    open_stream,
    pack,
    pack_connect,
    pack_frame,
    pack_server_info,
    parse_frame,
    parse_server_info,
    unpack,
)
from train import simulate_take

VERSIONS = [(3, 0), (3, 1), (4, 0), (4, 1)]
COUNTS = st.integers(0, 60)
SILENT = "the server answers, but "


@st.composite
def marker_frames(draw):
    count = draw(COUNTS)
    coordinate = st.floats(-50.0, 50.0, width=32)
    points = draw(arrays.arrays(np.float32, (count, 3), elements=coordinate, unique=True))
    ids = draw(arrays.arrays(np.int64, count, elements=st.integers(-1, 2**31 - 1)))
    time = draw(st.floats(0.0, 1e6))
    return StreamedFrame(draw(st.integers(0, 2**31 - 1)), time, points.astype(float), ids)


def full_frame(markers, older, *, sized: bool, time: float = 12.5, end: int = 0) -> bytes:
    """A frame with something in every section, put together value by value as the format is documented.

    `markers` are (ID, x, y, z, flags), `older` those of the list without IDs.
    """

    def section(*things: bytes) -> bytes:
        content = b"".join(things)
        return struct.pack("<i", len(things)) + (struct.pack("<i", len(content)) if sized else b"") + content

    def marker(number, x, y, z, flags) -> bytes:
        return struct.pack("<i3ffhf", number, x, y, z, 0.0064, flags, 0.0002)

    point = struct.pack("<3f", 9.0, 9.0, 9.0)
    body = struct.pack("<i3f4ffh", 7, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 1.0, 0.001, 1)
    bodies = struct.pack("<i", 2) + body + body
    channel = struct.pack("<i3f", 3, 1.0, 2.0, 3.0)
    plate = struct.pack("<ii", 1, 2) + channel + channel
    parts = [
        struct.pack("<i", 42),
        section(b"Glove\0" + struct.pack("<i", 2) + point + point, b"all\0" + struct.pack("<i", 0)),
        section(*(struct.pack("<3f", *place) for place in older)),
        section(body, body, body),
        section(struct.pack("<i", 3) + bodies),
    ]
    if sized:
        solved = struct.pack("<i", 1) + marker(70001, 9.0, 9.0, 9.0, 8 | 4)
        parts.append(section(struct.pack("<i", 4) + bodies + solved))
    parts += [section(*(marker(*values) for values in markers)), section(plate, plate), section(plate)]
    parts.append(struct.pack("<IId3Q", 1, 2, time, 3, 4, 5))
    parts += [struct.pack("<II", 6, 7)] if sized else []
    return b"".join(parts) + struct.pack("<hi", 3, end)


@given(marker_frames(), st.sampled_from(VERSIONS))
def test_packing_and_reading_keep_a_frame(frame, version):
    kind, payload = unpack(pack_frame(frame, version))
    assert kind == Kind.FRAME
    read = parse_frame(payload, version)
    assert (read.number, read.time) == (frame.number, frame.time)
    # Those without IDs come last, each point once.
    order = np.argsort(frame.ids < 0, kind="stable")
    np.testing.assert_array_equal(read.points, frame.points[order])
    np.testing.assert_array_equal(read.ids, frame.ids[order])


@pytest.mark.parametrize("sized", [False, True])
def test_every_section_is_stepped_over(sized):
    markers = [
        (5, 0.1, 0.2, 0.3, 2 | 16),  # unlabeled
        (65537, 0.4, 0.5, 0.6, 2 | 8),  # of an asset
        (65538, 0.7, 0.8, 0.9, 1 | 4 | 8),  # occluded, where the asset's model has it
        (65539, 1.0, 1.1, 1.2, 4 | 8),  # the same without the first flag
        (131073, 0.4, 0.5, 0.6, 2 | 8),  # of another asset that shares a marker
        (6, 9999999.0, 9999999.0, 9999999.0, 2),  # no place at all
        (8, np.nan, 0.0, 0.0, 2),
        (9, -0.5, 0.0, 0.0, 2 | 32),  # an active one
    ]
    older = [(0.1, 0.2, 0.3), (-0.1, -0.2, -0.3)]
    frame = parse_frame(full_frame(markers, older, sized=sized), (4, 1) if sized else (4, 0))
    assert (frame.number, frame.time) == (42, 12.5)
    np.testing.assert_array_equal(frame.ids, [5, 65537, 9, -1])
    wanted = [(0.1, 0.2, 0.3), (0.4, 0.5, 0.6), (-0.5, 0.0, 0.0), (-0.1, -0.2, -0.3)]
    np.testing.assert_array_equal(frame.points, np.float32(wanted))


@pytest.mark.parametrize("sized", [False, True])
@pytest.mark.parametrize("labeled", [False, True])
def test_points_of_marker_sets_and_assets_count_where_labeled_markers_are_off(sized, labeled):
    payload = full_frame([(5, 0.1, 0.2, 0.3, 2 if labeled else 18)], [(0.5, 0.5, 0.5)], sized=sized)
    twice = np.array([9.0, 9.0, 9.0], dtype="<f4").tobytes() * 2
    other = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]], dtype="<f4").tobytes()  # zeros: not seen
    payload = payload.replace(
        b"Glove\0" + struct.pack("<i", 2) + twice, b"Glove\0" + struct.pack("<i", 2) + other
    )
    payload = payload.replace(b"all\0" + struct.pack("<i", 0), b"")
    payload = payload[:4] + struct.pack("<i", 1) + payload[8:]
    frame = parse_frame(payload, (4, 1) if sized else (4, 0))
    in_lists, in_sets = [(0.1, 0.2, 0.3), (0.5, 0.5, 0.5)], [(1.0, 2.0, 3.0)]  # the asset's is filled in
    np.testing.assert_array_equal(frame.points, np.float32(in_lists + ([] if labeled else in_sets)))
    np.testing.assert_array_equal(frame.ids, [5, -1] if labeled else [5, -1, -1])


@pytest.mark.parametrize("sized", [False, True])
def test_the_two_layouts_are_not_taken_for_each_other(sized):
    frame = StreamedFrame(1, 2.0, np.arange(30.0).reshape(10, 3), np.arange(10))
    empty = StreamedFrame(1, 2.0, np.empty((0, 3)), np.empty(0, dtype=np.int64))
    for payload in (
        full_frame([(5, 0.1, 0.2, 0.3, 2)], [], sized=sized),
        unpack(pack_frame(frame, (4, 1) if sized else (3, 0)))[1],
        unpack(pack_frame(empty, (4, 1) if sized else (3, 0)))[1],
    ):
        with pytest.raises(DamagedPacket):
            parse_frame(payload, (4, 0) if sized else (4, 1))


@pytest.mark.parametrize("sized", [False, True])
def test_every_cut_is_noticed(sized):
    version = (4, 1) if sized else (3, 1)
    payload = full_frame([(5, 0.1, 0.2, 0.3, 2)], [(1.0, 1.0, 1.0)], sized=sized)
    for length in range(len(payload)):
        with pytest.raises(DamagedPacket):
            parse_frame(payload[:length], version)
    for damaged in (
        payload + bytes(5),
        full_frame([], [], sized=sized, end=1),
        full_frame([], [], sized=sized, time=np.nan),
    ):
        with pytest.raises(DamagedPacket):
            parse_frame(damaged, version)
    packet = pack(Kind.FRAME, payload)
    for length in range(0, len(packet), 7):
        with pytest.raises(DamagedPacket):
            unpack(packet[:length])


def test_a_count_takes_no_memory():
    huge = struct.pack("<ii", 1, 2**31 - 1) + bytes(1000)
    for version in VERSIONS:
        with pytest.raises(DamagedPacket, match="more than there is"):
            parse_frame(huge, version)


@pytest.mark.parametrize(
    "info", [ServerInfo("Motive", (3, 1), 1511, "239.255.42.99"), ServerInfo("a" * 255, (4, 1), 50000, None)]
)
def test_server_infos_are_read(info):
    kind, payload = unpack(pack_server_info(info))
    assert kind == Kind.SERVER_INFO and len(payload) == 279
    assert parse_server_info(payload) == info


@pytest.mark.parametrize("version", VERSIONS)
def test_the_latency_is_from_the_middle_of_the_exposure_to_the_sending(version):
    nothing = np.zeros((0, 3)), np.zeros(0, dtype=int)
    frame = StreamedFrame(5, 2.5, *nothing, latency=0.0042)
    _, payload = unpack(pack_frame(frame, version))
    assert parse_frame(payload, version).latency == pytest.approx(0.0042, abs=1e-6)
    assert parse_frame(payload, version, clock=10_000_000).latency == pytest.approx(0.00042, abs=1e-7)
    _, unknown = unpack(pack_frame(StreamedFrame(5, 2.5, *nothing), version))
    assert math.isnan(parse_frame(unknown, version).latency)


@pytest.mark.parametrize(
    ("exposed", "sent", "clock"), [(100, 50, 1000), (1, 2**64 - 1, 1000), (5, 6, 0), (0, 900, 1000)]
)
def test_times_that_cannot_be_of_one_clock_are_no_latency(exposed, sent, clock):
    payload = full_frame([], [], sized=False)
    before = struct.pack("<d3Q", 12.5, 3, 4, 5)
    assert payload.count(before) == 1
    payload = payload.replace(before, struct.pack("<d3Q", 12.5, exposed, 0, sent))
    assert math.isnan(parse_frame(payload, (3, 0), clock=clock).latency)
    assert parse_frame(payload, (3, 0), clock=clock).time == 12.5


def test_a_greeting_says_which_layout_is_wanted():
    kind, payload = unpack(pack_connect())
    assert kind == Kind.CONNECT and len(payload) == 270
    assert payload[:8] == b"handsim\0" and payload[265:269] == bytes((4, 1, 0, 0))


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """A server is waited for, however busy the machine is."""
    monkeypatch.setattr(natnet, "_PATIENCE", LONG)


def opened(url: str, **options: object) -> LiveStream:
    """A server's frames in order; none is dropped, however busy the machine is."""
    stream = LiveStream(open_stream(url), **options)  # type: ignore[arg-type]
    stream.forgiven_until = math.inf
    return stream


@functools.cache
def twin() -> Take:
    return simulate_take(kind="hand-controller", num_frames=60, seed=5)


class Puppet:
    """A server that says what a test tells it to, and answers a greeting."""

    def __init__(self, *infos: ServerInfo | bytes, deaf: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((LOOPBACK, 0))
        self.socket.settimeout(0.05)
        self.url = f"natnet://{LOOPBACK}:{self.socket.getsockname()[1]}"
        self.heard: list[int] = []
        self._answers = [info if isinstance(info, bytes) else natnet.pack_server_info(info) for info in infos]
        self._deaf, self._ended = deaf, threading.Event()
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()

    def _answer(self) -> None:
        while not self._ended.is_set():
            try:
                packet, self.client = self.socket.recvfrom(4096)
            except TimeoutError:
                continue
            self.heard.append(natnet.unpack(packet)[0])
            if self.heard[-1] == Kind.CONNECT and len(self.heard) > self._deaf:
                for answer in self._answers:
                    self.socket.sendto(answer, self.client)

    def say(self, packet: bytes) -> None:
        self.socket.sendto(packet, self.client)

    def __enter__(self) -> Puppet:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self.socket.close()


def unicast(version: tuple[int, int]) -> ServerInfo:
    return ServerInfo("puppet", version, 1511, None)


def frame(number: int, version: tuple[int, int]) -> bytes:
    points = np.array([[number, 0.0, 1.0]]) / 128.0
    return natnet.pack_frame(StreamedFrame(number, number / 100.0, points, np.array([number])), version)


def bare(number: int, version: tuple[int, int], points: np.ndarray) -> bytes:
    """A frame without markers in its lists; the points are in a marker set, and again in that of all."""
    content = struct.pack("<i", len(points)) + points.astype("<f4").tobytes()
    sets = [name + content for name in (b"glove\0", b"all\0") if len(points)]
    empty = natnet.pack_frame(
        StreamedFrame(number, number / 100.0, np.empty((0, 3)), np.empty(0, int)), version
    )
    _, payload = unpack(empty)
    there = 12 if version >= (4, 1) else 8
    size = struct.pack("<i", sum(map(len, sets))) if version >= (4, 1) else b""
    return pack(
        Kind.FRAME, payload[:4] + struct.pack("<i", len(sets)) + size + b"".join(sets) + payload[there:]
    )


def say_frames(puppet: Puppet, version: tuple[int, int], frames: list[np.ndarray]) -> None:
    for number, points in enumerate(frames):
        puppet.say(bare(number, version, points))


@pytest.mark.parametrize("version", VERSIONS)
def test_points_of_marker_sets_are_used_beside_unlabeled_ones(version, monkeypatch):
    monkeypatch.setattr("track.streams.live_stream._EMPTY_TIME", -1.0)
    points = np.array([[0.25, 0.5, 0.75], [0.0, 0.0, 0.0], [0.5, 0.5, 1.0]])
    with Puppet(unicast(version)) as puppet, opened(puppet.url) as stream:
        say_frames(puppet, version, [points, points[:0], points])
        np.testing.assert_array_equal(next(stream).points, points[[0, 2]])
        assert not len(next(stream).points) and len(next(stream).points) == 2 and not stream.point_doubt
        puppet.say(frame(3, version))
        puppet.say(bare(4, version, points))
        assert len(next(stream).points) == 1 and len(next(stream).points) == 2


@pytest.mark.parametrize("version", VERSIONS)
def test_frames_without_points_name_the_switch(version, monkeypatch):
    monkeypatch.setattr("track.streams.live_stream._EMPTY_TIME", -1.0)
    with Puppet(unicast(version)) as puppet, opened(puppet.url) as stream:
        assert not stream.point_doubt, "no frame came"
        say_frames(puppet, version, [np.empty((0, 3))] * 3)
        assert [next(stream).number for _ in range(3)] == [0, 1, 2]
        assert stream.point_doubt.startswith(
            "frames arrive, but no point was in any of them; switch on Labeled"
        )
        puppet.say(frame(3, version))
        assert len(next(stream).points) == 1 and not stream.point_doubt


@pytest.mark.parametrize("version", [(3, 0), (4, 0), (4, 1)])
def test_a_take_arrives_whole(version):
    take = twin()
    with ReplayServer(take, version=version) as server, opened(server.url) as stream:
        info = stream._frames.server
        assert info.version == version and info.application == "handsim replay"
        got = list(itertools.islice(stream, take.num_frames))
        assert (stream.counts["damaged_packets"], stream.counts["late_frames"]) == (0, 0)
    for number, one in enumerate(got):
        there = np.isfinite(take.points[number, :, 0])
        assert (one.number, one.silent) == (number, False)
        assert one.time == pytest.approx(number / take.rate)
        np.testing.assert_array_equal(one.points, np.float32(take.points[number, there]))
        np.testing.assert_array_equal(one.ids, take.ids[number, there])


def test_frames_are_played_at_their_rate(monkeypatch):
    take, now = twin(), [50.0]
    monkeypatch.setattr(natnet, "time", SimpleNamespace(monotonic=lambda: now[0], time=time.time))
    with ReplayServer(take) as server, opened(server.url, silence=LONG) as stream:
        assert next(stream).number == 0
        for last in (1, 10, 11, 40):
            now[0] = 50.0 + (last + 0.5) / take.rate
            while next(stream).number < last:
                pass
            wait_for(lambda last=last: server.sent > last)
            assert server.sent == last + 1, "those whose time has come"


def test_ids_of_a_replayed_capture_last_until_a_marker_is_lost():
    positions = np.arange(24.0).reshape(4, 2, 3) / 100.0
    positions[1, 0] = np.nan
    with ReplayServer(Capture(("a", "b"), positions, 100.0)) as server, opened(server.url) as stream:
        ids = [list(one.ids) for one in itertools.islice(stream, 4)]
    assert ids == [[0, 1], [1], [2, 1], [2, 1]]


def test_bad_packets_are_counted_and_left_out():
    rng = np.random.default_rng(0)
    with Puppet(unicast((4, 0))) as server, opened(server.url, silence=LONG) as stream:
        for number in range(20):
            packet = frame(number, (4, 0))
            for bad in (
                packet[: rng.integers(len(packet))],
                rng.bytes(rng.integers(1, 300)),
                natnet.pack(Kind.FRAME, rng.bytes(200)),
                natnet.pack(Kind.SERVER_INFO, b"short"),
            ):
                server.say(bad)
            server.say(natnet.pack(Kind.KEEP_ALIVE))  # good, but no frame
            server.say(packet)
        got = list(itertools.islice(stream, 20))
    assert [one.number for one in got] == list(range(20))
    assert stream.counts["damaged_packets"] >= 60


def test_only_bad_packets_are_silence():
    with Puppet(unicast((4, 0))) as server, opened(server.url, silence=0.3) as stream:
        ended = threading.Event()

        def babble() -> None:
            while not ended.wait(0.005):
                server.say(b"\x07\x00\xff\xff?")

        thread = threading.Thread(target=babble)
        thread.start()
        while stream.counts["damaged_packets"] <= 10:
            assert next(stream).silent
        ended.set()
        thread.join()


@pytest.mark.parametrize(
    ("said", "spoken"), [((4, 1), (3, 1)), ((3, 1), (4, 1)), ((4, 7), (4, 1)), ((255, 255), (4, 1))]
)
def test_a_server_that_speaks_another_layout_than_it_says_is_understood(said, spoken):
    with Puppet(unicast(said)) as server, opened(server.url, silence=LONG) as stream:
        for number in range(3):
            server.say(frame(number, spoken))
        assert [one.number for one in itertools.islice(stream, 3)] == [0, 1, 2]
        assert stream.counts["damaged_packets"] == 0


def test_the_client_listens_on_loopback_only_and_takes_leave():
    with Puppet(unicast((4, 1)), deaf=1) as server:
        with opened(server.url) as stream:
            assert server.client[0] == LOOPBACK
            assert stream._frames._sockets[0].getsockname()[0] == LOOPBACK
        assert list(stream) == []
        wait_for(lambda: server.heard[-1] == Kind.DISCONNECT)
        calls = server.heard[:-1]
        assert len(calls) >= 2 and set(calls) == {Kind.CONNECT}, "called again, as it was deaf once"


def frames(stream: PointStream) -> list[int]:
    """The numbers of the frames that arrive."""
    arrived: list[int] = []
    wait_for(lambda: arrived.extend(one.number for one in stream.poll(0.05)) or bool(arrived))
    return arrived


def test_a_quiet_server_is_greeted_anew(monkeypatch):
    now = [50.0]
    monkeypatch.setattr(natnet, "_KEEP_ALIVE", 0.1)
    monkeypatch.setattr(natnet, "_ATTEND_PERIOD", 0.01)
    monkeypatch.setattr(natnet, "time", SimpleNamespace(monotonic=lambda: now[0], time=time.time))
    with Puppet(unicast((4, 1))) as server:
        stream = open_stream(server.url)
        for heard in (2, 4, 6):
            stream._framed_at = 0.0  # long ago
            now[0] += 0.11
            wait_for(lambda heard=heard: len(server.heard) == 1 + heard)
            server.say(natnet.pack(Kind.KEEP_ALIVE))  # good, but no frame
            server.say(frame(heard, (4, 1)))
            assert frames(stream) == [heard]
        assert server.heard == [Kind.CONNECT, *[Kind.KEEP_ALIVE, Kind.CONNECT] * 3]
        server.heard.clear()
        for number in range(10):
            server.say(frame(10 + number, (4, 1)))
            assert frames(stream) == [10 + number]
            now[0] += 0.03
        wait_for(lambda: server.heard)
        stream.close()
        wait_for(lambda: server.heard[-1:] == [Kind.DISCONNECT])
    assert set(server.heard[:-1]) == {Kind.KEEP_ALIVE}


def test_multicast_is_heard_on_loopback():
    group = "239.255.42.98"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((LOOPBACK, 0))
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LOOPBACK))
        port = sender.getsockname()[1]  # servers send from their data port
        with Puppet(ServerInfo("puppet", (4, 1), port, group)) as server:
            try:
                stream = opened(server.url, silence=LONG)
                sender.sendto(frame(0, (4, 1)), (group, port))
            except (CaptureError, OSError):
                pytest.skip("no multicast on this machine's loopback")
            with stream:
                sender.sendto(frame(1, (4, 1)), (group, port))
                assert [one.number for one in itertools.islice(stream, 2)] == [0, 1]


def test_a_server_that_comes_back_with_another_group_and_port_is_heard(monkeypatch):
    monkeypatch.setattr(natnet, "_KEEP_ALIVE", 0.1)
    monkeypatch.setattr(natnet, "_ATTEND_PERIOD", 0.01)
    with contextlib.ExitStack() as stack:
        senders = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        infos = []
        for sender, group in zip(senders, ("239.255.42.98", "239.255.42.97"), strict=True):
            sender.bind((LOOPBACK, 0))
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LOOPBACK))
            infos.append(ServerInfo("puppet", (4, 1), sender.getsockname()[1], group))
        with Puppet(infos[0]) as server:
            try:
                stream = stack.enter_context(contextlib.closing(open_stream(server.url)))
                senders[0].sendto(frame(0, (4, 1)), (infos[0].group, infos[0].data_port))
            except (CaptureError, OSError):
                pytest.skip("no multicast on this machine's loopback")
            assert frames(stream) == [0]
            for number in (1, 0):  # and back again
                server._answers = [natnet.pack_server_info(infos[number])]
                stream._framed_at = 0.0  # long ago
                wait_for(lambda number=number: (stream.poll(0.01), stream._joined == infos[number])[1])
                senders[number].sendto(
                    frame(5 + number, (4, 1)), (infos[number].group, infos[number].data_port)
                )
                assert frames(stream) == [5 + number]
            server._answers = [natnet.pack_server_info(unicast((4, 1)))]
            stream._framed_at = 0.0
            wait_for(lambda: (stream.poll(0.01), len(stream._sockets) == 1)[1])
            server.say(frame(9, (4, 1)))
            assert frames(stream) == [9]


def test_servers_that_cannot_be_used_are_told():
    for info, words in (
        (unicast((2, 10)), r"speaks NatNet 2\.10, expected 3\.0 or newer"),
        (ServerInfo("x", (4, 1), 1511, "10.0.0.1"), r"10\.0\.0\.1"),
    ):
        with Puppet(info) as server, pytest.raises(CaptureError, match=words):
            opened(server.url)
    with pytest.raises(CaptureError, match="cannot be reached"):
        open_stream("natnet://no-such-host.invalid")


@pytest.mark.parametrize("group", ["239.255.42.99", "239.1.2.3", "224.0.0.77"])
def test_a_group_that_lets_no_frame_through_is_told(group):
    with Puppet(ServerInfo("Motive", (3, 1), 1511, group)) as server:
        try:
            stream = opened(server.url, silence=0.2)
        except CaptureError:
            pytest.skip("no multicast on this machine's loopback")
        with stream:
            assert next(stream).silent
            assert stream.silence_doubt == (
                f"{SILENT}no frame of its multicast group {group}, port 1511, arrives: choose Unicast in "
                "Motive's streaming pane (WSL, Docker and some networks do not pass multicast)"
            )


def test_why_no_frame_comes_is_told(monkeypatch):
    with Puppet(unicast((4, 1))) as server, opened(server.url, silence=0.1) as stream:
        assert stream.silence_doubt == f"{SILENT}sends no frame; is it playing?"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.bind((LOOPBACK, 0))
            stranger.sendto(frame(0, (4, 1)), server.client)
            name = f"{LOOPBACK}:{stranger.getsockname()[1]}"
            wait_for(lambda: (next(stream), f"1 packets came from {name}" in stream.silence_doubt)[1])
        server.say(pack(Kind.FRAME, b"nonsense"))
        wait_for(lambda: (next(stream), "its 1 packets are no frames of NatNet" in stream.silence_doubt)[1])
        server.say(frame(1, (4, 1)))
        assert not next(one for one in stream if not one.silent).silent
        assert stream.silence_doubt == "is the server playing?"
        monkeypatch.setattr(natnet, "_AWAY_TIME", -1.0)
        assert (
            stream.silence_doubt
            == f"the server at {LOOPBACK} no longer answers; it is called again and again"
        )


@pytest.mark.parametrize("answer", [b"", b"HTTP/1.1 400 Bad Request", pack(Kind.SERVER_INFO)])
def test_another_program_at_the_port_is_told(answer, monkeypatch):
    monkeypatch.setattr(natnet, "_PATIENCE", 0.2)
    monkeypatch.setattr(natnet, "_RETRY", 0.1)
    with Puppet(answer) as server, pytest.raises(natnet.NoServerError, match="answers, but speaks no NatNet"):
        open_stream(server.url)


def test_a_port_at_which_no_program_listens_is_told(monkeypatch):
    monkeypatch.setattr(natnet, "_PATIENCE", 0.2)
    monkeypatch.setattr(natnet, "_RETRY", 0.1)
    with Puppet() as server:
        url, port = server.url, server.socket.getsockname()[1]
        with pytest.raises(
            natnet.NoServerError, match=f"no NatNet server answers at port {port} of {LOOPBACK};"
        ):
            open_stream(url)
    with pytest.raises(natnet.NoServerError, match=f"at port {port}: no program of {LOOPBACK} listens there"):
        open_stream(url)


@pytest.mark.parametrize(
    "damaged",
    [
        lambda packet: packet[:4] + struct.pack("<iii", 3, 2**31 - 1, 0) + packet[16:],
        lambda packet: packet[:4] + struct.pack("<iii", 3, -1, 0) + packet[16:],
        lambda packet: packet[:-20],
        lambda packet: packet[:2] + struct.pack("<H", 65535) + packet[4:],
        lambda packet: packet[:2] + struct.pack("<H", 3) + packet[4:],
    ],
)
def test_a_packet_that_lies_in_the_stream_is_counted_and_the_others_are_read(damaged):
    with Puppet(unicast((4, 1))) as server, opened(server.url, silence=LONG) as stream:
        for number in range(6):
            packet = frame(number, (4, 1))
            server.say(damaged(packet) if number == 3 else packet)
        assert [one.number for one in itertools.islice(stream, 5)] == [0, 1, 2, 4, 5]
        counts = stream.counts
        assert counts["damaged_packets"] == 1 and counts["missing_frames"] == 1


def test_what_cannot_be_replayed_is_told():
    points, ids = np.zeros((2, 3, 3)), np.zeros((2, 3), dtype=int)
    for arguments, options, words in (
        ((points, ids[:1], 100.0), {}, "expected (T, N, 3) and (T, N)"),
        ((points, ids, 100.0), {"version": (2, 9)}, "unknown NatNet version '2.9'"),
        ((np.zeros((1, 2000, 3)), np.zeros((1, 2000), dtype=int), 100.0), {}, "expected at most 1500"),
    ):  # fmt: skip
        with error_names(HandSimError, words):
            ReplayServer(
                SimpleNamespace(**dict(zip(("points", "ids", "rate"), arguments, strict=True))), **options
            )


@pytest.mark.parametrize("host", [LOOPBACK, "127.0.0.2"])
def test_only_the_server_and_its_ports_are_heard(host):
    with Puppet(unicast((4, 1))) as server, opened(server.url, silence=LONG) as stream:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            try:
                stranger.bind((host, 0))
            except OSError:
                pytest.skip("this machine has one loopback address only")
            for number in range(5):
                stranger.sendto(frame(900 + number, (4, 1)), server.client)
        for number in range(3):
            server.say(frame(number, (4, 1)))
        assert [one.number for one in itertools.islice(stream, 3)] == [0, 1, 2]
        assert stream.counts["foreign_packets"] == 5


def test_the_port_for_data_is_the_server_s_too():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as data:
        data.bind((LOOPBACK, 0))
        info = ServerInfo("puppet", (4, 1), data.getsockname()[1], None)
        with Puppet(info) as server, opened(server.url, silence=LONG) as stream:
            for number in range(3):
                data.sendto(frame(number, (4, 1)), server.client)
            assert [one.number for one in itertools.islice(stream, 3)] == [0, 1, 2]
