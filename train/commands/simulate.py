"""The command `handsim simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from gloves.captures.capture import Capture
from gloves.captures.formats import WRITABLE, check_suffix, write_capture
from gloves.captures.gaps import count_gaps
from gloves.captures.markers import UNLABELED
from gloves.takes.take import SUFFIX
from handsim.app.messages import print_line
from handsim.files.atomic import atomic_writes
from handsim.files.outputs import check_outputs
from train.simulation.takes import TakeConfig, simulate_take


def simulate(out: Path, config: Annotated[TakeConfig, tyro.conf.arg(name="")]) -> None:
    """Simulate a capture of two hands; the truth goes beside it.

    Args:
        out: Unlabeled .c3d or .trc file; OUT.truth.npz takes IDs, labels, poses and shapes.
        config: What to simulate.
    """
    check_suffix(out, WRITABLE)
    check_outputs((config.glove, config.rig), (out, out.with_suffix(SUFFIX)))
    take = simulate_take(config)
    names = tuple(f"{UNLABELED}{number + 1}" for number in range(take.points.shape[1]))
    truth = out.with_suffix(SUFFIX)
    with atomic_writes(out, truth) as (capture_file, truth_file):  # a capture without its truth is no use
        write_capture(capture_file, Capture(names, take.points, take.rate))
        take.save(truth_file)
    counts = count_gaps(take.markers_present())
    print_line(f"{out}: {take.num_frames} frames, {counts.gaps} gaps; truth in {truth}")
