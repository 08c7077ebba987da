"""C3D: every kind of number a file may use, checked against ezc3d; gaps, long takes, and damaged files."""

import struct
from pathlib import Path

import ezc3d
import numpy as np
import pytest

from gloves import Capture, read_capture, write_capture
from gloves.captures.c3d import read_c3d
from handsim.errors import CaptureError, HandSimWarning
from tests.sentences import error_names

INTEL, DEC, SGI = 84, 85, 86
ORDER = {INTEL: "<", DEC: "<", SGI: ">"}
POINTS = np.array([[[1.5, -2.0, 3.0], [40.0, 50.5, -60.0]], [[7.0, 8.0, 9.0], [0.5, 0.25, 0.125]]])
MM = dict.fromkeys(("mm", "Mill", " mm.", "mm\0inch"), 1e-3)
METERS = dict.fromkeys(("M", "Mete", "METERS", "metre"), 1.0)
BIG = np.tile(POINTS, (40, 1, 1))  # more than what may fill a file


def floats(values: np.ndarray, processor: int) -> bytes:
    if processor != DEC:
        return np.asarray(values, f"{ORDER[processor]}f4").tobytes()
    return np.asarray(np.asarray(values) * 4.0, "<f4").view("<u2").reshape(-1, 2)[:, ::-1].tobytes()


def record(name: str, group: int, body: bytes, processor: int) -> bytes:
    head = struct.pack("bb", len(name), group) + name.encode()
    return head + struct.pack(f"{ORDER[processor]}H", len(body) + 2) + body


def c3d(
    points: np.ndarray = POINTS,
    *,
    processor: int = INTEL,
    scale: float = -1.0,
    labels: tuple[str, ...] = ("a", "b"),
    units: str = "mm",
    rate: float = 120.0,
    missing: tuple[tuple[int, int], ...] = (),
    analog: int = 0,
    analog_in_header: int | None = None,
    stated_frames: int | None = None,
    header_scale: float | None = None,
    header_frames: int | None = None,
    long_frames: tuple[int, int] | None = None,
) -> bytes:
    """A small file, byte by byte: header, one block of parameters, data."""
    order, (num_frames, num_points) = ORDER[processor], points.shape[:2]

    def integers(*values: int) -> bytes:
        return struct.pack("bBB", 2, 1, len(values)) + struct.pack(f"{order}{len(values)}H", *values) + b"\0"

    def real(value: float) -> bytes:
        return struct.pack("bB", 4, 0) + floats(np.array([value]), processor) + b"\0"

    def text(*values: str) -> bytes:
        width = max(map(len, values), default=0)
        joined = "".join(value.ljust(width) for value in values).encode()
        return struct.pack("bBBB", -1, 2, width, len(values)) + joined + b"\0"

    group = [
        record("POINT", -1, b"\0", processor),
        record("USED", 1, integers(num_points), processor),
        record("FRAMES", 1, integers(num_frames if stated_frames is None else stated_frames), processor),
        record("SCALE", 1, real(scale), processor),
        record("RATE", 1, real(rate), processor),
        record("DATA_START", 1, integers(4), processor),
        record("LABELS", 1, text(*labels), processor),
        record("UNITS", 1, text(units), processor),
        record("ANALOG", -2, b"\0", processor),
        record("USED", 2, integers(analog), processor),
        record("RATE", 2, real(rate), processor),
        record("TRIAL", -3, b"\0", processor),
    ]
    if long_frames:
        group.append(record("ACTUAL_START_FIELD", 3, integers(1, 0), processor))
        group.append(record("ACTUAL_END_FIELD", 3, integers(*long_frames), processor))
    parameters = bytes([1, 0x50, 2, processor]) + b"".join(group) + bytes(4)
    assert len(parameters) <= 1024
    header = bytes([2, 0x50]) + struct.pack(
        f"{order}5H",
        num_points,
        analog if analog_in_header is None else analog_in_header,
        1,
        num_frames if header_frames is None else header_frames,
        0,
    )
    header += floats(np.array([scale if header_scale is None else header_scale]), processor) + struct.pack(
        f"{order}2H", 4, int(analog > 0)
    )
    header += floats(np.array([rate]), processor)
    residual = np.zeros((num_frames, num_points, 1))
    for frame, point in missing:
        residual[frame, point] = -1.0
    if scale < 0.0:
        words = np.concatenate([points, residual], axis=2)
    else:
        words = np.concatenate([np.round(points / scale), residual], axis=2)
    frames = np.concatenate(
        [words.reshape(num_frames, 4 * num_points), np.full((num_frames, analog), 77.0)], axis=1
    )
    data = floats(frames, processor) if scale < 0.0 else frames.astype(f"{order}i2").tobytes()
    return header.ljust(512, b"\0") + parameters.ljust(1024, b"\0") + data.ljust(512, b"\0")


