"""Whether the sides of gloves that are like their own mirror image are exchanged, and whether it is told.

python -m benchmarks.mirror_like [--gloves 0 1 2 3] [--seeds 1 2 3 4] [--frames 300] [--store FOLDER]

Captures of three kinds are labeled and tracked as `handsim label` and `handsim track` do. Sides are exchanged
in a hand if most points with its labels are truly the other hand's, in a fifth of its frames or more. It is
told by a warning of the glove, when its labeler is loaded, or by a fault of the tracked take. --store keeps
outcomes in a folder, from which another run continues.
"""

from __future__ import annotations

import warnings
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import torch

from benchmarks.record import describe, kept, run
from gloves import MarkerLayout, MarkerPlace, Take, load_layout
from track import find_suspect_spans, label_capture, track_capture
from train import load_labeler, simulate_take

KINDS = ("single-hand", "hand-hand", "hand-pen")
_TIPS = ("index_distal", "middle_distal", "ring_distal", "little_distal")
_KNUCKLES = ("index_proximal", "middle_proximal", "ring_proximal", "little_proximal")
_MIXED = ("thumb_distal", "little_distal", "index_proximal", "ring_proximal", "middle_distal")
_CROSS = ("index_middle", "middle_distal", "ring_middle", "little_distal")
GLOVES = (_TIPS, _KNUCKLES, _MIXED, _CROSS)
_BACK = ((0.3, 0.2), (0.3, -0.2), (0.7, 0.2), (0.7, -0.2))  # along and across the palm
_EXCHANGED = 0.2  # share of a hand's frames


def mirror_like(number: int) -> MarkerLayout:
    """One of the gloves: a marker on each of some bones, and four that are symmetric on the back."""
    places = [MarkerPlace(bone, bone, along=0.7, around=0.0) for bone in GLOVES[number]]
    for n, (along, across) in enumerate(_BACK):
        places.append(MarkerPlace(f"Back{n}", "palm", along=along, around=0.0, across=across))
    return MarkerLayout(f"mirror{number}", tuple(places), load_layout("dense19").radius)


def shares(take: Take, truth: np.ndarray) -> tuple[float, float]:
    """Share of points right, and the larger share of a hand's frames whose labels are the other hand's."""
    part = take.hands[0].layout.num_markers
    there = np.isfinite(take.points[..., 0])
    both = (take.labels >= 0) & (truth >= 0)
    largest = 0.0
    for hand in range(len(take.hands)):
        mine = both & (take.labels // part == hand)
        other = mine & (truth // part != hand)
        frames = mine.any(axis=1)
        if frames.any():
            largest = max(largest, float((2 * other.sum(axis=1) > mine.sum(axis=1))[frames].mean()))
    return float((take.labels == truth)[there].mean()), largest


def outcome(number: int, kind: str, seed: int, frames: int) -> dict[str, list[float]]:
    """Of `label` and `track`: shares of `shares`, and whether the glove and the take tell of the sides."""
    layout = mirror_like(number)
    take = simulate_take(kind, glove=layout, num_frames=frames, seed=seed).without_body()  # type: ignore[arg-type]
    found = {}
    for name, make in (("label", label_capture), ("track", track_capture)):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            labeler = load_labeler(layout)
        by_glove = any("mirror image" in str(one.message) for one in told)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = make(take.capture(), glove=layout, labeler=labeler)
        by_take = any("may be the" in span.why for span in find_suspect_spans(made))
        found[name] = [*shares(made, take.labels), float(by_glove), float(by_take)]
    return found


def main(
    gloves: tuple[int, ...] = (0, 1, 2, 3),
    seeds: tuple[int, ...] = (1, 2, 3, 4),
    frames: int = 300,
    store: Path | None = None,
) -> None:
    torch.set_num_threads(1)
    print(describe("torch", "numba"))
    rows: dict[str, list[list[float]]] = {"label": [], "track": []}
    for number, seed, kind in product(gloves, seeds, KINDS):
        path = None if store is None else store / f"{number}_{kind}_{seed}_{frames}.json"
        found = kept(path, partial(outcome, number, kind, seed, frames))
        for name, row in found.items():
            rows[name].append(row)
        told = "; ".join(
            f"{name} {100 * right:.1f} % right, exchanged in {100 * share:.0f} %, told by "
            f"the glove {glove:.0f}, by the take {take:.0f}"
            for name, (right, share, glove, take) in found.items()
        )
        print(f"glove {number}, {kind}, seed {seed}: {told}", flush=True)
    for name, every in rows.items():
        _, share, glove, take = np.array(every).T
        exchanged = share > _EXCHANGED
        silent = exchanged & (glove + take == 0)
        print(
            f"{name}: {len(every)} captures, {(~exchanged).sum()} right, {exchanged.sum()} exchanged, of "
            f"these told {(exchanged & ~silent).sum()} (by the take {(exchanged & (take > 0)).sum()}), in "
            f"silence {silent.sum()}; unsure though right {(~exchanged & (take > 0)).sum()}"
        )


if __name__ == "__main__":
    run(main, __doc__)
