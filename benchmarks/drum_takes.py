"""Takes with a drum beside the hands: reflections by the dozen, close to the markers.

Han et al. 2018 tell of a drum sequence with up to twenty ghost markers a frame, and show no figure of it.
Here there are exactly twenty in every frame. A ghost is born 10 to 50 mm from a marker of either hand, in any
direction. Half of them stand still in the room, as worn spots of the rim do; the other half are mirror
images: of the marker they were born beside, in a plane that stands still half way between the two, as a
chrome shell has them. A ghost has an ID of its own and is to last 0.1 s on average, two frames at least; it
ends sooner where it is more than 60 mm from all markers or within 4 mm of another point, which no optical
system tells apart. The next one then takes its place, somewhere else. The markers' own points stay as they
are.

Who labels such a take by hand takes a ghost within 3 mm of a marker that has no point for the marker; that is
the truth of the simulated room as well (`train.simulation.room`), and here.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from gloves import Take
from gloves.optics.ghosts import reflect
from gloves.optics.reconstruction import number_runs
from train.simulation.room import label_false_points

NUMBER = 20  # ghosts a frame
BORN = (0.010, 0.050)  # [m] from a marker
LIFE, SHORTEST = 0.1, 2  # [s] on average, [frames] at least
LOST, MERGED = 0.060, 0.004  # [m] from all markers, from another point
OWNED = 0.003  # [m] from a marker without a point
STANDING = 0.5  # share that stands still


def with_drum(take: Take, *, rng: np.random.Generator) -> Take:
    """The same take with ghosts around the hands."""
    hands = enumerate(take.hands)
    markers = np.concatenate([hand.markers(take.qpos[:, number])[0] for number, hand in hands], axis=1)
    ghosts = np.full((take.num_frames, 2 * NUMBER, 3), np.nan)
    for place in range(NUMBER):  # two columns each: an unbroken stretch of a column is one ghost
        frame = turn = 0
        while frame < take.num_frames:
            life = _life(take, markers, frame, rng)
            ghosts[frame : frame + len(life), 2 * place + turn] = life
            frame, turn = frame + len(life), 1 - turn
    there = take.markers_present()
    found = SimpleNamespace(false_points=ghosts, rays=there.astype(int))
    owned = label_false_points(cast(Any, found), markers, np.arange(markers.shape[1]), OWNED)
    runs = number_runs(np.isfinite(ghosts[..., 0]))
    ids = np.where(runs >= 0, runs + take.ids.max() + 1, -1)
    order = rng.permutation(take.points.shape[1] + ghosts.shape[1])
    points = np.concatenate([take.points, ghosts], axis=1)[:, order]
    return dataclasses.replace(
        take,
        points=points,
        ids=np.concatenate([take.ids, ids], axis=1)[:, order],
        labels=np.concatenate([take.labels, owned], axis=1)[:, order],
        confidence=np.where(np.isfinite(points[..., 0]), 1.0, np.nan),
    )


def _life(take: Take, markers: np.ndarray, frame: int, rng: np.random.Generator) -> np.ndarray:
    """Places (L, 3) [m] of a ghost from its birth on, at least one."""
    while True:
        frames = slice(frame, frame + max(SHORTEST, round(rng.exponential(LIFE) * take.rate)))
        around = markers[frames]
        parent = around[:, rng.integers(markers.shape[1])]
        way = rng.standard_normal(3)
        way *= rng.uniform(*BORN) / np.linalg.norm(way)
        if rng.random() < STANDING:
            path = np.tile(parent[0] + way, (len(around), 1))
        else:
            path = reflect(parent, parent[0] + 0.5 * way, way / np.linalg.norm(way))
        from_markers = np.linalg.norm(around - path[:, None], axis=-1).min(axis=1)
        from_points = np.linalg.norm(take.points[frames] - path[:, None], axis=-1)
        apart = np.where(np.isnan(from_points), np.inf, from_points).min(axis=1)
        over = (from_markers > LOST) | (apart < MERGED)
        end = int(over.argmax()) if over.any() else len(path)
        if end >= min(SHORTEST, len(path)):
            return path[:end]
