"""C3D, the binary format of motion capture: read here, written through ezc3d.

Reading does not use ezc3d because that library (1.7) can end the whole process on a damaged file,
pads a cut one silently, and stops at 65,535 frames. Only what a capture needs is read: the points,
their labels, units and rate; analog channels, events and force plates are passed over.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.captures._c3d_frames import BLOCK, MOST_FRAMES, Header, read_points
from gloves.captures._c3d_parameters import Parameters
from gloves.captures._text import Tell, meters_per, warn
from gloves.captures.capture import Capture
from gloves.captures.frame_times import StatedTimes, check_same_rate, timed_positions
from handsim.errors import CaptureError, shortened
from handsim.files.atomic import unwritten
from handsim.files.names import plain_path

if TYPE_CHECKING:
    import ezc3d

_MOST_LABEL_BYTES: Final = 255


def read_c3d(data: bytes, tell: Tell = warn) -> Capture:
    """The capture in the bytes of a C3D file; points with a negative residual are missing.

    A missing unit is told, and where the file contradicts itself.
    """
    if len(data) < BLOCK or data[1] != 0x50:
        raise CaptureError("not a C3D file: it does not begin with a C3D header block")
    parameters = Parameters.parse(data, (data[0] - 1) * BLOCK, tell)
    header = Header.parse(data, parameters.processor)
    points = read_points(data, parameters, header, tell)
    rate = parameters.number("POINT", "RATE", default=header.rate)
    check_same_rate("POINT:RATE", rate, "the header's rate", header.rate)
    units = next(iter(parameters.strings("POINT", "UNITS")), "")
    if not units:
        tell("the file states no POINT:UNITS, read as millimeters, which most programs write")
    missing = points[..., 3] < 0.0
    positions = points[..., :3] * meters_per(units or "mm")
    positions[missing] = np.nan
    timed = timed_positions(positions, StatedTimes(repr(rate), "POINT:RATE"), tell)
    return Capture(_labels(parameters, points.shape[1]), *timed)


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
                f"marker name '{shortened(name)}' is longer than the {_MOST_LABEL_BYTES} bytes of a label"
            )
    # ezc3d adds '.c3d' to any other ending, '.C3D' too.
    written = path if path.suffix == ".c3d" else path.with_name(f"{path.name}.c3d")
    try:
        written.touch()  # ezc3d does not report that it may not write
        with plain_path(written) as plain:
            _content(capture).write(str(plain))
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
    if capture.num_frames > MOST_FRAMES:
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
        header = np.frombuffer(file.read(BLOCK), "<u2")
    if len(header) == BLOCK // 2:
        expected = (int(header[8]) - 1) * BLOCK + 16 * capture.num_frames * len(capture.names)
        if path.stat().st_size >= expected:
            return
    raise unwritten(path)


def _labels(parameters: Parameters, num_points: int) -> tuple[str, ...]:
    """POINT:LABELS and its continuations LABELS2, LABELS3, ...; a point without one becomes '*n'."""
    labels = parameters.strings("POINT", "LABELS")
    number = 2
    while len(labels) < num_points and (more := parameters.strings("POINT", f"LABELS{number}")):
        labels += more
        number += 1
    labels = labels[:num_points] + [""] * (num_points - len(labels))
    return tuple(label or f"*{number}" for number, label in enumerate(labels, 1))
