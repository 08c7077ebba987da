"""How far the metacarpals of ring and little finger flex in the palm, by markers of labeled captures.

    python -m benchmarks.palm RH1 RH6 RH2 RH3 RH5 RPF1 CAPTURES [--lever 54] [--takes FOLDER --finger little]

Six markers are named: four on the back, two of them at the wrist and two at the knuckles of index and middle
finger, each on the thumb's side first; one on the knuckle of the finger, and one on its middle joint. --lever
is how far the knuckle is from the hinge at the wrist [mm]. A table has, for each capture, the range from the
5th to the 95th percentile of

- flexion of the first bone against the rigid back, as a model with a rigid palm has it;
- the plain angle of wrist, knuckle and middle joint, which has no sign and counts abduction;
- the same in the plane of flexion, with a sign;
- the hinge: the knuckle's motion across the metacarpal over the lever;

how far knuckles are from the hinge's path (RMS); and the share of the first bone's flexion by which the
metacarpal flexes and turns aside, which a rigid palm takes for flexion and abduction of the MCP joint (ratios
of RMS, counted from the tenth of the frames with the least flexion). The last row is the RMS of all captures.

Captures of one person are in one folder. With several people a second table has, for each, the share of the
flexion by which the metacarpals of the others flex (least squares, all people alike); what it explains of the
person's own flexion of the metacarpal, from the flat hand and around its mean; and the median error of the
range of MCP flexion of a rigid palm, and of a palm with this share.

With a folder of their takes (`handsim track CAPTURES --calibrate --out FOLDER`) a third table has the tracked
MCP flexion of the finger beside the signed angle of wrist, knuckle and middle joint, both from the flat hand:
ranges, error (RMS), the same over the bone's flexion (RMS), stated standard deviation (median), and errors
within one and two of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rich
from numpy.typing import NDArray
from rich.table import Table

from benchmarks.record import number_table, run
from gloves import load_take, read_capture
from handsim.space.transforms import rigid_fit, unit

Doubles = NDArray[np.float64]
_FLAT = 10.0  # [%] of the frames that count as a flat hand
_ROUNDS = 4  # of fitting the markers of the back to their median places


class Motion(NamedTuple):
    """Motion of a finger's first bone and of its metacarpal."""

    figures: list[float]
    """The row of the table."""
    bone: Doubles
    """Flexion of the bone against the back, from the flat hand (T,) [rad]."""
    metacarpal: Doubles
    """Flexion of the metacarpal in each frame (T,) [rad]; zero is the flat hand."""
    signed: Doubles
    """Angle of the bone with the line from the wrist to the knuckle (T,) [rad]."""
    flat: NDArray[np.bool_]
    """Frames that count as the flat hand (T,)."""
    whole: NDArray[np.bool_]
    """Which frames of the capture these are: those with all markers."""

    def centered(self) -> Motion:
        """The motion around its mean."""
        bone, metacarpal = self.bone - self.bone.mean(), self.metacarpal - self.metacarpal.mean()
        return self._replace(bone=bone, metacarpal=metacarpal)

    def squares(self, share: float) -> tuple[float, float]:
        """Mean square of the metacarpal's flexion without a share of the bone's, and with it [rad^2]."""
        left = self.metacarpal - share * self.bone
        return float((left**2).mean()), float((self.metacarpal**2).mean())

    def range_error(self, share: float) -> float:
        """Error of the range of MCP flexion if the metacarpal has this share of the bone's flexion [deg]."""
        return abs(_range((1.0 - share) * self.bone) - _range(self.bone - self.metacarpal))


def main(
    back: tuple[str, str, str, str],
    knuckle: str,
    joint: str,
    captures: tuple[Path, ...],
    lever: float = 54.0,
    takes: Path | None = None,
    finger: str = "little",
) -> None:
    columns = ["rigid palm", "plain angle", "in the plane", "hinge", "off [mm]", "share", "aside"]
    table = number_table(f"Ranges of flexion at {knuckle} [deg]", ["capture"], columns)
    people: dict[str, list[Motion]] = {}
    for path in captures:
        capture = read_capture(path)
        points = dict(zip(capture.names, capture.positions.swapaxes(0, 1), strict=True))
        on_back = np.stack([points[name] for name in back], axis=1)
        people.setdefault(path.parent.name, []).append(motion(on_back, points[knuckle], points[joint], lever))
    every = [one.figures for person in people.values() for one in person]
    names = [path.stem for person in people for path in captures if path.parent.name == person]
    every.append(np.sqrt(np.square(every).mean(axis=0)).tolist())
    for name, figures in zip([*names, "all"], every, strict=True):
        table.add_row(name, *map("{:.1f}".format, figures[:-2]), *map("{:.3f}".format, figures[-2:]))
    rich.print(table)
    if len(people) > 1:
        rich.print(_held_out(people))
    if takes is not None:
        motions = dict(zip(names, [one for person in people.values() for one in person], strict=True))
        rich.print(_tracked(motions, takes, f"{finger}_MCP_flexion"))


