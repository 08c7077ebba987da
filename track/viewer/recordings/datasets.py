"""Training sets as the viewer shows them."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import UInt32

from handsim.hand.model import HandModel
from handsim.space.cameras import CameraRig
from track.viewer.recordings.recording import Recording, ShownFrame
from track.viewer.recordings.takes import rig_of_settings
from train.data.shards import Dataset

_ROWS_PER_SECOND: Final = 4.0
"""Rows of a training set do not follow each other in time; they are shown at this pace."""


class DatasetRecording(Recording):
    """A training set, row by row: hand, true markers, what the cameras see of them, ghosts.

    Args:
        dataset: The training set; its rows stay on disk.
        rig: The cameras; those of the set, if it names shipped ones or holds its own, when None.
    """

    def __init__(self, dataset: Dataset, rig: CameraRig | None = None) -> None:
        self._dataset = dataset
        self._starts = np.cumsum([0, *map(len, dataset.shards)])
        self._model: tuple[tuple[int, int], HandModel] | None = None
        markers, ghosts = len(dataset.marker_names), dataset.shards[0].dtype["ghosts"].shape[0]
        super().__init__(
            np.arange(self._starts[-1]) / _ROWS_PER_SECOND,
            dataset.marker_names,
            most_points=markers + ghosts,
            rig=rig_of_settings(dataset.manifest.config.get("rig")) if rig is None else rig,
        )

    def frame(self, index: int) -> ShownFrame:
        """One of the rows."""
        shard = int(np.searchsorted(self._starts, index, side="right")) - 1
        row = self._dataset.shards[shard][index - self._starts[shard]]
        observed = np.isfinite(row["observed"][:, 0])
        markers = np.where(observed[:, None], row["observed"], row["markers"])
        ghosts = row["ghosts"][np.isfinite(row["ghosts"][:, 0])]
        labels = np.concatenate([np.arange(len(markers)), np.full(len(ghosts), -1)])
        model = self._hand(shard, int(row["hand"]))
        return ShownFrame(
            time=float(self.times[index]),
            words=(
                f"**{model.shape.side}** hand of {1e3 * model.shape.length:.0f} mm",
                f"{observed.sum()} of {len(markers)} markers observed, {len(ghosts)} ghosts",
            ),
            hands=(model,),
            qpos=row["qpos"].astype(np.float64)[None],
            points=np.concatenate([markers, ghosts]).astype(np.float64),
            labels=labels,
            seen=np.concatenate([observed, np.ones(len(ghosts), dtype=np.bool_)]),
            rays=self._rays(row["markers"], row["cameras"]),
        )

    def _hand(self, shard: int, number: int) -> HandModel:
        """The hand of a row; rows that follow each other mostly share it."""
        if self._model is None or self._model[0] != (shard, number):
            shape = self._dataset.hands(shard)[number]
            self._model = ((shard, number), HandModel(shape))
        return self._model[1]

    def _rays(self, markers: np.ndarray, cameras: UInt32[np.ndarray, "M"]) -> np.ndarray:
        if self.rig is None:
            return np.empty((0, 2, 3))
        numbers = np.arange(len(self.rig.positions), dtype=np.uint32)
        marker, camera = np.nonzero((cameras[:, None] >> numbers) & 1)
        return np.stack([markers[marker], self.rig.positions[camera]], axis=1).astype(np.float64)
