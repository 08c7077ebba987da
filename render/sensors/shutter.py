"""Motion blur and rolling shutter, from pictures of moments that the caller draws.

A row of a picture is open for `exposure` seconds; the rows open one after the other, `readout` seconds from
the first to the last. Time 0 is the middle of the middle row's exposure: the time of a frame's ground truth.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy.typing import NDArray

from handsim.errors import ArgumentError
from render.sensors.exposure import linear_of


@dataclass(frozen=True, slots=True)
class Shutter:
    """Exposure times of a picture's rows."""

    exposure: float = 0.0
    """Exposure time of each row [s]."""
    readout: float = 0.0
    """Time from the first row's opening to the last row's [s]; 0 for a global shutter."""
    sub_frames: int = 1
    """Number of instants that are drawn."""


@dataclass(frozen=True, slots=True)
class ShutterConfig:
    """Ranges of shutters; drawn uniformly unless stated."""

    exposure: tuple[float, float] = (0.001, 0.016)
    """Drawn uniformly on a logarithmic scale [s]."""
    readout: tuple[float, float] = (0.005, 0.025)
    """Readout time of a rolling shutter [s]."""
    rolling_share: float = 0.5
    """Share of rolling shutters."""
    sub_frames: int = 8


def sample_shutter(config: ShutterConfig, *, rng: np.random.Generator) -> Shutter:
    """A random shutter."""
    exposure = float(np.exp(rng.uniform(*np.log(config.exposure))))
    rolls, readout = bool(rng.random() < config.rolling_share), float(rng.uniform(*config.readout))
    return Shutter(exposure, readout if rolls else 0.0, config.sub_frames)


def shutter_times(
    exposure: float, readout: float, sub_frames: int, height: int
) -> tuple[Float[np.ndarray, "S"], Float[np.ndarray, "H S"]]:
    """Moments to draw, and how much each row of the picture has of each.

    The time in which any row is open is cut into as many equal pieces; a moment is a piece's middle, and a
    row's weights are the shares of its exposure that fall into the pieces.

    Args:
        exposure: Of a row [s].
        readout: From the first row's opening to the last one's [s].
        sub_frames: How many moments.
        height: Rows of the picture.

    Returns:
        Times [s], 0 in the middle, and weights, which add up to 1 in every row.

    Raises:
        ArgumentError: A time is negative or not finite, or there is no moment or no row.
    """
    if not (0.0 <= exposure < np.inf and 0.0 <= readout < np.inf) or sub_frames < 1 or height < 1:
        raise ArgumentError(
            f"a shutter of {exposure:g} s, read out in {readout:g} s, with {sub_frames} sub-frames of "
            f"{height} rows; expected times of at least 0 and counts of at least 1"
        )
    total = exposure + readout
    cuts = total * (np.arange(sub_frames + 1) / sub_frames - 0.5)
    times = 0.5 * (cuts[:-1] + cuts[1:])
    middles = readout * (np.arange(height) / max(height - 1, 1) - 0.5) if height > 1 else np.zeros(1)
    if exposure < 1e-9:  # rows are moments: each has the piece that it falls into
        nearest = np.abs(middles[:, None] - times).argmin(axis=1)
        return times, np.eye(sub_frames)[nearest]
    opened, closed = middles[:, None] - 0.5 * exposure, middles[:, None] + 0.5 * exposure
    overlap = np.minimum(closed, cuts[1:]) - np.maximum(opened, cuts[:-1])
    weights = np.maximum(overlap, 0.0)
    weights[weights < 1e-9 * exposure] = 0.0
    return times, weights / weights.sum(axis=1, keepdims=True)


def combine(
    sub_frames: Iterable[UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"]],
    weights: Float[np.ndarray, "H S"],
) -> Float32[np.ndarray, "H W 3"]:
    """Light of the picture that a shutter makes of moments, for `render.sensors.exposure.expose`.

    Moments come in their order, as sRGB bytes or as light; one is held at a time. Weights are those of
    `shutter_times`.

    Raises:
        ArgumentError: There are not as many moments as weights, or one has another size.
    """
    total: NDArray[np.float32] | None = None
    count = 0
    for number, frame in enumerate(sub_frames):
        count = number + 1
        if number >= weights.shape[1] or len(frame) != len(weights):
            break
        if total is None:
            total = np.zeros(frame.shape, np.float32)
        (rows,) = np.nonzero(weights[:, number])
        if len(rows):
            part = slice(rows[0], rows[-1] + 1)
            light = linear_of(np.ascontiguousarray(frame[part])) if frame.dtype == np.uint8 else frame[part]
            total[part] += light * weights[part, number, None, None].astype(np.float32)
    if total is None or count != weights.shape[1] or len(total) != len(weights):
        raise ArgumentError(
            f"{count} or more sub-frames of some height, expected {weights.shape[1]} of {len(weights)} rows"
        )
    return total
