"""OpenSim's motion file, .mot: joint angles in degrees, a column per coordinate and side.

The columns are `right_wrist_tx` to `tz` [m], `right_wrist_rx` to `rz` (body-fixed rotations about x, y and z,
as in OpenSim's own free joint), then `right_` and the name of each joint. Axes are the take's; numbers of
frames without a pose are NaN.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.files.atomic import atomic_write
from handsim.hand.osim import coordinate_names
from handsim.motion_files.motion import Motion, PosedHand, posed_hands, seconds_of
from handsim.space.transforms import UpAxis, body_fixed_angles, quaternion_matrix


def write_mot(path: Path, motion: Motion, up: UpAxis = "z") -> None:
    """Write the angles of all hands.

    Args:
        path: A .mot file.
        motion: What to write.
        up: Of no effect: the axes are the take's.

    Raises:
        OSError: The file cannot be written.
    """
    hands = tuple(posed_hands(motion))
    table = np.concatenate([seconds_of(motion)[:, None], *(_coordinates(hand) for hand in hands)], axis=1)
    names = ["time", *(name for hand in hands for name in coordinate_names(hand.side))]
    header = [
        path.stem,
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
