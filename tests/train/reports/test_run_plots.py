"""Pictures of a run at their limits: nothing to show, a single step, names of any kind."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from train.evaluation import History, reliability
from train.reports.plot_style import picture
from train.reports.run_plots import (
    LONGEST_NAME,
    confusion_size,
    draw_confusion,
    draw_curves,
    draw_reliability,
    row_percent,
    short,
)

pytestmark = pytest.mark.filterwarnings("error")


@pytest.mark.parametrize(
    "history",
    [
        History(),
        History([(256, 3.0, 0.1)], [(256, 0.1, 0.5)]),
        History([(256, 3.0, 0.1), (512, 0.02, 0.1), (768, 1e-4, 0.0)], [(512, 0.1, 1.0), (768, 0.2, 1.0)]),
    ],
)
def test_curves_of_any_length_are_drawn(history):
    assert picture((6.0, 4.0), partial(draw_curves, history=history)).startswith("data:image/svg")


@pytest.mark.parametrize(
    "confusion",
    [np.zeros((6, 6), int), 7 * np.eye(6, dtype=int), np.ones((6, 6), int), np.diag([0, 5, 0, 0, 9, 0])],
)
def test_any_confusion_is_drawn(confusion):
    names = ("a$b$", "<i>&amp;", "x" * 60, "\\frac", "e")
    draw = partial(draw_confusion, names=names, confusion=confusion)
    assert picture(confusion_size(6), draw).startswith("data:image/svg")


def test_rows_are_shares_of_their_points():
    shares = row_percent(np.array([[3, 1], [0, 0]]))
    np.testing.assert_array_equal(shares, [[75.0, 25.0], [np.nan, np.nan]])


@pytest.mark.parametrize("count", [0, 1, 5000])
def test_reliability_of_few_and_many_points(rng, count):
    confidence = rng.uniform(size=count)
    bins = reliability(confidence, confidence > 0.4)
    draw = partial(draw_reliability, bins=bins, error=0.1)
    assert picture((6.0, 6.0), draw).startswith("data:image/svg")


def test_long_names_are_cut():
    assert short("IndexTip") == "IndexTip"
    assert len(short("x" * 60)) == LONGEST_NAME and short("x" * 60).endswith("…")
