"""Means over the steps between entries, whether or not the run was stopped between them."""

from __future__ import annotations

import dataclasses

from train.history import History


def test_an_entry_is_the_mean_since_the_one_before():
    history = History()
    for loss in (4.0, 2.0, 3.0):
        history.add(loss)
    assert history.close(768, 0.1) == 3.0
    history.add(1.0)
    assert history.close(1024, 0.05) == 1.0
    assert history.losses == [(768, 3.0, 0.1), (1024, 1.0, 0.05)]


def test_steps_that_wait_are_kept():
    history = History()
    history.add(4.0)
    again = History(**dataclasses.asdict(history))
    again.add(2.0)
    assert again.close(512, 0.1) == 3.0
    assert history.losses == []
