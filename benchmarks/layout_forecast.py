"""What `handsim glove score` says of layouts, beside captures that are labeled and tracked afterwards.

Twelve layouts of 6 to 30 markers: symmetric, sparse, on the palm's side, without thumb, in clusters, and
shipped ones. Forecast and outcome have other people and motions. Layouts that are finished stay in the
folder; run again to continue.

python -m benchmarks.layout_forecast FOLDER
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from benchmarks.record import describe, run
from gloves import MarkerLayout, MarkerPlace, load_layout
from handsim.hand.shape import BONE_NAMES, DIGITS, bones_of
from track.glove_score import CAPTURES, FRAMES, METHODS, WORK, mean_trial, try_layout
from train import Labeler
from train.labelers.layout_labeler import learned_labeler

Figures = dict[str, Any]


def main(folder: Path) -> None:
    print(describe("torch", "numpy"))
    told, found, listed = [], [], 0
    for layout in chosen_layouts():
        path = folder / layout.name
        path.mkdir(parents=True, exist_ok=True)
        labeler = learned_labeler(layout)
        told.append(stored(path / "told.json", lambda: trial_figures(layout, labeler, 0, FRAMES)))  # noqa: B023
        found.append(stored(path / "found.json", lambda: trial_figures(layout, labeler, 50, 600, 4)))  # noqa: B023
        for work, shares in told[-1].items():
            pairs = ", ".join(
                f"{method} {100 * share:.2f} / {100 * found[-1][work]['share'][method]:.2f}"
                for method, share in shares["share"].items()
            )
            least = ", ".join(f"{100 * one:.2f}" for one in found[-1][work]["worst"].values())
            joints = f"{shares['joints']:.1f} / {found[-1][work]['joints']:.1f} deg"
            print(
                f"{layout.name}, {work}: forecast / outcome {pairs}; worst {least}; joints {joints}, size "
                f"off {found[-1][work]['size']:.1f} mm",
                flush=True,
            )
        worst = int(np.argmin(told[-1]["two touching"]["right"]))
        listed += worst in np.argsort(found[-1]["two touching"]["right"])[:3]
    for work in WORK:
        for method in METHODS:
            pairs = [[one[work]["share"][method] for one in rows] for rows in (told, found)]
            print(f"{work}, {method}: rank correlation {spearmanr(*pairs).statistic:.3f}")
    print(f"worst marker of touching hands among the worst three: {listed} of {len(told)}")


def trial_figures(
    layout: MarkerLayout, labeler: Labeler, first: int, frames: int, count: int = CAPTURES
) -> Figures:
    """What became of captures of a layout, by kind of work: means, and the worst capture's slots."""
    trials = [
        try_layout(layout, "figure5", labeler, count=1, first=number, frames=frames)
        for number in range(first, first + count)
    ]
    figures: Figures = {}
    for work in trials[0]:
        rows = [one[work] for one in trials]
        mean = mean_trial(rows)
        figures[work] = {
            "share": {method: mean.share(method) for method in METHODS},
            "worst": {method: min(row.share(method) for row in rows) for method in METHODS},
            "right": mean.right.tolist(),
            "joints": float(np.rad2deg(np.sqrt(np.nanmean(mean.joints**2)))),
            "size": 1e3 * mean.size_error,
        }
    return figures


def chosen_layouts() -> list[MarkerLayout]:
    """Twelve layouts of 6 to 30 markers: five shipped ones, and seven with what makes layouts hard."""
    shipped = [load_layout(name) for name in ("starter6", "tips8", "starter10", "sparse13", "starter30")]
    tips = [_on(digit, 3, 0.7) for digit in DIGITS]
    fingers = DIGITS[1:]
    knuckles, middles = ([_on(digit, bone, 0.55) for digit in fingers] for bone in (1, 2))
    palm = [*tips, *middles, *_back((0.3, 0.2), (0.4, -0.25), (0.75, 0.1))]
    pairs = [_on(digit, 3, *place) for digit in DIGITS for place in ((0.45, -0.4), (0.75, 0.4))]
    sides = [*(_on(digit, 3, 0.6, 0.5) for digit in DIGITS), _on("thumb", 2, 0.5, 0.3),
             _on("middle", 2, 0.5, -0.5), _on("little", 2, 0.5, -1.0)]  # fmt: skip
    some = [_on("index", 2, 0.5), _on("ring", 2, 0.5)]
    made = {
        "symmetric8": [*tips[1:], *_back((0.3, 0.2), (0.3, -0.2), (0.7, 0.2), (0.7, -0.2))],
        "mixed10": [*tips, *some, *_back((0.3, 0.25), (0.5, -0.2), (0.7, 0.0))],
        "near13": [
            *tips, *middles, _on("index", 3, 0.15), *_back((0.3, 0.2), (0.35, -0.25), (0.7, 0.05)),
        ],
        "bones16": [*tips, *middles, _on("thumb", 2, 0.5), *knuckles, *_back((0.3, 0.2), (0.4, -0.2))],
        "palmar12": [dataclasses.replace(one, around=np.pi) for one in palm],
        "clusters18": [
            *pairs, *knuckles, *_back((0.3, 0.12), (0.42, 0.12), (0.36, -0.05), (0.6, -0.25)),
        ],
        "sides11": [*sides, *_back((0.25, 0.0), (0.5, 0.3), (0.6, -0.3))],
    }  # fmt: skip
    return [*shipped, *(MarkerLayout(name, tuple(places), 0.0032) for name, places in made.items())]


def _on(digit: str, number: int, along: float, around: float = 0.0) -> MarkerPlace:
    """A marker on a digit's bone, the first, second or third from the knuckle."""
    bone = BONE_NAMES[bones_of(digit)[number - 1]]
    return MarkerPlace(f"{bone}_{along:g}_{around:g}", bone, along, around)


def _back(*places: tuple[float, float]) -> list[MarkerPlace]:
    """Markers on the back of the hand: along and across."""
    return [
        MarkerPlace(f"Back{number}", "palm", along, 0.0, across)
        for number, (along, across) in enumerate(places, 1)
    ]


def stored(path: Path, make: Callable[[], Figures]) -> Figures:
    """Figures from a file; made and stored where there is none."""
    if not path.exists():
        path.write_text(json.dumps(make()))
    figures: Figures = json.loads(path.read_text())
    return figures


if __name__ == "__main__":
    run(main, __doc__)
