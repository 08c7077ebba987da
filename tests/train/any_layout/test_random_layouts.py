"""Random layouts: as many markers as asked for, apart from each other, often alike on all fingers."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.hand.topology import BONE_NAMES, BONES
from train.any_layout import random_layouts
from train.any_layout.random_layouts import RandomLayouts
from train.any_layout.skin_bank import sample_skin_bank


@pytest.fixture(scope="module")
def bank():
    return sample_skin_bank(300, 3, rng=np.random.default_rng(0))


@pytest.mark.parametrize("count", [5, 12, 30])
def test_markers_are_apart(bank, count):
    spacing, rng = bank.mean_distances(), np.random.default_rng(1)
    layouts = RandomLayouts(bank.places, spacing)
    for _ in range(20):
        chosen = layouts.draw(count, rng)
        assert len(set(chosen.tolist())) == count
        apart = spacing[np.ix_(chosen, chosen)] + np.eye(count)
        assert apart.min() > 0.006


def test_regular_layouts_have_rows_over_the_fingers(bank, monkeypatch):
    layouts, rows = RandomLayouts(bank.places, bank.mean_distances()), []
    for share in (0.0, 1.0):
        monkeypatch.setattr(random_layouts, "_REGULAR", share)
        rng = np.random.default_rng(2)
        rows.append(sum(_has_rows([bank.places[place].bone for place in layouts.draw(10, rng)])
                        for _ in range(100)))  # fmt: skip
    assert rows[1] > 2 * rows[0]


def _has_rows(bones):
    """Whether four digits or more have equally many markers."""
    digits = np.array([BONES[BONE_NAMES.index(bone)].digit for bone in bones])
    counts = np.bincount(digits[digits >= 0], minlength=5)
    return np.count_nonzero(counts == np.bincount(counts[counts > 0]).argmax()) >= 4
