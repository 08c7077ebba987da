"""What docs/how_to/robots.md is tried with: a robot's hand, and the axes that dex-retargeting defines."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

RANGES = {"0": "-0.47 0.47", "1": "-0.19 1.61", "2": "-0.17 1.7", "3": "-0.22 1.61"}
THUMB = {"0": "0.26 1.39", "1": "-0.1 1.16", "2": "-0.18 1.64", "3": "-0.16 1.71"}
BONE = '<body pos="{at} 0 0"><joint name="{name}" axis="{axis}" range="{range}"/>{flesh}'
FLESH = '<geom fromto="0 0 0 {} 0 0" size=".009" type="capsule"/>'
PLACES = ("0 0 0", "0 -.03 0", "0 -.06 0", "-.06 .03 0")  # of index, middle, ring finger and thumb
DEFAULTS = '<joint damping=".3"/><position kp="10"/><geom contype="0" conaffinity="0"/>'


def allegro() -> mujoco.MjModel:
    """A hand with the names and ranges of Allegro's in mujoco_menagerie; its thumb is placed otherwise."""
    fingers = [_finger(name, RANGES) for name in ("ffj", "mfj", "rfj")] + [_finger("thj", THUMB)]
    beside = "".join(f'<body pos="{at}">{one}</body>' for at, one in zip(PLACES, fingers, strict=True))
    joints = [f"{name}j{n}" for name in ("ff", "mf", "rf", "th") for n in range(4)]
    motors = "".join(f'<position name="{one.replace("j", "a")}" joint="{one}"/>' for one in joints)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><default>{DEFAULTS}</default>'
        f"<worldbody>{beside}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def _finger(name: str, ranges: dict[str, str]) -> str:
    bones = []
    for n, span in ranges.items():  # the first joint turns the finger aside, at its root
        axis, flesh = ("0 1 0", FLESH.format(0.04)) if n > "0" else ("0 0 1", FLESH.format(0.002))
        bones.append(BONE.format(at=0.04 * (n > "1"), name=name + n, axis=axis, range=span, flesh=flesh))
    return "".join(bones) + "</body>" * len(bones)


def turn_to_dex_retargeting(keypoints: np.ndarray) -> float:
    """Angle [rad] between the axes of keypoints (21, 3) and those that dex-retargeting's detector finds.

    It takes them from the wrist and the knuckles of index and middle finger, of a right hand.
    """
    back = keypoints[0] - keypoints[9]
    normal = np.linalg.svd(keypoints[[0, 5, 9]] - keypoints[[0, 5, 9]].mean(axis=0))[2][2]
    back -= normal * (back @ normal)
    back /= np.linalg.norm(back)
    side = np.cross(back, normal)
    if side @ (keypoints[5] - keypoints[9]) < 0:
        side, normal = -side, -normal
    to_mano = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])  # OPERATOR2MANO_RIGHT
    return float(Rotation.from_matrix(np.stack([back, normal, side], axis=1) @ to_mano).magnitude())


def check_angles(page: dict[str, Any]) -> None:
    """Check that the page's angles of the robot are in its ranges, one for each joint."""
    model, robot = page["model"], page["robot"]
    low, high = model.jnt_range.T
    assert np.isfinite(robot).all() and (robot >= low).all() and (robot <= high).all()
    middle = page["angles"]["middle_MCP_flexion"][page["there"]]
    assert np.allclose(robot[:, model.joint("mfj1").qposadr[0]], middle)
    assert set(page["FOLLOWS"]) == {model.joint(n).name for n in range(model.njnt)}


def check_targets(page: dict[str, Any]) -> None:
    """Check that live hands give the targets that the take gives, and lost hands none."""
    model, angles, targets = page["model"], page["angles"], page["targets"]
    assert set(page["MOTORS"]) == set(page["FOLLOWS"])
    assert model.actuator(page["MOTORS"]["mfj1"]).name == "mfa1"
    header = {"angles": list(angles)}
    sent = targets(header, {"angles": [float(angles[name][page["there"]][5]) for name in angles]})
    for joint in page["FOLLOWS"]:
        assert abs(sent[joint] - page["robot"][5, model.joint(joint).qposadr[0]]) < 1e-9
    assert targets(header, {"angles": None}) is None


def check_rows(page: dict[str, Any]) -> None:
    """Check that there is a row for each moment at a steady rate, of the stated shapes and types."""
    rows, times = page["rows"], page["steady"].times
    assert len(rows) == len(times) and np.allclose(np.diff(times), 1 / page["FPS"])
    for key, feature in page["features"].items():
        assert all(row[key].shape == feature["shape"] and row[key].dtype == feature["dtype"] for row in rows)
