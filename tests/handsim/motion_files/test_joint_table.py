from __future__ import annotations

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handsim.errors import CaptureError
from handsim.hand.model import KEYPOINT_NAMES, hand_keypoints
from handsim.hand.shape import JOINT_NAMES
from handsim.motion_files.joint_files import read_joint_csv, write_joint_csv, write_joint_parquet, write_mot
from handsim.motion_files.motion import posed_hands, seconds_of


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


def test_what_was_written_is_read(motion, tmp_path):
    path = tmp_path / "poses.csv"
    write_joint_csv(path, motion)
    table = read_joint_csv(path)
    assert table.sides == ("right", "left")
    np.testing.assert_allclose(table.times, motion.times, atol=1e-6)
    np.testing.assert_allclose(table.qpos, motion.qpos, rtol=1e-8, atol=1e-9)  # NaN where ours are


def test_columns_may_come_in_any_order_and_be_more_or_fewer(motion, tmp_path):
    write_joint_csv(tmp_path / "poses.csv", motion)
    with (tmp_path / "poses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = [name for name in reversed(rows[0]) if not name.startswith(("thumb_tip", "index_MCP_x"))]
    with (tmp_path / "other.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [*names, "note"], extrasaction="ignore", restval="ours, or not")
        writer.writeheader()
        writer.writerows(row for row in rows if row["hand"] == "left")
    table = read_joint_csv(tmp_path / "other.csv")
    assert table.sides == ("left",)
    np.testing.assert_allclose(table.qpos[:, 0], motion.qpos[:, 1], rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("wrist_qw", "wrist_w", "no column 'wrist_qw'; of a .csv are read frame, time_s, hand, wrist_x_m to"),
        ("0,100,right", "0,100,both", "line 2: unknown hand 'both'; valid names: left, right"),
        ("0,100,left", "0,100,right", "line 3 has frame 0 of the right hand again"),
        ("0,100,right,", "0,100,right,1 m", "line 2: could not convert string to float: '1 m"),
    ],
)
def test_what_cannot_be_read_is_told(motion, tmp_path, old, new, words):
    path = tmp_path / "poses.csv"
    write_joint_csv(path, motion)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(CaptureError) as caught:
        read_joint_csv(path)
    assert words in str(caught.value)


def test_header_and_angles(motion, tmp_path):
    path = tmp_path / "hands.mot"
    write_mot(path, motion)
    lines = path.read_text().splitlines()
    end = lines.index("endheader")
    stated = dict(line.split("=") for line in lines[1:end])
    names = lines[end + 1].split("\t")
    table = np.array([line.split("\t") for line in lines[end + 2 :]], dtype=float)
    assert lines[0] == "hands" and stated["version"] == "1" and stated["inDegrees"] == "yes"
    assert (int(stated["nRows"]), int(stated["nColumns"])) == table.shape == (len(table), len(names))
    columns = dict(zip(names, table.T, strict=True))
    np.testing.assert_allclose(columns["time"], seconds_of(motion), atol=1e-8)
    for number, hand in enumerate(motion.hands):
        qpos, present = motion.qpos[:, number], np.isfinite(motion.qpos[:, number, 0])
        angles = np.stack([columns[f"{hand.side}_{joint}"] for joint in JOINT_NAMES], axis=1)
        np.testing.assert_allclose(np.deg2rad(angles), qpos[:, 7:], atol=1e-9)  # NaN where ours are
        place = np.stack([columns[f"{hand.side}_wrist_t{axis}"] for axis in "xyz"], axis=1)
        np.testing.assert_allclose(place, qpos[:, :3], atol=1e-8)
        turns = np.stack([columns[f"{hand.side}_wrist_r{axis}"] for axis in "xyz"], axis=1)[present]
        expected = Rotation.from_quat(qpos[present, 3:7], scalar_first=True)
        error = Rotation.from_euler("XYZ", turns, degrees=True).inv() * expected
        assert error.magnitude().max() < 1e-8
