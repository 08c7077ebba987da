"""Whether the list of doubtful frames is right, the confidence in labels, and the bound on wrong frames.

python -m benchmarks.doubtful_frames [--gloves dense19 sparse13] [--seeds 300 301] [--label] [--unseen]
    [--real DATA] [--store FOLDER] [--takes 66] [--fit]

A person's capture of each kind is tracked (--label: labeled) without calibration. By turns of the seed there
are foreign markers; many gaps, and markers that exchange trajectories; gaps and foreign markers; noise.
--unseen tracks captures of other sorts instead, from which nothing was learned: moving skin, other rigs,
twenty foreign markers, gloves that no labeler was trained for, and with --real also hands of real people in
motion, see `real_motion`. A run of errors is consecutive frames, gaps of 5 bridged, in which a marker lacks
its label, has another one, or a point that is none has it; where half of a hand is wrong, it is the hand's.

--store keeps every tracked take and its true labels in a folder, so that a run that was stopped continues;
--takes ends after that many of them.
--fit prints the coefficients of `track.label_confidence`, fitted to the captures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import binary_closing

from benchmarks.real_motion import tracker_of, true_labels
from benchmarks.real_scenes import CONDITIONS, make_scene
from benchmarks.record import Figures, describe, report, run, save_figures
from gloves import Take, load_take
from gloves.captures.capture import runs_of
from track import find_suspect_spans, label_capture, track_capture
from track.label_confidence import evidence_of, label_confidence
from track.recorder import frame_values, take_of_rows
from track.smoothed_take import smooth_take
from track.take_faults import SuspectSpan
from track.take_summary import _VOUCH_LEAST, frame_confidence, vouch
from train import OpticsOptions, simulate_take
from train.evaluation import expected_calibration_error
from train.simulation.scenes import SimulatedKind

KINDS = ("single-hand", "hand-hand", "hand-pen", "hand-controller")
POOR = OpticsOptions(blob_loss=0.08, dropout=0.004, noise=0.25)  # the usual: 0.002, 0.0002, 0.12
OWN = ("dfki13", "starter15")  # gloves without a trained labeler
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


class Case(NamedTuple):
    """A capture to be tracked."""

    name: str
    """Words by which figures are summed up; with `number` the name of its files."""
    number: int
    make: Callable[[], tuple[Take, np.ndarray]]
    """Returns the tracked take and the true labels (T, N)."""

    def kept(self, folder: Path | None) -> tuple[Take, np.ndarray]:
        """The tracked take and the true labels, from the folder if they are there, else kept in it."""
        if folder is None:
            return self.make()
        path = folder / f"{self.name.replace(' ', '_')}_{self.number}.npz"
        truth = path.with_suffix(".npy")
        if not truth.exists():
            take, labels = self.make()
            folder.mkdir(parents=True, exist_ok=True)
            take.save(path)
            np.save(truth, labels)  # last, as it tells that the take is whole
        return load_take(path), np.load(truth)


def usual_cases(gloves: tuple[str, ...], seeds: tuple[int, ...], frames: int, label: bool) -> list[Case]:
    """Captures of the paper's kinds, with errors."""

    def make(glove: str, seed: int, kind: SimulatedKind) -> tuple[Take, np.ndarray]:
        truth = simulate(glove, kind, seed, frames)
        return (label_capture if label else track_capture)(truth, glove=glove), truth.labels

    every = product(gloves, seeds, KINDS)
    return [Case(f"{glove} {kind}", seed, partial(make, glove, seed, kind)) for glove, seed, kind in every]


def unseen_cases(frames: int, real: Path | None) -> list[Case]:
    """76 simulated captures and 24 of real hands, of sorts from which nothing was learned."""

    def make(seed: int, **options: Any) -> tuple[Take, np.ndarray]:
        truth = simulate_take(seed=seed, num_frames=frames, **options).without_body()
        return track_capture(truth, glove=options["glove"]), truth.labels

    def tracked(folder: Path, condition: str) -> tuple[Take, np.ndarray]:
        scene = make_scene(folder, condition, seed=1, frames=frames)
        stream, tracker = tracker_of(scene)
        there = np.isfinite(scene.points[..., 0])
        rows = [frame_values(one, tracker.step(one.points, one.ids, one.time)) for one in stream]
        take = take_of_rows(rows, tracker, scene.capture())
        sure = dataclasses.replace(take.point_list, confidence=label_confidence(take))
        take = smooth_take(dataclasses.replace(take, point_list=sure))
        return take, np.where(there, true_labels(scene), -1)

    sorts: dict[str, list[dict[str, Any]]] = {
        "twin": [{"kind": kind} for kind in KINDS],
        "gaps": [{"kind": kind, "optics": POOR} for kind in KINDS],
        "skin": [{"kind": "real-like"}] * 2,
        "foreign": [{"kind": kind, "others": 20} for kind in KINDS],
        "rig": [
            {"kind": kind, "rig": rig} for kind, rig in zip(KINDS, ("six", "eight", "six"), strict=False)
        ],
    }
    trained = [
        (f"{sort} {glove}", {"glove": glove, **options})
        for glove in ("dense19", "sparse13")
        for sort, several in sorts.items()
        for options in several
    ]
    own = [(f"own {glove}", {"glove": glove, "kind": kind}) for glove in OWN for kind in KINDS]
    every = [*trained, *own, *trained]
    cases = [
        Case(name, 700 + n, partial(make, 700 + n, **options)) for n, (name, options) in enumerate(every)
    ]
    people = sorted(real.glob("User*/capture*")) if real else []
    scenes = product(people, CONDITIONS[1:])
    of_people = [Case(f"real {how}", n, partial(tracked, who, how)) for n, (who, how) in enumerate(scenes)]
    return [*cases[: -len(trained)], *of_people, *cases[-len(trained) :]]


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


