"""How far the metacarpals of ring and little finger flex in the palm, by markers of labeled captures.

    python -m benchmarks.palm RH1 RH6 RH2 RH3 RH5 RPF1 CAPTURES [--lever 54]

Six markers are named: four on the back, two of them at the wrist and two at the knuckles of index and middle
finger, each on the thumb's side first; one on the knuckle of the finger, and one on its middle joint. --lever
is how far the knuckle is from the hinge at the wrist [mm]. A table has, for each capture, the range from the
5th to the 95th percentile of

- flexion of the first bone against the rigid back, as a model with a rigid palm has it;
- the plain angle of wrist, knuckle and middle joint, which has no sign and counts abduction;
- the same in the plane of flexion, with a sign;
- the hinge: the knuckle's motion across the metacarpal over the lever;

and how far knuckles are from the hinge's path (RMS).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rich
from numpy.typing import NDArray

from benchmarks.record import number_table, run
from gloves import read_capture
from handsim.space.transforms import rigid_fit, unit

Doubles = NDArray[np.float64]
_ROUNDS = 4  # of fitting the markers of the back to their median places


def main(
    back: tuple[str, str, str, str], knuckle: str, joint: str, captures: tuple[Path, ...], lever: float = 54.0
) -> None:
    columns = ["rigid palm", "plain angle", "in the plane", "hinge", "off [mm]"]
    table = number_table(f"Ranges of flexion at {knuckle} [deg]", ["capture"], columns)
    for path in captures:
        capture = read_capture(path)
        points = dict(zip(capture.names, capture.positions.swapaxes(0, 1), strict=True))
        on_back = np.stack([points[name] for name in back], axis=1)
        figures = flexion(on_back, points[knuckle], points[joint], lever)
        table.add_row(path.stem, *(f"{value:.1f}" for value in figures))
    rich.print(table)


def flexion(back: Doubles, knuckle: Doubles, joint: Doubles, lever: float) -> list[float]:
    """The figures of one capture, from markers (T, 4, 3), (T, 3) and (T, 3) [m]."""
    whole = np.isfinite(np.concatenate([back, knuckle[:, None], joint[:, None]], axis=1)).all(axis=(1, 2))
    back, knuckle, joint = back[whole], knuckle[whole], joint[whole]
    places = back[0] - back[0].mean(axis=0)
    for _ in range(_ROUNDS):
        turns, shifts = rigid_fit(back, np.broadcast_to(places, back.shape))
        own = np.einsum("tij,tmj->tmi", turns, back) + shifts[:, None]
        places = np.median(own, axis=0)
    ahead = unit(places[2:].mean(axis=0) - places[:2].mean(axis=0))
    up = unit(np.cross(ahead, places[2] - places[3]))
    knuckle, joint, wrist = (
        np.einsum("tij,tj->ti", turns, one) + shifts for one in (knuckle, joint, back[:, 1])
    )
    bone, before, middle = joint - knuckle, knuckle - wrist, np.median(knuckle, axis=0)
    rigid = np.arctan2(-bone @ up, bone @ ahead)
    plain = np.arccos(np.einsum("ti,ti->t", unit(bone), unit(before)))
    signed = rigid - np.arctan2(-before @ up, before @ ahead)
    along = unit(middle - places[1])
    moved = knuckle - middle
    across = moved - np.outer(moved @ along, along)
    way = np.linalg.svd(across, full_matrices=False)[2][0]
    hinge = np.arctan2(across @ way, 1e-3 * lever)
    off = moved - np.outer(across @ way, way)
    ranges = [float(np.rad2deg(np.ptp(np.percentile(one, [5, 95])))) for one in (rigid, plain, signed, hinge)]
    return [*ranges, 1e3 * float(np.sqrt((off**2).sum(axis=1).mean()))]


if __name__ == "__main__":
    run(main, __doc__)
