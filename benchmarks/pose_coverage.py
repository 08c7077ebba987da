"""How well sampled poses cover those of real people: the distance to the nearest one.

    python -m benchmarks.pose_coverage CAPTURES [--poses 100000 --frames 2000 --seed 0]

CAPTURES is a folder of labeled dense19 captures, one sub-folder a person (such as the public
Mocap_SIG18_Data); only right hands, named *_right.trc, are used. Sampled poses of the mean hand are scaled to
each person's mean BackHand1-IndexMCP distance, aligned rigidly (Kabsch) and compared by the 3D RMS over the
19 markers. Candidates come from the nearest pair-distance vectors, 200 per frame; more change nothing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from benchmarks.people import right_hands
from benchmarks.record import describe, report, run
from gloves import load_layout
from gloves.fit import attach_markers
from handsim import HandModel, join_qpos
from handsim.space.transforms import rigid_fit
from poses.shapes import sample_valid_angles

CANDIDATES = 200
PAIRS = np.triu_indices(19, 1)


def pair_distances(markers: np.ndarray) -> torch.Tensor:
    difference = markers[:, PAIRS[0]] - markers[:, PAIRS[1]]
    return torch.from_numpy(np.linalg.norm(difference, axis=-1).astype(np.float32))


def nearest_rms(queries: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """3D RMS [m] of each query (T, 19, 3) to its nearest pose (N, 19, 3)."""
    pose_distances, result = pair_distances(poses), np.empty(len(queries))
    for first in range(0, len(queries), 100):
        block = queries[first : first + 100]
        near = torch.cdist(pair_distances(block), pose_distances).topk(CANDIDATES, largest=False).indices
        for number, query in enumerate(block):
            candidates = poses[near[number].numpy()]
            rotation, shift = rigid_fit(candidates, np.broadcast_to(query, candidates.shape))
            error = np.einsum("kij,kmj->kmi", rotation, candidates) + shift[:, None] - query
            result[first + number] = np.sqrt((error**2).sum(-1).mean(-1)).min()
    return result


def main(
    captures: Path, poses: int = 100_000, frames: int = 2000, seed: int = 0, save: str | None = None
) -> None:
    print(describe("torch"))
    rng = np.random.default_rng(seed)
    layout, model = load_layout("dense19"), HandModel.named("M")
    qpos = join_qpos(sample_valid_angles(model, poses, rng=rng))
    sampled, _ = attach_markers(layout, model).markers(model, model.forward_kinematics(qpos))
    first, second = layout.names.index("BackHand1"), layout.names.index("IndexMCP")

    def size(markers: np.ndarray) -> float:
        return float(np.linalg.norm(markers[:, first] - markers[:, second], axis=1).mean())

    people = right_hands(captures, layout.names)
    total = sum(map(len, people.values()))
    errors = []
    for name, markers in people.items():
        count = round(frames * len(markers) / total)
        chosen = markers[rng.choice(len(markers), count, replace=False)]
        errors.append(1e3 * nearest_rms(chosen, sampled * (size(markers) / size(sampled))))
        print(f"{name}: {count} frames, median {np.median(errors[-1]):.2f} mm, "
              f"p95 {np.percentile(errors[-1], 95):.2f} mm")  # fmt: skip
    everyone = np.concatenate(errors)
    what = f"nearest of {poses:,} sampled poses to {len(everyone):,} frames, 3D RMS median and p95 [mm]"
    report(save, {"all": (what, np.percentile(everyone, [50, 95]))})


if __name__ == "__main__":
    run(main, __doc__)