@pytest.mark.parametrize("processor", [INTEL, DEC, SGI])
@pytest.mark.parametrize("scale", [-1.0, 0.125])
@pytest.mark.parametrize("analog", [0, 3])
def test_every_number_format_reads_as_ezc3d_reads_it(tmp_path, processor, scale, analog):
    path = tmp_path / "take.c3d"
    path.write_bytes(c3d(processor=processor, scale=scale, analog=analog, missing=((1, 0),)))
    capture = read_capture(path)
    wanted = POINTS.copy()
    wanted[1, 0] = np.nan
    np.testing.assert_allclose(capture.positions, wanted * 1e-3, rtol=1e-12)
    assert (capture.names, capture.rate) == (("a", "b"), 120.0)
    # ezc3d reads no big-endian files, and asks for more of an analog group than stands here.
    if not analog and processor != SGI:
        other = ezc3d.c3d(str(path))
        np.testing.assert_allclose(capture.positions.transpose(2, 1, 0) * 1e3, other["data"]["points"][:3])


@pytest.mark.parametrize(("unit", "meters"), [*MM.items(), ("cm ", 1e-2), *METERS.items()])
def test_units(unit, meters):
    np.testing.assert_allclose(read_c3d(c3d(units=unit)).positions, POINTS * meters)


def test_points_without_labels_get_one() -> None:
    assert read_c3d(c3d(labels=("thumb",))).names == ("thumb", "*2")
    assert read_c3d(c3d(labels=(" ", "b", "more"))).names == ("*1", "b")


def hidden(data: bytes, name: str) -> bytes:
    """A file without one parameter."""
    return data.replace(name.encode(), name[::-1].lower().encode())


def test_a_parameter_that_the_header_has_may_be_absent(recwarn: pytest.WarningsRecorder) -> None:
    for name in ("SCALE", "RATE", "USED", "FRAMES"):
        for scale in (-1.0, 0.125):
            capture = read_c3d(hidden(c3d(scale=scale), name))
            np.testing.assert_allclose(capture.positions, POINTS * 1e-3)
            assert capture.rate == 120.0
    assert not recwarn


