"""Label points that have no names with the labeler that comes with the package.

    python examples/03_label_a_capture.py

A small data set is generated. Its markers are corrupted as in the paper (markers dropped, ghosts added, order
shuffled) and labeled, each frame on its own. The true labels tell how many are right.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from train import (
    Cloud,
    Corruption,
    Labeler,
    Labeling,
    LabelingReport,
    corrupt,
    evaluate_labeler,
    generate_dataset,
    load_labeler,
)


def main() -> None:
    labeler: Labeler = load_labeler("dense19")
    with TemporaryDirectory() as folder:
        dataset = generate_dataset(Path(folder) / "set", num_frames=1000, seed=42, workers=1)
        markers = dataset.rows()["markers"].astype(np.float64)  # (1000, 19, 3) [m]
    cloud: Cloud = corrupt(markers[:1], Corruption(), rng=np.random.default_rng(0))  # the first frame
    points = cloud.points[0, cloud.present[0]]  # (N, 3)
    labeling: Labeling = labeler.label_frames([points])[0]
    for label, confidence in zip(labeling.labels[:4], labeling.confidence[:4], strict=True):
        print("ghost" if label < 0 else labeler.marker_names[label], f"{confidence:.3f}")
    for corruption in (Corruption(occlude=0, ghosts=0), Corruption(occlude=5, ghosts=2)):
        report: LabelingReport = evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(0))
        share = 100 * report.figures["slot_accuracy"]
        print(f"occlude {corruption.occlude}, ghosts {corruption.ghosts}: {share:.2f} % of slots right")


if __name__ == "__main__":
    main()
