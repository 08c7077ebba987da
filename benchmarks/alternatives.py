"""Confidence in labels on whole takes: whether labels that are wrong in every frame are told as doubtful.

python -m benchmarks.alternatives --takes 200 --seed 7000 --out FILE.json [--first N]

Simulated captures of random layouts of 6 to 30 markers, five takes each, are labeled. A third of the layouts
have look-alike pairs of markers or are like their own mirror image. In a third of the takes two markers are
worn 10 to 30 mm from where the layout has them. FILE.json has one JSON line a take; takes that it has are not
made again. A take is sure if no likely alternative gives more than 1 % of doubt to any of its labels. It is
wrong if the points with some label are mostly another marker's, or of no marker.
"""

from __future__ import annotations

import dataclasses
import warnings
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich import print as show

from benchmarks.mirror_like import GLOVES, mirror_like
from benchmarks.record import describe, kept_rows, number_table, run
from gloves import MarkerLayout, MarkerPlace, Take
from gloves.fit import attach_markers
from handsim import HandModel
from handsim.errors import HandSimError
from handsim.hand.shape import BONES, PALM, SIDES
from track import label_capture
from track.alternatives.alternatives import ALTERNATIVES, label_probability
from track.gloves.glove_improvement import sample_places
from track.gloves.glove_score import layout_at as markers_alone
from train import simulate_take
from train.evaluation import BINS, expected_calibration_error, reliability
from train.labelers.layout_labeler import LayoutLabeler

KINDS = ("single-hand", "hand-hand", "real-like")
FRAMES, TAKES_A_LAYOUT = 120, 5
POSES = 10_000  # that describe a layout to its labeler
RADIUS = 0.0032  # [m]
labeler_of = cache(partial(LayoutLabeler.at_once, num_poses=POSES))  # not improved for the layout
OFF = (0.010, 0.030)  # [m] how far from its place a marker is worn
SURE = 0.99


