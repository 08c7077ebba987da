"""Recordings for the viewer: frames of hands, points and bodies, shown singly or as a video."""

from __future__ import annotations

import itertools
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt32

from gloves.captures.capture import Capture
from gloves.fit import GloveFit
from gloves.takes.bodies import RigidBody
from gloves.takes.take import STATUSES, Take, label_names
from handsim.callbacks import Progress, no_progress
from handsim.hand.model import HandModel
from handsim.hand.shape import NUM_QPOS
from handsim.pages import distinct_colors
from handsim.space.rig import CameraRig, list_rigs, load_rig
from handsim.space.transforms import UpAxis, room_axes, rotated_poses
from track.bodies.rigid_body import RigidTemplate
from track.frames import StreamedFrame, TrackedFrame
from track.takes.take_faults import SuspectSpan
from track.takes.take_summary import find_suspect_spans, frame_confidence
from train.data.shards import Dataset

GHOST_COLOR: Final = (128, 128, 128)
"""Color of unlabeled points."""
_NO_NAME: Final = re.compile(r"(?:.*:)?\s*(?:\*|_?unlabell?ed|uname)", re.I)
"""Names that optical systems give to unnamed trajectories."""
_ROW_RATE: Final = 4.0  # [Hz] played rows of a training set
_MOST_LIVE_POINTS: Final = 400  # largest number of shown points of a live frame
_VIDEO_RATE: Final = 30.0  # highest rate of a video [Hz]


@dataclass(frozen=True, slots=True, eq=False)
class ShownFrame:
    """One frame: H hands, N points, B bodies, R rays."""

    time: float
    """[s]"""
    words: tuple[str, ...] = ()
    """Lines about the frame."""
    hands: tuple[HandModel, ...] = ()
    qpos: Float[np.ndarray, "H 27"] = field(default_factory=lambda: np.empty((0, 27)))
    """Poses [m, rad]; NaN for a hand without a pose."""
    points: Float[np.ndarray, "N 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """World positions [m]."""
    labels: Int[np.ndarray, "N"] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Indices of `Recording.label_names`, -1 for a ghost."""
    seen: Bool[np.ndarray, "N"] = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    """Which points were seen; others are computed from a pose."""
    bodies: Float[np.ndarray, "B 7"] = field(default_factory=lambda: np.empty((0, 7)))
    """Position [m] and orientation (wxyz) of each body; NaN if lost."""
    rays: Float[np.ndarray, "R 2 3"] = field(default_factory=lambda: np.empty((0, 2, 3)))
    """Lines of sight from markers to the cameras that see them [m]."""


class Recording(ABC):
    """T frames, computed on request."""

    times: Float[np.ndarray, "T"]
    """Time of each frame [s], increasing."""
    label_names: tuple[str, ...]
    most_points: int
    """The largest number of points in a frame."""
    radius = 0.0035
    """Marker radius [m]."""
    bodies: tuple[RigidBody, ...] = ()
    rig: CameraRig | None = None
    curves: Mapping[str, Float[np.ndarray, "T"]] = {}
    """Quantities over time by name."""
    suspects: tuple[SuspectSpan, ...] = ()
    """Doubtful spans of frames, the most doubtful first."""
    has_hands = has_filled = True
    """Whether there are hands, and filled-in points."""

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.times)

    @abstractmethod
    def frame(self, index: int) -> ShownFrame:
        """Make a frame."""


class TakeRecording(Recording):
    """A take with the given cameras, or those in its settings."""

    def __init__(self, take: Take, rig: CameraRig | None = None) -> None:
        self.times, self.label_names = take.times, take.label_names
        self.most_points = int(take.point_list.counts.max()) + take.hand_labels[-1].stop
        self.radius, self.bodies = take.hands[0].layout.radius, tuple(take.bodies)
        self.rig = rig_of_settings(take.settings.get("rig")) if rig is None else rig
        self.replace(take)

    def replace(self, take: Take) -> None:
        """Replace labels and poses of the same frames."""
        self._take, self.curves, self.suspects = take, _curves(take), find_suspect_spans(take)
        self._filled = np.concatenate([take.filled(side) for side in take.sides], axis=1)
        self._markers = np.concatenate([take.markers(side) for side in take.sides], axis=1)

    def frame(self, index: int) -> ShownFrame:
        """Make a frame."""
        take, points = self._take, self._take.point_list
        there = points.of(index)
        filled = np.flatnonzero(self._filled[index])
        return ShownFrame(
            time=float(take.times[index]),
            words=tuple(self._words(index)),
            hands=tuple(hand.model for hand in take.hands_at(index)),
            qpos=take.qpos[index],
            points=np.concatenate([points.points[there], self._markers[index, filled]]),
            labels=np.concatenate([points.labels[there].astype(np.int64), filled]),
            seen=np.repeat([True, False], [there.stop - there.start, len(filled)]),
            bodies=take.body_poses[index],
        )

    def _words(self, index: int) -> Iterator[str]:
        take = self._take
        for hand, (side, labels) in enumerate(zip(take.sides, take.hand_labels, strict=True)):
            filled = int(self._filled[index, labels].sum())
            yield _words_of(side, STATUSES[take.status[index, hand]], take.rms[index, hand], filled)
        for number, body in enumerate(take.bodies):
            status = STATUSES[take.body_status[index, number]]
            yield _words_of(body.name, status, take.body_rms[index, number])
        there = take.point_list.labels[take.point_list.of(index)]
        yield f"{len(there)} points, {(there < 0).sum()} without label"


