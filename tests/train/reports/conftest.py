"""A training set in three shards, and pages as they are."""

import pytest

from train import Dataset, GenerateSettings
from train.simulation import generation


@pytest.fixture(scope="module", autouse=True)
def pages_without_pictures() -> None:
    """Here they have them."""


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("sets") / "small"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generation, "ROWS_PER_SHARD", 150)
        generation.make_dataset(GenerateSettings(num_frames=400, seed=3, frames_per_hand=50), out, workers=1)
    return Dataset(out)