def random_layout(number: int, rng: np.random.Generator) -> MarkerLayout:
    """A random layout; of three in turn one has twin markers or is like its own mirror image."""
    count = int(rng.integers(6, 31))
    if number % 6 == 3:
        return mirror_like(number // 6 % len(GLOVES))
    twins = 2 if number % 6 == 0 else 0
    places = list(sample_places(max(count - twins, 5), rng=rng, apart=0.012))
    for place in rng.choice(len(places), twins, replace=False):
        places.append(moved(places[place], 0.009, 0.014, rng))
    named = [dataclasses.replace(one, name=f"M{n}") for n, one in enumerate(places)]
    return MarkerLayout(f"random{number}", tuple(named), RADIUS)


def moved(place: MarkerPlace, least: float, most: float, rng: np.random.Generator) -> MarkerPlace:
    """A place on the same bone at a distance in a range [m]."""
    model = HandModel.named("M")
    while True:
        along = float(np.clip(place.along + rng.normal(0.0, 0.4), -0.2, 1.0))
        across = place.across + rng.normal(0.0, 0.2) if place.bone == BONES[PALM].name else 0.0
        around = place.around + rng.normal(0.0, 0.3)
        try:
            other = dataclasses.replace(place, along=along, around=around, across=across)
            points = attach_markers(markers_alone([place, other], RADIUS), model).points
        except HandSimError:
            continue
        if least < np.linalg.norm(points[1] - points[0]) < most:
            return other


def labeled(number: int, seed: int) -> tuple[Take, np.ndarray, dict[str, Any]]:
    """A labeled take, the true label of each point, and what kind of take it is."""
    group, turn = divmod(number, TAKES_A_LAYOUT)
    worn = layout = random_layout(group, np.random.default_rng((seed, group)))
    rng, off = np.random.default_rng((seed, group, turn)), (group + turn) % 3 == 0
    if off:
        places = list(layout.markers)
        for place in rng.choice(len(places), 2, replace=False):
            places[place] = dataclasses.replace(moved(places[place], *OFF, rng), name=places[place].name)
        worn = dataclasses.replace(layout, markers=tuple(places))
    kind = KINDS[(number + group) % len(KINDS)]
    hands = {"hands": (SIDES[number % 2],)} if kind == "single-hand" else {}
    truth = simulate_take(kind, glove=worn, num_frames=FRAMES, seed=seed + number, **hands)  # type: ignore[arg-type]
    truth = truth.without_body()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        take = label_capture(truth.capture(), glove=layout, labeler=labeler_of(layout))
    table = np.array([take.label_names.index(name) for name in truth.label_names] + [-1])
    about = {"number": number, "layout": layout.name, "markers": layout.num_markers, "kind": kind, "off": off}
    return take, table[truth.point_list.labels], about


def outcome(take: Take, true: np.ndarray) -> dict[str, Any]:
    """Of each label: points, confidence and right ones; which are wrong throughout; what is told."""
    labels, confidence = take.point_list.labels, take.point_list.confidence
    there = np.unique(labels[labels >= 0])
    every = [labels == label for label in there]
    right = [float((true[one] == label).mean()) for one, label in zip(every, there, strict=True)]
    bins = reliability(confidence[labels >= 0], (true == labels)[labels >= 0])
    return {
        "labels": [take.label_names[label] for label in there],
        "points": [int(one.sum()) for one in every],
        "confidence": [float(confidence[one].mean()) for one in every],
        "right": right,
        "least": float(label_probability(take)[there].min(initial=1.0)),
        "wrong": [take.label_names[label] for label, share in zip(there, right, strict=True) if share < 0.5],
        "bins": np.nan_to_num([bins.count, bins.confidence, bins.right]).tolist(),
        "told": take.settings.get(ALTERNATIVES, {}),
    }


def summary(rows: list[dict[str, Any]]) -> None:
    """Print calibration by label of a take and by point, and the takes that are wrong."""
    confidence, right = (np.concatenate([row[key] for row in rows]) for key in ("confidence", "right"))
    count, told, true = np.array([row["bins"] for row in rows]).transpose(1, 0, 2)
    total = count.sum(axis=0)
    pooled = [(count * one).sum(axis=0) / np.maximum(total, 1) for one in (told, true)]
    error = 100 * (np.abs(pooled[0] - pooled[1]) * total).sum() / total.sum()
    labels = reliability(confidence, right)
    table = number_table("confidence by label of a take", ("bin",), ("labels", "told [%]", "right [%]"))
    for n, number in enumerate(labels.count):
        shares = (f"{100 * share[n]:.1f}" for share in (labels.confidence, labels.right))
        table.add_row(f"{n / BINS:.2f}", str(number), *shares)
    show(table)
    by_label = 100 * expected_calibration_error(confidence, right)
    print(f"ECE by label of a take {by_label:.2f} %, by point {error:.2f} %")
    for words, chosen in (
        ("alternatives", [row for row in rows if row["least"] >= SURE]),
        ("mean confidence", [row for row in rows if np.mean(row["confidence"]) >= SURE]),
    ):
        wrong = [row["number"] for row in chosen if row["wrong"]]
        print(f"sure by {words}: {len(chosen)} of {len(rows)} takes; of these wrong throughout: {wrong}")
    print(f"wrong throughout: {[row['number'] for row in rows if row['wrong']]}")


def main(out: Path = Path("alternatives.json"), takes: int = 200, seed: int = 7000, first: int = 0) -> None:
    torch.set_num_threads(1)
    print(describe("torch", "numba"))

    def make(number: int) -> dict[str, Any]:
        take, true, about = labeled(number, seed)
        row = about | outcome(take, true)
        share = 100 * np.mean(true == take.point_list.labels)
        print(*about.values(), f"{share:.2f} % right, wrong {row['wrong']}", flush=True)
        return row

    summary(kept_rows(out, range(first, first + takes), make))


if __name__ == "__main__":
    run(main, __doc__)
