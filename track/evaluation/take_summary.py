"""Summary of a tracked take, as lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from gloves.takes.tracked_take import LOST, STATUSES, TrackedTake

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def summarize(take: TrackedTake) -> list[str]:
    """One line per hand, one per body and one for the unlabeled points."""
    lines = []
    for number, side in enumerate(take.sides):
        status, rms = take.status[:, number], take.rms[:, number]
        line = f"{side} hand: {_status_shares(status)}"
        if np.isfinite(rms).any():
            missing = take.filled[:, number].mean(axis=1)[status != LOST].mean()
            line += f"; {_median_rms(rms)}, {100 * missing:.1f} % of markers filled in"
        else:
            line += "; it was never found; --hands selects the hands"
        lines.append(line)
    for number, body in enumerate(take.bodies):
        rms = take.body_rms[:, number]
        words = _median_rms(rms) if np.isfinite(rms).any() else "it was never found: are these its markers?"
        lines.append(f"{body.name}: {_status_shares(take.body_status[:, number])}; {words}")
    there = np.isfinite(take.points[..., 0])
    unlabeled = int((there & (take.labels < 0)).sum())
    return [*lines, f"{unlabeled} of {int(there.sum())} points are not markers"]


def _status_shares(status: Int[np.ndarray, "T"]) -> str:
    """Share of the frames with each status."""
    return ", ".join(
        f"{STATUSES[number]} {100 * np.mean(status == number):.1f} %"
        for number in reversed(range(len(STATUSES)))
    )


def _median_rms(rms: Float[np.ndarray, "T"]) -> str:
    return f"median RMS {1e3 * np.nanmedian(rms):.2f} mm"


def print_line(line: str) -> None:
    """Print a line as it is."""
    Console().print(line, highlight=False, soft_wrap=True, markup=False)
