from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest
import tyro

from handsim.errors import ArgumentError
from handsim.settings import Expected, Limits, Mixture, Settings
from tests.sentences import error_names


class Thing:
    name = "a thing"


@dataclass(frozen=True, slots=True)
class Group(Settings):
    noise: Annotated[float, Limits(0.0, above=True)] = 1.0
    bits: int = 8


@dataclass(frozen=True, slots=True)
class Shares(Mixture):
    one: float = 0.5
    two: float = 0.5


@dataclass(frozen=True, slots=True)
class Mixed(Settings):
    shares: Shares = field(default_factory=Shares)


@dataclass(frozen=True, slots=True)
class Options(Settings):
    num_frames: Annotated[int, Limits(1)] = 1
    kind: Literal["one", "two"] = "one"
    hands: tuple[Literal["right", "left"], ...] = ("right", "left")
    chances: Annotated[tuple[float, float], Limits(0.0, 1.0, ascends=True)] = (0.0, 0.5)
    thing: Annotated[Thing | str | Path, Expected("a Thing, or its name", lambda: ("dense19",))] = "dense19"
    out: Path | None = None
    group: Group = field(default_factory=lambda: Group(bits=9))

    def check(self) -> None:
        if self.kind == "two" and self.num_frames < 2:
            raise ArgumentError("kind is two and num_frames 1, expected two frames")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"num_frames": 0}, "num_frames | 0 | at least 1"),
        ({"num_frames": 1.5}, "num_frames | 1.5 | whole number"),
        ({"num_frames": True}, "num_frames | True | whole number"),
        ({"kind": "tow"}, "kind | tow | two | one"),
        ({"kind": "two"}, "two frames"),
        ({"hands": ("up",)}, "hands | up | right | left"),
        ({"hands": 5}, "hands | 5 | tuple"),
        ({"chances": (0.5, 0.25)}, "chances | 0.5 | smaller"),
        ({"chances": (0.5,)}, "chances | 2 values"),
        ({"chances": (0.5, np.nan)}, "chances | nan | 0 to 1"),
        ({"thing": 5}, "thing | 5 | a Thing, or its name | dense19"),
        ({"out": 5}, "out | 5 | path"),
        ({"group": 5}, "group | 5 | Group"),
        ({"group": {"nose": 5}}, "group | nose | noise"),
        ({"group": {"noise": 0.0}}, "noise | 0 | above 0"),
        ({"frames": 5}, "frames | num_frames"),
    ],
)
def test_a_mistake_ends_in_a_sentence_that_names_it(options, words):
    with error_names(ArgumentError, words):
        Options.of(None, options)


def test_what_is_given_simply_becomes_what_the_annotation_says():
    options = Options(num_frames=np.int64(3), hands="left", chances=[0.0, 1.0], out="a", group={"noise": 2})
    assert options.hands == ("left",)
    assert options.chances == (0.0, 1.0)
    assert options.out == Path("a")
    assert options.group == Group(2, 9)  # the mapping says what differs from the field's default
    assert type(options.num_frames) is int


def test_settings_come_back_from_their_record():
    options = Options(num_frames=7, hands=("left",), out=Path("a"), group=Group(2.0))
    record = json.loads(json.dumps(options.record()))
    assert Options.from_json({**record, "more": 1}) == options
    assert Options(thing=Thing()).record()["thing"] == "a thing"


def test_options_change_settings():
    assert Options.of(Options(num_frames=7), {"kind": "two"}) == Options(num_frames=7, kind="two")
    with pytest.raises(ArgumentError, match=r"settings is {.num_frames.: 7}"):
        Options.of({"num_frames": 7})


@pytest.mark.parametrize(
    ("given", "expected"),
    [({"one": 2.0}, (2.0, 0.5)), ({"one": 0.0}, (0.0, 0.5)), ({"two": 0}, (0.5, 0.0)), ({}, (0.5, 0.5))],
)
def test_shares_that_are_not_given_keep_their_defaults_as_on_the_command_line(given, expected):
    assert Mixed(shares=given).shares == Shares(**given) == Shares(*expected)
    words = [word for name, share in given.items() for word in (f"--shares.{name}", str(share))]
    assert tyro.cli(Mixed, args=words).shares == Shares(*expected)


def test_shares_are_normalized_and_checked():
    np.testing.assert_array_equal(Shares(1.0, 3.0).shares, [0.25, 0.75])
    assert Mixed.from_json(Mixed(shares=Shares(1.0, 0.0)).record()) == Mixed(shares=Shares(1.0, 0.0))
    with pytest.raises(ArgumentError, match="the sum of one, two is 0, expected a number above 0"):
        Mixed(shares={"one": 0.0, "two": 0.0})
    with pytest.raises(ArgumentError, match="two is -1, expected a number of at least 0"):
        Shares(1.0, -1.0)
    with pytest.raises(ArgumentError, match="unknown setting of shares 'three'"):
        Mixed(shares={"three": 1.0})


@dataclass(frozen=True, slots=True)
class Numbers(Settings):
    rate: Annotated[float, Limits(0.0)] = 1.0
    sure: bool = False
    sides: Annotated[tuple[float, float], Limits(0.0)] = (0.0, 1.0)
    bodies: Sequence[str | Thing] = ()


@pytest.mark.parametrize(
    ("options", "record"),
    [
        ({"rate": np.float32(0.5)}, {"rate": 0.5}),
        ({"rate": np.float64(0.5)}, {"rate": 0.5}),
        ({"rate": np.array(0.5)}, {"rate": 0.5}),
        ({"rate": np.int16(3)}, {"rate": 3}),
        ({"sure": np.bool_(True)}, {"sure": True}),
        ({"sides": np.array([0.25, 2.0], np.float32)}, {"sides": [0.25, 2.0]}),
        ({"sides": (np.float32(0.25), np.int64(2))}, {"sides": [0.25, 2]}),
        ({"bodies": "pen"}, {"bodies": ["pen"]}),
        ({"bodies": ["pen", Thing()]}, {"bodies": ["pen", "a thing"]}),
    ],
)
def test_numbers_of_numpy_are_recorded_as_numbers(options, record):
    found = Numbers(**options).record()
    assert {name: found[name] for name in record} == record
    assert Numbers.from_json(json.loads(json.dumps(found))).record() == found


@pytest.mark.parametrize("bodies", [{"pen"}, (name for name in ["pen"]), 5])
def test_what_has_no_order_is_no_list(bodies):
    with pytest.raises(ArgumentError, match=r"bodies is .*, expected a tuple"):
        Numbers(bodies=bodies)
