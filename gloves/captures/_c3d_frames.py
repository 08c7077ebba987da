"""Where the frames of a C3D file lie, how its numbers are written, and the points in them.

Header and parameters both state it, and some programs write one of them wrong. Where they contradict each
other, the size of the data decides and the user is told; where it does not decide, the file is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from gloves.captures._c3d_parameters import FLOAT_DTYPES, INTEGER_DTYPES, Parameters, to_native
from gloves.captures._text import Tell
from handsim.errors import CaptureError

BLOCK: Final = 512
MOST_FRAMES: Final = 65535  # of a 16-bit count; longer takes state the rest in TRIAL:ACTUAL_END_FIELD
_MOST_FILLING: Final = 2 * BLOCK  # bytes behind the last frame
_SAME_SCALE: Final = 1e-3  # by which the two scales of a file may differ, of themselves


@dataclass(frozen=True, slots=True)
class Header:
    """What the first block of a file states."""

    num_points: int
    per_frame: int
    """Analog numbers of a frame."""
    num_frames: int
    """By the numbers of the first and the last frame."""
    scale: float
    """Negative where positions are written as floats; otherwise the size of one step of integers."""
    start: int
    """First byte of the frames."""
    samples: int
    """Analog samples of a channel in a frame."""
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
    """Bytes that the frames have room for, and the number of frames."""

    room: int
    stated: int | None
    """None where a long take states its length nowhere."""

    def fits(self, frame_bytes: int) -> bool:
        """Whether frames of this size fill the room, but for the blocks that fill a file."""
        return self.stated is not None and 0 <= self.room - self.stated * frame_bytes < _MOST_FILLING


def read_points(
    data: bytes, parameters: Parameters, header: Header, tell: Tell
) -> Float[np.ndarray, "T N 4"]:
    """Coordinates in the file's unit and residuals of all frames."""
    processor = parameters.processor
    num_points = int(parameters.number("POINT", "USED", default=header.num_points)) & 0xFFFF
    if not num_points:
        raise CaptureError("no markers: the file holds no points")
    if header.start < BLOCK:
        raise CaptureError("damaged: the header names no block where the points begin")
    parameters_at = (data[0] - 1) * BLOCK
    end = parameters_at if parameters_at > header.start else len(data)
    extent = _Extent(max(0, end - header.start), _stated_frames(parameters, header.num_frames))
    scale = _scale(parameters, header, extent, num_points, tell)
    dtype = FLOAT_DTYPES[processor] if scale < 0.0 else INTEGER_DTYPES[processor]
    size = np.dtype(dtype).itemsize
    analog = _analog_numbers(parameters, header, extent, size, num_points, tell)
    words = 4 * num_points + analog  # points, then the analog samples of the frame
    count = _num_frames(data, header, extent, words, size, num_points == header.num_points, tell)
    frames = np.frombuffer(data, dtype, count=count * words, offset=header.start).reshape(-1, words)
    if extent.stated is None:
        frames = _without_padding(frames)
    points = frames[:, : 4 * num_points].reshape(-1, num_points, 4)
    if scale < 0.0:
        return to_native(points, processor)
    scaled: NDArray[np.float64] = points * np.array([scale, scale, scale, 1.0])
    return scaled


def _scale(parameters: Parameters, header: Header, extent: _Extent, num_points: int, tell: Tell) -> float:
    """POINT:SCALE, or the header's where there is none; see `Header.scale`."""
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
        tell(f"{text}; by the file's size its numbers are {'floats' if as_floats else 'integers'}")
        return scale if (scale < 0.0) == as_floats else other
    if scale > 0.0 and abs(scale - other) > _SAME_SCALE * scale:
        raise CaptureError(f"{text}: the size of the positions is not known; export the file again")
    return scale


def _analog_numbers(
    parameters: Parameters, header: Header, extent: _Extent, size: int, num_points: int, tell: Tell
) -> int:
    """Analog numbers of a frame, which lie between its points and those of the next."""
    channels = int(parameters.number("ANALOG", "USED", default=0.0 if header.per_frame == 0 else -1.0))
    stated = header.per_frame
    if channels < 0 or stated == channels * header.samples:  # less than none: nothing is stated
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
    tell(f"{text}; by the file's size they are {fitting[0]}")
    return fitting[0]


def _stated_frames(parameters: Parameters, in_header: int) -> int | None:
    """Number of frames: POINT:FRAMES or the header; where 16 bits are full, the fields for long takes.

    None means that a long take states its length nowhere, as ezc3d writes it; the data itself decides.
    """
    frames = int(parameters.number("POINT", "FRAMES", default=in_header))
    frames = frames & 0xFFFF if frames < 0 else frames
    if frames != MOST_FRAMES:
        return frames
    first = parameters.words("TRIAL", "ACTUAL_START_FIELD")
    last = parameters.words("TRIAL", "ACTUAL_END_FIELD")
    if len(first) == len(last) == 2:
        return max(0, last[0] + (last[1] << 16) - first[0] - (first[1] << 16) + 1)
    return int(parameters.number("POINT", "LONG_FRAMES", default=0.0)) or None


def _num_frames(
    data: bytes, header: Header, extent: _Extent, words: int, size: int, agreed: bool, tell: Tell
) -> int:
    """Number of frames to read, each of so many words (numbers) of so many bytes."""
    present, stated = extent.room // (words * size), extent.stated
    if stated == 0 or (stated is None and present == 0):
        raise CaptureError("no frames: the file holds no frame")
    if stated is None:
        return present
    if present < stated:
        if not 0 < header.num_frames == present:
            raise CaptureError(f"truncated: the file states {stated} frames and has room for {present}")
        tell(f"POINT:FRAMES is {stated}, and header and data have {present} frames; these are read")
        return present
    used = stated * words * size
    behind = data[header.start + used + _MOST_FILLING : header.start + extent.room]
    if extent.room - used >= _MOST_FILLING and any(behind):
        frames = f"{stated} frames of {words} numbers"
        text = f"the file states {frames}, which are {used} bytes, and has {extent.room}"
        if not agreed or stated != header.num_frames:
            raise CaptureError(f"damaged: {text}")
        tell(f"{text}; what follows them is not read")
    return stated


def _without_padding(frames: NDArray[np.generic]) -> NDArray[np.generic]:
    """Frames without the zeros that fill the last block."""
    most = BLOCK // frames[:1].nbytes
    end = len(frames)
    while end > max(MOST_FRAMES, len(frames) - most) and not frames[end - 1].any():
        end -= 1
    return frames[:end]
