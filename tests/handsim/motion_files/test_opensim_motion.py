from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from handsim.hand.topology import JOINT_NAMES
from handsim.motion_files.motion import seconds_of
from handsim.motion_files.opensim_motion import write_mot


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
