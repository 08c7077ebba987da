"""What `handsim glove score` says of layouts, beside other captures that are labeled and tracked.

Twelve layouts of 6 to 19 markers: shipped ones, one like its mirror image, one on palm and back, one on every
bone that plays the piano, and random ones. The score's captures and the others have other people and motions;
all are labeled and tracked by the calls of `handsim label` and `handsim track`. A capture that the folder
holds is not made again, so that the command can be stopped and continued.

python -m benchmarks.layout_forecast FOLDER [--layouts dense19 mirror0]
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from benchmarks.mirror_like import mirror_like
from benchmarks.record import Figures, describe, kept, report, run
from gloves import MarkerLayout, MarkerPlace, load_layout
from handsim.hand.shape import BONE_NAMES, DIGITS, bones_of
from track.gloves.glove_improvement import sample_places
from track.gloves.glove_score import CAPTURES, FRAMES, METHODS, WORK, try_take
from train import load_labeler, simulate_take

TOLD, FOUND = tuple(range(1, CAPTURES + 1)), (51, 52)  # seeds of the score's captures, and of the others
NEAR = 0.05  # difference of shares that is no miss
SHIPPED = ("dense19", "sparse13", "dfki13", "starter6", "starter10", "starter15")
Row = dict[str, Any]


def main(folder: Path, layouts: tuple[str, ...] = (), save: str | None = None) -> None:
    print(describe("torch", "numpy"))
    chosen = [layout for layout in chosen_layouts() if not layouts or layout.name in layouts]
    # The same seeds of all layouts come first, so that a part of the run is of many layouts.
    for seed, layout, work in product(_in_turn(), chosen, WORK):
        row = captured(folder, layout, work, seed)
        shares = ", ".join(f"{method} {100 * row[method]:.1f}" for method in METHODS)
        print(f"{layout.name}, {work}, seed {seed}: {shares}, wrong {row['wrong']:.2f}", flush=True)
    report(save, summary({layout.name: _rows(folder, layout) for layout in chosen}))


def captured(folder: Path, layout: MarkerLayout, work: str, seed: int) -> Row:
    """Shares of right slots of a capture, by method, and the probability that labels are wrong throughout."""

    def make() -> Row:
        take = simulate_take(WORK[work], glove=layout, num_frames=FRAMES, seed=seed)
        trial = try_take(take, layout, load_labeler(layout))
        said = [[one.words, one.probability] for one in trial.alternatives]
        return {**{method: trial.share(method) for method in METHODS}, "wrong": trial.wrong, "said": said}

    found: Row = kept(folder / f"{layout.name}-{WORK[work]}-{seed}.json", make)
    return found


def _in_turn() -> list[int]:
    """Seeds of the score and of the other captures by turns."""
    return [FOUND[0], TOLD[0], FOUND[1], *TOLD[1:]]


def _rows(folder: Path, layout: MarkerLayout) -> dict[str, tuple[list[Row], list[Row]]]:
    """The captures of the score and the others, by work."""
    return {
        work: tuple([captured(folder, layout, work, seed) for seed in seeds] for seeds in (TOLD, FOUND))  # type: ignore[misc]
        for work in WORK
    }


def summary(rows: dict[str, dict[str, tuple[list[Row], list[Row]]]]) -> Figures:
    """Print forecast and truth of each layout and work, and how often the forecast holds."""
    told, found, misses, silent, wrong = [], [], [], [], []
    for (name, works), method in product(rows.items(), METHODS):
        for work, (said, true) in works.items():
            shares, truth = ([one[method] for one in part] for part in (said, true))
            told.append(np.mean(shares))
            found.append(np.mean(truth))
            low, high = min(shares) - NEAR, max(shares) + NEAR
            misses += [abs(one - told[-1]) for one in truth]
            silent += [not low <= one <= high for one in truth]
            listed = ", ".join(f"{100 * one:.1f}" for one in truth)
            print(
                f"{name}, {work}, {method}: forecast {100 * told[-1]:.1f}, worst {100 * min(shares):.1f}; "
                f"captures {listed}"
            )
    for name, works in rows.items():
        said = [one["wrong"] for told_of, _ in works.values() for one in told_of]
        # A capture that one of the two methods labels wrong throughout says so with a probability of a half.
        true = [
            any(share >= 0.5 for _, share in one["said"]) for _, others in works.values() for one in others
        ]
        wrong.append(np.array([np.mean(said), np.mean(true)]))
        print(
            f"{name}: wrong throughout {100 * wrong[-1][0]:.1f} % forecast, {100 * wrong[-1][1]:.1f} % found"
        )
    figures: Figures = {
        "rank_correlation": (
            "Spearman's of forecast and mean of the captures",
            float(spearmanr(told, found)[0]),
        ),
        "worst_miss": ("Largest difference of a capture from the forecast [%]", 100 * float(max(misses))),
        "outside": (
            f"Captures more than {100 * NEAR:.0f} points beyond those of the score [%]",
            100 * float(np.mean(silent)),
        ),
        "wrong": ("Captures wrong throughout: forecast, found [%]", (100 * np.mean(wrong, axis=0)).tolist()),
    }
    return figures


def chosen_layouts() -> list[MarkerLayout]:
    """Twelve layouts of 6 to 19 markers: six shipped ones, and six with what makes layouts hard."""
    tips, ends = ([_on(digit, 3, 0.7) for digit in DIGITS], [_on(digit, 2, 0.9) for digit in DIGITS])
    knuckles, firsts = ([_on(digit, 1, along) for digit in DIGITS[1:]] for along in (0.55, 0.1))
    back = _back(*product((0.25, 0.6, 0.85), (0.1, -0.2)))
    palm = [replace(one, name=f"Palm{number}", around=np.pi) for number, one in enumerate(back, 1)]
    made = {
        "palmback12": [*back, *palm],
        "knuckles12": [*tips, *knuckles, *_back((0.3, 0.2), (0.3, -0.2), (0.7, 0.0))],
        "piano17": [*tips, *ends, *firsts, *_back((0.1, 0.2), (0.1, -0.2), (0.4, 0.0))],
        **{f"random{count}": sample_places(count, rng=np.random.default_rng(count)) for count in (9, 12)},
    }
    own = [MarkerLayout(name, tuple(places), 0.0032) for name, places in made.items()]
    return [own[0], mirror_like(0), *(load_layout(name) for name in SHIPPED), *own[1:]]


def _on(digit: str, number: int, along: float) -> MarkerPlace:
    """A marker on a digit's bone, the first, second or third from the knuckle."""
    bone = BONE_NAMES[bones_of(digit)[number - 1]]
    return MarkerPlace(f"{bone}_{along:g}", bone, along, 0.0)


def _back(*places: tuple[float, float]) -> list[MarkerPlace]:
    """Markers on the back of the hand: along and across."""
    return [
        MarkerPlace(f"Back{number}", "palm", along, 0.0, across)
        for number, (along, across) in enumerate(places, 1)
    ]


if __name__ == "__main__":
    run(main, __doc__)
