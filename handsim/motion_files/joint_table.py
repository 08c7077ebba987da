"""Tables of joints, .csv and .parquet: a row per frame and hand, a column per number, its unit in its name.

Where a hand has no pose, its row is there and its numbers are missing: empty in a .csv, null in .parquet.
OpenSim's .mot has a row per frame, angles in degrees and NaN without a pose.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Final, NamedTuple, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.errors import CaptureError, HandSimError, choices
from handsim.files.atomic import atomic_write
from handsim.files.inputs import read_bytes
from handsim.files.names import as_text
from handsim.hand.keypoints import KEYPOINT_NAMES, hand_keypoints
from handsim.hand.osim import coordinate_names
from handsim.hand.topology import JOINT_NAMES, SIDES, Side
from handsim.motion_files.motion import Motion, PosedHand, posed_hands, seconds_of
from handsim.space.transforms import UpAxis, body_fixed_angles, quaternion_matrix

_FIRST: Final = ("frame", "time_s", "hand")
_QPOS: Final = (
    *(f"wrist_{axis}_m" for axis in "xyz"),
    *(f"wrist_q{part}" for part in "wxyz"),
    *(f"{joint}_rad" for joint in JOINT_NAMES),
)
NUMBERS: Final[tuple[str, ...]] = (
    *_QPOS,
    *(f"{keypoint}_{axis}_m" for keypoint in KEYPOINT_NAMES[1:] for axis in "xyz"),
)
"""Columns after `frame`, `time_s` and `hand`: the world's positions and the wrist's quaternion, angles."""


class JointTable(NamedTuple):
    """The poses of a table."""

    sides: tuple[Side, ...]
    """Whose they are, in the order in which the table names the hands first."""
    times: Float[np.ndarray, "T"]
    """Time of each frame [s]."""
    qpos: Float[np.ndarray, "T H 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]; NaN without a pose."""


def read_joint_csv(path: Path) -> JointTable:
    """The poses in a .csv of `write_joint_csv`, or in another with its columns of frame, time, hand and qpos.

    Further columns, such as the positions of joints, are passed over; columns may come in any order.
    """
    text = read_bytes(path, error=CaptureError).decode("utf-8-sig", "replace")
    lines = csv.reader(text.splitlines())
    try:
        titles = [title.strip() for title in next(lines, [])]
        wanted = [*_FIRST, *_QPOS]
        missing = [name for name in wanted if name not in titles]
        if missing:
            raise CaptureError(
                f"{path}: no column '{missing[0]}'; of a .csv are read {', '.join(_FIRST)}, {_QPOS[0]} to "
                f"{_QPOS[6]} and the joint angles {_QPOS[7]} to {_QPOS[-1]}, as handsim export writes them"
            )
        columns = [titles.index(name) for name in wanted]
        rows = [(lines.line_num, [row[column].strip() for column in columns]) for row in lines if any(row)]
    except (csv.Error, IndexError) as error:
        raise CaptureError(f"{path}: line {lines.line_num} cannot be read: {error}") from error
    if not rows:
        raise CaptureError(f"{path}: no frames: nothing follows the line of titles")
    return _table(path, rows)


def _table(path: Path, rows: list[tuple[int, list[str]]]) -> JointTable:
    """Rows of the columns `_FIRST` and `_QPOS` with the numbers of their lines, by frame and hand."""
    frames: dict[str, int] = {}
    sides: dict[str, int] = {}
    for number, (frame, _, side, *_) in rows:
        if side not in SIDES:
            raise CaptureError(f"{path}: line {number}: {choices(side, SIDES, noun='hand')}")
        frames.setdefault(frame, len(frames))
        sides.setdefault(side, len(sides))
    times = np.full(len(frames), np.nan)
    qpos = np.full((len(frames), len(sides), len(_QPOS)), np.nan)
    filled = np.zeros(qpos.shape[:2], dtype=np.bool_)
    for number, (frame, time, side, *cells) in rows:
        place = frames[frame], sides[side]
        if filled[place]:
            raise CaptureError(f"{path}: line {number} has frame {frame} of the {side} hand again")
        filled[place] = True
        try:
            times[place[0]] = float(time)
            qpos[place] = [float(cell) if cell else np.nan for cell in cells]
        except ValueError as error:
            raise CaptureError(f"{path}: line {number}: {error}") from error
    return JointTable(cast("tuple[Side, ...]", tuple(sides)), times, qpos)


