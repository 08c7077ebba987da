"""Gloves learned from simulated labeled captures: bones and places of markers against those that are worn.

python -m benchmarks.learned_gloves [--gloves 40] [--seed 9100]

Each glove has 6 to 30 markers at random places. Two people wear it for 20 s each. Columns have numbers for
names. A marker counts if it is farther than 5 mm from the bounds of its bone.
"""

from __future__ import annotations

import dataclasses
import warnings
from time import process_time
from typing import Any

import numpy as np
import torch

from benchmarks.record import describe, run
from gloves import Capture, MarkerLayout
from gloves.fit import attach, settle_glove
from handsim import HandModel
from handsim.errors import HandSimError
from handsim.hand.shape import BONE_NAMES, PALM, SIDES
from track import learn_glove
from track.gloves.glove_improvement import sample_places
from train import simulate_take

SECONDS, RATE, RADIUS = 20.0, 120.0, 0.003
CLEAR = 0.005  # [m] distance of a counted marker from the bounds of its bone
KINDS = ("single-hand", "real-like")


def random_glove(number: int, seed: int) -> MarkerLayout:
    """A glove of 6 to 30 markers at random places, at least 12 mm apart."""
    rng = np.random.default_rng((seed, number))
    count = int(rng.integers(6, 31))
    places = sample_places(count, rng=rng, apart=0.012)[:count]
    markers = tuple(dataclasses.replace(one, name=f"P{row}") for row, one in enumerate(places))
    return MarkerLayout(f"random{number}", markers, RADIUS)


def labeled_capture(layout: MarkerLayout, kind: str, side: str, seed: int) -> Capture:
    """A capture of one hand, a column for each marker."""
    count = round(SECONDS * RATE)
    hands: dict[str, Any] = {"hands": (side,)} if kind == "single-hand" else {}
    take = simulate_take(kind, glove=layout, num_frames=count, seed=seed, **hands)  # type: ignore[arg-type]
    markers = take.without_body().observed(side)  # type: ignore[arg-type]
    return Capture(layout.names, markers, take.rate)


def compared(layout: MarkerLayout, found: MarkerLayout) -> dict[str, Any]:
    """Errors of the learned places on a hand of size M [mm], and which bones are right."""
    model = HandModel.named("M")
    worn, other = (
        attach(layout, model).attachment,
        settle_glove(dataclasses.replace(found, sides=SIDES), model),
    )
    rows = [layout.names.index(name) for name in found.names]
    off = 1e3 * np.linalg.norm(worn.points[rows] - other.attachment.points, axis=1)
    bones = [BONE_NAMES.index(layout.markers[row].bone) for row in rows]
    learned = [BONE_NAMES.index(one.bone) for one in found.markers]
    clear = []
    for row, bone in zip(rows, bones, strict=True):
        along, length = layout.markers[row].along, model.skeleton.lengths[bone]
        inner = along * length > CLEAR and ((1.0 - along) * length > CLEAR or bone % 3 == 0)
        clear.append(bool(inner or bone == PALM))
    right = [one == other for one, other in zip(bones, learned, strict=True)]
    return {"off": off, "right": right, "clear": clear}


def outcome(number: int, seed: int) -> dict[str, Any]:
    """What was learned of one glove: see `compared`; or why it was refused."""
    layout, kind, side = random_glove(number, seed), KINDS[number % 2], SIDES[number // 2 % 2]
    captures = [labeled_capture(layout, kind, side, seed + 2 * number + person) for person in (0, 1)]
    began, row = process_time(), dict[str, Any]()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            learned = learn_glove(captures, radius_mm=1e3 * RADIUS)
        row = {"side": learned.layout.sides == (side,)} | compared(layout, learned.layout)
        share = 100 * np.mean(np.array(row["right"])[np.array(row["clear"])])
        print(f"glove {number}: bones {share:.0f} %, off {np.median(row['off']):.1f} mm", flush=True)
    except HandSimError as error:
        print(f"glove {number}: {error}", flush=True)
    return row | {"seconds": process_time() - began}


def main(gloves: int = 40, seed: int = 9100) -> None:
    torch.set_num_threads(1)
    print(describe("torch", "numba"))
    summary([outcome(number, seed) for number in range(gloves)])


def summary(rows: list[dict[str, Any]]) -> None:
    """Print bones and places over all gloves."""
    found = [row for row in rows if "off" in row]
    right = np.concatenate([np.array(row["right"])[np.array(row["clear"])] for row in found])
    off = np.concatenate([row["off"] for row in found])
    print(
        f"{len(found)} of {len(rows)} gloves learned, the side right in {sum(row['side'] for row in found)}"
    )
    print(
        f"bone right for {100 * right.mean():.1f} % of {len(right)} markers; place within "
        f"{np.median(off):.1f} mm (median), {np.quantile(off, 0.95):.1f} mm (95 %)"
    )
    print(
        f"seconds of a core: {np.median([row['seconds'] for row in rows]):.0f} (median), "
        f"{max(row['seconds'] for row in rows):.0f} (most)"
    )


if __name__ == "__main__":
    run(main, __doc__)
