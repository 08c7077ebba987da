"""Make a training set with a pose sampler of your own, and learn from it with a corruption of your own.

    python examples/11_your_own_sampler_and_corruption.py

Both are in own_ideas.py beside this script. Their names are in the settings of the set and of the run:
neither is continued with another. The same batches go to a network that is not ours as tensors.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from own_ideas import Pointing, hide_a_side
from torch.utils.data import DataLoader

from handsim import HandSimError
from train import CloudStream, OwnCorruption, TrainSettings, evaluate_labeler, generate_dataset, train_labeler


def main() -> None:
    small = {"width": 16, "gates": 4, "depth": 2}
    config = TrainSettings(samples=10_000, corruption=hide_a_side, rig_share=0.2, network=small)
    with TemporaryDirectory() as name:
        folder = Path(name)
        dataset = generate_dataset(
            folder / "set", sampler=Pointing(), num_frames=2000, frames_per_hand=50, workers=1
        )
        try:
            generate_dataset(folder / "set", num_frames=2000, frames_per_hand=50)
        except HandSimError as error:
            print(str(error).replace(name, ""))
        train_labeler(dataset, folder / "run", config)
        markers = dataset.rows()["markers"][-200:]  # (200, 19, 3) [m]
        figures = evaluate_labeler(folder / "run", markers).figures
        print(
            f"{100 * figures['slot_accuracy']:.1f} % of slots right after {config.samples} clouds; a guess "
            "is right for 5 %, and use takes far more clouds"
        )
        corruption: OwnCorruption = hide_a_side
        loader = DataLoader(CloudStream(dataset, corruption, batch=64), batch_size=None)
        points, present, labels = next(iter(loader))  # (64, N, 3) [m], (64, N) bool, (64, N) marker or -1
        print(f"a batch: {tuple(points.shape)}, {int((present & (labels < 0)).sum())} ghosts")


if __name__ == "__main__":
    main()
