"""Labelled captures of several people, one sub-folder each."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gloves.captures import read_capture
from gloves.captures.markers import select_markers


def right_hands(captures: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Markers (T, M, 3) [m] of every person's files *_right.trc, by the sub-folder's name."""
    return {
        person.name: np.concatenate(
            [select_markers(read_capture(file), names) for file in sorted(person.rglob("*_right.trc"))]
        )
        for person in sorted(captures.iterdir())
        if person.is_dir()
    }
