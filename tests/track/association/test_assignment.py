"""The best rows of several digits together, against trying all of them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from track.association.assignment import best_combination
from track.association.digit_hypotheses import IMPOSSIBLE


@st.composite
def tables(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Scores, sets, counts and bans of up to five digits with up to ten candidate points."""
    digits, points = draw(st.integers(1, 5)), draw(st.integers(1, 10))
    counts = np.array(draw(st.lists(st.integers(1, 6), min_size=digits, max_size=digits)))
    scores, sets = (
        np.full((digits, counts.max()), -IMPOSSIBLE),
        np.zeros((digits, counts.max()), dtype=np.int64),
    )
    for digit, count in enumerate(counts.tolist()):
        row = draw(st.lists(st.integers(-20, 40), min_size=count, max_size=count))
        scores[digit, :count] = sorted(row, reverse=True)
        sets[digit, : count - 1] = draw(
            st.lists(st.integers(0, 2**points - 1), min_size=count - 1, max_size=count - 1)
        )
    banned = np.array([draw(st.integers(-1, count - 1)) for count in counts.tolist()])
    return scores, sets, counts, banned


def best_of_all(scores: np.ndarray, sets: np.ndarray, counts: np.ndarray, banned: np.ndarray) -> float | None:
    """The most that any choice reaches that uses no point twice and nothing banned."""
    totals = []
    for rows in itertools.product(*map(range, counts)):
        used = [int(sets[digit, row]) for digit, row in enumerate(rows)]
        apart = all((one & two) == 0 for one, two in itertools.combinations(used, 2))
        if apart and not (np.array(rows) == banned).any():
            totals.append(float(sum(scores[digit, row] for digit, row in enumerate(rows))))
    return max(totals, default=None)


@settings(deadline=None, max_examples=300)
@given(tables())
def test_no_other_choice_is_better(table):
    scores, sets, counts, banned = table
    best = np.full(len(counts), -7)
    total, wanted = best_combination(scores, sets, counts, banned, best), best_of_all(*table)
    if wanted is None:
        assert total <= -IMPOSSIBLE / 2
        return
    assert total == pytest.approx(wanted)
    chosen = np.arange(len(counts)), best
    assert ((best >= 0) & (best < counts) & (best != banned)).all()
    assert scores[chosen].sum() == pytest.approx(total)
    assert all(one & two == 0 for one, two in itertools.combinations(sets[chosen].tolist(), 2))


def test_without_a_conflict_everybody_has_the_best():
    scores, sets = np.tile([9.0, 5.0, 0.0], (5, 1)), np.array([[1 << k, 1 << k, 0] for k in range(5)])
    best = np.zeros(5, dtype=np.int64)
    assert best_combination(scores, sets, np.full(5, 3), np.full(5, -1), best) == 45.0
    assert best.tolist() == [0] * 5


def test_a_point_goes_to_whom_it_is_worth_more():
    scores, sets = np.array([[9.0, 8.0, 0.0], [9.0, 1.0, 0.0]]), np.array([[1, 2, 0], [1, 4, 0]])
    best = np.zeros(2, dtype=np.int64)
    assert best_combination(scores, sets, np.array([3, 3]), np.array([-1, -1]), best) == 17.0
    assert best.tolist() == [1, 0]
    assert best_combination(scores, sets, np.array([3, 3]), np.array([-1, 0]), best) == 10.0
    assert best.tolist() == [0, 1]
