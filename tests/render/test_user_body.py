"""The person behind a take's hands: wrists that bend as far as wrists do, arms that enter from below."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gloves import Take
from handsim.space.rig import load_rig
from render import draw
from render.arms import most_hidden
from render.frames import FOREARM, PARTS_A_HAND
from render.skin.look import ELBOW
from render.user_body import UPPER_ARM, UserBody
from render.viewpoints import Framing
from train import simulate_take


@pytest.fixture(scope="module", params=["single-hand", "hand-hand", "hand-pen", "hand-controller"])
def take(request) -> Take:
    return simulate_take(kind=request.param, num_frames=120, seed=3)


def rotations(qpos: np.ndarray) -> Rotation:
    return Rotation.from_quat(qpos[:, [4, 5, 6, 3]])


def test_wrists_bend_no_farther_than_wrists_do(take):
    forearms = UserBody(take).forearms
    np.testing.assert_allclose(np.linalg.norm(forearms, axis=-1), 1.0)
    for number, hand in enumerate(take.hands):
        x, y, z = rotations(take.qpos[:, number]).inv().apply(forearms[:, number]).T
        flexion = np.rad2deg(np.arctan2(-z, -x))
        radial = np.rad2deg(np.arcsin(y if hand.side == "right" else -y))
        assert flexion.min() >= -60.1 and flexion.max() <= 54.1
        assert radial.min() >= -40.1 and radial.max() <= 17.1


def test_upper_arms_are_about_as_long_as_those_of_people(take):
    user = UserBody(take)
    lengths = np.array([hand.shape.length for hand in take.hands])
    elbows = take.qpos[..., :3] + ELBOW * lengths[:, None] * user.forearms
    stretch = np.linalg.norm(user.shoulders - elbows, axis=-1) / (UPPER_ARM * lengths)
    assert np.exp(np.abs(np.log(stretch)).mean()) < 1.25


def test_elbows_do_not_jump(take):
    forearms = UserBody(take).forearms
    steps = np.rad2deg(np.arccos(np.clip((forearms[1:] * forearms[:-1]).sum(axis=-1), -1.0, 1.0)))
    assert steps.max() < 10.0


def test_the_person_turns_and_moves_with_the_hands(take):
    turn, shift = Rotation.from_euler("z", 120.0, degrees=True), np.array([0.3, -1.0, 0.2])
    moved = take.qpos.copy()
    for number in range(len(take.hands)):
        moved[:, number, :3] = turn.apply(moved[:, number, :3]) + shift
        moved[:, number, 3:7] = (turn * rotations(moved[:, number])).as_quat()[:, [3, 0, 1, 2]]
    here, there = UserBody(take), UserBody(Take.of_poses(take.hands, moved, rate=take.rate))
    np.testing.assert_allclose(there.eyes, turn.apply(here.eyes) + shift, atol=1e-9)
    np.testing.assert_allclose(there.shoulders, turn.apply(here.shoulders) + shift, atol=1e-9)


def test_trunks_and_heads_are_no_obstacle_between_hands_and_the_cameras_of_a_rig(take):
    cameras, points = load_rig("six").T_world_camera[:, :3, 3], Framing(take).points.astype(float)
    user = UserBody(take, cameras)
    trunk = np.tile(user.trunk, (len(points), 1, 1, 1))
    nothing = np.zeros(points.shape[:3])
    free = [most_hidden(trunk, np.tile(eye, (len(points), 1)), points, nothing) < 0.5 for eye in cameras]
    assert np.mean(free) >= 0.95


def test_a_camera_behind_or_in_the_person_sees_no_hand_and_one_before_the_person_does(take):
    user = UserBody(take)
    framing = Framing(take, user)
    middle = framing.middle()
    back = (user.eyes - middle) * (1.0, 1.0, 0.0)

    def free(eye: np.ndarray) -> float:
        return framing.clear_share(np.tile(eye, (len(framing.sampled), 1)))

    assert free(middle + 2.0 * back) == free(middle + back) == 0.0
    aside = 0.7 * np.cross(back, (0.0, 0.0, 1.0))  # from ahead one hand may be behind the other
    assert (
        max(free(middle - 1.5 * back + way + (0.0, 0.0, 0.3)) for way in (-aside, 0.0 * aside, aside)) > 0.5
    )


def test_a_hand_that_is_not_there_has_no_arm():
    take = simulate_take(kind="hand-hand", num_frames=60, seed=1)
    take.qpos[:20, 0] = np.nan
    take.qpos[10:30, 1] = np.nan
    forearms = UserBody(take).forearms
    np.testing.assert_array_equal(np.isnan(forearms[..., 0]), np.isnan(take.qpos[..., 0]))


def test_the_users_eyes_see_whole_hands_and_arms_from_below():
    whole, low, shares = [], [], []
    for kind in ("single-hand", "hand-hand", "hand-pen", "hand-controller"):
        take = simulate_take(kind=kind, num_frames=240, seed=1)
        for frame in draw(take, view={"placement": "head"}, passes=("ids",), num_frames=6):
            parts = frame.ideal.parts
            height, width = parts.shape
            border = np.ones_like(parts, dtype=bool)
            border[1:-1, 1:-1] = False
            for number, hand in enumerate(frame.hands):
                whole.append(((hand.keypoints >= 0.0) & (hand.keypoints < (width, height))).all())
                arm = parts == 1 + PARTS_A_HAND * number + FOREARM
                shares.append(arm.mean())
                if (arm & border).any():
                    low.append(np.nonzero(arm & border)[0].mean() > 0.5 * height)
    assert np.mean(whole) >= 0.95 and np.mean(low) >= 0.85 and np.mean(np.array(shares) > 0.25) <= 0.05