def _words_of(name: str, status: object, rms: float, filled: int = 0) -> str:
    """Line on the state of a hand or a body."""
    rms_words = f", RMS {1e3 * rms:.2f} mm" if np.isfinite(rms) else ""
    return f"**{name}** {status}{rms_words}" + (f", {filled} filled in" if filled else "")


def _curves(take: Take) -> dict[str, Float[np.ndarray, "T"]]:
    """RMS of each hand and doubt over time; empty if no pose was fitted, as in a simulated take."""
    if not np.isfinite(take.rms).any():
        return {}
    curves = {f"{side} RMS [mm]": 1e3 * take.rms[:, hand] for hand, side in enumerate(take.sides)}
    return curves | {"doubt, 0 to 1": 1.0 - frame_confidence(take)}


def rig_of_settings(rig: object) -> CameraRig | None:
    """The rig stored in settings, or the shipped rig that they name; None for a path."""
    return load_rig(rig) if isinstance(rig, dict) or rig in list_rigs() else None


class LiveRecording(Recording):
    """Newest frame of a running tracker."""

    def __init__(
        self, hands: Sequence[GloveFit], bodies: Sequence[RigidTemplate], rig: CameraRig | None
    ) -> None:
        self._models = tuple(hand.model for hand in hands)
        self._offsets = np.cumsum([0, *(hand.layout.num_markers for hand in hands)])
        self.times, self.label_names = np.zeros(1), label_names(hands, bodies)
        self.most_points, self.radius = _MOST_LIVE_POINTS, hands[0].layout.radius
        self.bodies, self.rig = tuple(bodies), rig

    def frame(self, index: int) -> ShownFrame:
        """An empty frame, before the first one is tracked."""
        return ShownFrame(0.0)

    def frame_of(self, frame: StreamedFrame, tracked: TrackedFrame) -> ShownFrame:
        """Make a frame from the tracker's input and output."""
        filled = [hand.markers[hand.filled] for hand in tracked.hands]
        labels = [offset + hand.filled for offset, hand in zip(self._offsets, tracked.hands, strict=False)]
        bodies = [np.concatenate([body.translation, body.rotation]) for body in tracked.bodies]
        count = len(frame.points)
        words = [_words_of(hand.side, hand.status, hand.rms) for hand in tracked.hands]
        words += [f"**{body.name}** {body.status}" for body in tracked.bodies]
        return ShownFrame(
            time=frame.time,
            words=(*words, f"{count} points", *tracked.notes),
            hands=self._models,
            qpos=np.array([hand.qpos for hand in tracked.hands]).reshape(-1, NUM_QPOS),
            points=np.concatenate([frame.points, *filled]),
            labels=np.concatenate([tracked.labels, *labels]).astype(np.int64),
            seen=np.repeat([True, False], [count, sum(map(len, filled))]),
            bodies=np.array(bodies).reshape(-1, 7),
        )


