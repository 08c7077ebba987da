"""Describe a glove of ten markers in Python, and train a labeler for it.

    python examples/05_train_for_your_own_glove.py

The labeler is measured on people that it was not trained on. Training set and network are small, so that
this takes twenty seconds; `handsim generate` and `handsim train` take larger ones, and say whether the result
is better than what a glove of your own has without training, the labeler for any layout (docs/labeling.md).
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from gloves import MarkerLayout, MarkerPlace
from train import Corruption, Dataset, TrainSettings, evaluate_labeler, generate_dataset, train_labeler

DIGITS = ("thumb", "index", "middle", "ring", "little")
TIPS = [MarkerPlace(f"{digit}_tip", f"{digit}_distal", 0.7, 0.0) for digit in DIGITS]
BACK = [
    MarkerPlace("back_a", "palm", 0.35, 0.0, 0.2),  # along the palm, around and across it
    MarkerPlace("back_b", "palm", 0.75, 0.0, -0.1),
    MarkerPlace("back_c", "palm", 0.25, 0.0, -0.2),
    MarkerPlace("index_middle", "index_middle", 0.5, 0.0),
    MarkerPlace("ring_middle", "ring_middle", 0.5, 0.0),
]
GLOVE = MarkerLayout("ten", (*TIPS, *BACK), radius=0.0032)  # [m]


def main() -> None:
    config = TrainSettings(samples=25_000, network={"width": 32, "gates": 8, "depth": 3})
    with TemporaryDirectory() as name:
        folder = Path(name)
        made: dict[str, Dataset] = {
            part: generate_dataset(
                folder / part, glove=GLOVE, num_frames=frames, seed=seed, workers=1, frames_per_hand=60
            )
            for part, frames, seed in (("train", 4000, 0), ("test", 500, 1))
        }
        train_labeler(made["train"], folder / "run", config)
        for corruption in (Corruption(occlude=0, ghosts=0), Corruption(occlude=2, ghosts=2)):
            report = evaluate_labeler(folder / "run", made["test"], corruption)
            share = 100 * report.figures["slot_accuracy"]
            print(f"occlude {corruption.occlude}, ghosts {corruption.ghosts}: {share:.1f} % of slots right")
    print(
        f"Between 40 and 70 % is expected after {config.samples} clouds; a guess is right for a tenth. For "
        "use, take load_labeler(GLOVE), or more frames and clouds (docs/labeling.md)."
    )


if __name__ == "__main__":
    main()
