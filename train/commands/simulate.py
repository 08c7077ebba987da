"""The command `handsim simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from gloves.captures.capture import Capture
from gloves.captures.formats import WRITABLE, check_suffix, write_capture
from gloves.captures.gaps import count_gaps
from gloves.captures.markers import UNLABELED
from gloves.takes.take import SUFFIX
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
    write_capture(out, Capture(names, take.points, take.rate))
    truth = out.with_suffix(SUFFIX)
    take.save(truth)
    counts = count_gaps(take.markers_present())
    Console().print(
        f"{out}: {take.num_frames} frames, {counts.gaps} gaps; truth in {truth}",
        highlight=False,
        soft_wrap=True,
    )
