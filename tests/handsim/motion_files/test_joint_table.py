from __future__ import annotations

import csv

import numpy as np
import pytest

from handsim.hand.keypoints import KEYPOINT_NAMES, hand_keypoints
from handsim.hand.topology import JOINT_NAMES
from handsim.motion_files.joint_table import write_joint_csv, write_joint_parquet
from handsim.motion_files.motion import posed_hands


def rows_of(path):
    if path.suffix == ".csv":
        write = write_joint_csv
    else:
        pytest.importorskip("pyarrow", reason="pyarrow is not installed")
        write = write_joint_parquet

    def read(motion):
        write(path, motion)
        if path.suffix == ".csv":
            with path.open(newline="") as file:
                return list(csv.DictReader(file))
        from pyarrow import parquet

        return parquet.read_table(path).to_pylist()

    return read


@pytest.mark.parametrize("name", ["joints.csv", "joints.parquet"])
def test_a_row_per_frame_and_hand_holds_the_pose(motion, tmp_path, name):
    rows = rows_of(tmp_path / name)(motion)
    assert len(rows) == 2 * motion.num_frames
    for number, row in enumerate(rows):
        frame, hand = number // 2, list(posed_hands(motion))[number % 2]
        assert (int(row["frame"]), row["hand"]) == (frame, hand.side)
        assert float(row["time_s"]) == pytest.approx(motion.times[frame], abs=1e-6)
        if not hand.present[frame]:
            assert {row[key] for key in row if key not in ("frame", "time_s", "hand")} <= {"", None}
            continue
        angles = [float(row[f"{joint}_rad"]) for joint in JOINT_NAMES]
        wrist = [float(row[f"wrist_{part}"]) for part in ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")]
        np.testing.assert_allclose([*wrist, *angles], hand.qpos[frame], rtol=1e-8, atol=1e-9)
        found = [[float(row[f"{keypoint}_{axis}_m"]) for axis in "xyz"] for keypoint in KEYPOINT_NAMES]
        expected = hand_keypoints(hand.model, hand.qpos[frame : frame + 1])[0]
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-9)
