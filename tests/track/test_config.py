"""Settings of the tracker: what they accept, and that they are used and recorded."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from handsim.errors import ArgumentError
from track import TrackerConfig
from track.association.initialization import HandInitializer


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "4", None, True])
@pytest.mark.parametrize("name", [setting.name for setting in dataclasses.fields(TrackerConfig)])
def test_every_setting_is_a_positive_number(name, value):
    with pytest.raises(ArgumentError, match=rf"{name} is .*, expected a (whole )?number"):
        TrackerConfig(**{name: value})


def test_labels_are_counted_in_whole_numbers():
    with pytest.raises(ArgumentError, match=r"fewest_labels is 2\.5, expected a whole number"):
        TrackerConfig(fewest_labels=2.5)


def test_more_strays_make_a_hand_less_likely():
    few, many = TrackerConfig(), TrackerConfig(stray_density=20000.0)
    scores = [HandInitializer([], None, config).score(12, 0.002) for config in (few, many)]  # type: ignore[arg-type]
    assert scores[0] - scores[1] == pytest.approx(12 * np.log(10.0))
