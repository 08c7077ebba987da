"""What `handsim glove improve` is worth: labels, tracks and joints of fresh captures, before and after.

Six layouts that make labels hard. The captures, of one hand, of two and of two that touch, have other people
and motions than the search and the command's own check. What is finished stays in the folder.

python -m benchmarks.layout_improvement FOLDER [--minutes 3]
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from benchmarks.layout_forecast import chosen_layouts, stored, trial_figures
from benchmarks.record import Figures, describe, run, save_figures
from gloves import MarkerLayout, MarkerPlace, load_layout
from handsim.cli.main import main as handsim
from handsim.hand.shape import BONE_NAMES, DIGITS, bones_of
from track.glove_score import METHODS
from train.labelers.layout_labeler import learned_labeler

HARD = ("tips8", "symmetric8", "sides11", "palmar12")  # of `chosen_layouts`
FIRST, FRAMES = 80, 600  # of the fresh captures
WHAT = "slots right of label, of track [%], joints' error [deg]; means of nine captures"


def main(folder: Path, minutes: float = 3.0, save: str | None = None) -> None:
    print(describe("torch", "numpy"))
    figures: Figures = {}
    better = np.zeros(3, int)
    for layout in hard_layouts():
        path = folder / layout.name
        path.mkdir(parents=True, exist_ok=True)
        before, after = path / "before.toml", path / "after.toml"
        layout.save(before)
        if not after.exists():
            command = ["glove", "improve", str(before), "--minutes", str(minutes)]
            assert handsim([*command, "--captures", "0", "--out", str(after)]) == 0
        measured = {path.stem: outcome(path) for path in (before, after)}
        gained = np.subtract(measured["after"], measured["before"]) * (1, 1, -1)
        better += gained > 0
        for when, values in measured.items():
            print(f"{layout.name} {when}: " + ", ".join(f"{value:.2f}" for value in values), flush=True)
            figures[f"{layout.name}_{when}"] = (f"Layout {layout.name} {when} glove improve: {WHAT}", values)
    print(f"better in {' / '.join(map(str, better))} of the layouts: {WHAT}")
    save_figures(save, figures)


def hard_layouts() -> list[MarkerLayout]:
    """Two of which every digit has the same markers and the back none, and four others."""
    listed = {layout.name: layout for layout in chosen_layouts()}
    alike = [_alike("hopeless6", ("index", "middle", "ring"), 2), _alike("lazy15", DIGITS, 3)]
    return [*alike, *(listed[name] for name in HARD)]


def _alike(name: str, digits: tuple[str, ...], each: int) -> MarkerLayout:
    """Some digits with markers in the middle of their last bones, nothing else."""
    markers = tuple(
        MarkerPlace(f"{digit.capitalize()}{number}", BONE_NAMES[bones_of(digit)[-number]], 0.5, 0.0)
        for digit in digits
        for number in range(1, each + 1)
    )
    return dataclasses.replace(load_layout("dense19"), name=name, markers=markers)


def outcome(path: Path) -> list[float]:
    """Of a layout's file: slots right of `label` and of `track` [%], joints' error [deg]."""
    layout = load_layout(str(path))
    works = stored(
        path.with_suffix(".json"), lambda: trial_figures(layout, learned_labeler(layout), FIRST, FRAMES)
    ).values()
    slots = [100.0 * float(np.mean([work["share"][method] for work in works])) for method in METHODS]
    return [*slots, float(np.mean([work["joints"] for work in works]))]


if __name__ == "__main__":
    run(main, __doc__)
