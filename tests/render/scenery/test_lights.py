from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from handsim.errors import HandSimError
from render.scenery.lights import Lamp, Lighting, sample_lighting


def test_lightings_are_plain_values_and_repeat() -> None:
    first, again = (sample_lighting(rng=np.random.default_rng(4)) for _ in range(2))
    assert first == again
    assert json.loads(json.dumps(dataclasses.asdict(first)))["ambient"] == list(first.ambient)


def test_lightings_neither_blind_nor_leave_in_the_dark(rng: np.random.Generator) -> None:
    for _ in range(200):
        lighting = sample_lighting(rng=rng)
        total = sum(lamp.strength for lamp in lighting.lamps) + np.mean(lighting.ambient)
        assert 0.5 < total < 2.2
        assert lighting.lamps[0].direction == lighting.lamps[-1].direction  # the key light's unshadowed part
        assert all(0.6 < level < 1.6 for lamp in lighting.lamps for level in lamp.color)


def test_too_many_lamps_are_told() -> None:
    with pytest.raises(HandSimError, match="6 lamps"):
        Lighting((Lamp((0.0, 0.0, -1.0), 1.0),) * 6, (0.0, 0.0, 0.0))