def _tracked(motions: dict[str, Motion], folder: Path, angle: str) -> Table:
    """How far off a tracked angle is, and how far it is said to be."""
    columns = ["tracked", "by markers", "error [deg]", "over flexion", "SD", "1 SD [%]", "2 SD [%]"]
    table, every = number_table(f"{angle} of takes [deg]", ["capture"], columns), []
    for name, one in motions.items():
        take = load_take(folder / f"{name}.npz")
        (side,) = take.sides
        found, spread = (values[angle][one.whole] for values in (take.angles(side), take.angle_spreads(side)))
        known, flat = np.isfinite(found), np.isfinite(found) & one.flat
        off = np.abs((found - found[flat].mean() - one.signed + one.signed[flat].mean())[known])
        rms, flexed = np.sqrt((off**2).mean()), np.sqrt((one.bone[known] ** 2).mean())
        within = [100.0 * (off <= factor * spread[known]).mean() for factor in (1, 2)]
        degrees = np.rad2deg([rms, np.median(spread[known])])
        every.append(
            [_range(found[known]), _range(one.signed[known]), degrees[0], rms / flexed, degrees[1], *within]
        )
    every.append(np.mean(every, axis=0).tolist())
    for name, figures in zip([*motions, "mean"], every, strict=True):
        cells = [f"{value:.2f}" if number == 3 else f"{value:.1f}" for number, value in enumerate(figures)]
        table.add_row(name, *cells)
    return table


def _held_out(people: dict[str, list[Motion]]) -> Table:
    """What the share of the other people explains of each person's metacarpals."""
    columns = ["share of others", "explained [%]", "around its mean [%]", "range off [deg]", "with the share"]
    table = number_table("One share for all people", ["person"], columns)
    squares, errors = [], []
    for name, person in people.items():
        others = [motions for other, motions in people.items() if other != name]
        share, around = _share(others), _share([[one.centered() for one in motions] for motions in others])
        left = [[*one.squares(share), *one.centered().squares(around)] for one in person]
        off = [[one.range_error(0.0), one.range_error(share)] for one in person]
        squares.append(np.mean(left, axis=0).tolist())
        errors += off
        table.add_row(name, f"{share:.2f}", *_cells(squares[-1:], off))
    table.add_row("all", "", *_cells(squares, errors))
    return table


def _cells(squares: list[list[float]], errors: list[list[float]]) -> list[str]:
    """Cells of a row: how much of the motion a share explains [%], and median errors of ranges [deg]."""
    left, whole, around, spread = np.sum(squares, axis=0)
    explained = [f"{100.0 * (1.0 - one):.0f}" for one in (left / whole, around / spread)]
    return [*explained, *map("{:.1f}".format, np.median(errors, axis=0))]


def _share(people: Sequence[Sequence[Motion]]) -> float:
    """Share of the bone's flexion by which the metacarpal flexes; each person counts the same."""
    moments = [
        np.mean([[(one.bone * one.metacarpal).mean(), (one.bone**2).mean()] for one in person], axis=0)
        for person in people
    ]
    both, alone = np.sum(moments, axis=0)
    return float(both / alone)


def _range(angles: Doubles) -> float:
    """Range from the 5th to the 95th percentile [deg]."""
    return float(np.rad2deg(np.ptp(np.percentile(angles, [5, 95]))))


def motion(back: Doubles, knuckle: Doubles, joint: Doubles, lever: float) -> Motion:
    """The motion of one capture, from markers (T, 4, 3), (T, 3) and (T, 3) [m]."""
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
    flat = rigid <= np.percentile(rigid, _FLAT)
    bent = rigid - rigid[flat].mean()
    turned = np.stack([-moved @ up, moved @ np.cross(up, ahead)]) / (1e-3 * lever)
    turned -= turned[:, flat].mean(axis=1, keepdims=True)
    shares = np.linalg.norm(turned, axis=1) / np.linalg.norm(bent)
    ranges = [_range(one) for one in (rigid, plain, signed, hinge)]
    figures = [*ranges, 1e3 * float(np.sqrt((off**2).sum(axis=1).mean())), *shares.tolist()]
    return Motion(figures, bent, turned[0], signed, flat, whole)


if __name__ == "__main__":
    run(main, __doc__)
