"""The pictures of a take's page: joint angles, residuals, and which markers were seen, over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.capture import runs_of
from gloves.takes.take import COASTING, LOST
from handsim.hand.shape import DIGITS, JOINT_NAMES
from track.reports.hand_figures import HandFigures
from train.reports.plot_style import BAND, BLUE, CARD, GREEN, LINE, SOFT, VIOLET, WARM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ANGLES_SIZE: Final = (9.6, 9.6)
"""Width and height of the angles' picture [inch]."""
RESIDUALS_SIZE: Final = (9.6, 2.2)
_BINS: Final = 750  # of a long take; the curve has the least and the largest value of each
_STROKES: Final = (VIOLET, BLUE, WARM, GREEN)  # of a digit's joints, from the knuckle outwards
_COASTING: Final = "#efd9c9"


def presence_size(num_markers: int) -> tuple[float, float]:
    """Width and height [inch] of a picture with a strip for each marker."""
    return 9.6, 1.0 + 0.17 * num_markers


def draw_angles(figure: Figure, times: Float[np.ndarray, "T"], hand: HandFigures) -> None:
    """One panel for each digit with its four angles and their bands; lost and coasting frames are shaded."""
    panels = figure.subplots(len(DIGITS), 1, sharex=True)
    starts, _ = _bins(len(times))
    shape = len(times), len(DIGITS), -1
    angles = hand.angles.reshape(shape)
    spread = None if hand.angle_spread is None else hand.angle_spread.reshape(shape)
    names = np.reshape([joint.split("_", 1)[1].replace("_", " ") for joint in JOINT_NAMES], angles.shape[1:])
    for number, (digit, panel) in enumerate(zip(DIGITS, panels, strict=True)):
        _prepare(panel, times, hand.status)
        panel.axhline(0.0, color=LINE, linewidth=0.8)
        for joint, (name, stroke) in enumerate(zip(names[number], _STROKES, strict=True)):
            values = angles[:, number, joint]
            panel.plot(*decimated(times, values), color=stroke, linewidth=1.1, label=name)
            if spread is not None:
                low, high = values - spread[:, number, joint], values + spread[:, number, joint]
                low, high = np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)
                panel.fill_between(times[starts], low, high, color=stroke, alpha=0.15, linewidth=0.0)
        panel.set_ylabel(f"{digit} [deg]")
        panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, handlelength=1.2)
    panels[-1].set_xlabel("time [s]")
    figure.align_ylabels()


def draw_residuals(figure: Figure, times: Float[np.ndarray, "T"], hand: HandFigures) -> None:
    """RMS distance of a hand's points from the markers of its pose."""
    panel = figure.subplots()
    _prepare(panel, times, hand.status)
    panel.plot(*decimated(times, 1e3 * hand.rms), color=BLUE, linewidth=1.1)
    panel.set_ylim(bottom=0.0)
    panel.set_ylabel("RMS [mm]")
    panel.set_xlabel("time [s]")


def draw_presence(figure: Figure, times: Float[np.ndarray, "T"], hand: HandFigures) -> None:
    """A strip for each marker: blue where it was seen, blank where not; of long takes the share seen."""
    from matplotlib.colors import LinearSegmentedColormap

    panel = figure.subplots()
    starts, ends = _bins(len(times))
    share = np.add.reduceat(hand.seen, starts, axis=0, dtype=np.float64) / (ends - starts)[:, None]
    colors = LinearSegmentedColormap.from_list("seen", (CARD, BLUE))
    edges = np.append(times[starts], _end(times))
    rows = np.arange(share.shape[1] + 1)
    panel.pcolormesh(edges, rows, share.T, cmap=colors, vmin=0.0, vmax=1.0, rasterized=True)
    panel.hlines(rows[1:-1], edges[0], edges[-1], color=CARD, linewidth=1.5)
    panel.set_yticks(rows[:-1] + 0.5, hand.marker_names, fontsize=7.5)
    panel.tick_params(axis="y", length=0.0)
    panel.invert_yaxis()
    panel.set_xlim(edges[0], edges[-1])
    panel.set_xlabel("time [s]")


def decimated(
    times: Float[np.ndarray, "T"], values: Float[np.ndarray, "T"]
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"]]:
    """A curve of at most twice 750 values: the least and the largest of each bin of frames.

    Args:
        values: NaN where there is none; of a bin without any too.
    """
    starts, ends = _bins(len(times))
    if len(starts) == len(times):
        return times, values
    middles = (starts + ends) // 2
    pairs = np.stack([np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)], axis=1)
    return np.stack([times[starts], times[middles]], axis=1).ravel(), pairs.ravel()


def shaded(times: Float[np.ndarray, "T"], flags: Bool[np.ndarray, "T"]) -> list[tuple[float, float]]:
    """Begin and length of the spans of frames that are flagged [s], as wide as a bin at least."""
    starts, ends = _bins(len(times))
    edges = np.append(times, _end(times))
    runs = runs_of(np.logical_or.reduceat(flags, starts))
    return [(float(edges[starts[a]]), float(edges[ends[b]] - edges[starts[a]])) for a, b in runs]


def _bins(num_frames: int) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """The first frame of each bin, and the one after its last; a bin for each frame of a short take."""
    width = 1 if num_frames <= 2 * _BINS else -(-num_frames // _BINS)
    starts = np.arange(0, num_frames, width)
    return starts, np.append(starts[1:], num_frames)


def _end(times: Float[np.ndarray, "T"]) -> float:
    """When the last frame ends [s]: it lasts as long as the one before."""
    return float(2.0 * times[-1] - times[-2]) if len(times) > 1 else float(times[-1]) + 1.0


def _prepare(panel: Axes, times: Float[np.ndarray, "T"], status: Int[np.ndarray, "T"]) -> None:
    """Grid and limits of a panel, with the frames shaded in which the hand is lost or coasts."""
    panel.grid(axis="y", color=BAND, linewidth=0.8)
    panel.set_xlim(times[0], _end(times))
    for state, color in ((COASTING, _COASTING), (LOST, LINE)):
        spans: Sequence[tuple[float, float]] = shaded(times, status == state)
        across = panel.get_xaxis_transform()
        panel.broken_barh(spans, (0.0, 1.0), transform=across, facecolors=color, linewidth=0.0)
    panel.tick_params(labelcolor=SOFT)
