"""Captures as the viewer shows them."""

from __future__ import annotations

import itertools
import re
from typing import Final

import numpy as np

from gloves.captures.capture import Capture
from handsim.space.cameras import CameraRig
from track.viewer.recordings.recording import Recording, ShownFrame

_NO_NAME: Final = re.compile(r"(?:.*:)?\s*(?:\*|_?unlabell?ed|uname)", re.I)
"""Names that optical systems give to trajectories that nobody named."""


class CaptureRecording(Recording):
    """A marker file: named trajectories in color, the others gray.

    Args:
        capture: The file's content.
        rig: The cameras, where they are known.
    """

    def __init__(self, capture: Capture, rig: CameraRig | None = None) -> None:
        self._positions = capture.positions
        named = np.array([_NO_NAME.match(name) is None for name in capture.names])
        self._labels = np.where(named, np.cumsum(named) - 1, -1)
        counts = np.isfinite(capture.positions[..., 0]).sum(axis=1)
        super().__init__(
            np.arange(capture.num_frames) / capture.rate,
            tuple(itertools.compress(capture.names, named)),
            most_points=int(counts.max()),
            rig=rig,
            has_hands=False,
            has_filled=False,
        )

    def frame(self, index: int) -> ShownFrame:
        """One of the frames."""
        there = np.isfinite(self._positions[index, :, 0])
        labels = self._labels[there]
        return ShownFrame(
            time=float(self.times[index]),
            words=(f"{len(labels)} points, {(labels < 0).sum()} without name",),
            points=self._positions[index, there],
            labels=labels,
            seen=np.ones(len(labels), dtype=np.bool_),
        )
