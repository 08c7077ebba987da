"""What `handsim glove improve` is worth: labelers trained alike before and after, and joints' errors.

It begins with six markers on three fingers that look alike, with fifteen of which every digit has three at
the same places and the back of the hand none, and with dense19. What is finished stays in the folder.

python -m benchmarks.layout_improvement FOLDER [--minutes 3] [--frames 60000] [--samples 300000]
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from benchmarks.layout_forecast import measure, stored
from benchmarks.record import describe
from gloves.layout import MarkerLayout, MarkerPlace, load_layout
from handsim.cli.main import main as handsim
from handsim.hand.topology import BONE_NAMES, DIGITS, bones_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="layouts, training sets, runs and results")
    parser.add_argument("--minutes", type=float, default=3.0, help="of each search")
    parser.add_argument("--frames", type=int, default=60_000, help="of each training set")
    parser.add_argument("--samples", type=int, default=300_000, help="of each training")
    options = parser.parse_args()
    print(describe("torch", "numpy"))
    for layout in (alike("hopeless6", ("index", "middle", "ring"), 2), alike("lazy15", DIGITS, 3),
                   load_layout("dense19")):  # fmt: skip
        folder = options.folder / layout.name
        folder.mkdir(parents=True, exist_ok=True)
        before, after = folder / "before.toml", folder / "after.toml"
        layout.save(before)
        if not after.exists():
            command = ["glove", "improve", str(before), "--minutes", str(options.minutes)]
            assert handsim([*command, "--out", str(after)]) == 0
        for name in ("before", "after"):
            (folder / name).mkdir(exist_ok=True)
            glove = load_layout(str(folder / f"{name}.toml"))
            measured = stored(
                folder / name / "measured.json",
                lambda glove=glove, path=folder / name: measure(glove, path, options.frames, options.samples),
            )
            shares = ", ".join(
                f"{100 * measured[one]:.2f} % {one}" for one in ("observed", "corrupted", "clean")
            )
            joints = np.rad2deg(np.sqrt(np.mean(np.square(measured["joints"]))))
            print(f"{layout.name} {name}: slots right {shares}; joints {joints:.1f} deg", flush=True)


def alike(name: str, digits: tuple[str, ...], each: int) -> MarkerLayout:
    """Some digits with markers in the middle of their last bones, nothing else."""
    markers = tuple(
        MarkerPlace(f"{digit.capitalize()}{number}", BONE_NAMES[bones_of(digit)[-number]], 0.5, 0.0)
        for digit in digits
        for number in range(1, each + 1)
    )
    return dataclasses.replace(load_layout("dense19"), name=name, markers=markers)


if __name__ == "__main__":
    main()
