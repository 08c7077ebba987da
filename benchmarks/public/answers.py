"""Labels, joints and joint angles of one capture: what the truth holds, and what participants give.

One form for both, an `.npz` of plain arrays, so that a copy of the truth is a perfect result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from gloves import GloveFit
from gloves.takes.take import keypoints_of
from handsim.errors import FileError
from handsim.files.arrays import read_npz
from handsim.files.outputs import atomic_write
from handsim.hand.shape import NUM_JOINTS, NUM_KEYPOINTS, Side

SIDES: Final[tuple[Side, ...]] = ("right", "left")
"""The hands of every capture, in the order of labels and arrays."""
_LARGEST_PLACE: Final = 100.0  # [m] from the origin; millimeters are beyond it
_LARGEST_ANGLE: Final = 2 * np.pi  # [rad]; degrees are beyond it


class BenchmarkError(FileError):
    """A benchmark or results that cannot be read, used or written."""


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """What is said of a capture's T frames: two hands, N columns of points.

    Raises:
        BenchmarkError: An array has another shape or type than stated, or numbers in other units.
    """

    labels: Int[np.ndarray, "T N"]
    """Label of each point, -1 for a point of no marker and where there is no point."""
    joints: Float[np.ndarray, "T 2 21 3"] | None = None
    """Keypoints of the right hand and the left one in the world [m], in the order of
    `handsim.hand.model.KEYPOINT_NAMES`; NaN where one is not known."""
    angles: Float[np.ndarray, "T 2 20"] | None = None
    """Their joint angles as docs/conventions.md defines them [rad]; NaN where one is not known."""

    def __post_init__(self) -> None:
        if self.labels.dtype.kind not in "iu" or self.labels.ndim != 2:
            found = f"{self.labels.dtype} of shape {self.labels.shape}"
            raise BenchmarkError(f"labels are {found}, expected whole numbers (frames, columns)")
        frames = len(self.labels)
        shapes = {"joints": (frames, 2, NUM_KEYPOINTS, 3), "angles": (frames, 2, NUM_JOINTS)}
        units = {"joints": (_LARGEST_PLACE, "meters"), "angles": (_LARGEST_ANGLE, "radians")}
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array is None:
                continue
            if array.dtype.kind != "f" or array.shape != shape:
                raise BenchmarkError(
                    f"{name} are {array.dtype} of shape {array.shape}, expected floats of shape {shape}"
                )
            largest, unit = units[name]
            there = array[~np.isnan(array)]
            if there.size and not np.abs(there).max() <= largest:
                raise BenchmarkError(f"{name} reach {np.abs(there).max():g}, expected {unit}")


def check_labels(
    labels: Int[np.ndarray, "T N"], present: Bool[np.ndarray, "T N"], names: tuple[str, ...]
) -> None:
    """Refuse labels that name no marker, of points that are not there (`present`), or given twice in a frame.

    Raises:
        BenchmarkError: The first frame in which a label is wrong, counted from 1, and how.
    """
    if labels.shape != present.shape:
        raise BenchmarkError(
            f"labels are of {labels.shape[0]} frames of {labels.shape[1]} columns, expected the capture's "
            f"{present.shape[0]} frames of {present.shape[1]} columns"
        )
    if labels.size and not (labels.min() >= -1 and labels.max() < len(names)):
        raise BenchmarkError(
            f"labels go from {labels.min()} to {labels.max()}, expected -1 for none to {len(names) - 1}"
        )
    given = labels >= 0
    if (given & ~present).any():
        frame, column = np.argwhere(given & ~present)[0]
        raise BenchmarkError(
            f"frame {frame + 1} labels column {column + 1}, which has no point there, expected -1"
        )
    frames, columns = np.nonzero(given)
    counts = np.zeros((len(labels), len(names)), dtype=np.int64)
    np.add.at(counts, (frames, labels[frames, columns]), 1)
    if (counts > 1).any():
        frame, label = np.argwhere(counts > 1)[0]
        raise BenchmarkError(f"frame {frame + 1} has {names[label]} twice, expected each label once at most")


def poses_of(
    hands: Sequence[GloveFit], qpos: Float[np.ndarray, "T H 27"]
) -> tuple[Float[np.ndarray, "T 2 21 3"], Float[np.ndarray, "T 2 20"]]:
    """Joints [m] and joint angles [rad] of poses, the right hand first; NaN for a hand that is not there."""
    keypoints, frames = keypoints_of(hands, qpos), len(qpos)
    joints = np.full((frames, 2, NUM_KEYPOINTS, 3), np.nan)
    angles = np.full((frames, 2, NUM_JOINTS), np.nan)
    for number, hand in enumerate(hands):
        joints[:, SIDES.index(hand.side)] = keypoints[:, number]
        angles[:, SIDES.index(hand.side)] = qpos[:, number, -NUM_JOINTS:]
    return joints, angles


def save_answers(path: Path, answers: Answers) -> None:
    """Write an `.npz`, whole or not at all; labels take a byte, other numbers float32.

    Not compressed, because the bytes of compressed files depend on the library that compresses.

    Raises:
        OSError: The file cannot be written.
    """
    arrays: dict[str, Shaped[np.ndarray, "..."]] = {"labels": answers.labels.astype(np.int8)}
    for name in ("joints", "angles"):
        if getattr(answers, name) is not None:
            arrays[name] = getattr(answers, name).astype(np.float32)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_arrays(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """All arrays of an `.npz`; nothing is unpickled.

    Raises:
        BenchmarkError: It cannot be read.
    """
    try:
        return read_npz(path)
    except OSError as error:
        raise BenchmarkError(f"cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise BenchmarkError("not an .npz of plain arrays, or a damaged one") from error


def unpack_answers(arrays: dict[str, np.ndarray[Any, Any]]) -> Answers:
    """Answers from arrays by name.

    Raises:
        BenchmarkError: There are no labels, or the arrays are not as stated in `Answers`.
    """
    if "labels" not in arrays:
        raise BenchmarkError(
            f"the arrays are {', '.join(sorted(arrays)) or 'none'}, expected labels, and joints and angles "
            "if they are known"
        )
    return Answers(arrays["labels"], arrays.get("joints"), arrays.get("angles"))
