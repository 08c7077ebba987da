"""Settings of the tracker: what they accept, and that they are used and recorded."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from handsim.errors import ArgumentError
from track.association.initialization import HandInitializer
from track.config import (
    GatingConfig,
    InitializationConfig,
    NoiseConfig,
    PresenceConfig,
    SolverConfig,
    TrackerConfig,
)


def test_settings_are_json():
    settings = dataclasses.asdict(TrackerConfig())
    assert json.loads(json.dumps(settings)) == settings
    assert sum(map(len, settings.values())) >= 80


def test_every_setting_is_a_number_with_a_docstring():
    for concern in dataclasses.fields(TrackerConfig):
        kind = type(concern.default)
        assert kind.__doc__
        for setting in dataclasses.fields(kind):
            assert isinstance(setting.default, int | float), setting.name


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "4"])
def test_numbers_must_be_positive_and_finite(value):
    with pytest.raises(ArgumentError, match=r"gate is .*, expected a positive number"):
        GatingConfig(gate=value)


@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan])
def test_shares_are_between_zero_and_one(value):
    with pytest.raises(ArgumentError, match=r"most_gated is .*, expected a number from 0 to 1"):
        GatingConfig(most_gated=value)


def test_counts_are_whole_and_log_odds_of_either_sign():
    with pytest.raises(ArgumentError, match=r"most_steps is 2\.5, expected a whole number"):
        SolverConfig(most_steps=2.5)  # type: ignore[arg-type]
    assert PresenceConfig(seen_elsewhere=-3.0).seen_elsewhere == -3.0
    with pytest.raises(ArgumentError, match="seen_elsewhere is nan, expected a finite number"):
        PresenceConfig(seen_elsewhere=np.nan)


@pytest.mark.parametrize(
    ("concern", "low", "high"),
    [
        (NoiseConfig, "first_spread_least", "first_spread_most"),
        (PresenceConfig, "return_least", "return_most"),
        (InitializationConfig, "search_least", "search_most"),
    ],
)
def test_bounds_are_in_order(concern, low, high):
    with pytest.raises(ArgumentError, match=rf"{low} is 0.9, expected at most {high}, which is 0.1"):
        concern(**{low: 0.9, high: 0.1})


def test_more_strays_make_a_hand_less_likely():
    few, many = TrackerConfig(), TrackerConfig()
    many = dataclasses.replace(many, association=dataclasses.replace(many.association, stray_density=20000.0))
    scores = [HandInitializer([], None, config).score(12, 0.002) for config in (few, many)]  # type: ignore[arg-type]
    assert scores[0] - scores[1] == pytest.approx(12 * np.log(10.0))
