"""What `handsim glove score` says of layouts, beside labelers that are trained on them and solved poses.

Twelve layouts of 6 to 30 markers: the shipped ones, even and crowded random ones, and one without thumb and
palm, whose fingers look alike. Each gets a training set and a labeler of its own; forecast and measurement
use other people, poses and losses. Layouts that are finished stay in the folder; run again to continue.

python benchmarks/layout_forecast.py FOLDER [--frames 60000] [--samples 300000]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path

import numpy as np
from any_layout import random_layout
from machine import describe
from scipy.stats import spearmanr

from gloves.layout import MarkerLayout, list_layouts, load_layout, save_layout
from handsim.app.cli import main as handsim
from handsim.space.cameras import load_rig
from track.glove_advice.joint_spread import NOISE
from track.glove_advice.layout_score import LayoutScore, score_layout
from track.glove_advice.observed_hands import ObservedHand, observe_poses
from track.kinematics.pose_solver import PoseSolver
from train.glove_labeler import ANY_LAYOUT, labeler_for_glove

SCORED_FRAMES = 1500  # as `handsim glove score`
MEASURED_FRAMES = 3000
FEWEST_MARKERS = 4  # of a pose


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="training sets, runs and results")
    parser.add_argument("--frames", type=int, default=60_000, help="of each training set")
    parser.add_argument("--samples", type=int, default=300_000, help="of each training: minutes on one core")
    options = parser.parse_args()
    print(describe("torch", "numpy"))
    found = []
    for layout in chosen_layouts():
        folder = options.folder / layout.name
        result = folder / "result.json"
        if not result.exists():
            folder.mkdir(parents=True, exist_ok=True)
            result.write_text(json.dumps(compare(layout, folder, options.frames, options.samples)))
        found.append(json.loads(result.read_text()))
        print_layout(layout, found[-1])
    for name in ("observed", "corrupted", "clean"):
        pairs = 100.0 * np.array([one[name] for one in found])
        error = pairs[:, 0] - pairs[:, 1]
        print(
            f"{name}: rank correlation {spearmanr(pairs[:, 0], pairs[:, 1]).statistic:.3f}, mean error "
            f"{np.abs(error).mean():.2f} points, bias {error.mean():+.2f}, largest {np.abs(error).max():.2f}"
        )
    ratios = [one["joint_ratio"] for one in found]
    print(f"joints: measured to forecast, median over layouts {np.median(ratios):.2f}, "
          f"from {min(ratios):.2f} to {max(ratios):.2f}")  # fmt: skip


def chosen_layouts() -> list[MarkerLayout]:
    """Eight shipped layouts, three random ones and one whose fingers look alike."""
    layouts = [load_layout(name) for name in list_layouts()]
    rng = np.random.default_rng(11)
    layouts += [random_layout(number, rng) for number in range(3)]
    rows = load_layout("dense19")
    fingers = [marker for marker in rows.markers if marker.bone.split("_")[0] not in ("thumb", "palm")]
    alike = tuple(
        dataclasses.replace(marker, along=0.5, around=0.0)
        for marker in {marker.bone: marker for marker in fingers}.values()
    )
    return [*layouts, dataclasses.replace(rows, name="alike", markers=alike)]


def compare(layout: MarkerLayout, folder: Path, frames: int, samples: int) -> dict[str, object]:
    """Forecast and measured figures of a layout."""
    rig = load_rig("figure5")
    glove = folder / "glove.toml"
    save_layout(glove, layout)
    rng = np.random.default_rng(0)
    begin = time.perf_counter()
    hands = observe_poses(layout, rig, SCORED_FRAMES, rng=rng)
    forecast = score_layout(layout, hands, labeler_for_glove(str(glove), ANY_LAYOUT), rng=rng)
    scored = time.perf_counter() - begin
    data, run = folder / "data", folder / "run"
    if not data.exists():
        handsim(
            [
                "generate",
                "--glove",
                str(glove),
                "--num-frames",
                str(frames),
                "--seed",
                "5",
                "--out",
                str(data),
            ]
        )
    begin = time.perf_counter()
    assert handsim(["train", str(data), "--samples", str(samples), "--threads", "1", "--out", str(run)]) == 0
    trained = time.perf_counter() - begin
    rng = np.random.default_rng(99)
    hands = observe_poses(layout, rig, MEASURED_FRAMES, rng=rng)
    measured = score_layout(layout, hands, labeler_for_glove(str(glove), run), rng=rng)
    pairs = {
        name: [slots(forecast, name), slots(measured, name)] for name in ("observed", "corrupted", "clean")
    }
    errors = solved_errors(hands, rng)
    return {
        **pairs,
        "joints": [np.rad2deg(forecast.joints).tolist(), np.rad2deg(errors).tolist()],
        "joint_ratio": float(np.median(errors / forecast.joints)),
        "seconds": [scored, trained],
        "markers": layout.num_markers,
    }


def slots(score: LayoutScore, name: str) -> float:
    return float(getattr(score, name).figures["slot_accuracy"])


def solved_errors(hands: list[ObservedHand], rng: np.random.Generator) -> np.ndarray:
    """Root mean square error of each joint [rad], solved from the markers that are seen, with their noise."""
    squares, count = np.zeros(20), 0
    for hand in hands:
        good = np.isfinite(hand.frames.observed[..., 0]).sum(axis=1) >= FEWEST_MARKERS
        markers = hand.fit.markers(hand.qpos)[0]
        markers = np.where(np.isfinite(hand.frames.observed), markers, np.nan)
        noisy = markers + NOISE * rng.standard_normal(markers.shape)
        solved = PoseSolver(hand.fit).solve(noisy[good], hand.qpos[good]).qpos
        squares += ((solved - hand.qpos[good])[:, 7:] ** 2).sum(axis=0)
        count += int(good.sum())
    return np.sqrt(squares / count)


def print_layout(layout: MarkerLayout, found: dict[str, object]) -> None:
    told = ", ".join(
        f"{name} {100 * found[name][0]:.2f} / {100 * found[name][1]:.2f}"
        for name in ("observed", "corrupted", "clean")
    )
    scored, trained = found["seconds"]
    print(
        f"{layout.name}: {layout.num_markers} markers, forecast / measured: {told}; joints measured to "
        f"forecast {found['joint_ratio']:.2f}; scored in {scored:.0f} s, trained in {trained:.0f} s",
        flush=True,
    )


if __name__ == "__main__":
    main()
