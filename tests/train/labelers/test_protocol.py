"""What every labeler promises, whatever its kind: odd clouds, bad clouds, order of frames."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from handsim.errors import ArgumentError
from train import CNNConfig, SetLabelerConfig
from train.labelers.networks import labeler_of, new_network
from train.labelers.protocol import Labeling, label_in_batches
from train.labelers.storage import OnnxLabeler, export_onnx

NAMES = tuple(f"marker{number}" for number in range(19))


CONFIGS = {"set": SetLabelerConfig(), "cnn": CNNConfig(), "cnn, random views": CNNConfig(views="random")}


@pytest.fixture(scope="module", params=[*CONFIGS, "set, onnx", "cnn, onnx"])
def labeler(request, tmp_path_factory):
    torch.manual_seed(0)
    network = new_network(CONFIGS[request.param.removesuffix(", onnx")])
    if "onnx" in request.param:
        path = tmp_path_factory.mktemp("onnx") / "labeler.onnx"
        export_onnx(network, NAMES, path)
        return OnnxLabeler(path)
    return labeler_of(network, NAMES)


def check(labeling, count):
    assert labeling.labels.shape == labeling.confidence.shape == (count,)
    assert (labeling.labels >= -1).all()
    assert (labeling.labels < len(NAMES)).all()
    named = labeling.labels[labeling.labels >= 0]
    assert len(set(named.tolist())) == len(named)
    assert (labeling.confidence >= 0).all()
    assert (labeling.confidence <= 1 + 1e-6).all()


@pytest.mark.parametrize("count", [0, 1, 2, 19, 500])
def test_clouds_of_any_size(labeler, count, rng):
    (labeling,) = labeler.label_frames([rng.normal(scale=0.05, size=(count, 3))])
    check(labeling, count)


def test_points_at_one_place(labeler, rng):
    cloud = rng.normal(scale=0.05, size=(12, 3))
    cloud[3] = cloud[7]
    for points in (cloud, np.zeros((6, 3))):
        check(labeler.label_frames([points])[0], len(points))


def test_no_frames_at_all(labeler):
    assert labeler.label_frames([]) == []


def test_each_frame_keeps_its_place_and_does_not_feel_the_others(labeler, rng):
    frames = [rng.normal(scale=0.05, size=(count, 3)) for count in (7, 0, 19, 3, 12)]
    together = labeler.label_frames(frames)
    for points, labeling in zip(frames, together, strict=True):
        check(labeling, len(points))
        (alone,) = labeler.label_frames([points])
        np.testing.assert_allclose(alone.confidence, labeling.confidence, atol=1e-4)
        assert (alone.labels == labeling.labels).mean() > 0.9 if len(points) else True


def test_far_from_the_origin_is_as_good_as_near(labeler, rng):
    cloud = rng.normal(scale=0.05, size=(15, 3))
    near, far = labeler.label_frames([cloud, cloud + [40.0, -900.0, 3.0]])
    np.testing.assert_allclose(near.confidence, far.confidence, atol=1e-4)


@pytest.mark.parametrize(
    ("points", "sentence"),
    [
        (np.full((3, 3), np.nan), "frame 1 holds NaN or infinite points; leave missing points out"),
        (np.full((3, 3), np.inf), "frame 1 holds NaN or infinite points"),
        (np.zeros((4, 2)), r"frame 1 has shape \(4, 2\), expected \(N, 3\)"),
        (np.zeros(3), r"frame 1 has shape \(3,\), expected \(N, 3\)"),
        (np.zeros((513, 3)), "frame 1 holds 513 points, expected at most 512"),
    ],
)
def test_bad_clouds_are_told(labeler, points, sentence):
    with pytest.raises(ArgumentError, match=sentence):
        labeler.label_frames([np.zeros((3, 3)), points])


def test_millimeters_are_told_and_strays_are_not(labeler, rng):
    hands = [rng.normal(scale=0.05, size=(19, 3)) for _ in range(5)]
    with pytest.raises(ArgumentError, match=r"span \d+ m, expected a hand in meters; millimeters\?"):
        labeler.label_frames([1000.0 * hand for hand in hands])
    stray = np.concatenate([hands[0], [[200.0, 0.0, 0.0]]])
    check(labeler.label_frames([stray, *hands[1:]])[0], 20)


def test_batches_of_large_clouds_are_small(rng):
    sizes = []

    def label(clouds):
        sizes.append([len(cloud) for cloud in clouds])
        return [Labeling(np.full(len(cloud), -1), np.ones(len(cloud))) for cloud in clouds]

    frames = [rng.random((count, 3)) for count in (*[20] * 300, *[512] * 2, 0)]
    found = label_in_batches(frames, label)
    assert [len(one.labels) for one in found] == [len(frame) for frame in frames]
    assert sizes == [[512], [512], [20] * 256, [20] * 44 + [0]], "as many pairs of points, not of frames"
