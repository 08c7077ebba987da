"""Labeled captures of several people, one sub-folder each."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gloves.captures.formats import read_markers


def right_hands(captures: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Markers (T, M, 3) [m] of every person's files *_right.trc, by the sub-folder's name."""
    return {
        person.name: read_markers(sorted(person.rglob("*_right.trc")), names)
        for person in sorted(captures.iterdir())
        if person.is_dir()
    }
