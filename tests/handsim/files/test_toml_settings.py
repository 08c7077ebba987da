"""Settings from tables: values reach their fields, and what is wrong is named."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

import pytest

from handsim.errors import ArgumentError, HandSimError
from handsim.files.toml_settings import settings_of
from track.config import TrackerConfig
from train.config import TrainConfig
from train.simulation.dataset_config import DatasetConfig
from train.simulation.takes import TakeConfig


@dataclass(frozen=True)
class Inner:
    width: int = 1
    scale: float = 2.0


@dataclass(frozen=True)
class Outer:
    name: str = "x"
    mode: Literal["fast", "slow"] = "fast"
    pair: tuple[float, float] = (0.0, 1.0)
    most: int | None = None
    inner: Inner = field(default_factory=Inner)

    def __post_init__(self) -> None:
        if self.pair[0] > self.pair[1]:
            raise ArgumentError("pair is turned round")


def test_values_reach_their_fields_and_others_keep_their_defaults():
    table = {"mode": "slow", "pair": [0, 0.5], "most": 3, "inner": {"scale": 4}}
    assert settings_of(Outer, table, "it") == Outer("x", "slow", (0.0, 0.5), 3, Inner(1, 4.0))
    assert settings_of(Outer, {}, "it") == Outer()


@pytest.mark.parametrize("kind", [DatasetConfig, TakeConfig, TrainConfig, TrackerConfig])
def test_settings_of_all_commands_come_back_from_their_own_values(kind):
    settings = kind()
    table = dataclasses.asdict(settings)
    assert settings_of(kind, table, "it") == settings


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"nam": "x"}, "it has an unknown key 'nam' (did you mean 'name'?); valid names: name, mode, pair"),
        ({"inner": {"with": 1}}, "it.inner has an unknown key 'with' (did you mean 'width'?)"),
        ({"name": 3}, "it.name is 3: expected str, got int"),
        ({"inner": {"width": 1.5}}, "it.inner.width is 1.5: expected int, got float"),
        ({"inner": 3}, "it.inner is 3: expected object, got int"),
        ({"most": "many"}, 'it.most is "many": expected int, got str'),
        ({"mode": "quick"}, "unknown it.mode 'quick'; valid names: fast, slow"),
        ({"pair": [0.0, "b"]}, 'it.pair[1] is [0.0, "b"]: expected float, got str'),
        ({"pair": [0.0]}, "it.pair is [0.0]: expected array of length 2, got 1"),
        ({"pair": [1, 0]}, "pair is turned round"),
    ],
)
def test_what_is_wrong_is_named(table, sentence):
    with pytest.raises(HandSimError) as error:
        settings_of(Outer, table, "it")
    assert sentence in str(error.value)