@pytest.mark.parametrize("processor", [INTEL, DEC, SGI])
@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"without": "UNITS"}, "no POINT:UNITS, read as millim"),
        ({"stated_frames": 81}, "POINT:FRAMES is 81, and header"),
        ({"analog_in_header": 8}, "size they are 0"),
        ({"scale": -0.5, "header_scale": 0.5}, "are floats"),
        ({"scale": 0.125, "header_scale": -0.125}, "are integers"),
        ({"more": 80, "stated_frames": 80, "header_frames": 80}, "what follows them is not read"),
        ({"unended": True}, "points behind it"),
    ],
)
def test_what_is_wrong_beside_the_points_is_told(changes, sentence, processor):
    """Files of real programs: one of header, parameters and data contradicts the two others."""
    told, changes = [], dict(changes)
    name, more, open_end = (changes.pop(key, None) for key in ("without", "more", "unended"))
    data = c3d(np.tile(POINTS, (40 + (more or 0) // 2, 1, 1)), processor=processor, **changes)
    data = hidden(data, name) if name else unended(data, processor) if open_end else data
    np.testing.assert_allclose(read_c3d(data, told.append).positions, BIG * 1e-3)
    assert len(told) == 1 and sentence in told[0]


def unended(data: bytes, processor: int) -> bytes:
    """The last parameter points far away instead of saying that it is the last, as some writers leave it."""
    group = data.index(b"TRIAL") + len("TRIAL")
    return data[:group] + struct.pack(f"{ORDER[processor]}H", 16129) + data[group + 2 :]


def test_damage_to_what_is_not_read_does_not_matter() -> None:
    """A record that makes no sense, of another group than those of points."""
    data = c3d(labels=("a", "b"))
    end = data.index(b"TRIAL") + len("TRIAL") + 3
    broken = b"\x04\x04EMGS" + struct.pack("<H", 7) + b"\x07\xff\xff\xff\xff"
    np.testing.assert_allclose(
        read_c3d(data[:end] + broken + data[end + len(broken) :]).positions, POINTS * 1e-3
    )


def test_ezc3d_reads_what_we_write(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    positions = rng.normal(size=(50, 7, 3))
    positions[rng.random((50, 7)) < 0.4] = np.nan
    names = ("ThumbTip", "*12", "Unlabeled 2379", "Größe", "a b", "x", "y")
    path = tmp_path / "take.c3d"
    write_capture(path, Capture(names, positions, 120.0))
    other = ezc3d.c3d(str(path))
    assert tuple(other["parameters"]["POINT"]["LABELS"]["value"]) == names
    np.testing.assert_allclose(other["data"]["points"][:3], positions.transpose(2, 1, 0) * 1e3, rtol=1e-6)


def test_more_points_than_one_label_list_holds(tmp_path: Path) -> None:
    names = tuple(f"Unlabeled trajectory {number}" for number in range(700))
    positions = np.random.default_rng(3).normal(size=(2, 700, 3))
    write_capture(tmp_path / "take.c3d", Capture(names, positions, 120.0))
    again = read_capture(tmp_path / "take.c3d")
    assert again.names == names
    np.testing.assert_allclose(again.positions, positions, atol=1e-6)


def test_a_take_longer_than_16_bits_keeps_every_frame(tmp_path: Path) -> None:
    positions = np.zeros((70_000, 1, 3))
    positions[:, 0, 0] = np.arange(70_000) * 1e-3
    write_capture(tmp_path / "take.c3d", Capture(("a",), positions, 120.0))
    again = read_capture(tmp_path / "take.c3d")
    np.testing.assert_allclose(again.positions, positions, atol=1e-5)


def test_a_long_take_that_does_not_state_its_length(tmp_path: Path) -> None:
    """As ezc3d alone writes one; 16 bytes a frame, so the last block has room for 15 frames that are none."""
    points = np.ones((4, 1, 65_553))
    points[0] = np.arange(65_553)
    content = ezc3d.c3d()
    content["parameters"]["POINT"]["RATE"]["value"] = [120.0]
    content["parameters"]["POINT"]["LABELS"]["value"] = ["a"]
    content["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    content["data"]["points"] = points
    content.write(str(tmp_path / "take.c3d"))
    again = read_capture(tmp_path / "take.c3d")
    np.testing.assert_allclose(again.positions[:, 0, 0], points[0, 0] * 1e-3)


def test_the_long_count_is_asked_only_where_16_bits_are_full() -> None:
    """A cropped file may keep the frame numbers of the whole take there."""
    assert read_c3d(c3d(long_frames=(0, 2))).num_frames == 2


def test_every_cut_is_told_or_harmless(tmp_path: Path) -> None:
    data = c3d()
    whole = 1536 + 2 * 2 * 16
    for length in range(len(data)):
        if length < whole:
            with pytest.raises(CaptureError):
                read_c3d(data[:length])
        else:
            np.testing.assert_allclose(read_c3d(data[:length]).positions, POINTS * 1e-3)


BAD = {
    "not C3D": (b"PathFileType" * 100, "not a C3D file | header"),
    "cut in the header": (c3d()[:300], "not a C3D file | header"),
    "cut in the parameters": (c3d()[:700], "truncated | 2 frames | room for 0"),
    "cut in the frames": (c3d()[: 1536 + 40], "truncated | 2 frames | room for 1"),
    "cut before the frames": (c3d()[:1536], "truncated | 2 frames | room for 0"),
    "unknown unit": (c3d(units="inch"), "'inch' | mm, cm, m"),
    "no rate": (c3d(rate=0.0), "POINT:RATE is '0.0' | positive number"),
    "rate is NaN": (c3d(rate=float("nan")), "damaged | POINT:RATE is nan"),
    "scale is zero": (c3d().replace(struct.pack("<f", -1.0), bytes(4)), "POINT:SCALE is 0 | not 0"),
    "no points": (c3d(np.zeros((2, 0, 3)), labels=()), "no markers"),
    "no frames": (c3d(np.zeros((0, 2, 3))), "no frames"),
    "more frames stated than there are": (c3d(stated_frames=99), "truncated | 99 frames | room for 16"),
    "a long take cut": (
        c3d(stated_frames=65535, long_frames=(0, 2)),
        "truncated | 131072 frames | room for 16",
    ),
    "unknown numbers": (c3d()[:515] + b"\x99" + c3d()[516:], "damaged | parameter section | number format"),
    "another analog block in the header": (
        c3d(BIG, analog=4, analog_in_header=2),
        "damaged | 2 analog numbers | 4 channels of 1 samples | without analog data",
    ),
    "fewer points than were written": (
        c3d(np.tile(BIG, (1, 4, 1))).replace(b"USED\x08\0\x02\1\1\x08", b"USED\x08\0\x02\1\1\x02"),
        "damaged | 80 frames of 8 numbers | 2560 bytes | 10240",
    ),
    "another scale": (
        c3d(scale=0.125, header_scale=0.25),
        "POINT:SCALE is 0.125 | 0.25 | export the file again",
    ),
    "integers or floats": (
        c3d(scale=0.125, header_scale=-1.0),
        "POINT:SCALE is 0.125 | -1 | integers | floats",
    ),
    "too few frames": (c3d(stated_frames=81, header_frames=80), "truncated | 81 frames | room for 16"),
}


@pytest.mark.parametrize("case", BAD)
def test_damage_is_told(tmp_path: Path, case: str) -> None:
    path = tmp_path / "take.c3d"
    content, words = BAD[case]
    path.write_bytes(content)
    with error_names(CaptureError, f"{path} | {words}"):
        read_capture(path)


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_a_labeled_c3d_keeps_all_of_its_source_but_the_points(tmp_path: Path, unit: str) -> None:
    rng, source, out = np.random.default_rng(0), tmp_path / "in.c3d", tmp_path / "out.c3d"
    content = ezc3d.c3d()
    content["header"]["points"]["first_frame"] = 41
    parameters, data = content["parameters"], content["data"]
    parameters["POINT"]["RATE"]["value"], parameters["POINT"]["UNITS"]["value"] = [100.0], [unit]
    parameters["POINT"]["LABELS"]["value"] = ["*0", "*1", "*2"]
    data["points"] = np.ones((4, 3, 50))
    data["points"][:3] = rng.normal(size=(3, 3, 50)) * (1e3 if unit == "mm" else 1.0)
    parameters["ANALOG"]["RATE"]["value"] = [1000.0]
    parameters["ANALOG"]["LABELS"]["value"], parameters["ANALOG"]["UNITS"]["value"] = (
        ["Fx", "EMG"],
        ["N", "V"],
    )
    parameters["ANALOG"]["SCALE"]["value"] = np.array([0.5, 0.25])
    data["analogs"] = rng.normal(size=(1, 2, 500))
    content.add_parameter("EVENT", "LABELS", ["Touch", "Grasp"])
    content.add_parameter("EVENT", "TIMES", np.array([[0.0, 0.0], [0.45, 0.5]]))
    content.add_parameter("SUBJECTS", "NAMES", ["Anna"])
    content.add_parameter("FORCE_PLATFORM", "CORNERS", rng.normal(size=(3, 4, 1)))
    content.write(str(source))
    with source.open("r+b") as file:  # ezc3d writes no events into the header
        for word, value in ((150, struct.pack("<H", 1)), (152, struct.pack("<f", 0.45)), (198, b"GRSP")):
            file.seek(2 * word)
            file.write(value)
    capture = read_capture(source)
    names = ("right:ThumbTip", "right:IndexTip", "Unlabeled1")
    write_capture(out, Capture(names, capture.positions[:, ::-1], capture.rate), source=source)
    before, after = ezc3d.c3d(str(source)), ezc3d.c3d(str(out))
    np.testing.assert_array_equal(after["data"]["analogs"], before["data"]["analogs"])
    np.testing.assert_allclose(after["data"]["points"], before["data"]["points"][:, ::-1], rtol=1e-6)
    assert after["parameters"]["POINT"]["LABELS"]["value"] == list(names)
    for part in ("points", "analogs"):
        assert after["header"][part] == before["header"][part]
    assert out.read_bytes()[2 * 147 : 512] == source.read_bytes()[2 * 147 : 512], "events of the header"
    for group, kept in before["parameters"].items():
        for name in kept.keys() - {"__METADATA__", "DATA_START"}:
            if (group, name) not in {("POINT", "LABELS"), ("POINT", "DESCRIPTIONS")}:
                found = after["parameters"][group][name]
                assert found["type"] == kept[name]["type"]
                np.testing.assert_array_equal(found["value"], kept[name]["value"], err_msg=f"{group}:{name}")
    damaged = source.read_bytes()
    at = damaged.index(b"NAMES") + len(b"NAMES") + 2
    (tmp_path / "damaged.c3d").write_bytes(damaged[:at] + b"\x64" + damaged[at + 1 :])  # 100 bytes a number
    with pytest.warns(HandSimWarning, match="'NAMES' is damaged, and left out"):
        write_capture(out, Capture(names, capture.positions, capture.rate), source=tmp_path / "damaged.c3d")
    assert "NAMES" not in ezc3d.c3d(str(out))["parameters"]["SUBJECTS"]
    with error_names(CaptureError, "the source has 50 frames and the capture 49"):
        write_capture(out, Capture(names, capture.positions[1:], capture.rate), source=source)


@pytest.mark.parametrize("processor", [INTEL, DEC, SGI])
@pytest.mark.parametrize("scale", [-1.0, 0.125])
def test_every_number_format_is_kept_as_floats(tmp_path: Path, processor: int, scale: float) -> None:
    source, out = tmp_path / "in.c3d", tmp_path / "out.c3d"
    source.write_bytes(c3d(processor=processor, scale=scale, analog=3))
    capture = read_capture(source)
    write_capture(out, Capture(("A", "B"), capture.positions, capture.rate), source=source)
    again, data = read_capture(out), out.read_bytes()
    assert again.names == ("A", "B")
    np.testing.assert_allclose(again.positions, capture.positions, rtol=1e-6)
    start = (struct.unpack_from("<H", data, 16)[0] - 1) * 512
    numbers = np.frombuffer(data, "<f4", 2 * 11, start).reshape(2, 11)
    assert (numbers[:, 8:] == 77.0).all() and struct.unpack_from("<H", data, 4)[0] == 3
