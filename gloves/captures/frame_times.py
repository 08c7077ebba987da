"""Rate, times and numbers of the frames of a capture: one rule for every format.

They have to agree. A gap in the numbers or in the times becomes frames without a point, and is told. What
cannot agree is refused in a sentence that says both values.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from gloves.captures._text import cell_number
from handsim.errors import CaptureError

LOWEST_RATE: Final = 1.0
HIGHEST_RATE: Final = 5000.0
"""Frames per second of any optical system [Hz]."""
_SAME_RATE: Final = 0.02  # by which two rates may differ: 119.88 is called 120, 29.97 is called 30
_COARSEST: Final = 1  # decimals of times, at least; whole seconds are no times of frames
_FINEST: Final = 9  # decimals
_UNEVEN: Final = 0.1  # of the step between two frames, by which times without a stated rate may differ
_JITTER: Final = 0.25  # of a frame's time, which times vary by where nothing is missing
_MOST_MISSING: Final = 10  # times as many frames as are there
_MOST_DIGITS: Final = 12  # of a count
_SHOWN: Final = 3  # gaps that a sentence names


@dataclass(frozen=True, slots=True)
class StatedTimes:
    """What a file states of the times of its T frames."""

    rate: str
    """The frame rate, as it is written."""
    rate_name: str
    """What the file calls it."""
    numbers: Float[np.ndarray, "T"] | None = None
    """Number of each frame; None, or NaN anywhere, where there is none."""
    times: Float[np.ndarray, "T"] | None = None
    """Time of each frame [s]; None, or NaN anywhere, where there is none."""
    count: str = ""
    """Number of frames, as it is written."""
    count_name: str = ""
    """What the file calls it."""
    count_is_reliable: bool = True
    """Whether fewer frames mean that the file is cut; many programs and people shorten a TRC as it is."""


def check_rate(rate: float, name: str = "the rate") -> None:
    """Raise a `CaptureError` unless a frame rate [Hz] is that of an optical system."""
    if not LOWEST_RATE <= rate <= HIGHEST_RATE:
        raise CaptureError(
            f"{name} is {rate:g} Hz, expected {LOWEST_RATE:g} to {HIGHEST_RATE:g} frames per second"
        )


def check_same_rate(name: str, rate: float, other_name: str, other: float) -> None:
    """Refuse two stated rates [Hz] of the same frames that differ; one that is none does not count."""
    if 0.0 < other < np.inf and abs(rate - other) > _SAME_RATE * other:
        raise CaptureError(
            f"{name} is {rate:g} Hz and {other_name} {other:g} Hz; correct the one that is wrong"
        )


def timed_positions(
    positions: Float[np.ndarray, "R N 3"], stated: StatedTimes, tell: Callable[[str], None]
) -> tuple[Float[np.ndarray, "T N 3"], float]:
    """Positions of all frames from the first to the last [m], and their rate [Hz].

    Frames that are missing are NaN, and told, as is a rate that is stated by the times alone.
    """
    numbers, times = _increasing_numbers(stated.numbers), _increasing_times(stated)
    steps, stride = np.ones(len(positions) - 1, dtype=np.int64), 1
    if numbers is not None and len(numbers) > 1:
        steps = np.diff(numbers)
        stride = int(np.gcd.reduce(steps))  # some programs keep the cameras' numbers of every other frame
        steps //= stride
    rate = _stated_rate(stated.rate)
    if rate is None:
        rate = _rate_of_times(stated, steps, times, tell)
    check_rate(rate, stated.rate_name)
    if times is not None and len(times) > 1:
        ticks = _Ticks.of(times, rate)
        if stride > 1 and not ticks.agree(steps):
            steps, stride = steps * stride, 1
        if not ticks.agree(steps):
            raise CaptureError(
                f"{stated.rate_name} is {rate:g} Hz, and by their times the frames are at "
                f"{ticks.rate(steps):.6g} Hz; correct the one that is wrong"
            )
        steps = _with_gaps_in_time(steps, ticks)
    frames = np.concatenate([[0], np.cumsum(steps)])
    num_frames = int(frames[-1]) + 1
    first = 0 if numbers is None else int(numbers[0])
    _check_missing(num_frames, steps, first + stride * frames, times)
    _check_count(stated, len(positions), num_frames, tell)
    if num_frames == len(positions):
        return positions, rate
    tell(_missing_sentence(steps, first + stride * frames, stride, num_frames))
    filled = np.full((num_frames, *positions.shape[1:]), np.nan)
    filled[frames] = positions
    return filled, rate


@dataclass(frozen=True, slots=True)
class _Ticks:
    """Times of frames, beside the rate that is stated."""

    times: Float[np.ndarray, "T"]
    """[s]"""
    stated: float
    """[Hz]"""
    rounding: float
    """The step to which times were rounded [s]."""
    window: int
    """Frames between two times whose distance shows the rate."""

    @staticmethod
    def of(times: Float[np.ndarray, "T"], rate: float) -> _Ticks:
        rounding = 10.0**-_FINEST
        for decimals in range(_COARSEST, _FINEST):
            scaled = times * 10.0**decimals
            if np.abs(scaled - np.round(scaled)).max() < 1e-3:
                rounding = 10.0**-decimals
                break
        window = min(len(times) - 1, math.ceil(max(1.0, rounding * rate / _SAME_RATE)))
        return _Ticks(times, rate, rounding, window)

    def rate(self, steps: Int[np.ndarray, "T-1"]) -> float:
        """The usual rate of the times [Hz]."""
        frames = np.concatenate([[0], np.cumsum(steps)])
        spans = self.times[self.window :] - self.times[: -self.window]
        interval = float(np.median(spans / (frames[self.window :] - frames[: -self.window])))
        return 1.0 / interval if interval > 0.0 else np.inf

    def agree(self, steps: Int[np.ndarray, "T-1"]) -> bool:
        """Whether the rate of the times is the stated one, as far as they are rounded."""
        tolerance = _SAME_RATE + self.rounding * self.stated / self.window
        rate = self.rate(steps)
        return rate < np.inf and abs(self.stated / rate - 1.0) <= tolerance


def _stated_rate(text: str) -> float | None:
    """The rate that a header states [Hz]; None where that is no positive number."""
    try:
        rate = cell_number(text)
    except ValueError:
        return None
    return rate if 0.0 < rate < np.inf else None


def _increasing_numbers(numbers: Float[np.ndarray, "T"] | None) -> Int[np.ndarray, "T"] | None:
    """The numbers of the frames, if all have one; a `CaptureError` unless they are whole and increase."""
    if numbers is None or np.isnan(numbers).any():
        return None
    odd = np.flatnonzero((numbers != np.round(numbers)) | (np.abs(numbers) > 2.0**52))
    if len(odd):
        raise CaptureError(f"a frame has the number {numbers[odd[0]]:g}, expected a whole one")
    back = np.flatnonzero(np.diff(numbers) <= 0)
    if len(back):
        first, second = numbers[back[0] : back[0] + 2]
        raise CaptureError(f"frame {second:.0f} follows frame {first:.0f}, expected numbers that increase")
    return numbers.astype(np.int64)


def _increasing_times(stated: StatedTimes) -> Float[np.ndarray, "T"] | None:
    """The times of the frames [s], if all have one; a `CaptureError` unless they increase."""
    times = stated.times
    if times is None or np.isnan(times).any():
        return None
    back = np.flatnonzero(np.diff(times) < 0.0)
    if len(back):
        first, second = times[back[0] : back[0] + 2]
        raise CaptureError(f"the time goes back from {first:g} s to {second:g} s (row {back[0] + 2})")
    if len(times) > 1 and times[0] == times[-1]:
        raise CaptureError(
            f"all {len(times)} frames have the time {times[0]:g} s, and {stated.rate_name} is "
            f"{stated.rate.strip() or 'not stated'}"
        )
    return times


def _rate_of_times(
    stated: StatedTimes,
    steps: Int[np.ndarray, "T-1"],
    times: Float[np.ndarray, "T"] | None,
    tell: Callable[[str], None],
) -> float:
    """The rate of evenly spaced times [Hz], where none is stated."""
    text = f"{stated.rate_name} is '{stated.rate.strip()[:40]}', expected a positive number"
    intervals = np.empty(0) if times is None else np.diff(times) / steps
    if len(intervals) < 2 or np.ptp(intervals) > _UNEVEN * intervals.mean():
        raise CaptureError(f"{text} of frames per second")
    rate = float(1.0 / intervals.mean())
    tell(f"{text}; by the column of times it is {rate:.6g} Hz")
    return rate


def _with_gaps_in_time(steps: Int[np.ndarray, "T-1"], ticks: _Ticks) -> Int[np.ndarray, "T-1"]:
    """Frames from each row to the next, with those that are missing by the times alone.

    A time that is late and made up for by the next one is no gap: clocks jitter. Numbers that go on by more
    frames than times are a `CaptureError`.
    """
    interval = 1.0 / ticks.rate(steps)
    excess = np.diff(ticks.times) / interval - steps
    slack = ticks.rounding / interval + 0.5 * _SAME_RATE * steps
    excess = np.sign(excess) * np.maximum(np.abs(excess) - slack, 0.0)
    around = np.concatenate([[0.0], excess, [0.0]])
    made_up = np.minimum(around[:-2], 0.0) + np.minimum(around[2:], 0.0)
    late = np.maximum(around[:-2], 0.0) + np.maximum(around[2:], 0.0)
    together = np.diff(ticks.times) == 0.0
    behind = np.flatnonzero((excess + late < -0.5) & ((steps > 1) | together))
    if len(behind):
        row = int(behind[0])
        first, second = ticks.times[row : row + 2]
        raise CaptureError(
            f"from row {row + 1} to row {row + 2} the frame's number goes on by {steps[row]}, and its time, "
            f"from {first:g} s to {second:g} s, by {(second - first) / interval:.3g} frames"
        )
    gaps = np.where(excess > 0.0, np.maximum(np.round(excess + made_up - _JITTER), 0.0), 0.0)
    return steps + gaps.astype(np.int64)


def _check_missing(
    num_frames: int,
    steps: Int[np.ndarray, "T-1"],
    numbers: Int[np.ndarray, "T"],
    times: Float[np.ndarray, "T"] | None,
) -> None:
    """Refuse a jump that leaves almost nothing of a capture."""
    there = len(numbers)
    if num_frames - there <= _MOST_MISSING * there:
        return
    row = int(np.argmax(steps))
    at = "" if times is None else f", from {times[row]:g} s to {times[row + 1]:g} s"
    raise CaptureError(
        f"{steps[row] - 1} frames are missing behind frame {numbers[row]}{at}, and {there} are there; "
        "correct the numbers or the times, or cut the capture there"
    )


def _check_count(stated: StatedTimes, there: int, spanned: int, tell: Callable[[str], None]) -> None:
    """Whether there are as many frames as stated, with those that are missing between others."""
    text = stated.count.strip()
    if not text.isdecimal():
        return
    count = int(text[:_MOST_DIGITS])
    if count > spanned and stated.count_is_reliable:
        raise CaptureError(
            f"truncated: {stated.count_name} is {count}, and {spanned} frames are there; export the file "
            "again, or correct that number if they are all"
        )
    if count < there or count > spanned:
        tell(f"{stated.count_name} is {count}, and {there} frames are there; all are read")


def _missing_sentence(
    steps: Int[np.ndarray, "T-1"], numbers: NDArray[np.int64], stride: int, num_frames: int
) -> str:
    gaps = np.flatnonzero(steps > 1)
    spans = [(numbers[row] + stride, numbers[row + 1] - stride) for row in gaps[:_SHOWN]]
    shown = ", ".join(f"{first}" if first == last else f"{first} to {last}" for first, last in spans)
    more = f" and {len(gaps) - _SHOWN} more gaps" if len(gaps) > _SHOWN else ""
    missing = int((steps - 1).sum())
    return f"{missing} of {num_frames} frames are missing ({shown}{more}); they are read without points"
