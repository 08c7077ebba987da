"""Reader and writer of C3D, the binary format of motion capture.

No library is used, because ezc3d 1.7 can crash the process on a damaged file, silently pads a file that was
cut, and stops at 65,535 frames. The reader reads only the points, their labels, units and rate. The writer
copies analog channels, events, force plates and all other parameters from the source file.

Header and parameters both state where the frames lie and how numbers are encoded, and some programs write one
of them wrong. If they contradict each other, the reader takes the one that fits the size of the data, with a
warning; if neither or both fit, it refuses the file.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.captures.capture import Capture
from gloves.captures.coordinates import LEFT_OUT, UNMARKED, without_outputs
from gloves.captures.text import StatedTimes, Warn, check_same_rate, emit_warning, meters_per, timed_positions
from handsim.errors import CaptureError, shortened

_INTEL, _DEC, _SGI = 84, 85, 86
INTEGER_DTYPES: Final = {_INTEL: "<i2", _DEC: "<i2", _SGI: ">i2"}
FLOAT_DTYPES: Final = {_INTEL: "<f4", _DEC: "<u4", _SGI: ">f4"}  # DEC floats are bits until `to_native`
BLOCK: Final = 512
_CHARACTER, _BYTE, _INTEGER, _FLOAT = -1, 1, 2, 4
_READ_GROUPS: Final = {"POINT", "ANALOG", "TRIAL"}
"""Groups of parameters that locate the points; damage to other groups is ignored."""
_MAX_BYTES: Final = 1 << 22
"""Largest size of all parameter values; damaged records may overlap and state far more."""
MAX_FRAMES: Final = 65535  # largest 16-bit count; longer takes state their length in ACTUAL_END_FIELD
_MAX_PADDING: Final = 2 * BLOCK  # bytes after the last frame
_SCALE_TOLERANCE: Final = 1e-3  # relative difference of the two scales of a file
_MAX_COUNT: Final = 255
"""Largest number of labels in a parameter; more labels follow in LABELS2, LABELS3, ..."""
_EVENT_TIMES: Final = slice(304, 376)
"""Bytes of the header with the times of events; their flags and labels follow."""
_POINT_PREFIXES: Final = ("USED", "SCALE", "RATE", "FRAMES", "LONG_FRAMES", "UNITS", "LABELS", "DESCRIPTIONS")
"""Prefixes of the parameters in group POINT that describe the points."""
_OUTPUTS: Final = ("ANGLES", "MOMENTS", "FORCES", "POWERS", "SCALARS", "REACTIONS", "MODELED_MARKERS")
"""Parameters of the group POINT that name columns which are no markers."""


def to_native(values: NDArray[np.generic], processor: int) -> NDArray[np.float64]:
    """Convert floats of a file to doubles; DEC floats have swapped halves and are four times too large."""
    if processor != _DEC:
        with np.errstate(invalid="ignore"):  # a damaged file may hold signaling NaNs
            return values.astype(np.float64)
    bits = values.astype(np.uint32)
    swapped = ((bits >> np.uint32(16)) | (bits << np.uint32(16))).astype("<u4")
    return to_native(swapped.view("<f4"), _INTEL) / 4.0


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters by upper-case group and name: numbers, or strings for characters."""

    processor: int
    """Number format of the file: Intel, DEC or SGI."""
    values: dict[tuple[str, str], list[float] | list[str]]

    @staticmethod
    def parse(data: bytes, start: int, warn: Warn) -> Parameters:
        """Read the records from byte `start` of a file of at least one block."""
        if not 0 < start <= len(data) - 4 or data[start + 3] not in INTEGER_DTYPES:
            raise CaptureError("damaged: the parameter section is missing or in an unknown number format")
        processor = data[start + 3]
        try:
            found = list(_records(data, start + 4, processor, warn))
            groups = {-group: name for group, name, _ in found if group < 0}
            read = [(groups[one], name, raw) for one, name, raw in found if groups.get(one) in _READ_GROUPS]
            sizes = (
                64 + math.prod(raw[2 : 2 + raw[1]]) * abs(int.from_bytes(raw[:1], "little", signed=True))
                for _, _, raw in read
            )
            if sum(sizes) > _MAX_BYTES:
                raise CaptureError(f"damaged: the parameters hold more than {_MAX_BYTES} bytes")
            values = {(group, name): _read_values(bytes(raw), processor) for group, name, raw in read}
        except (ValueError, IndexError) as error:
            raise CaptureError("damaged: the parameter section cannot be read") from error
        return Parameters(processor, values)

    def number(self, group: str, name: str, *, default: float | None = None) -> float:
        """The first number of a parameter."""
        values = self.values.get((group, name), [])
        if values and isinstance(values[0], float):
            if not math.isfinite(values[0]):
                raise CaptureError(f"damaged: {group}:{name} is {values[0]}")
            return values[0]
        if default is None:
            raise CaptureError(f"damaged: the file states no number {group}:{name}")
        return float(default)

    def words(self, group: str, name: str) -> list[int]:
        """A parameter as unsigned 16-bit words; empty if it is absent or holds no numbers."""
        values = self.values.get((group, name), [])
        numbers = [value for value in values if isinstance(value, float) and math.isfinite(value)]
        return [int(value) & 0xFFFF for value in numbers]

    def strings(self, group: str, name: str) -> list[str]:
        """A parameter of characters as strings without padding; empty if it is absent."""
        return [value for value in self.values.get((group, name), []) if isinstance(value, str)]


