"""A training set in three shards, and pages as they are."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import pytest

from train import Dataset, GenerateSettings
from train.simulation import generation


@pytest.fixture(scope="module", autouse=True)
def pages_without_pictures() -> None:
    """Here they have them."""


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages that are not looked at have a small picture in each place: to draw takes seconds."""
    for page in ("run_page", "dataset_page", "hand_plot"):
        monkeypatch.setattr(
            f"train.reports.{page}.picture", lambda *drawn: "data:image/svg+xml;base64,PHN2Zy8+"
        )


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("sets") / "small"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generation, "ROWS_PER_SHARD", 150)
        generation.make_dataset(GenerateSettings(num_frames=400, seed=3, frames_per_hand=50), out, workers=1)
    return Dataset(out)


def pictures(page: Path) -> list[str]:
    """The drawings of a page."""
    found = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', page.read_text("utf-8"))
    return [base64.b64decode(picture).decode() for picture in found]