def write_joint_csv(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write the table as text, UTF-8, with nine digits, in the take's axes whatever `up` is.

    Raises:
        OSError: The file cannot be written.
    """
    hands = tuple(posed_hands(motion))
    tables = [_numbers(hand) for hand in hands]
    row_format = ",%.9g" * len(NUMBERS)
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join([*_FIRST, *NUMBERS]) + "\n")
        for frame, time in enumerate(motion.times.tolist()):
            for hand, table in zip(hands, tables, strict=True):
                row = table[frame]
                text = row_format % tuple(row.tolist()) if hand.present[frame] else "," * len(NUMBERS)
                file.write(f"{frame},{time:.9g},{hand.side}{text}\n")


def write_joint_parquet(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write the table as Apache Parquet, in the take's axes whatever `up` is.

    Raises:
        OSError: The file cannot be written.
        HandSimError: pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise HandSimError(".parquet needs pyarrow; run `pip install 'handsim[parquet]'`") from error
    hands = tuple(posed_hands(motion))
    count = len(hands)
    numbers = np.stack([_numbers(hand) for hand in hands], axis=1).reshape(-1, len(NUMBERS))
    columns = {
        "frame": pyarrow.array(np.repeat(np.arange(len(motion.times)), count)),
        "time_s": pyarrow.array(np.repeat(motion.times, count)),
        "hand": pyarrow.array([hand.side for hand in hands] * len(motion.times)),
        **{
            name: pyarrow.array(np.ascontiguousarray(column), from_pandas=True)  # NaN becomes null
            for name, column in zip(NUMBERS, numbers.T, strict=True)
        },
    }
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        parquet.write_table(pyarrow.table(columns), file)


def _numbers(hand: PosedHand) -> Float[np.ndarray, "T K"]:
    """The columns `NUMBERS`; NaN in frames without a pose."""
    qpos = hand.qpos
    keypoints = hand_keypoints(hand.model, qpos)[:, 1:].reshape(len(qpos), -1)
    numbers = np.concatenate([qpos, keypoints], axis=1)
    numbers[~hand.present] = np.nan
    return numbers


def write_mot(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write the angles of all hands, in the take's axes whatever `up` is.

    Raises:
        OSError: The file cannot be written.
    """
    hands = tuple(posed_hands(motion))
    table = np.concatenate([seconds_of(motion)[:, None], *(_coordinates(hand) for hand in hands)], axis=1)
    names = ["time", *(name for hand in hands for name in coordinate_names(hand.side))]
    header = [
        as_text(path.stem),
        "version=1",
        f"nRows={len(table)}",
        f"nColumns={table.shape[1]}",
        "inDegrees=yes",
        "endheader",
        "\t".join(names),
    ]
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(header) + "\n")
        np.savetxt(file, table, fmt="%.9f", delimiter="\t")


def _coordinates(hand: PosedHand) -> Float[np.ndarray, "T 26"]:
    """Position of the wrist [m], its rotations and the joint angles [deg]; NaN without a pose."""
    qpos = hand.qpos
    turns = np.unwrap(body_fixed_angles(quaternion_matrix(qpos[:, 3:7])), axis=0)
    angles = np.rad2deg(np.concatenate([turns, qpos[:, 7:]], axis=1))
    coordinates: NDArray[np.float64] = np.concatenate([qpos[:, :3], angles], axis=1)
    coordinates[~hand.present] = np.nan
    return coordinates
