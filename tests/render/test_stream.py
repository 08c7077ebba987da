"""Pictures for training loops: their truth, their order and their people."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
import torch
from torch import distributed
from torch.utils.data import DataLoader

from handsim import HandModel, HandSimError, join_qpos
from render import PictureStream, RenderConfig, ShutterConfig, render_take
from train import simulate_take

BARE = RenderConfig(passes=("depth", "ids"), depth_sensor=None)


def fists(model, num_poses, *, rng):
    low, high = model.skeleton.ranges.T
    return low + (high - low) * rng.beta(4, 2, (num_poses, 20))


def taken(count, **options):
    return list(itertools.islice(PictureStream(**({"config": BARE} | options)), count))


@pytest.mark.parametrize("crop", [None, 96])
def test_the_truth_fits_the_pictures(crop):
    share = (0.4, 0.6)
    for number, one in enumerate(taken(8, sampler=fists, crop=crop, fill=share, people=4)):
        height, width = one["depth"].shape
        assert (height, width) == ((480, 640) if crop is None else (crop, crop)) and one["number"] == number
        keypoints = one["keypoints"].numpy()
        projected = one["keypoints_camera"].numpy() @ one["K"].numpy().T
        np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], keypoints, atol=0.01)
        assert ((keypoints > 0) & (keypoints < (width, height))).all(), "the hand is in the picture"
        assert share[0] - 0.1 < np.ptp(keypoints, axis=0).max() / min(width, height) < share[1] + 0.1
        seen = one["visible"].numpy()
        columns, rows = keypoints[seen].astype(int).T
        ahead = one["keypoints_camera"].numpy()[seen, 2] - one["depth"].numpy()[rows, columns]
        assert np.median(np.abs(ahead)) < 0.02 and (one["ids"].numpy()[rows, columns] == 1).mean() > 0.7


def test_batches_are_the_same_with_any_number_of_workers():
    def batches(workers):
        stream = PictureStream(config=BARE, crop=48, batch=3, people=4, sitting=5, seed=3)
        return list(itertools.islice(DataLoader(stream, batch_size=3, num_workers=workers), 9))

    alone = batches(0)
    assert [batch["number"].tolist() for batch in alone[:2]] == [[0, 1, 2], [3, 4, 5]]
    for one, other in zip(alone, batches(2), strict=True):
        assert one.keys() == other.keys()
        assert all(torch.equal(one[name].nan_to_num(), other[name].nan_to_num()) for name in one)


def draw_as(rank, file, results, workers, method):
    """What a rank of two draws, told by numbers."""
    distributed.init_process_group("gloo", init_method=f"file://{file}", rank=rank, world_size=2)
    stream = PictureStream(config=BARE, crop=32, batch=4, seed=0)
    loader = DataLoader(stream, batch_size=4, num_workers=workers, multiprocessing_context=method)
    numbers = [batch["number"].tolist() for batch in itertools.islice(loader, 4)]
    (results / str(rank)).write_text(json.dumps(numbers))
    distributed.destroy_process_group()


@pytest.mark.slow
@pytest.mark.parametrize(("workers", "method"), [(0, None), (2, "fork"), (2, "spawn")])
def test_ranks_of_torch_draw_different_pictures(workers, method, tmp_path):
    """The ranks know of each other by torch.distributed alone, and so do the workers of their loaders."""
    arguments = (tmp_path / "meeting", tmp_path, workers, method)
    torch.multiprocessing.spawn(draw_as, args=arguments, nprocs=2)
    drawn = [json.loads((tmp_path / str(rank)).read_text()) for rank in range(2)]
    for number in range(8):
        assert drawn[number % 2][number // 2] == list(range(4 * number, 4 * number + 4))


def test_people_take_turns():
    pictures = taken(40, crop=32, people=4, sitting=5)
    shapes = [tuple(one["shape"].tolist()) for one in pictures]
    assert len(set(shapes[:4])) == 4
    assert len(set(shapes)) >= 8, "each is replaced after five pictures"
    assert {int(one["side"]) for one in pictures} == {0, 1}
    assert len({tuple(one["qpos"].tolist()) for one in pictures}) == 40


def test_colors_and_sensors():
    config = RenderConfig(passes=("rgb", "depth", "normals"))
    one = taken(1, config=config, crop=64, side="left")[0]
    assert one["rgb"].shape == one["noisy_rgb"].shape == one["normals"].shape == (3, 64, 64)
    assert one["rgb"].dtype == torch.uint8 and (one["rgb"] != one["noisy_rgb"]).any()
    assert (one["depth"] > 0).all(), "there is a wall or a room behind the hand"
    bare = RenderConfig(passes=("rgb", "depth", "ids"), room_depth=False)
    hand = taken(1, config=bare, crop=64, side="left")[0]["depth"] > 0
    assert 0 < hand.sum() < hand.numel()
    assert (one["noisy_depth"][hand] > 0).float().mean() > 0.5, "hands are not too near for the sensor"
    assert one["side"] == 0


def test_own_poses_and_takes():
    qpos = np.stack([join_qpos(np.full((5, 20), 0.2))] * 2, axis=1)
    qpos[:, 1, 1] += 0.15
    one = taken(1, poses=qpos, crop=64)[0]
    assert one["keypoints"].shape == (2, 21, 2) and one["side"].tolist() == [1, 0]
    shape = HandModel.named("L", side="left").shape
    one = taken(1, poses=qpos[:, 0], model=shape, crop=64)[0]
    np.testing.assert_allclose(one["qpos"], qpos[0, 0], atol=1e-6)
    assert one["shape"][0] == np.float32(shape.length) and one["side"] == 0
    take = simulate_take(kind="hand-pen", num_frames=6)
    one = taken(1, takes=take, crop=64)[0]
    assert one["keypoints"].shape == (2, 21, 2) and one["ids"].max() == 3, "two hands and a pen"


def test_own_photographs_are_mixed_in(tmp_path):
    config = RenderConfig(passes=("rgb", "depth", "ids"))
    qpos = join_qpos(np.full((10, 20), 0.2))
    assert render_take(qpos, tmp_path, "coco", config, model="M", workers=1) == 10
    mixed = {"config": config, "photographs": tmp_path / "annotations.json", "photograph_share": 0.5}
    alone = taken(12, config=config, crop=64)
    pictures = taken(12, crop=64, **mixed)
    assert {bool(one["drawn"]) for one in pictures} == {True, False}
    for one, drawn in zip(pictures, alone, strict=True):
        assert one.keys() == pictures[0].keys() and one["rgb"].shape == (3, 64, 64)
        if one["drawn"]:
            assert torch.equal(one["rgb"], drawn["noisy_rgb"]), "the others are what they would be without"
            continue
        keypoints = one["keypoints"].numpy()
        assert 0.3 < np.nanmax(np.ptp(keypoints, axis=0)) / 64 < 0.8 and one["side"] == 1
        columns, rows = keypoints[one["visible"].numpy()].astype(int).T
        assert ((columns >= 0) & (columns < 64) & (rows >= 0) & (rows < 64)).all()
    batches = DataLoader(PictureStream(crop=64, batch=4, **mixed), batch_size=4, num_workers=2)
    numbers = [batch["number"].tolist() for batch in itertools.islice(batches, 3)]
    assert numbers == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]


def test_people_and_tones_are_told():
    pictures = taken(
        8, crop=32, people=4, sitting=100, config=RenderConfig(passes=("rgb",), color_sensor=None)
    )
    people = [int(one["person"]) for one in pictures]
    tones = [float(one["tone"]) for one in pictures]
    assert people[:4] == people[4:] and len(set(people)) == 4 and tones[:4] == tones[4:]
    assert all(-60.0 < tone < 70.0 for tone in tones)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sampler": fists, "poses": np.zeros((2, 20))}, "expected one of sampler, poses and takes"),
        ({"side": "both"}, "unknown side 'both'"),
        ({"people": 0}, "people is 0"),
        ({"camera": "headset_fisheye", "crop": 64}, "expected 16 pixels or more of a pinhole camera"),
        ({"people": 2.5}, "people is 2.5, expected a whole number"),
        ({"fill": 0.5}, "fill is 0.5, expected two numbers"),
        ({"poses": "no"}, "poses is 'no', expected an array"),
        ({"takes": 5}, "takes is 5, expected a Take"),
        ({"photograph_share": 2.0}, "photograph_share is 2, expected a number from 0 to 1"),
        ({"photographs": "none.json"}, "none.json"),
        ({"config": "fast"}, "config is 'fast', expected a RenderConfig"),
        ({"camera": 3}, "camera is 3, expected a Camera or the name of a preset"),
        ({"config": RenderConfig(shutter=ShutterConfig())}, "poses without times have no motion to blur"),
        ({"sampler": lambda model, num_poses, *, rng: np.zeros((num_poses, 21))}, r"shape \(2, 21\)"),
    ],
)
def test_mistakes_are_told(arguments, message):
    with pytest.raises(HandSimError, match=message):
        taken(1, **arguments)
