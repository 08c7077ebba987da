"""The README of a benchmark: a data card as hubs of data read it, YAML first and then words."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from benchmarks.public.answers import load_answers
from benchmarks.public.difficulties import BENCHMARK, DIFFICULTIES, GLOVE, Plan
from benchmarks.public.manifest import capture_path, label_names, truth_path
from gloves import read_capture
from train.simulation.scenes import RATE

_TAGS: Final = ("motion-capture", "hand-tracking", "marker-labeling", "point-cloud", "synthetic", "handsim")
_SIZES: Final = ((1e3, "n<1K"), (1e4, "1K<n<10K"), (1e5, "10K<n<100K"), (1e6, "100K<n<1M"))
_HEAD: Final = """\
---
license: cc-by-4.0
pretty_name: {name}
task_categories:
- other
annotations_creators:
- machine-generated
size_categories:
- {size}
tags:
{tags}
---

"""
_CONTENT: Final = """\
# {name}, {size}

{captures} simulated captures of two hands in marker gloves, {frames:,} frames at {rate:g} Hz, made by
handsim: unlabeled points, as an optical system with several cameras exports them. Two tasks: say which
marker each point is, and where the joints of the hands are. Each capture has {seconds:.3g} s of one person;
those of other difficulties show the same person and, at the same speed, the same motion:

{kinds}

## Files

A tracker may read everything in `captures/`, and nothing else:

- `captures/NAME.trc`: points in millimeters, z up. Columns are called Unlabeled1 and so on. An unbroken
  stretch of a column is one point; after a gap the column goes on with another one.
- `captures/glove.toml`: the glove `{glove}` as designed, 19 markers on each hand.
- `captures/captures.csv`: cameras, length and breadth of the hands of each capture.
- `captures/NAME.user.json`: the true hands and gloves, for results with *calibrated* users. Results that do
  not read it are *uncalibrated*.
- `captures/rig-*.toml`: the cameras.

`truth/NAME.npz` is for the scorer alone: `labels` (frames, columns), `joints` (frames, 2, 21, 3) in meters
and `angles` (frames, 2, 20) in radians, the right hand first. `manifest.json` has the names of labels and
joints, all settings and seeds, and the SHA-256 of every file.

"""
_WORDS: Final = """

## Results

Write `NAME.csv` for every capture, with the columns `frame,point,label`, as `17,Unlabeled4,right:ThumbTip`:
frames and points are named as in the `.trc`, and points without a label are left out. Or write `NAME.npz`
like the truth. Then count them:

```
python -m benchmarks.public score THIS_FOLDER RESULTS
```

With results name the benchmark, its size, and whether users were calibrated. Do not train on these captures.

## How it was made

```
python -m benchmarks.public make --size {size} --out THIS_FOLDER
```

Every number is seeded, and positions are rounded to 0.01 mm, so that the same command gives the same bytes on
most machines; on others single numbers differ in their last digit, and the command names the files. The
README of benchmarks/public in handsim's sources defines difficulties and figures.

## Limits

- Simulated: no real person was recorded, flesh moves in `real-like` captures alone, and no ID passes from
  one marker to another.
- The controller's own markers are left out; the pen's tip is a point of no marker.
- The truth is public, so a result is worth what is told of how it was made.

## License

CC BY 4.0, see `LICENSE.txt`. Credit: the handsim authors.
"""
_WHAT: Final = {
    "single-hand": "two hands in the air that touch nothing",
    "hand-hand": "they clasp, clap, rub, point and interlace",
    "hand-pen": "the right hand points with a pen at the markers of the left",
    "hand-controller": "the right hand plays with a controller",
    "real-like": "hands of anybody, children included, that meet twice as fast, with noise and moving skin",
}


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
    frames = sum(one.num_frames for one in plan.captures)
    size = next((name for most, name in _SIZES if frames < most), "n>1M")
    tags = "\n".join(f"- {tag}" for tag in _TAGS)
    return (
        _HEAD.format(name=BENCHMARK, size=size, tags=tags)
        + _CONTENT.format(
            name=BENCHMARK,
            size=plan.size,
            captures=len(plan.captures),
            frames=frames,
            rate=RATE,
            seconds=plan.num_frames / RATE,
            kinds="\n".join(f"- `{kind}`: {_WHAT[kind]}" for kind in plan.kinds),
            glove=GLOVE,
        )
        + "\n".join(_difficulties(counts))
        + _WORDS.format(size=plan.size)
    )


def _difficulties(counts: dict[str, Counts]) -> list[str]:
    rows = [
        f"| {name} | `{DIFFICULTIES[name].rig}` | {DIFFICULTIES[name].speed} | {100 * one.missing:.2f} % "
        f"| {one.gaps:.1f} | {one.ghosts:.2f} |"
        for name, one in counts.items()
    ]
    return [
        "## Difficulties",
        "",
        "| | cameras | speed | markers missing | gaps per second | ghosts per frame |",
        "|---|---|---|---|---|---|",
        *rows,
    ]
