"""C3D, the binary format of motion capture: read here, written through ezc3d.

Reading does not use ezc3d because that library (1.7) can end the whole process on a damaged file,
pads a cut one silently, and stops at 65,535 frames. Only what a capture needs is read: the points,
their labels, units and rate; analog channels, events and force plates are passed over.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.captures._c3d_parameters import FLOAT_DTYPES, INTEGER_DTYPES, Parameters, to_native
from gloves.captures._text import meters_per, positive_rate
from gloves.captures.capture import Capture
from handsim.errors import CaptureError

if TYPE_CHECKING:
    import ezc3d
    from jaxtyping import Float
    from numpy.typing import NDArray

_BLOCK: Final = 512
_MOST_FRAMES: Final = 65535  # of a 16-bit count; longer takes state the rest in TRIAL:ACTUAL_END_FIELD
_MOST_FILLING: Final = 2 * _BLOCK  # bytes behind the last frame
_MOST_LABEL_BYTES: Final = 255


def read_c3d(data: bytes) -> Capture:
    """The capture in the bytes of a C3D file; points with a negative residual are missing.

    Raises:
        CaptureError: Not a C3D, cut or damaged, without points or frames, or in unknown units.
    """
    if len(data) < _BLOCK or data[1] != 0x50:
        raise CaptureError("not a C3D file: it does not begin with a C3D header block")
    parameters = Parameters.parse(data, start=(data[0] - 1) * _BLOCK)
    points = _read_points(data, parameters)
    rate = parameters.number("POINT", "RATE")
    units = parameters.strings("POINT", "UNITS")
    if not units:
        raise CaptureError("the file states no POINT:UNITS")
    missing = points[..., 3] < 0.0
    positions = points[..., :3] * meters_per(units[0])
    positions[missing] = np.nan
    return Capture(
        _labels(parameters, points.shape[1]), positions, positive_rate(repr(rate), name="POINT:RATE")
    )


def write_c3d(path: Path, capture: Capture) -> None:
    """Write float32 millimeters; a missing point gets residual -1.

    A take of more than 65,535 frames states its length in TRIAL:ACTUAL_END_FIELD, as the format has it;
    programs that do not read it (ezc3d 1.7 is one) see the first 65,535 frames.

    Raises:
        CaptureError: A label is too long.
        OSError: The file cannot be opened, or the disk did not take the whole file.
    """
    for name in capture.names:
        if len(name.encode()) > _MOST_LABEL_BYTES:
            raise CaptureError(
                f"marker name '{name[:40]}...' is longer than the {_MOST_LABEL_BYTES} bytes of a label"
            )
    # ezc3d adds '.c3d' to any other ending, '.C3D' too.
    written = path if path.suffix == ".c3d" else path.with_name(f"{path.name}.c3d")
    try:
        written.touch()  # ezc3d does not report that it may not write
        _content(capture).write(str(written))
        _check_written(written, capture)
        written.replace(path)
    except BaseException:
        written.unlink(missing_ok=True)
        raise


def _content(capture: Capture) -> ezc3d.c3d:
    """The capture as an ezc3d object."""
    import ezc3d

    missing = np.isnan(capture.positions[..., 0]).T
    points = np.ones((4, *missing.shape))
    points[:3] = np.moveaxis(capture.positions, (0, 1, 2), (2, 1, 0)) * 1e3
    content = ezc3d.c3d()
    group = content["parameters"]["POINT"]
    group["RATE"]["value"] = [capture.rate]
    group["LABELS"]["value"] = list(capture.names)
    group["UNITS"]["value"] = ["mm"]
    content["data"]["points"] = points
    content["data"]["meta_points"]["residuals"] = np.where(missing, -1.0, 0.0)[None]
    if capture.num_frames > _MOST_FRAMES:
        for name, count in (("ACTUAL_START_FIELD", 1), ("ACTUAL_END_FIELD", capture.num_frames)):
            content.add_parameter("TRIAL", name, [0, 0])
            content["parameters"]["TRIAL"][name] |= {
                "type": ezc3d.ezc3d.INT,
                "value": np.array([count & 0xFFFF, count >> 16]),
            }
    return content


def _check_written(path: Path, capture: Capture) -> None:
    """Check the size of a written file: ezc3d does not notice failed writes, such as on a full disk."""
    with path.open("rb") as file:
        header = np.frombuffer(file.read(_BLOCK), "<u2")
    if len(header) == _BLOCK // 2:
        expected = (int(header[8]) - 1) * _BLOCK + 16 * capture.num_frames * len(capture.names)
        if path.stat().st_size >= expected:
            return
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _read_points(data: bytes, parameters: Parameters) -> Float[np.ndarray, "T N 4"]:
    """Coordinates in the file's unit and residuals of all frames."""
    header = np.frombuffer(data[:_BLOCK], INTEGER_DTYPES[parameters.processor]).view(
        INTEGER_DTYPES[parameters.processor].replace("i", "u")
    )
    num_points = int(parameters.number("POINT", "USED", default=header[1])) & 0xFFFF
    _check_analog(parameters, per_frame=int(header[2]), samples=int(header[9]))
    scale = parameters.number("POINT", "SCALE")
    if scale == 0.0:
        raise CaptureError(f"POINT:SCALE is {scale:g}, expected a number that is not 0")
    dtype = FLOAT_DTYPES[parameters.processor] if scale < 0.0 else INTEGER_DTYPES[parameters.processor]
    words = 4 * num_points + int(header[2])  # points, then the analog samples of the frame
    start = (int(header[8]) - 1) * _BLOCK
    if not num_points:
        raise CaptureError("no markers: the file holds no points")
    if start < _BLOCK:
        raise CaptureError("damaged: the header names no block where the points begin")
    frame_bytes = words * np.dtype(dtype).itemsize
    present = max(0, len(data) - start) // frame_bytes
    stated = _stated_frames(parameters, int(header[4]) - int(header[3]) + 1)
    if stated == 0 or (stated is None and present == 0):
        raise CaptureError("no frames: the file holds no frame")
    if stated is not None and present < stated:
        raise CaptureError(f"truncated: the file states {stated} frames and has room for {present}")
    if stated is not None and present > stated:
        _check_end(data, start + stated * frame_bytes, start, f"{stated} frames of {words} numbers")
    frames = np.frombuffer(data, dtype, count=(stated or present) * words, offset=start).reshape(-1, words)
    if stated is None:
        frames = _without_padding(frames)
    points = frames[:, : 4 * num_points].reshape(-1, num_points, 4)
    if scale < 0.0:
        return to_native(points, parameters.processor)
    scaled: NDArray[np.float64] = points * np.array([scale, scale, scale, 1.0])
    return scaled