class CaptureRecording(Recording):
    """A marker file: named trajectories in color, others gray."""

    has_hands = has_filled = False

    def __init__(self, capture: Capture, rig: CameraRig | None = None) -> None:
        named = np.array([_NO_NAME.match(name) is None for name in capture.names])
        self._positions, self._labels = capture.positions, np.where(named, np.cumsum(named) - 1, -1)
        self.times = np.arange(capture.num_frames) / capture.rate
        self.label_names = tuple(itertools.compress(capture.names, named))
        self.most_points = int(np.isfinite(capture.positions[..., 0]).sum(axis=1).max())
        self.rig = rig

    def frame(self, index: int) -> ShownFrame:
        """Make a frame."""
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
    """Rows of a training set, with the given cameras or those in its settings."""

    def __init__(self, dataset: Dataset, rig: CameraRig | None = None) -> None:
        self._dataset = dataset
        self._starts = np.cumsum([0, *map(len, dataset.shards)])
        self._model: tuple[tuple[int, int], HandModel] | None = None
        self.times = np.arange(self._starts[-1]) / _ROW_RATE
        self.label_names = dataset.marker_names
        self.most_points = len(dataset.marker_names) + dataset.shards[0].dtype["ghosts"].shape[0]
        self.rig = rig_of_settings(dataset.manifest.config.get("rig")) if rig is None else rig

    def frame(self, index: int) -> ShownFrame:
        """Make a frame."""
        shard = int(np.searchsorted(self._starts, index, side="right")) - 1
        row = self._dataset.shards[shard][index - self._starts[shard]]
        observed = np.isfinite(row["observed"][:, 0])
        markers = np.where(observed[:, None], row["observed"], row["markers"])
        ghosts = row["ghosts"][np.isfinite(row["ghosts"][:, 0])]
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
            labels=np.concatenate([np.arange(len(markers)), np.full(len(ghosts), -1)]),
            seen=np.concatenate([observed, np.ones(len(ghosts), dtype=np.bool_)]),
            rays=self._rays(row["markers"], row["cameras"]),
        )

    def _hand(self, shard: int, number: int) -> HandModel:
        """The hand of a row, cached because the next row mostly has the same one."""
        if self._model is None or self._model[0] != (shard, number):
            self._model = ((shard, number), HandModel(self._dataset.hands(shard)[number]))
        return self._model[1]

    def _rays(self, markers: np.ndarray, cameras: UInt32[np.ndarray, "M"]) -> np.ndarray:
        if self.rig is None:
            return np.empty((0, 2, 3))
        numbers = np.arange(len(self.rig.positions), dtype=np.uint32)
        marker, camera = np.nonzero((cameras[:, None] >> numbers) & 1)
        return np.stack([markers[marker], self.rig.positions[camera]], axis=1).astype(np.float64)


def label_colors(names: Sequence[str]) -> UInt8[np.ndarray, "K 3"]:
    """A color for each label, equal for both hands, with the color of unlabeled points last."""
    bare = [name.rsplit(":", 1)[-1] for name in names]
    order = {name: number for number, name in enumerate(dict.fromkeys(bare))}
    colors = distinct_colors(len(order))  # in the order of the glove, so that digits differ
    chosen = np.array([colors[order[name]] for name in bare]).reshape(-1, 3)
    labeled = np.round(255 * chosen).astype(np.uint8)
    return np.concatenate([labeled, np.array([GHOST_COLOR], dtype=np.uint8)])


def write_video(
    path: Path,
    recording: Recording,
    shown: Float[np.ndarray, "N 3"],
    *,
    up: UpAxis = "z",
    write_clip: Callable[..., None],
    progress: Progress = no_progress,
) -> int:
    """Write a recording as a video (.mp4) in real time; return the number of pictures.

    The view contains the points `shown` [m]; `write_clip` of `render.illustrations` draws and encodes.
    """
    rate, frames = chosen_frames(recording.times)
    turn = room_axes(up)
    palette = label_colors(recording.label_names) / 255.0

    def pictures() -> Iterator[tuple[Any, ...]]:
        for number, index in enumerate(frames, start=1):
            frame = recording.frame(index)
            hands = list(zip(frame.hands, rotated_poses(frame.qpos, turn), strict=True))
            points, labels = frame.points[frame.seen] @ turn.T, frame.labels[frame.seen]
            yield hands, points, palette[labels], f"frame {index}, {frame.time:.2f} s"
            progress(number, len(frames))

    there = shown[np.isfinite(shown).all(axis=1)] @ turn.T
    write_clip(path, pictures(), rate=rate, shown=there, radius=recording.radius)
    return len(frames)


def chosen_frames(times: Float[np.ndarray, "T"]) -> tuple[float, list[int]]:
    """Rate of a video [Hz], and the frame of each picture: the last one until the picture's time."""
    if len(times) < 2:
        return _VIDEO_RATE, [0]
    rate = min(_VIDEO_RATE, 1.0 / float(np.median(np.diff(times))))
    count = int(np.floor((times[-1] - times[0]) * rate + 1e-6)) + 1
    moments = times[0] + np.arange(count) / rate
    frames = np.searchsorted(times, moments + 1e-6, side="right") - 1
    return rate, [int(frame) for frame in frames]
