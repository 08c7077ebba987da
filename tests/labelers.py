"""A labeler that tests ask, and that tells how often."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from train import Labeling, load_labeler


class CountingLabeler:
    """The labeler of dense19, which keeps how many frames it was asked for in each call."""

    def __init__(self) -> None:
        self._labeler = load_labeler("dense19")
        self.marker_names = self._labeler.marker_names
        self.calls: list[int] = []

    def label_frames(self, frames: Sequence[np.ndarray]) -> list[Labeling]:
        self.calls.append(len(frames))
        return self._labeler.label_frames(frames)
