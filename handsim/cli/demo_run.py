"""One run of `handsim demo`: what its steps share, and where they leave their files for each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

GLOVE: Final = "dense19"


@dataclass(frozen=True, slots=True)
class DemoRun:
    """What every step of the demo is given.

    Each package contributes steps: functions that take a `DemoRun` and return a `Section` or None.
    Steps hand data on as files in `work`, one way, in the order of the table in `handsim.cli.command_table`.
    """

    out: Path
    """Folder of the page; pictures go here."""
    work: Path
    """Folder for files between steps, removed afterwards."""
    seed: int
    num_frames: int
    """Frames to generate and label."""
    report: Callable[[str], None]
    """Shows what is being done."""

    @property
    def dataset(self) -> Path:
        """Folder of the generated training set."""
        return self.work / "dataset"

    @property
    def figures(self) -> Path:
        """JSON of the labeler's figures and speeds."""
        return self.work / "figures.json"

    @property
    def labeled_frame(self) -> Path:
        """One labeled frame (.npz): points (N, 3) [m], labels and truth (N,), seen (M,), qpos (27,), hand."""
        return self.work / "labeled_frame.npz"

    @property
    def tracked_take(self) -> Path:
        """The tracked take (.npz)."""
        return self.work / "tracked.npz"