def _records(data: bytes, at: int, processor: int, warn: Warn) -> Iterator[tuple[int, str, memoryview]]:
    """Number of its group (negative for the group itself), name, and content of each record."""
    order: Literal["little", "big"] = "big" if processor == _SGI else "little"
    view = memoryview(data)
    points_at = (int.from_bytes(data[16:18], order) - 1) * BLOCK
    end = points_at if points_at > at else len(data)  # end of the section
    while at + 2 <= len(data):
        name_length = abs(int.from_bytes(data[at : at + 1], "little", signed=True))
        group = int.from_bytes(data[at + 1 : at + 2], "little", signed=True)
        if name_length == 0:
            break
        offset_at = at + 2 + name_length
        name = data[at + 2 : offset_at].decode("latin-1").upper().strip()
        offset = int.from_bytes(data[offset_at : offset_at + 2], order)
        # Records are chained by 16-bit offsets.
        yield group, name, view[offset_at + 2 : offset_at + 2 + (1 << 17)]
        if offset == 0:
            break
        at = offset_at + offset
        if at > end:
            warn(f"the parameter section ends with {shortened(name)!r}, which points behind it")
            break


def _read_values(raw: bytes, processor: int) -> list[float] | list[str]:
    """The values of one parameter record, `raw` beginning at its type."""
    kind = int.from_bytes(raw[:1], "little", signed=True)
    dimensions = list(raw[2 : 2 + raw[1]])
    count = math.prod(dimensions)
    size = abs(kind)
    body = raw[2 + raw[1] : 2 + raw[1] + count * size]
    if (
        kind not in {_CHARACTER, _BYTE, _INTEGER, _FLOAT}
        or len(body) < count * size
        or len(dimensions) < raw[1]
    ):
        raise ValueError("not a parameter")
    if kind == _CHARACTER:
        width = dimensions[0] if dimensions else 1
        return [_decoded_text(body[at : at + width]) for at in range(0, count, width)] if count else []
    if kind == _BYTE:
        return [float(value) for value in body]
    if kind == _INTEGER:
        return [float(value) for value in np.frombuffer(body, INTEGER_DTYPES[processor])]
    return [float(value) for value in to_native(np.frombuffer(body, FLOAT_DTYPES[processor]), processor)]


def _decoded_text(raw: bytes) -> str:
    raw = raw.partition(b"\0")[0].strip(b" ")  # bytes after a zero are garbage
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


