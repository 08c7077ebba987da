"""Scenes of real hands in motion, made from the poses of Mocap_SIG18_Data (Han et al. 2018)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from gloves import Capture, load_layout
from gloves.optics.reconstruction import number_runs

Condition = Literal["clean", "gaps", "close", "new-ids", "exchanged-ids"]
CONDITIONS: tuple[Condition, ...] = get_args(Condition)
FAST = {"User1/capture1", "User2/capture1", "User2/capture3"}  # three times as fast as 120 Hz would show
NAMES = load_layout("dense19").names
_DARK = 0.5  # [s] between two sequences
_SHORTEST = 40  # frames of a sequence
_JUMP = 0.012  # [m] change of a hand's velocity between two frames that cuts a sequence at 120 Hz
_MISSING, _USUAL_GAP = 0.04, 11.0  # share of the time, and mean length in frames
_EXCHANGED = 0.022  # [m] between points whose IDs may be exchanged


class Scene(NamedTuple):
    """A capture of both hands."""

    points: np.ndarray
    """(T, S, 3) [m], a column per marker, those of the right hand first, then ghosts; NaN elsewhere."""
    ids: np.ndarray
    """(T, S), -1 where there is no point."""
    counted: np.ndarray
    """(T,) whether the hands are there."""
    rate: float
    """[Hz]"""

    def capture(self) -> Capture:
        """The points without labels; the IDs of a capture are its columns' runs."""
        return Capture(tuple(f"*{column}" for column in range(self.points.shape[1])), self.points, self.rate)


def make_scene(folder: Path, condition: str, *, seed: int, frames: int = 0) -> Scene:
    """A capture under a condition, see `real_motion`.

    Args:
        folder: A capture's folder, .../User1/capture1.
        condition: One of `CONDITIONS`.
        seed: For gaps, ghosts and IDs.
        frames: Frames at most; all when 0.
    """
    rng = np.random.default_rng(seed)
    rate = 40.0 if "/".join(folder.parts[-2:]) in FAST else 120.0
    parts, counted, width = [], [], 2 * len(NAMES)
    for right, far in _sequences(folder, rate):
        left = _brought_close(right, far, rate, rng) if condition == "close" else far
        points = np.concatenate([right, left], axis=1)
        if condition != "clean":
            ghosts = [ghost for hand in (right, left) for ghost in sample_ghosts(hand, rng)]
            for column in points.swapaxes(0, 1):
                column[sample_gaps(len(column), rng)] = np.nan
            points = np.concatenate([points, *(ghost[:, None] for ghost in ghosts)], axis=1)
        dark = np.full((int(_DARK * rate), points.shape[1], 3), np.nan)
        parts += [points, dark]
        counted += [np.ones(len(points), dtype=bool), np.zeros(len(dark), dtype=bool)]
        width = max(width, points.shape[1])
        if frames and sum(map(len, parts)) >= frames:
            break
    points = np.concatenate(
        [np.pad(part, ((0, 0), (0, width - part.shape[1]), (0, 0)), constant_values=np.nan) for part in parts]
    )
    seen = np.isfinite(points[..., 0])
    ids = number_runs(seen)
    if condition == "new-ids":
        ids = np.where(seen, np.arange(seen.size).reshape(seen.shape), -1)
    elif condition == "exchanged-ids":
        _exchange(points, ids, rng)
    return Scene(points, ids, np.concatenate(counted), rate)


