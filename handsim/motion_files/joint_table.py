"""Tables of joints, .csv and .parquet: a row per frame and hand, a column per number, its unit in its name.

Where a hand has no pose, its row is there and its numbers are missing: empty in a .csv, null in .parquet.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float

from handsim.errors import HandSimError
from handsim.files.atomic import atomic_write
from handsim.hand.keypoints import KEYPOINT_NAMES, hand_keypoints
from handsim.hand.topology import JOINT_NAMES
from handsim.motion_files.motion import Motion, PosedHand, posed_hands
from handsim.space.transforms import UpAxis

NUMBERS: Final[tuple[str, ...]] = (
    *(f"wrist_{axis}_m" for axis in "xyz"),
    *(f"wrist_q{part}" for part in "wxyz"),
    *(f"{joint}_rad" for joint in JOINT_NAMES),
    *(f"{keypoint}_{axis}_m" for keypoint in KEYPOINT_NAMES[1:] for axis in "xyz"),
)
"""Columns after `frame`, `time_s` and `hand`: the world's positions and the wrist's quaternion, angles."""


def write_joint_csv(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write the table as text, UTF-8, with nine digits.

    Args:
        path: A .csv file.
        motion: What to write.
        up: Of no effect: the axes are the take's.

    Raises:
        OSError: The file cannot be written.
    """
    hands = tuple(posed_hands(motion))
    tables = [_numbers(hand) for hand in hands]
    row_format = ",%.9g" * len(NUMBERS)
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(["frame", "time_s", "hand", *NUMBERS]) + "\n")
        for frame, time in enumerate(motion.times.tolist()):
            for hand, table in zip(hands, tables, strict=True):
                row = table[frame]
                text = row_format % tuple(row.tolist()) if hand.present[frame] else "," * len(NUMBERS)
                file.write(f"{frame},{time:.9g},{hand.side}{text}\n")


def write_joint_parquet(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write the table as Apache Parquet.

    Args:
        path: A .parquet file.
        motion: What to write.
        up: Of no effect: the axes are the take's.

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
    with atomic_write(path) as temporary:
        parquet.write_table(pyarrow.table(columns), temporary)


def _numbers(hand: PosedHand) -> Float[np.ndarray, "T K"]:
    """The columns `NUMBERS`; NaN in frames without a pose."""
    qpos = hand.qpos
    keypoints = hand_keypoints(hand.model, qpos)[:, 1:].reshape(len(qpos), -1)
    numbers = np.concatenate([qpos, keypoints], axis=1)
    numbers[~hand.present] = np.nan
    return numbers