@dataclass(frozen=True, slots=True)
class Header:
    """The content of the first block of a file."""

    num_points: int
    per_frame: int
    """Analog numbers per frame."""
    num_frames: int
    """Number of frames, from the numbers of the first and the last frame."""
    scale: float
    """Negative if positions are floats; otherwise the unit of integer positions."""
    start: int
    """First byte of the frames."""
    samples: int
    """Analog samples per channel and frame."""
    rate: float

    @staticmethod
    def parse(data: bytes, processor: int) -> Header:
        """The header of a file of at least one block, in one of the three number formats."""
        integers = np.frombuffer(data[:BLOCK], INTEGER_DTYPES[processor].replace("i", "u"))
        floats = to_native(np.frombuffer(data[:BLOCK], FLOAT_DTYPES[processor]), processor)
        words = [int(word) for word in integers[:10]]
        return Header(
            num_points=words[1],
            per_frame=words[2],
            num_frames=words[4] - words[3] + 1,
            scale=float(floats[3]),
            start=(words[8] - 1) * BLOCK,
            samples=words[9],
            rate=float(floats[5]),
        )


@dataclass(frozen=True, slots=True)
class _Extent:
    """Room for the frames in the file [bytes], and the stated number of frames, None if there is none."""

    room: int
    stated: int | None

    def fits(self, frame_bytes: int) -> bool:
        """Whether the stated number of frames of this size fills the room up to the padding."""
        return self.stated is not None and 0 <= self.room - self.stated * frame_bytes < _MAX_PADDING


def read_points(
    data: bytes, parameters: Parameters, header: Header, warn: Warn
) -> Float[np.ndarray, "T N 4"]:
    """Coordinates in the file's unit, and residuals."""
    frames, num_points, scale = _read_frames(data, parameters, header, warn)
    points = frames[:, : 4 * num_points].reshape(-1, num_points, 4)
    if scale < 0.0:
        return to_native(points, parameters.processor)
    return np.asarray(points * np.array([scale, scale, scale, 1.0]))


def _read_frames(
    data: bytes, parameters: Parameters, header: Header, warn: Warn
) -> tuple[NDArray[np.generic], int, float]:
    """Numbers of frames as stored (T, K), those of points first; the number of points; `Header.scale`."""
    processor = parameters.processor
    num_points = int(parameters.number("POINT", "USED", default=header.num_points)) & 0xFFFF
    if not num_points:
        raise CaptureError("no markers: the file holds no points")
    if header.start < BLOCK:
        raise CaptureError("damaged: the header names no block where the points begin")
    parameters_at = (data[0] - 1) * BLOCK
    end = parameters_at if parameters_at > header.start else len(data)
    extent = _Extent(max(0, end - header.start), _stated_frames(parameters, header.num_frames))
    scale = _scale_of(parameters, header, extent, num_points, warn)
    dtype = FLOAT_DTYPES[processor] if scale < 0.0 else INTEGER_DTYPES[processor]
    size = np.dtype(dtype).itemsize
    analog = _analog_numbers(parameters, header, extent, size, num_points, warn)
    words = 4 * num_points + analog
    count = _num_frames(data, header, extent, words, size, num_points == header.num_points, warn)
    frames = np.frombuffer(data, dtype, count=count * words, offset=header.start).reshape(-1, words)
    if extent.stated is None:  # zeros may pad the last block
        end, most = len(frames), BLOCK // frames[:1].nbytes
        while end > max(MAX_FRAMES, len(frames) - most) and not frames[end - 1].any():
            end -= 1
        frames = frames[:end]
    return frames, num_points, scale


