"""One-to-one matching against brute force."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from train.matching import GHOST, match_scores


def log_softmax(raw):
    return raw - np.log(np.exp(raw).sum(axis=1, keepdims=True))


def total(labels, by_point, by_label):
    score = sum(by_point[point, -1] for point in np.flatnonzero(labels == GHOST))
    for label in range(len(by_label)):
        held = np.flatnonzero(labels == label)
        if len(held) > 1:
            return -np.inf
        score += by_label[label, held[0]] + by_point[held[0], label] if len(held) else by_label[label, -1]
    return score


@given(seed=st.integers(0, 10_000), count=st.integers(0, 4), num_labels=st.integers(1, 3))
@settings(max_examples=60, deadline=None)
def test_no_labelling_scores_better(seed, count, num_labels):
    rng = np.random.default_rng(seed)
    by_point = log_softmax(2 * rng.normal(size=(count, num_labels + 1)))
    by_label = log_softmax(2 * rng.normal(size=(num_labels, count + 1)))
    labels, confidence = match_scores(by_point, by_label)
    best = max(
        total(np.array(choice, dtype=int), by_point, by_label)
        for choice in itertools.product(range(-1, num_labels), repeat=count)
    )
    assert np.isclose(total(labels, by_point, by_label), best)
    assert ((confidence >= 0) & (confidence <= 1)).all()
