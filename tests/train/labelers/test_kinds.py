"""Batches give the labels of single clouds, through a copy of the network and on a GPU too."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.held_out import held_out_markers
from train.config import CNNConfig
from train.data.batches import Corruption, corrupt
from train.glove_labeler import load_labeler
from train.labelers import kinds
from train.labelers.kinds import labeler_of, new_network

NAMES = tuple(f"m{number}" for number in range(19))


@pytest.fixture(scope="module")
def clouds():
    cloud = corrupt(held_out_markers("dense19", 60, seed=0), Corruption(), rng=np.random.default_rng(0))
    return [points[here] for points, here in zip(cloud.points, cloud.present, strict=True)]


def same_labels(batched, single):
    different = sum((one.labels != two.labels).any() for one, two in zip(batched, single, strict=True))
    off = max(np.abs(one.confidence - two.confidence).max() for one, two in zip(batched, single, strict=True))
    return different == 0 and off < 1e-3


def test_batches_give_the_labels_of_clouds_alone(clouds):
    labeler = load_labeler("dense19")
    assert same_labels(labeler.label_frames(clouds), [labeler.label_frames([one])[0] for one in clouds])


def test_a_copy_on_another_device_gives_the_same(clouds, monkeypatch):
    expected = drawn_cnn().label_frames(clouds[:8])
    other = torch.device("cpu", 0)  # which is another name than that of the network's device
    monkeypatch.setattr(kinds, "batch_device", lambda: other)
    assert same_labels(drawn_cnn().label_frames(clouds[:8]), expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_gives_the_labels_of_the_cpu(clouds, monkeypatch):
    on_gpu = drawn_cnn().label_frames(clouds)
    monkeypatch.setattr(kinds, "batch_device", lambda: torch.device("cpu"))
    assert same_labels(on_gpu, drawn_cnn().label_frames(clouds))


def drawn_cnn():
    torch.manual_seed(0)
    return labeler_of(new_network(CNNConfig()), NAMES)