def _scale_of(parameters: Parameters, header: Header, extent: _Extent, num_points: int, warn: Warn) -> float:
    """POINT:SCALE, or the header's scale without it; see `Header.scale`."""
    scale = parameters.number("POINT", "SCALE", default=header.scale)
    if scale == 0.0 or not np.isfinite(scale):
        raise CaptureError(f"POINT:SCALE is {scale:g}, expected a number that is not 0")
    other = header.scale
    if other == 0.0 or not np.isfinite(other):
        return scale
    text = f"POINT:SCALE is {scale:g} and the header's scale {other:g}"
    if (scale < 0.0) != (other < 0.0):
        words = 4 * num_points + header.per_frame
        as_floats, as_integers = extent.fits(4 * words), extent.fits(2 * words)
        if as_floats == as_integers:
            raise CaptureError(
                f"{text}: one says integers, the other floats, and the file's size does not decide"
            )
        warn(f"{text}; by the file's size its numbers are {'floats' if as_floats else 'integers'}")
        return scale if (scale < 0.0) == as_floats else other
    if scale > 0.0 and abs(scale - other) > _SCALE_TOLERANCE * scale:
        raise CaptureError(f"{text}: the size of the positions is not known; export the file again")
    return scale


def _analog_numbers(
    parameters: Parameters, header: Header, extent: _Extent, size: int, num_points: int, warn: Warn
) -> int:
    """Analog numbers per frame, which follow the points of each frame."""
    channels = int(parameters.number("ANALOG", "USED", default=0.0 if header.per_frame == 0 else -1.0))
    stated = header.per_frame
    if channels < 0 or stated == channels * header.samples:  # ANALOG:USED is absent, or agrees
        return stated
    rates = [parameters.number(group, "RATE", default=0.0) for group in ("ANALOG", "POINT")]
    ratio = round(rates[0] / rates[1]) if rates[1] > 0.0 else 0
    if stated == channels * ratio:
        return stated
    candidates = {stated, channels * header.samples, channels * ratio}
    fitting = [number for number in candidates if extent.fits(size * (4 * num_points + number))]
    text = (
        f"the header states {stated} analog numbers a frame, and the parameters {channels} channels of "
        f"{max(header.samples, ratio)} samples"
    )
    if len(fitting) != 1:
        raise CaptureError(f"damaged: {text}; export the file again, without analog data")
    warn(f"{text}; by the file's size they are {fitting[0]}")
    return fitting[0]


def _stated_frames(parameters: Parameters, in_header: int) -> int | None:
    """POINT:FRAMES or the header's number of frames; for more than 16 bits, the fields of long takes.

    None means that the length of a long take is stated nowhere, as in files of ezc3d.
    """
    frames = int(parameters.number("POINT", "FRAMES", default=in_header))
    frames = frames & 0xFFFF if frames < 0 else frames
    if frames != MAX_FRAMES:
        return frames
    first = parameters.words("TRIAL", "ACTUAL_START_FIELD")
    last = parameters.words("TRIAL", "ACTUAL_END_FIELD")
    if len(first) == len(last) == 2:
        return max(0, last[0] + (last[1] << 16) - first[0] - (first[1] << 16) + 1)
    return int(parameters.number("POINT", "LONG_FRAMES", default=0.0)) or None


def _num_frames(
    data: bytes, header: Header, extent: _Extent, words: int, size: int, agreed: bool, warn: Warn
) -> int:
    """Number of frames to read, each of `words` numbers of `size` bytes."""
    present, stated = extent.room // (words * size), extent.stated
    if stated == 0 or (stated is None and present == 0):
        raise CaptureError("no frames: the file holds no frame")
    if stated is None:
        return present
    if present < stated:
        if not 0 < header.num_frames == present:
            raise CaptureError(f"truncated: the file states {stated} frames and has room for {present}")
        warn(f"POINT:FRAMES is {stated}, and header and data have {present} frames; these are read")
        return present
    used = stated * words * size
    behind = data[header.start + used + _MAX_PADDING : header.start + extent.room]
    if extent.room - used >= _MAX_PADDING and any(behind):
        frames = f"{stated} frames of {words} numbers"
        text = f"the file states {frames}, which are {used} bytes, and has {extent.room}"
        if not agreed or stated != header.num_frames:
            raise CaptureError(f"damaged: {text}")
        warn(f"{text}; what follows them is not read")
    return stated


