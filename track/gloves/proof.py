"""The proof of a learned glove: it labels the points of frames from which it was not learned."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from gloves.captures.capture import Capture, run_lengths
from handsim.arrays import Doubles
from track.captures import label_capture
from track.frames import AnyCapture
from track.gloves.learned_glove import LearnedGlove, captures_of, held_out

_BLOCK_TIME: Final = 1.0  # [s] The frames of a block are similar and count once.
_FEWEST_GAPS: Final = 10  # A capture with fewer gaps gets gaps like those of optical systems:
_MEAN_GAP, _MISSING_SHARE = 0.05, 0.04  # their mean length [s], and the share of missing markers
_CONFIDENCE_LEVEL: Final = 0.95


class Proof(NamedTuple):
    """How well a glove labels the frames of captures from which it was not learned."""

    frames: float
    """Share of the frames in which every label is right."""
    interval: tuple[float, float]
    """95 % interval of this share, in which the frames of one second [s] count once."""
    slots: float
    """Share of the markers in all frames that are right."""
    by_capture: tuple[float, ...]
    """Share of right frames of each capture."""


def prove_glove(
    learned: LearnedGlove, captures: AnyCapture | Sequence[AnyCapture], *, rng: np.random.Generator
) -> Proof:
    """Label the last thirds of labeled captures with a glove that was learned from the rest.

    Points lose their names. If a capture has hardly any gaps, because somebody filled them, markers are left
    out at random.

    Args:
        learned: What `learn_glove` returned for the captures.
        captures: The captures [m] or paths of marker files, in the same order.
        rng: Source of the gaps.

    Returns:
        Shares of right frames and markers.

    Raises:
        CaptureError: A capture cannot be read.
    """
    sources = captures_of(captures)
    frames, slots, by_capture = list[Doubles](), list[float](), list[float]()
    for number, source in enumerate(sources):
        columns = {
            f"{one.hand.side}:{name}": column
            for one in learned.hands
            if one.capture == number
            for name, column in one.columns.items()
        }
        if not columns:
            continue
        tried = held_out(source)
        positions = _with_gaps(tried.positions, list(columns.values()), source.rate, rng)
        unnamed = Capture(tuple(f"Unlabeled{n}" for n in range(len(source.names))), positions, source.rate)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Wrong labels are counted below.
            take = label_capture(unnamed, glove=learned.layout)
        true = np.full(positions.shape[:2], -1)
        for name, column in columns.items():
            true[:, column] = take.label_names.index(name)
        wrong = (take.labels != true) & np.isfinite(positions[..., 0])
        right = ~wrong.any(axis=1)
        block = max(1, round(_BLOCK_TIME * source.rate))
        frames += [right[first : first + block] for first in range(0, len(right), block)]
        by_capture.append(float(right.mean()))
        slots.append(1.0 - float(wrong[:, list(columns.values())].mean()))
    shares = np.array([one.mean() for one in frames])
    mean = float(np.concatenate(frames).mean())
    return Proof(mean, _interval(shares), float(np.mean(slots)), tuple(by_capture))


def _with_gaps(
    positions: Float[np.ndarray, "T N 3"], columns: Sequence[int], rate: float, rng: np.random.Generator
) -> Float[np.ndarray, "T N 3"]:
    """The positions with gaps in some columns, if these have hardly any."""
    own = positions[:, columns, 0]
    if len(run_lengths(np.isnan(own), inside=True)) >= _FEWEST_GAPS:
        return positions
    changed = positions.copy()
    count, gap = len(positions), max(1.0, _MEAN_GAP * rate)
    for column in columns:
        for first in rng.integers(0, count, rng.poisson(_MISSING_SHARE * count / gap)):
            changed[first : first + rng.geometric(1.0 / gap), column] = np.nan
    return changed


def _interval(shares: Float[np.ndarray, "B"]) -> tuple[float, float]:
    """Wilson's interval of a mean share of B blocks, as if each block were right or wrong."""
    from scipy.stats import binomtest

    count = len(shares)
    found = binomtest(int(np.floor(shares.sum())), count).proportion_ci(_CONFIDENCE_LEVEL, "wilson")
    return float(found.low), float(found.high)
