"""The README of a benchmark, and what its captures hold."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from benchmarks.public.answers import load_answers
from benchmarks.public.difficulties import BENCHMARK, DIFFICULTIES, Plan
from benchmarks.public.manifest import capture_path, label_names, truth_path
from gloves import read_capture
from train.simulation.scenes import RATE

_CARD: Final = """\
# {name}, {size}

{captures} simulated captures of two hands in marker gloves, {frames:,} frames at {rate:g} Hz, made by
handsim: unlabeled points, as an optical system with several cameras exports them. A tracker may read
`captures/`, and nothing else; `truth/` is for the scorer alone, which counts a folder of results:

```
python -m benchmarks.public score THIS_FOLDER RESULTS
```

benchmarks/public/README.md in handsim's sources describes the files, the forms of results, what is counted,
and the limits. With results name the benchmark, its size, and whether users were calibrated. Do not train on
these captures. `python -m benchmarks.public make --size {size}` makes them again.

| | cameras | speed | markers missing | gaps per second | ghosts per frame |
|---|---|---|---|---|---|
{rows}

License: CC BY 4.0, see `LICENSE.txt`. Credit: the handsim authors.
"""


class Counts(NamedTuple):
    """What the captures of one difficulty hold."""

    missing: float
    """Share of the markers without a point."""
    ghosts: float
    """Points of no marker, per frame."""
    gaps: float
    """Times that a marker's point ends, per second of a capture; it comes back with another ID."""


def describe_captures(plan: Plan, folder: Path) -> dict[str, Counts]:
    """Counts by difficulty, from the files of a benchmark."""
    found: dict[str, list[Counts]] = {name: [] for name in plan.difficulties}
    for one in plan.captures:
        labels = load_answers(folder / truth_path(one.name)).labels
        points = np.isfinite(read_capture(folder / capture_path(one.name)).positions[..., 0])
        given = labels >= 0
        markers = np.zeros((len(labels), len(label_names())), dtype=bool)
        frames, columns = np.nonzero(given)
        markers[frames, labels[frames, columns]] = True
        ends = int((markers[:-1] & ~markers[1:]).sum())
        ghosts = float((points & ~given).sum() / len(labels))
        found[one.difficulty].append(Counts(1.0 - float(markers.mean()), ghosts, ends * RATE / len(labels)))
    return {name: Counts(*np.mean(counts, axis=0).tolist()) for name, counts in found.items() if counts}


def data_card(plan: Plan, counts: dict[str, Counts]) -> str:
    """The README's text."""
    rows = (
        f"| {name} | `{DIFFICULTIES[name].rig}` | {DIFFICULTIES[name].speed} | {100 * one.missing:.2f} % "
        f"| {one.gaps:.1f} | {one.ghosts:.2f} |"
        for name, one in counts.items()
    )
    return _CARD.format(
        name=BENCHMARK,
        size=plan.size,
        captures=len(plan.captures),
        frames=sum(one.num_frames for one in plan.captures),
        rate=RATE,
        rows="\n".join(rows),
    )
