"""What is said of a tracked take to whoever made it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from gloves.takes.tracked_take import LOST, STATUSES, TrackedTake

if TYPE_CHECKING:
    from jaxtyping import Float, Int


def summary(take: TrackedTake) -> list[str]:
    """What became of each hand, each body and the points, a line each."""
    lines = []
    for number, side in enumerate(take.sides):
        status, rms = take.status[:, number], take.rms[:, number]
        line = f"{side} hand: {_shares(status)}"
        if np.isfinite(rms).any():
            missing = take.filled[:, number].mean(axis=1)[status != LOST].mean()
            line += f"; {_median(rms)}, {100 * missing:.1f} % of markers filled in"
        else:
            line += "; it was never found: --hands says which hands there are"
        lines.append(line)
    for number, body in enumerate(take.bodies):
        rms = take.body_rms[:, number]
        words = _median(rms) if np.isfinite(rms).any() else "it was never found: are these its markers?"
        lines.append(f"{body.name}: {_shares(take.body_status[:, number])}; {words}")
    there = np.isfinite(take.points[..., 0])
    unlabeled = int((there & (take.labels < 0)).sum())
    return [*lines, f"{unlabeled} of {int(there.sum())} points are no markers"]


def _shares(status: Int[np.ndarray, "T"]) -> str:
    """How many of the frames have each status."""
    return ", ".join(
        f"{STATUSES[place]} {100 * np.mean(status == place):.1f} %"
        for place in reversed(range(len(STATUSES)))
    )


def _median(rms: Float[np.ndarray, "T"]) -> str:
    return f"median RMS {1e3 * np.nanmedian(rms):.2f} mm"


def say(line: str) -> None:
    """Print a line as it is."""
    Console().print(line, highlight=False, soft_wrap=True, markup=False)
