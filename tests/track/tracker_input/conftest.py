"""A take of two hands and a controller, and a tracker of them."""

from __future__ import annotations

import pytest

from benchmarks.paper.take_evaluation import true_users
from gloves import GloveFit, Take
from track import Tracker
from train import load_labeler, simulate_take


@pytest.fixture(scope="session")
def labeler():
    return load_labeler("dense19")


@pytest.fixture(scope="session")
def take() -> Take:
    return simulate_take(kind="hand-controller", num_frames=240)


@pytest.fixture(scope="session")
def users(take) -> list[GloveFit]:
    return true_users(take)


@pytest.fixture
def tracker(users, labeler) -> Tracker:
    return Tracker(users, labeler)
