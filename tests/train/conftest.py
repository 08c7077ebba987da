"""What tests of labelers share: gloves that are learned in a cache of their own, from little."""

from __future__ import annotations

import pytest

from train.any_layout.layout_labeler import LayoutLabeler
from train.any_layout.learned_gloves import fine_tuned_labeler


@pytest.fixture
def own_cache(monkeypatch, tmp_path):
    """A cache for this test alone, in which one step makes a labeler."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(fine_tuned_labeler, "__kwdefaults__", {"num_clouds": 64, "seed": 0})


@pytest.fixture
def quickly_learned(own_cache, monkeypatch):
    """A labeler that knows its layout from few poses, whatever its labels are then worth."""
    monkeypatch.setattr(LayoutLabeler.at_once.__func__, "__kwdefaults__", {"num_poses": 2000, "seed": 0})