def _check_analog(parameters: Parameters, *, per_frame: int, samples: int) -> None:
    """Whether the header's analog block, which lies between the points of two frames, is the parameters'.

    Args:
        parameters: Of the file.
        per_frame: Analog numbers of a frame by the header.
        samples: Samples of a channel in a frame by the header.

    Raises:
        CaptureError: It is not, so that points would be read from other places than they were written to.
    """
    channels = int(parameters.number("ANALOG", "USED", default=0.0 if per_frame == 0 else -1.0))
    if channels < 0 or per_frame == channels * samples:  # less than none: nothing is stated
        return
    rates = [parameters.number(group, "RATE", default=0.0) for group in ("ANALOG", "POINT")]
    ratio = round(rates[0] / rates[1]) if rates[1] > 0.0 else 0
    if per_frame != channels * ratio:
        raise CaptureError(
            f"damaged: the header states {per_frame} analog numbers a frame, and the parameters {channels} "
            f"channels of {max(samples, ratio)} samples; export the file again, without analog data"
        )


def _check_end(data: bytes, end: int, start: int, stated: str) -> None:
    """Whether the data end where the frames do, up to the blocks that fill the file.

    Raises:
        CaptureError: They do not, so that the frames have another size or number than stated.
    """
    parameters_at = (data[0] - 1) * _BLOCK
    last = parameters_at if parameters_at > start else len(data)
    if last - end >= _MOST_FILLING and any(data[end + _MOST_FILLING :]):
        raise CaptureError(
            f"damaged: the file states {stated}, which are {end - start} bytes, and has {last - start}"
        )


def _stated_frames(parameters: Parameters, in_header: int) -> int | None:
    """Number of frames: POINT:FRAMES or the header; where 16 bits are full, the fields for long takes.

    None means that a long take states its length nowhere, as ezc3d writes it; the data itself decides.
    """
    frames = int(parameters.number("POINT", "FRAMES", default=in_header))
    frames = frames & 0xFFFF if frames < 0 else frames
    if frames != _MOST_FRAMES:
        return frames
    first = parameters.words("TRIAL", "ACTUAL_START_FIELD")
    last = parameters.words("TRIAL", "ACTUAL_END_FIELD")
    if len(first) == len(last) == 2:
        return max(0, last[0] + (last[1] << 16) - first[0] - (first[1] << 16) + 1)
    return int(parameters.number("POINT", "LONG_FRAMES", default=0.0)) or None


def _without_padding(frames: NDArray[np.generic]) -> NDArray[np.generic]:
    """Frames without the zeros that fill the last block."""
    most = _BLOCK // frames[:1].nbytes
    end = len(frames)
    while end > max(_MOST_FRAMES, len(frames) - most) and not frames[end - 1].any():
        end -= 1
    return frames[:end]


def _labels(parameters: Parameters, num_points: int) -> tuple[str, ...]:
    """POINT:LABELS and its continuations LABELS2, LABELS3, ...; a point without one becomes '*n'."""
    labels = parameters.strings("POINT", "LABELS")
    number = 2
    while len(labels) < num_points and (more := parameters.strings("POINT", f"LABELS{number}")):
        labels += more
        number += 1
    labels = labels[:num_points] + [""] * (num_points - len(labels))
    return tuple(label or f"*{number}" for number, label in enumerate(labels, 1))
