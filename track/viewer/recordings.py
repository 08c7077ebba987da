"""What the viewer shows over time: frames of hands, points and bodies, made one at a time."""

from __future__ import annotations

import itertools
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

from gloves.captures.capture import Capture
from gloves.takes.take import STATUSES, RigidBody, Take
from handsim.hand.model import HandModel
from handsim.space.rig import CameraRig, as_rig, list_rigs
from track.take_summary import SuspectSpan, find_suspect_spans, frame_confidence
from train.data.shards import Dataset

_NO_NAME: Final = re.compile(r"(?:.*:)?\s*(?:\*|_?unlabell?ed|uname)", re.I)
"""Names that optical systems give to trajectories that nobody named."""
_ROWS_PER_SECOND: Final = 4.0
"""Rows of a training set do not follow each other in time; they are shown at this pace."""


@dataclass(frozen=True, slots=True, eq=False)
class ShownFrame:
    """One frame: H hands, N points, B bodies, R rays."""

    time: float
    """[s]"""
    words: tuple[str, ...] = ()
    """The state of the frame, one line each."""
    hands: tuple[HandModel, ...] = ()
    qpos: Float[np.ndarray, "H 27"] = field(default_factory=lambda: np.empty((0, 27)))
    """Poses in the world [m, rad]; NaN where a hand has none."""
    points: Float[np.ndarray, "N 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """World [m]."""
    labels: Int[np.ndarray, "N"] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Indices of `Recording.label_names`, -1 for a ghost."""
    seen: Bool[np.ndarray, "N"] = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    """Which points were seen; the others are filled in from a pose."""
    bodies: Float[np.ndarray, "B 7"] = field(default_factory=lambda: np.empty((0, 7)))
    """Position [m] and orientation (wxyz) of each body; NaN where it is lost."""
    rays: Float[np.ndarray, "R 2 3"] = field(default_factory=lambda: np.empty((0, 2, 3)))
    """Lines of sight from markers to the cameras that see them [m]."""


class ShownBody(NamedTuple):
    """A rigid body and its shape; without a shape its axes are drawn."""

    name: str
    vertices: Float[np.ndarray, "V 3"] | None = None
    """In its own frame [m]."""
    faces: Int[np.ndarray, "F 3"] | None = None


class Curve(NamedTuple):
    """A number that changes over the frames."""

    name: str
    values: Float[np.ndarray, "T"]


class Recording(ABC):
    """T frames, made when they are asked for.

    Args:
        times: Time of each frame [s], increasing.
        most_points: The largest number of points in a frame.
        bodies: The rigid bodies, in the order of `ShownFrame.bodies`.
        doubts: Spans of frames that deserve a look, the most doubtful first.
        has_filled: Whether there are points that were not seen.
    """

    def __init__(
        self,
        times: Float[np.ndarray, "T"],
        label_names: tuple[str, ...],
        *,
        most_points: int,
        radius: float = 0.0035,
        bodies: tuple[ShownBody, ...] = (),
        rig: CameraRig | None = None,
        curves: tuple[Curve, ...] = (),
        doubts: tuple[SuspectSpan, ...] = (),
        has_hands: bool = True,
        has_filled: bool = True,
    ) -> None:
        self.times, self.label_names, self.most_points = times, label_names, most_points
        self.radius, self.bodies, self.rig = radius, bodies, rig
        self.curves, self.doubts = curves, doubts
        self.has_hands, self.has_filled = has_hands, has_filled

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.times)

    @abstractmethod
    def frame(self, index: int) -> ShownFrame:
        """One of the frames."""


class TakeRecording(Recording):
    """A take: labels, poses and status as they were simulated or tracked.

    Args:
        rig: The cameras; those that the take names, if they come with handsim, when None.
    """

    def __init__(self, take: Take, rig: CameraRig | None = None) -> None:
        self._models = tuple(hand.model for hand in take.hands)
        super().__init__(
            take.times,
            take.label_names,
            most_points=int(take.point_list.counts.max()) + take.hand_labels[-1].stop,
            radius=take.hands[0].layout.radius,
            bodies=tuple(shown_body(body) for body in take.bodies),
            rig=rig_of_settings(take.settings.get("rig")) if rig is None else rig,
        )
        self.replace(take)

    def replace(self, take: Take) -> None:
        """Show the same frames with other labels and poses."""
        self._take, self.curves, self.doubts = take, _curves(take), find_suspect_spans(take)
        self._filled = np.concatenate([take.filled(side) for side in take.sides], axis=1)
        self._markers = np.concatenate([take.markers(side) for side in take.sides], axis=1)

    def frame(self, index: int) -> ShownFrame:
        """One of the frames."""
        take, points = self._take, self._take.point_list
        there = points.of(index)
        filled = np.flatnonzero(self._filled[index])
        return ShownFrame(
            time=float(take.times[index]),
            words=tuple(self._words(index)),
            hands=self._models,
            qpos=take.qpos[index],
            points=np.concatenate([points.points[there], self._markers[index, filled]]),
            labels=np.concatenate([points.labels[there].astype(np.int64), filled]),
            seen=np.repeat([True, False], [there.stop - there.start, len(filled)]),
            bodies=take.body_poses[index],
        )

    def _words(self, index: int) -> list[str]:
        take = self._take
        rows: list[tuple[str, int, float, int]] = [
            (side, take.status[index, hand], take.rms[index, hand], int(self._filled[index, labels].sum()))
            for hand, (side, labels) in enumerate(zip(take.sides, take.hand_labels, strict=True))
        ]
        rows += [
            (body.name, take.body_status[index, number], take.body_rms[index, number], 0)
            for number, body in enumerate(take.bodies)
        ]
        lines = []
        for name, status, rms, filled in rows:
            parts = [f"**{name}** {STATUSES[status]}"]
            parts += [f"RMS {1e3 * rms:.2f} mm"] if np.isfinite(rms) else []
            parts += [f"{filled} filled in"] if filled else []
            lines.append(", ".join(parts))
        labels = take.point_list.labels[take.point_list.of(index)]
        return [*lines, f"{len(labels)} points, {(labels < 0).sum()} without label"]


def _curves(take: Take) -> tuple[Curve, ...]:
    """RMS of each hand, and doubt; nothing where no pose was fitted, as of a truth."""
    if not np.isfinite(take.rms).any():
        return ()
    curves = [Curve(f"{side} RMS [mm]", 1e3 * take.rms[:, hand]) for hand, side in enumerate(take.sides)]
    return (*curves, Curve("doubt, 0 to 1", 1.0 - frame_confidence(take)))


def shown_body(body: RigidBody) -> ShownBody:
    """A body with its surface, where that is known."""
    thing = body.shape
    return ShownBody(body.name) if thing is None else ShownBody(body.name, thing.vertices, thing.faces)


def rig_of_settings(rig: object) -> CameraRig | None:
    """The rig that settings name or hold; None for a path, which is none to follow."""
    return as_rig(rig) if isinstance(rig, dict) or rig in list_rigs() else None


class CaptureRecording(Recording):
    """A marker file: named trajectories in color, the others gray."""

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