def _sequences(folder: Path, rate: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Right and left hands (T, 19, 3) [m] of one person at one time, cut where either jumps."""
    files = folder.glob("*left.trc")
    for file in sorted(files, key=lambda path: [int(number) for number in re.findall(r"\d+", path.name)]):
        left, numbers = _complete_frames(file)
        right, others = _complete_frames(file.with_name(file.name.replace("left", "right")))
        both, row, other = np.intersect1d(numbers, others, return_indices=True)
        hands = np.stack([right[other], left[row]])
        cut = np.diff(both, prepend=both[:1]) > 1
        if rate > 100.0:
            turns = np.linalg.norm(np.diff(hands.mean(2), n=2, axis=1), axis=-1) > _JUMP  # (2, T - 2)
            cut[3:] |= (turns[:, :-1] & turns[:, 1:]).any(axis=0)
        for part in np.split(np.arange(len(both)), np.flatnonzero(cut)):
            if len(part) >= _SHORTEST:
                yield hands[0, part], hands[1, part]


def _complete_frames(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """The frames of a file that show every marker: (T, 19, 3) [m], and their numbers (T,)."""
    cells = [line.split("\t") for line in file.read_text().splitlines()[5:]]
    count = 2 + 3 * len(NAMES)
    whole = [row for row in cells if len(row) >= count and all(cell.strip() for cell in row[2:count])]
    points = np.array([row[2:count] for row in whole], dtype=float).reshape(-1, len(NAMES), 3)
    return 1e-3 * points, np.array([int(row[0]) for row in whole], dtype=int)


def _brought_close(right: np.ndarray, left: np.ndarray, rate: float, rng: np.random.Generator) -> np.ndarray:
    """The left hand moved to 8 to 12 cm from the right one, where no two markers are within 15 mm."""
    spread = 0.03 * rate
    centers = [gaussian_filter1d(hand.mean(1), spread, axis=0) for hand in (right, left)]
    way = gaussian_filter1d(centers[1] - centers[0], 4.0 * spread, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    gap = 0.1 + 0.02 * np.sin(2.0 * np.pi * (np.arange(len(right)) / 204.0 + rng.random()))
    for t in range(len(right)):
        while gap[t] < 0.26:
            moved = left[t] - centers[1][t] + centers[0][t] + gap[t] * way[t]
            if np.linalg.norm(moved[:, None] - right[t], axis=-1).min() >= 0.015:
                break
            gap[t] += 0.002
    gap = gaussian_filter1d(maximum_filter1d(gap, 9), 3)
    moved: np.ndarray = left + (centers[0] - centers[1] + gap[:, None] * way)[:, None]
    return moved


def sample_gaps(frames: int, rng: np.random.Generator) -> np.ndarray:
    """When a marker is missing (T,): for 4 frames at a time in the median, 30 in one of ten."""
    gone, pause = np.zeros(frames, dtype=bool), _USUAL_GAP * (1.0 - _MISSING) / _MISSING
    t = rng.exponential(pause)
    while t < frames:
        length = int(np.clip(np.round(rng.lognormal(np.log(4.0), 1.572)), 1, 150))
        gone[int(t) : int(t) + length] = True
        t += length + rng.exponential(pause)
    return gone


def sample_ghosts(hand: np.ndarray, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Points (T, 3) [m] in a hand's box that go along with it for one to five frames, NaN else."""
    low, high = hand.min(1), hand.max(1)
    first = rng.exponential(20.0)
    while first < len(hand):
        t = int(first)
        last = min(len(hand), t + int(rng.integers(1, 6)))
        margin = 0.1 * (high[t] - low[t]).max()
        place = rng.uniform(low[t] - margin, high[t] + margin) - hand[t].mean(0)
        ghost = np.full((len(hand), 3), np.nan)
        ghost[t:last] = hand[t:last].mean(1) + place + rng.uniform(-0.003, 0.003, (last - t, 3))
        yield ghost
        first = last + rng.exponential(50.0)


def _exchange(points: np.ndarray, ids: np.ndarray, rng: np.random.Generator) -> None:
    """In one of 40 frames two points that are near each other exchange their IDs for good."""
    for t in np.flatnonzero(rng.random(len(ids)) < 1.0 / 40.0):
        seen = np.flatnonzero(ids[t] >= 0)
        distances = np.linalg.norm(points[t, seen, None] - points[t, seen], axis=-1)
        pairs = np.argwhere(np.triu(distances < _EXCHANGED, 1))
        if len(pairs):
            one, other = ids[t, seen[pairs[rng.integers(len(pairs))]]]
            later = ids[t:]
            mine, theirs = later == one, later == other
            later[mine], later[theirs] = other, one