def read_c3d(data: bytes, warn: Warn = emit_warning) -> Capture:
    """Read the bytes of a C3D file; points with a negative residual are missing, unless all are."""
    if len(data) < BLOCK or data[1] != 0x50:
        raise CaptureError("not a C3D file: it does not begin with a C3D header block")
    parameters = Parameters.parse(data, (data[0] - 1) * BLOCK, warn)
    header = Header.parse(data, parameters.processor)
    points = read_points(data, parameters, header, warn)
    rate = parameters.number("POINT", "RATE", default=header.rate)
    check_same_rate("POINT:RATE", rate, "the header's rate", header.rate)
    units = next(iter(parameters.strings("POINT", "UNITS")), "")
    if not units:
        warn("the file states no POINT:UNITS, read as millimeters, which most programs write")
    missing = points[..., 3] < 0.0
    positions = points[..., :3] * meters_per(units or "mm")
    located = np.isfinite(positions).all(axis=-1) & (positions != 0.0).any(axis=-1)
    left_out = int((located & missing).sum())
    findings = {LEFT_OUT: left_out}
    if left_out and not (located & ~missing).any():
        missing, findings = ~located, {UNMARKED: left_out}
    positions[missing] = np.nan
    timed = timed_positions(positions, StatedTimes(repr(rate), "POINT:RATE"), warn)
    capture = Capture(_labels(parameters, points.shape[1]), *timed, findings=findings)
    listed = [name for group in _OUTPUTS for name in _point_strings(parameters, group)]
    return without_outputs(capture, listed)


