"""A take: the output of an optical system, frame by frame, with its truth."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int

from gloves.captures.capture import Capture
from gloves.fit import GlovedHand, attach
from gloves.layout import stored_layout
from gloves.takes.archives import (
    check_shapes,
    check_types,
    names_of,
    read_archive,
    settings_of,
    write_archive,
)
from handsim._checks import check_type
from handsim.errors import ArgumentError
from handsim.hand.model import HandModel
from handsim.hand.records import HAND_DTYPE, pack_hand, unpack_hand
from handsim.hand.topology import NUM_QPOS

KIND: Final = "take"
SCHEMA: Final = 1
SUFFIX: Final = ".truth.npz"


@dataclass(frozen=True, slots=True, eq=False)
class HeldBody:
    """A rigid body of a take."""

    name: str
    marker_names: tuple[str, ...]
    T_world_body: Float[np.ndarray, "T 4 4"]
    """The body's frame seen from the world [m]."""

    def __post_init__(self) -> None:
        if self.T_world_body.ndim != 3 or self.T_world_body.shape[1:] != (4, 4):
            raise ArgumentError(f"T_world_body has shape {self.T_world_body.shape}, expected (T, 4, 4)")


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """Points of every frame with IDs and truth: T frames, N columns.

    A label counts through the markers of the hands, in their order, then those of the body; -1 is a ghost or
    no point at all. An unbroken stretch of a column is one ID.

    Raises:
        ArgumentError: The arrays do not fit together, a label names no marker, or the rate is not positive.
    """

    rate: float
    """Frames per second [Hz]."""
    points: Float[np.ndarray, "T N 3"]
    """World frame [m], NaN where a column has no point."""
    ids: Int[np.ndarray, "T N"]
    """The system's ID of each point, -1 where there is none."""
    labels: Int[np.ndarray, "T N"]
    """True label of each point."""
    hands: tuple[GlovedHand, ...]
    """The hands as they moved, with their gloves as worn: markers after slipping."""
    body: HeldBody | None
    """The rigid body that was held, if any."""
    settings: dict[str, Any]
    """Settings that made it, as JSON."""

    def __post_init__(self) -> None:
        try:
            _check(self)
        except ValueError as error:
            raise ArgumentError(f"not a take: {error}") from error

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.points)

    @property
    def hand_labels(self) -> tuple[range, ...]:
        """The labels of each hand's markers."""
        sizes = np.cumsum([0, *(hand.fit.layout.num_markers for hand in self.hands)])
        return tuple(range(int(low), int(high)) for low, high in itertools.pairwise(sizes))

    def observed(self, label: range) -> Float[np.ndarray, "T M 3"]:
        """Observed positions of the markers with these labels [m], NaN where they were lost."""
        observed = np.full((self.num_frames, len(label), 3), np.nan)
        mine = (self.labels >= label.start) & (self.labels < label.stop)
        frame, column = np.nonzero(mine)
        observed[frame, self.labels[frame, column] - label.start] = self.points[frame, column]
        return observed

    def markers_present(self) -> Bool[np.ndarray, "T M"]:
        """Which markers of the hands have a point in each frame."""
        observed = [self.observed(label) for label in self.hand_labels]
        present: np.ndarray = np.isfinite(np.concatenate(observed, axis=1)[..., 0])
        return present

    def capture(self) -> Capture:
        """The points without labels, as an optical system exports them: one trajectory per column."""
        names = tuple(f"*{column}" for column in range(self.points.shape[1]))
        return Capture(names, self.points, self.rate)

    def without_body(self) -> Take:
        """The take without the points of its body, which many optical systems track themselves."""
        gone = self.labels >= self.hand_labels[-1].stop
        return dataclasses.replace(
            self,
            points=np.where(gone[..., None], np.nan, self.points),
            ids=np.where(gone, -1, self.ids),
            labels=np.where(gone, -1, self.labels),
            body=None,
        )

    def save(self, path: Path) -> None:
        """Write a `.truth.npz`, whole or not at all; `load_take` reads it.

        Raises:
            OSError: The file cannot be written.
        """
        body = self.body
        header = {
            "units": "metres, radians, world frame",
            "rate": self.rate,
            "layouts": [dataclasses.asdict(hand.fit.layout) for hand in self.hands],
            "body": None if body is None else {"name": body.name, "marker_names": body.marker_names},
            "settings": self.settings,
        }
        arrays = {
            "points": self.points,
            "ids": self.ids.astype(np.int32),
            "labels": self.labels.astype(np.int16),
            "hands": np.array([pack_hand(hand.fit.shape) for hand in self.hands], dtype=HAND_DTYPE),
            "qpos": np.stack([hand.qpos for hand in self.hands]),
            "T_world_body": np.zeros((0, 4, 4)) if body is None else body.T_world_body,
        }
        write_archive(path, KIND, SCHEMA, header, arrays)


def load_take(path: str | Path) -> Take:
    """Read a `.truth.npz`, which `handsim simulate` and `Take.save` write; nothing is unpickled.

    Args:
        path: The file.

    Returns:
        Points (T, N, 3) [m] with IDs and true labels, and the hands' poses (T, 27) [m, rad].

    Raises:
        CaptureError: No such file, of another kind or schema, or damaged.
    """
    check_type("path", path, (str, Path), "the path of a take")
    return read_archive(path, KIND, (SCHEMA,), _unpack)


_TYPES: Final = {"points": "f8", "ids": "i4", "labels": "i2", "qpos": "f8", "T_world_body": "f8"}


def _unpack(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Take:
    check_types(arrays, {**_TYPES, "hands": HAND_DTYPE})
    if not (np.isfinite(arrays["qpos"]).all() and np.isfinite(arrays["T_world_body"]).all()):
        raise ValueError("poses are not finite")
    stored = zip(header["layouts"], arrays["hands"], arrays["qpos"], strict=True)
    hands = tuple(
        GlovedHand(attach(stored_layout(layout), HandModel(unpack_hand(record))), qpos)
        for layout, record, qpos in stored
    )
    body = header["body"] and HeldBody(
        header["body"]["name"], names_of(header["body"]["marker_names"]), arrays["T_world_body"]
    )
    take = Take(
        rate=float(header["rate"]),
        points=arrays["points"],
        ids=arrays["ids"],
        labels=arrays["labels"],
        hands=hands,
        body=body,
        settings=settings_of(header),
    )
    return take


def _check(take: Take) -> None:
    """Whether the parts of a take fit together; a `ValueError` says what does not."""
    if take.points.ndim != 3:
        raise ValueError(f"points have shape {take.points.shape}, expected (T, N, 3)")
    frames, columns = take.points.shape[:2]
    shapes = [
        (take.points, (frames, columns, 3)),
        (take.ids, (frames, columns)),
        (take.labels, take.ids.shape),
    ]
    shapes += [(hand.qpos, (frames, NUM_QPOS)) for hand in take.hands]
    shapes += [] if take.body is None else [(take.body.T_world_body, (frames, 4, 4))]
    check_shapes(shapes)
    known = sum(hand.fit.layout.num_markers for hand in take.hands)
    known += 0 if take.body is None else len(take.body.marker_names)
    if not 0.0 < take.rate < np.inf or (take.labels < -1).any() or (take.labels >= known).any():
        raise ValueError("the rate is not positive, or a label names no marker")
