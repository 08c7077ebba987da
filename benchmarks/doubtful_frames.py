"""Whether the list of doubtful frames is right, and the confidence in labels, on captures with errors.

python -m benchmarks.doubtful_frames [--gloves dense19 sparse13] [--seeds 300 301] [--label] [--fit]
    [--real DATA]

A person's capture of each kind is tracked (--label: labeled) without calibration. By turns of the seed there
are foreign markers; many gaps, and markers that exchange trajectories; gaps and foreign markers; noise. A run
of errors is consecutive frames, gaps of 5 bridged, in which a marker lacks its label, has another one, or a
point that is none has it; where half of a hand is wrong, it is the hand's. --real takes real hands in motion
instead, see `real_motion`. --fit prints the coefficients of `track.label_confidence`, fitted to the captures;
those in use are of seeds 101 to 114, which test nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_closing

from benchmarks.real_motion import tracker_of, true_labels
from benchmarks.real_scenes import CONDITIONS, make_scene
from benchmarks.record import Figures, describe, run, save_figures
from gloves import Take
from gloves.captures.capture import runs_of
from track import find_suspect_spans, label_capture, track_capture
from track.label_confidence import evidence_of, label_confidence
from track.recorder import TakeRecorder
from track.take_summary import _VOUCH_LEAST, frame_confidence, vouch
from train import OpticsOptions, simulate_take
from train.evaluation import expected_calibration_error

KINDS = ("single-hand", "hand-hand", "hand-pen", "hand-controller")
POOR = OpticsOptions(blob_loss=0.08, dropout=0.004, noise=0.25)  # the usual: 0.002, 0.0002, 0.12
GLOVES = ("dense19", "sparse13", "dfki13", "starter10", "tips8")
WHAT = (
    "runs of errors covered, spans with an error [%] | spans a minute | frames listed [%] | calibration "
    "error [%]: labels, points without one, frames"
)


def simulate(glove: str, kind: str, seed: int, frames: int = 600) -> Take:
    """A capture with its truth, in which errors are likely."""
    turn, rng = (seed + KINDS.index(kind)) % 4, np.random.default_rng(seed)
    optics, others = POOR if turn in (1, 2) else OpticsOptions(), (20, 0, 10, 0)[turn]
    take = simulate_take(kind=kind, glove=glove, num_frames=frames, seed=seed, optics=optics, others=others)
    take = take.without_body()
    points, labels = take.points.copy(), take.labels.copy()
    if turn == 3:
        points += rng.normal(0.0, rng.uniform(0.0005, 0.0015), points.shape)
    for t in np.flatnonzero(rng.random(frames) < 1.0 / 60.0) if turn == 1 else ():
        seen = np.flatnonzero(labels[t] >= 0)
        near = np.linalg.norm(points[t, seen, None] - points[t, seen], axis=-1) < 0.03
        if len(pairs := np.argwhere(np.triu(near, 1))):
            pair = seen[pairs[rng.integers(len(pairs))]]
            for values in (points, labels):
                values[t:, pair] = values[t:, pair[::-1]]
    confidence = np.where(np.isfinite(points[..., 0]), 1.0, np.nan)
    return dataclasses.replace(take, points=points, labels=labels, confidence=confidence)


def real_takes(data: Path, frames: int) -> Iterator[tuple[str, Take, np.ndarray]]:
    """What each scene of real hands is, its tracked take, and the true labels."""
    for folder in sorted(data.glob("User*/capture*")):
        for condition in CONDITIONS:
            scene = make_scene(folder, condition, seed=1, frames=frames)
            stream, tracker = tracker_of(scene)
            recorder, there = TakeRecorder(tracker), np.isfinite(scene.points[..., 0])
            for frame in stream:
                recorder.add(frame, tracker.step(frame.points, frame.ids, frame.time))
            take = recorder.take(scene.capture())
            sure = dataclasses.replace(take.point_list, confidence=label_confidence(take))
            take = dataclasses.replace(take, point_list=sure)
            yield f"{folder.parent.name} {condition}", take, np.where(there, true_labels(scene), -1)


def simulated_takes(
    gloves: tuple[str, ...], seeds: tuple[int, ...], frames: int, label: bool
) -> Iterator[tuple[str, Take, np.ndarray]]:
    """What each take is, the take and the true labels."""
    make = label_capture if label else track_capture
    for glove, seed, kind in product(gloves, seeds, KINDS):
        truth = simulate(glove, kind, seed, frames)
        yield f"{glove} {kind}", make(truth, glove=glove), truth.labels


def error_runs(take: Take, truth: np.ndarray) -> list[tuple[int, int]]:
    """First and last frame of each run of errors."""
    wrong, part = take.labels != truth, take.hands[0].layout.num_markers
    hands, runs = np.where(truth >= 0, truth // part, -1), []
    for hand in range(len(take.hands)):
        seen, bad = (hands == hand).sum(axis=1), (wrong & (hands == hand)).sum(axis=1)
        whole = (seen >= 3) & (2 * bad >= seen)
        runs.append(whole)
        wrong &= ~whole[:, None] | (hands != hand)
    missed, marker = take.labels < 0, truth >= 0
    for kind, keys in ((~missed & marker, truth), (missed, truth), (~marker, take.labels)):
        runs += [(wrong & kind & (keys == key)).any(axis=1) for key in np.unique(keys[wrong & kind])]
    closed = [binary_closing(np.pad(one, 6), np.ones(6))[6:-6] | one for one in runs]
    return [run for one in closed for run in runs_of(one)]


def score(take: Take, truth: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Runs, those covered, spans, those with an error, seconds and seconds listed; pairs for calibration."""
    spans, runs = find_suspect_spans(take, None), error_runs(take, truth)
    there = np.isfinite(take.points[..., 0])
    right, listed = (take.labels == truth) | ~there, np.zeros(take.num_frames, dtype=bool)
    for span in spans:
        listed[span.first : span.last + 1] = True
    covered = sum(listed[first : last + 1].any() for first, last in runs)
    good = sum(not right[span.first : span.last + 1].all() for span in spans)
    counts = [len(runs), covered, len(spans), good, take.num_frames / take.rate, listed.sum() / take.rate]
    parts = [there & (take.labels >= 0), there & (take.labels < 0)]
    pairs = [np.stack([take.confidence[part], right[part]]) for part in parts]
    certain = frame_confidence(take)
    known = np.isfinite(certain)
    return np.array(counts), [*pairs, np.stack([certain[known], right.all(axis=1)[known]])]


