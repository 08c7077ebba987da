"""The hand detector on drawn pictures that it has not seen, and on photographs.

    python -m benchmarks.hand_detector [--photos FOLDER --reference FILE] [--weights FOLDER]
        [--shards 2 --seed 99]

Prints for bare and gloved hands, alone and two in a picture: the share of hands found and of sides right,
false finds in a picture, the keypoints within a tenth of the hand's box (PCK@0.1) of hands that were found
and in boxes that were given, and milliseconds of one core. Then false finds in pictures without a hand.
Photographs are those of `keypoint_network.py`, seen whole as they were cropped there, and by the detector.
"""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.keypoint_training import MEDIAPIPE, Pictures, load_photos, pck
from benchmarks.looks_like_a_hand import frames_of
from benchmarks.record import Figures, describe, run, save_figures
from handsim.hand.shape import SIDES
from render import HandDetector
from render.film.detector import CROP_SIZE, ROOM, FoundHand
from render.film.training import Scene, draw_scenes

KINDS = {0: "bare", 1: "gloved", 2: "two bare", 5: "two gloved"}  # by the number of a shard, modulo six
NEAR = 0.35  # distance of the middles of one hand's boxes [longer side]
SMALL = 0.09  # hands whose longer side is a smaller share of the picture's do not count
EMPTY = 200  # pictures without a hand
WHAT = "found [%] | sides [%] | false finds a picture | PCK found | in boxes [%] | ms a picture | ms a hand"


def matched(scene: Scene, found: list[FoundHand]) -> list[tuple[int, int]]:
    """Pairs of a true and a found hand, each the nearest that is left."""
    pairs: list[tuple[float, int, int]] = []
    for number, points in enumerate(scene.keypoints):
        low, high = points.min(axis=0), points.max(axis=0)
        for other, hand in enumerate(found):
            away = np.linalg.norm(0.5 * (low + high) - hand.box[:2] - 0.5 * hand.box[2:])
            pairs.append((float(away / (high - low).max()), number, other))
    kept: list[tuple[int, int]] = []
    for away, number, other in sorted(pairs):
        if away < NEAR and not any(number == n or other == m for n, m in kept):
            kept.append((number, other))
    return kept


def share_near(found: np.ndarray, truth: np.ndarray) -> float:
    """PCK@0.1 of one hand."""
    size = np.ptp(truth, axis=0).max()
    return float((np.linalg.norm(found - truth, axis=1) < 0.1 * size).mean())


def figures_of(detector: HandDetector, scenes: list[Scene]) -> list[float]:
    """The figures of `WHAT`."""
    hands = hits = sides = false = 0
    near: list[float] = []
    given: list[float] = []
    spent = [0.0, 0.0]
    for scene in scenes:
        start = time.process_time()
        found = detector.detect(scene.picture)
        spent[0] += time.process_time() - start
        large = np.ptp(scene.keypoints, axis=1).max(axis=1) > SMALL * max(scene.picture.shape)
        pairs = matched(scene, found)
        false += len(found) - len(pairs)
        for number, other in pairs:
            if large[number]:
                hits += 1
                sides += SIDES.index(found[other].side) == scene.sides[number]
                near.append(share_near(found[other].keypoints, scene.keypoints[number]))
        hands += int(large.sum())
        low, high = scene.keypoints.min(axis=1), scene.keypoints.max(axis=1)
        start = time.process_time()
        known = detector.refine(
            scene.picture, np.column_stack([low, high - low]), [SIDES[n] for n in scene.sides]
        )
        spent[1] += time.process_time() - start
        given += [share_near(hand.keypoints, scene.keypoints[n]) for n, hand in enumerate(known) if large[n]]
    every = sum(len(scene.sides) for scene in scenes)
    return [
        *(100.0 * hits / hands, 100.0 * sides / max(hits, 1), false / len(scenes)),
        *(100.0 * float(np.mean(near)), 100.0 * float(np.mean(given))),
        *(1e3 * spent[0] / len(scenes), 1e3 * spent[1] / every),
    ]


def photograph_figures(detector: HandDetector, photos: Pictures) -> list[float]:
    """PCK@0.1 [%] of photographs that are first looked at as they were cropped, the same moved; found [%]."""
    side = CROP_SIZE / ROOM
    box = [[*(2 * [0.5 * (CROP_SIZE - side)]), side, side]]
    points = np.stack([detector.refine(crop, box, ["right"])[0].keypoints for crop in photos.crops])
    edge = CROP_SIZE // 2
    wide = [cv2.copyMakeBorder(crop, *(4 * [edge]), cv2.BORDER_REPLICATE) for crop in photos.crops]
    single = [len(detector.detect(picture)) == 1 for picture in wide]
    return [
        100.0 * pck(points, photos),
        100.0 * pck(MEDIAPIPE @ points, photos),
        100.0 * float(np.mean(single)),
    ]


def main(
    weights: Path | None = None,
    shards: int = 2,
    seed: int = 99,
    photos: Path | None = None,
    reference: Path | None = None,
    save: str | None = None,
) -> None:
    print(describe())
    cv2.setNumThreads(1)
    detector = HandDetector.load(weights)
    print(WHAT)
    figures: Figures = {}
    for kind, name in KINDS.items():
        drawn = itertools.chain.from_iterable(draw_scenes(6 * n + kind, seed=seed) for n in range(shards))
        scenes = [scene for scene in drawn if len(scene.sides)]
        figures[name.replace(" ", "_")] = (f"{name}: {WHAT}", figures_of(detector, scenes))
        print(
            f"{name:12s}",
            "  ".join(f"{value:6.2f}" for value in figures[name.replace(" ", "_")][1]),
            flush=True,
        )
    false = [
        len(detector.detect(frame.rgb if frame.noisy.rgb is None else frame.noisy.rgb))
        for frame in frames_of("mixed", 0, EMPTY, seed, [])
    ]
    figures["empty"] = ("false finds in a picture without a hand", float(np.mean(false)))
    print(f"without a hand: {np.mean(false):.3f} false finds a picture")
    if photos is not None and reference is not None:
        found = photograph_figures(detector, load_photos(photos, reference))
        figures["photographs"] = (
            "PCK@0.1 [%] | moved | one hand found [%]",
            found,
        )
        print("photographs ", "  ".join(f"{value:6.2f}" for value in found))
    save_figures(save, figures)


if __name__ == "__main__":
    run(main, __doc__)
