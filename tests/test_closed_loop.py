"""The whole chain at its ends: simulate, write, track, draw; what is drawn lies where the truth is."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.paper.take_evaluation import true_users
from gloves import load_take, read_capture
from handsim import HandModel
from handsim.cli.simulate import simulate
from handsim.hand.model import hand_keypoints
from render import RenderConfig, ViewConfig, draw
from track import track_capture
from train import SimulateSettings

MOST_MILLIMETERS = 1.0
MOST_PIXELS = 2.0
FRAMES = 120


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loop")
    simulate(folder / "take.c3d", SimulateSettings(kind="hand-hand", num_frames=FRAMES))
    return load_take(folder / "take.truth.npz"), folder


@pytest.fixture(scope="module")
def tracked(truth):
    """Tracked from the file of points alone."""
    take, folder = truth
    capture = read_capture(folder / "take.c3d")
    result = track_capture(capture, hands=true_users(take), labeler="dense19")
    result.save(folder / "tracked.npz")
    return load_take(folder / "tracked.npz"), folder


def test_hands_are_tracked_to_a_millimeter(truth, tracked):
    take, _ = truth
    result, _ = tracked
    for hand in take.moving_hands():
        place = result.hand_index(hand.shape.side)
        there = np.isfinite(result.qpos[:, place, 0])
        assert there.mean() >= 0.98
        model = HandModel(hand.shape)
        joints = [
            model.forward_kinematics(qpos[there])[..., :3, 3] for qpos in (result.qpos[:, place], hand.qpos)
        ]
        off = 1e3 * np.linalg.norm(joints[0] - joints[1], axis=-1)
        assert off.mean() <= MOST_MILLIMETERS


def test_pictures_of_tracked_hands_have_their_keypoints_where_the_truth_is(truth, tracked):
    take, folder = truth
    config = RenderConfig(view=ViewConfig(distance=(0.5, 0.5)), passes=("rgb", "depth", "ids"))
    off = []
    for frame in draw(folder / "tracked.npz", config=config, frames=range(10, FRAMES, 20)):
        assert frame.camera.size == (640, 480) and len(frame.hands) == 2
        for hand in frame.hands:
            true = next(one for one in take.moving_hands() if one.shape.side == hand.shape.side)
            points = hand_keypoints(HandModel(true.shape), true.qpos[frame.number : frame.number + 1])[0]
            off.append(np.linalg.norm(frame.camera.project(points) - hand.keypoints, axis=-1))
    assert np.mean(off) <= MOST_PIXELS
