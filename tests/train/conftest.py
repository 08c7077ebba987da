"""What tests of labelers share: a training set, pages without pictures, gloves learned from little."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from train import Dataset, generate_dataset
from train.labelers.layout_labeler import LayoutLabeler, fine_tuned_labeler


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """300 frames of hands alone."""
    out = tmp_path_factory.mktemp("sets") / "small"
    return generate_dataset(
        out, num_frames=300, frames_per_hand=20, scenes={"together": 0, "holding": 0}, workers=1
    )


@pytest.fixture(scope="module", autouse=True)
def pages_without_pictures() -> Iterator[None]:
    """A run of a small network draws for longer than it learns; tests of pages draw (tests/train/reports)."""
    with pytest.MonkeyPatch.context() as patch:
        for page in ("run_page", "dataset_page", "hand_plot"):
            patch.setattr(f"train.reports.{page}.picture", lambda *drawn: "data:,")
        yield


@pytest.fixture
def own_cache(monkeypatch, tmp_path):
    """A cache for this test alone, in which one step makes a labeler."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(fine_tuned_labeler, "__kwdefaults__", {"num_clouds": 64, "seed": 0})


@pytest.fixture
def quickly_learned(own_cache, monkeypatch):
    """A labeler that knows its layout from few poses, whatever its labels are then worth."""
    monkeypatch.setattr(LayoutLabeler.at_once.__func__, "__kwdefaults__", {"num_poses": 2000, "seed": 0})