def listed_frames(take: Take, spans: Sequence[SuspectSpan]) -> np.ndarray:
    """Which frames are listed as doubtful in their labels (T,)."""
    listed = np.zeros(take.num_frames, dtype=bool)
    for span in spans:
        listed[span.first : span.last + 1 if span.of_labels else span.first] = True
    return listed


def score(
    take: Take, truth: np.ndarray, suspect: Sequence[SuspectSpan]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Runs, those covered, spans, those with an error, seconds, frames, those listed; pairs of confidence."""
    spans = [span for span in suspect if span.of_labels]
    runs, listed = error_runs(take, truth), listed_frames(take, spans)
    there = np.isfinite(take.points[..., 0])
    right = (take.labels == truth) | ~there
    covered = sum(listed[first : last + 1].any() for first, last in runs)
    good = sum(not right[span.first : span.last + 1].all() for span in spans)
    frames = take.num_frames
    counts = [len(runs), covered, len(spans), good, frames / take.rate, frames, listed.sum()]
    parts = [there & (take.labels >= 0), there & (take.labels < 0)]
    pairs = [np.stack([take.confidence[part], right[part]]) for part in parts]
    certain = frame_confidence(take)
    known = np.isfinite(certain)
    return np.array(counts), [*pairs, np.stack([certain[known], right.all(axis=1)[known]])]


class Vouched(NamedTuple):
    """What a take says of its labels, and what is true."""

    bound: float
    """Least share of right frames among those not listed; 0 if none is told."""
    found: float
    """The true share."""
    right: float
    """Share of right frames among all."""
    listed: float
    """Share of the frames that are listed."""
    ratio: float
    """Share of wrong frames among those not listed, over what `vouch` multiplies by its factor."""

    @classmethod
    def of(cls, take: Take, truth: np.ndarray, spans: Sequence[SuspectSpan]) -> Vouched:
        """Compare a take with its true labels."""
        right = ((take.labels == truth) | ~np.isfinite(take.points[..., 0])).all(axis=1)
        rest = ~listed_frames(take, spans)
        doubt = 1.0 - np.nan_to_num(frame_confidence(take), nan=1.0)
        wrong, told = ((~right[rest]).mean(), doubt[rest].mean()) if rest.any() else (0.0, 0.0)
        ratio = float(wrong / (told + _VOUCH_LEAST))
        return cls(vouch(take, spans).right, 1.0 - wrong, right.mean(), 1.0 - rest.mean(), ratio)


def tell_vouched(takes: Sequence[Vouched]) -> Figures:
    """Figures of the bound over takes."""
    told = [one for one in takes if one.bound > 0.0]
    good = [one for one in takes if one.right >= 0.97]
    broken = sum(one.found < one.bound for one in told)
    figures: Figures = {
        "takes": ("takes, with a bound, with a broken one", [len(takes), len(told), broken]),
        "good": (
            "takes with 97 % of frames right, frames that these vouch for [%]",
            [len(good), 100.0 * np.mean([(1.0 - one.listed) * (one.bound > 0.0) for one in good])],
        ),
    }
    if (rank := int(np.ceil(0.95 * (len(told) + 1)))) <= len(told):
        factor = float(np.sort([one.ratio for one in told])[rank - 1])
        figures["factor"] = "factor of the bound that the next take keeps with 95 % (split conformal)", factor
    return figures


def row(counts: np.ndarray, pairs: list[np.ndarray]) -> list[float]:
    """`WHAT` of some captures."""
    runs, covered, spans, good, seconds, frames, listed = counts
    shares = [100.0 * covered / max(runs, 1), 100.0 * good / max(spans, 1)]
    errors = [100.0 * expected_calibration_error(one[0], one[1] > 0.5) for one in pairs]
    return [*shares, 60.0 * spans / seconds, 100.0 * listed / frames, *errors]


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
    unseen: bool = False,
    real: Path | None = None,
    store: Path | None = None,
    takes: int | None = None,
    fit: bool = False,
    save: str | None = None,
) -> None:
    torch.set_num_threads(1)
    print(describe("numba", "torch"), WHAT, sep="\n")
    table: dict[str, list[tuple[np.ndarray, list[np.ndarray]]]] = {}
    vouched: list[Vouched] = []
    labeled: list[tuple[np.ndarray, np.ndarray]] = []
    others: list[tuple[np.ndarray, np.ndarray]] = []
    cases = unseen_cases(frames, real) if unseen or real else usual_cases(gloves, seeds, frames, label)
    for case in cases[:takes]:
        take, truth = case.kept(store)
        spans = find_suspect_spans(take, None)
        scored = score(take, truth, spans)
        for key in (*case.name.split(), "all"):
            table.setdefault(key, []).append(scored)
        vouched.append(Vouched.of(take, truth, spans))
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
    told = tell_vouched(vouched)
    report(None, told)
    save_figures(save, {**figures, **told})
    if fit:
        print("_LABELED", fitted(labeled).round(2), "\n_UNLABELED", fitted(others).round(2))


if __name__ == "__main__":
    run(main, __doc__)