def vouch_ratio(take: Take, truth: np.ndarray) -> float:
    """Share of wrong frames among those not listed, over what `vouch` multiplies by its factor."""
    right = ((take.labels == truth) | ~np.isfinite(take.points[..., 0])).all(axis=1)
    listed = np.zeros(take.num_frames, dtype=bool)
    for span in find_suspect_spans(take, None):
        listed[span.first : span.last + 1 if span.of_labels else span.first] = True
    doubt = 1.0 - np.nan_to_num(frame_confidence(take), nan=1.0)
    if listed.all():
        return 0.0
    return float((~right[~listed]).mean() / (doubt[~listed].mean() + _VOUCH_LEAST))


def row(counts: np.ndarray, pairs: list[np.ndarray]) -> list[float]:
    """`WHAT` of some captures."""
    runs, covered, spans, good, seconds, listed = counts
    shares = [100.0 * covered / max(runs, 1), 100.0 * good / max(spans, 1)]
    errors = [100.0 * expected_calibration_error(one[0], one[1] > 0.5) for one in pairs]
    return [*shares, 60.0 * spans / seconds, 100.0 * listed / seconds, *errors]


def fitted(
    told: list[tuple[np.ndarray, np.ndarray]], most: float = 1000.0, ridge: float = 10.0
) -> np.ndarray:
    """Coefficients of a logistic model, the constant first, by Newton's method.

    Args:
        told: Of each capture, what is told of its points (P, F), and which are wrong (P,).
        most: Weight of all wrong points of a capture at most: a hand that is wrong throughout is one error.
        ridge: Precision of the coefficients around 0.
    """
    values, wrong = map(np.concatenate, zip(*told, strict=True))
    weight = np.concatenate([np.where(bad, min(1.0, most / max(bad.sum(), 1)), 1.0) for _, bad in told])
    columns = np.column_stack([np.ones(len(values)), values])
    found, prior = np.zeros(columns.shape[1]), ridge * np.diag([0.0] + [1.0] * values.shape[1])
    for _ in range(30):
        chance = 1.0 / (1.0 + np.exp(-columns @ found))
        gradient = columns.T @ (weight * (wrong - chance)) - prior @ found
        found += np.linalg.solve((columns.T * (weight * chance * (1.0 - chance))) @ columns + prior, gradient)
    return found


def main(
    gloves: tuple[str, ...] = GLOVES,
    seeds: tuple[int, ...] = (300, 301, 302, 303),
    frames: int = 600,
    label: bool = False,
    real: Path | None = None,
    fit: bool = False,
    save: str | None = None,
) -> None:
    torch.set_num_threads(1)
    print(describe("numba", "torch"), WHAT, sep="\n")
    table: dict[str, list[tuple[np.ndarray, list[np.ndarray]]]] = {}
    ratios: list[float] = []
    labeled: list[tuple[np.ndarray, np.ndarray]] = []
    others: list[tuple[np.ndarray, np.ndarray]] = []
    takes = real_takes(real, frames) if real else simulated_takes(gloves, seeds, frames, label)
    for name, take, truth in takes:
        for key in (*name.split(), "all"):
            table.setdefault(key, []).append(score(take, truth))
        if vouch(take).right > 0.0:
            ratios.append(vouch_ratio(take, truth))
        if fit:
            evidence = evidence_of(take)
            points = take.point_list
            true = truth[points.frames[evidence.points], points.columns[evidence.points]]
            wrong = evidence.labels != true
            labeled.append((evidence.labeled, wrong[evidence.labels >= 0]))
            others.append((evidence.unlabeled, wrong[evidence.labels < 0]))
    figures: Figures = {}
    for key, scores in table.items():
        counts, pairs = zip(*scores, strict=True)
        values = row(
            np.sum(counts, axis=0), [np.concatenate(some, axis=1) for some in zip(*pairs, strict=True)]
        )
        print(f"{key:16s} | " + " | ".join(f"{value:6.1f}" for value in values), flush=True)
        figures[key] = f"{WHAT}; {key}", values
    if (rank := int(np.ceil(0.95 * (len(ratios) + 1)))) <= len(ratios):
        factor = float(np.sort(ratios)[rank - 1])
        figures["vouch"] = "factor of the bound that the next take keeps with 95 % (split conformal)", factor
        print(f"factor of the bound on wrong frames by {len(ratios)} takes: {factor:.2f}")
    save_figures(save, figures)
    if fit:
        print("_LABELED", fitted(labeled).round(2), "\n_UNLABELED", fitted(others).round(2))


if __name__ == "__main__":
    run(main, __doc__)
