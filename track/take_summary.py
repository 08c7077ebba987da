"""Summary of a tracked take, as lines of text, and what in it tells of a mistake."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float, Int

from gloves.captures.plausibility import AT_ORIGIN, all_at_origin, unit_fault
from gloves.takes.take import LOST, STATUSES, Take
from handsim.hand.topology import Side

_LEAST_SEEN: Final = 0.1  # share of the frames that a hand should have a pose in
_MOST_FILLED: Final = 0.35  # share of a hand's markers; two hands that hide each other reach 0.31
_MOST_RMS: Final = 0.005  # [m]; hands of the nearest size reach 0.004
_MOST_UNLABELED: Final = 0.25  # share of the points


def summarize(take: Take) -> list[str]:
    """One line per hand, one per body and one for the unlabeled points."""
    lines = []
    for number, side in enumerate(take.sides):
        status, rms = take.status[:, number], take.rms[:, number]
        line = f"{side} hand: {_status_shares(status)}"
        if np.isfinite(rms).any():
            missing = take.filled(side)[status != LOST].mean()
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


def suspicions(take: Take) -> list[str]:
    """What is probably not as the user meant it, as one sentence each with its remedy."""
    there = np.isfinite(take.points[..., 0])
    if not there.any():
        return [f"no point is in any of the {take.num_frames} frames; does the camera system see markers?"]
    clouds = [points[seen] for points, seen in zip(take.points, there, strict=True)]
    if all_at_origin(clouds):
        return [AT_ORIGIN]
    fault = unit_fault(clouds, only_wide=True)
    if fault is not None:
        return [f"{fault.found}, expected meters; set the unit of the stream to meters{fault.hint}"]
    found = [sentence for side in take.sides for sentence in _suspicions_of(take, side)]
    unlabeled = float((take.labels[there] < 0).mean())
    if unlabeled > _MOST_UNLABELED:
        found.append(
            f"{100 * unlabeled:.1f} % of the points are not markers of what was tracked; name the glove worn "
            "(--glove), the hands (--hands) and the rigid bodies (--body) that are in the capture"
        )
    return found


def _suspicions_of(take: Take, side: Side) -> list[str]:
    """What tells of a mistake about one hand."""
    hand = take.hand(side)
    shown = take.status[:, hand] != LOST
    if shown.mean() < _LEAST_SEEN:
        others = [f" (--hands {other})" for other in take.sides if other != side]
        return [
            f"the {side} hand was seen in {100 * shown.mean():.1f} % of the frames; name the glove worn "
            f"(--glove), or track the other hand alone{''.join(others)}"
        ]
    found = []
    filled, rms = float(take.filled(side)[shown].mean()), float(np.nanmedian(take.rms[:, hand]))
    if filled > _MOST_FILLED:
        found.append(
            f"{100 * filled:.1f} % of the {side} hand's markers were not seen and are filled in from its "
            "pose; name the glove worn (--glove) and the hands that are in the capture (--hands)"
        )
    if rms > _MOST_RMS:
        found.append(
            f"the {side} hand's markers are {1e3 * rms:.1f} mm off its pose; name the glove worn (--glove), "
            "try another --size, or calibrate the hands (handsim calibrate, then --shape)"
        )
    return found


def _status_shares(status: Int[np.ndarray, "T"]) -> str:
    """Share of the frames with each status."""
    return ", ".join(
        f"{STATUSES[number]} {100 * np.mean(status == number):.1f} %"
        for number in reversed(range(len(STATUSES)))
    )


def _median_rms(rms: Float[np.ndarray, "T"]) -> str:
    return f"median RMS {1e3 * np.nanmedian(rms):.2f} mm"