def write_c3d(path: Path, capture: Capture, source: bytes | None = None) -> None:
    """Write float32 millimeters; a missing point gets residual -1.

    `source` holds the bytes of the C3D that the capture was read from. All of it but points and rotations
    (group ROTATION) is kept: analogs, events, first frame, parameters, and the unit, used by force plates.
    The length of a take of more than 65,535 frames stands in TRIAL:ACTUAL_END_FIELD; programs that ignore
    this field, such as ezc3d 1.7, see the first 65,535 frames.
    """
    for name in capture.names:
        if len(name.encode()) > _MAX_COUNT:
            raise CaptureError(
                f"marker name '{shortened(name)}' is longer than the {_MAX_COUNT} bytes of a label"
            )
    num_frames, num_points = capture.positions.shape[:2]
    kept = _empty_kept(num_frames) if source is None else _read_kept(source)
    if len(kept.analogs) != num_frames:
        raise CaptureError(f"the source has {len(kept.analogs)} frames and the capture {num_frames}")
    records = _point_records(kept.group, capture, kept.unit) + kept.records
    blocks = -(-(len(records) + len(_data_start(kept.group, 0)) + 6) // BLOCK)
    if blocks > 255:  # the number is a byte
        raise CaptureError(f"the parameters take {blocks} blocks, a C3D has 255 at most")
    section = bytes([1, 0x50, blocks, _INTEL]) + records + _data_start(kept.group, 2 + blocks)
    head, num_analogs = bytearray(kept.head), kept.analogs.shape[1]
    first = int.from_bytes(head[6:8], "little")
    last = min(first + num_frames - 1, MAX_FRAMES)
    struct.pack_into("<2B4H", head, 0, 2, 0x50, num_points, num_analogs, first, last)
    struct.pack_into("<f2Hf", head, 12, -1.0, 2 + blocks, kept.samples, capture.rate)
    points = np.zeros((num_frames, num_points, 4), dtype="<f4")
    points[..., :3] = capture.positions * (1.0 / meters_per(kept.unit))
    points[np.isnan(points[..., 0])] = (0.0, 0.0, 0.0, -1.0)
    data = np.concatenate([points.reshape(num_frames, -1), kept.analogs], axis=1).tobytes()
    path.write_bytes(bytes(head) + section.ljust(blocks * BLOCK, b"\0") + data + bytes(-len(data) % BLOCK))


class _KeptContent(NamedTuple):
    """The content of a source file that is copied beside new points."""

    unit: str
    """The unit of length."""
    head: bytes
    """The header, with the number of the first frame and the events."""
    analogs: Float[np.ndarray, "T A"]
    samples: int
    """Analog samples per channel and frame."""
    group: int
    """The number of the group POINT."""
    records: bytes
    """All parameters that do not describe the points."""


def _empty_kept(num_frames: int) -> _KeptContent:
    """The content beside the points of a file that has no source."""
    head = bytearray(BLOCK)
    struct.pack_into("<H", head, 6, 1)
    struct.pack_into("<H", head, 298, 12345)  # labels of events have four characters
    records = [
        _record(-2, "ANALOG", b"\0"),
        _parameter(2, "USED", _INTEGER, struct.pack("<H", 0)),
        _parameter(2, "RATE", _FLOAT, struct.pack("<f", 0.0)),
        _record(-3, "TRIAL", b"\0"),
        _parameter(3, "ACTUAL_START_FIELD", _INTEGER, struct.pack("<2H", 1, 0), 2),
        _parameter(3, "ACTUAL_END_FIELD", _INTEGER, struct.pack("<I", num_frames), 2),
    ]
    return _KeptContent("mm", bytes(head), np.empty((num_frames, 0), dtype="<f4"), 0, 1, b"".join(records))


def _read_kept(source: bytes) -> _KeptContent:
    """Read the content of a C3D that is kept: analogs, events, parameters, first frame and unit."""
    parameters = Parameters.parse(source, (source[0] - 1) * BLOCK, _silent)
    header = Header.parse(source, processor := parameters.processor)
    frames, num_points, scale = _read_frames(source, parameters, header, _silent)
    analogs = frames[:, 4 * num_points :]
    if scale < 0.0:
        analogs = to_native(analogs, processor)
    elif "UNSIGNED" in parameters.strings("ANALOG", "FORMAT"):
        analogs = analogs.view(analogs.dtype.str.replace("i", "u"))
    words = np.frombuffer(source[:BLOCK], INTEGER_DTYPES[processor]).astype("<u2")
    head = bytearray(words.tobytes())
    times = np.frombuffer(source[_EVENT_TIMES], FLOAT_DTYPES[processor])
    head[_EVENT_TIMES] = to_native(times, processor).astype("<f4").tobytes()
    head[_EVENT_TIMES.stop :] = source[_EVENT_TIMES.stop : BLOCK]
    channels = int(parameters.number("ANALOG", "USED", default=0.0))
    samples = analogs.shape[1] // channels if channels > 0 else header.samples
    unit = next(iter(parameters.strings("POINT", "UNITS")), "") or "mm"
    kept = _kept_records(source, processor)
    return _KeptContent(unit, bytes(head), analogs.astype("<f4"), samples, *kept)


def _silent(text: str) -> None:
    """Drop a warning: the user got it when the source was read."""


def _point_records(group: int, capture: Capture, unit: str) -> bytes:
    """The group POINT, without POINT:DATA_START."""
    num_frames, num_points = capture.positions.shape[:2]
    return b"".join(
        [
            _record(-group, "POINT", b"\0"),
            _parameter(group, "USED", _INTEGER, struct.pack("<H", num_points)),
            _parameter(group, "SCALE", _FLOAT, struct.pack("<f", -1.0)),
            _parameter(group, "RATE", _FLOAT, struct.pack("<f", capture.rate)),
            _parameter(group, "FRAMES", _INTEGER, struct.pack("<H", min(num_frames, MAX_FRAMES))),
            _parameter(group, "UNITS", _CHARACTER, unit.encode(), len(unit.encode())),
            *_text_parameters(group, "LABELS", capture.names),
            *_text_parameters(group, "DESCRIPTIONS", [""] * num_points),
        ]
    )


def _data_start(group: int, block: int) -> bytes:
    """The record of POINT:DATA_START."""
    return _parameter(group, "DATA_START", _INTEGER, struct.pack("<H", block))


def _text_parameters(group: int, name: str, texts: Sequence[str]) -> Iterator[bytes]:
    """A parameter of texts, and its continuations."""
    for part, start in enumerate(range(0, len(texts), _MAX_COUNT), 1):
        words = [text.encode() for text in texts[start : start + _MAX_COUNT]]
        width = max(map(len, words))
        content = b"".join(word.ljust(width) for word in words)
        yield _parameter(group, name + str(part) * (part > 1), _CHARACTER, content, width, len(words))


def _parameter(group: int, name: str, kind: int, values: bytes, *dimensions: int) -> bytes:
    """A parameter with values of a kind, a single one without dimensions."""
    return _record(
        group, name, struct.pack("<b", kind) + bytes([len(dimensions), *dimensions]) + values + b"\0"
    )


def _record(group: int, name: str, content: bytes) -> bytes:
    """A record of a parameter section; the number of a group itself is negative."""
    raw = name.encode("latin-1")
    return struct.pack("<2b", len(raw), group) + raw + struct.pack("<H", len(content) + 2) + content


def _kept_records(source: bytes, processor: int) -> tuple[int, bytes]:
    """A number for the group POINT, and the records of a source that do not describe points or rotations."""
    records = list(_records(source, (source[0] - 1) * BLOCK + 4, processor, _silent))
    groups = {-group: name for group, name, _ in records if group < 0}
    values = {(groups.get(group), name): content[2:4] for group, name, content in records}
    rotated = any(values.get(("ROTATION", "USED"), b""))
    kept: list[bytes] = []
    for group, name, content in records:
        owner = groups.get(abs(group))
        if owner == "ROTATION" and rotated:  # rotations follow the frames: dropped
            continue
        if owner == "POINT" and (group < 0 or name == "DATA_START" or name.startswith(_POINT_PREFIXES)):
            continue
        try:
            own = bytes(content[: 1 + content[0]]) if group < 0 else _in_intel(content, processor)
            kept.append(_record(group, name, own))
        except (ValueError, IndexError, struct.error):
            emit_warning(f"the source's parameter {shortened(name)!r} is damaged, and left out")
    point = next((number for number, name in groups.items() if name == "POINT"), max(groups, default=0) + 1)
    return point, b"".join(kept)


def _in_intel(content: memoryview, processor: int) -> bytes:
    """The content of a parameter's record up to its end, with numbers in Intel's format."""
    _read_values(bytes(content), processor)  # raises a ValueError if it is damaged
    kind, begin = int.from_bytes(content[:1], "little", signed=True), 2 + content[1]
    end = begin + math.prod(content[2:begin]) * abs(kind)
    values = bytes(content[begin:end])
    if kind == _INTEGER:
        values = np.frombuffer(values, INTEGER_DTYPES[processor]).astype("<i2").tobytes()
    elif kind == _FLOAT:
        values = to_native(np.frombuffer(values, FLOAT_DTYPES[processor]), processor).astype("<f4").tobytes()
    return bytes(content[:begin]) + values + bytes(content[end : end + 1 + content[end]])


def _labels(parameters: Parameters, num_points: int) -> tuple[str, ...]:
    """The names of all points; a point without one becomes '*n'."""
    labels = _point_strings(parameters, "LABELS")[:num_points]
    labels += [""] * (num_points - len(labels))
    return tuple(label or f"*{number}" for number, label in enumerate(labels, 1))


def _point_strings(parameters: Parameters, name: str) -> list[str]:
    """The strings of a parameter of the group POINT and its continuations (LABELS, LABELS2, LABELS3, ...)."""
    names = itertools.chain([name], (f"{name}{number}" for number in itertools.count(2)))
    parts = (parameters.strings("POINT", one) for one in names)
    return [text for part in itertools.takewhile(bool, parts) for text in part]
