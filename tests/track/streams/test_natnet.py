"""NatNet packets: what is packed is read, everything else is stepped over or refused, whatever the bytes."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from track import StreamedFrame
from track.streams.natnet import (
    NEWEST,
    DamagedPacket,
    Kind,
    ServerInfo,
    pack,
    pack_connect,
    pack_frame,
    pack_server_info,
    parse_frame,
    parse_server_info,
    unpack,
)

VERSIONS = [(3, 0), (3, 1), (4, 0), (4, 1)]
COUNTS = st.integers(0, 60)


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


@settings(max_examples=300)
@given(st.binary(max_size=400), st.sampled_from(VERSIONS))
def test_random_bytes_are_read_or_refused(payload, version):
    for read in (
        lambda: parse_frame(payload, version),
        lambda: parse_server_info(payload),
        lambda: unpack(payload),
    ):
        try:
            read()
        except DamagedPacket:
            pass


@settings(max_examples=300)
@given(st.data(), st.booleans())
def test_damaged_bytes_are_read_or_refused(data, sized):
    payload = bytearray(
        full_frame([(5, 0.1, 0.2, 0.3, 2), (6, 1.0, 1.0, 1.0, 2)], [(1.0, 1.0, 1.0)], sized=sized)
    )
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(payload) - 4))
        payload[at : at + 4] = data.draw(
            st.sampled_from([b"\xff\xff\xff\x7f", b"\xff\xff\xff\xff", b"\0\0\0\x80"])
        )
    try:
        frame = parse_frame(bytes(payload), NEWEST if sized else (3, 0))
    except DamagedPacket:
        return
    assert np.isfinite(frame.points).all() and len(frame.points) == len(frame.ids) <= 3


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


def test_a_greeting_says_which_layout_is_wanted():
    kind, payload = unpack(pack_connect())
    assert kind == Kind.CONNECT and len(payload) == 270
    assert payload[:8] == b"handsim\0" and payload[265:269] == bytes((4, 1, 0, 0))
