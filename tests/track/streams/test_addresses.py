"""Addresses of streams: what they open, and what is told of those that are none."""

from __future__ import annotations

import sys

import pytest

from handsim import HandSimError
from tests.sentences import error_names
from track import open_source
from track.streams.live_stream import VALID

SOURCE = """
import numpy as np
from track import StreamedFrame

class Counting:
    def __init__(self, frames="2"):
        self.frames = int(frames)
    def __iter__(self):
        for number in range(self.frames):
            yield StreamedFrame(number, 0.01 * number, np.zeros((1, 3)), np.array([0]))
    def close(self):
        pass

class NoSource:
    pass
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    (tmp_path / "own_sources.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    sys.modules.pop("own_sources", None)


@pytest.mark.parametrize("address", ["", "host", "http://host", "natnet", "a b:c", "9module:name"])
def test_what_is_no_address_is_told_with_the_valid_ones(address):
    with pytest.raises(HandSimError) as caught:
        open_source(address)
    assert str(caught.value) == f"'{address}' is not an address of a stream, expected {', '.join(VALID)}"


@pytest.mark.parametrize("address", ["own_sources:Counting", "own_sources:Counting?frames=5"])
def test_a_class_of_the_user_s_own(own, address):
    count = 5 if "frames" in address else 2
    assert [frame.number for frame in open_source(address)] == list(range(count))


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("own_sources:Nothing", "own_sources"),
        ("own_sources:NoSource", "no method __iter__"),
        ("own_sources:Counting?frames=many", "many"),
        ("own_sources:Counting?speed=2", "speed"),
        ("not_there:Source", "not_there"),
        ("qtm://host:port", "expected qtm://host:port or qtm://host"),
        ("qtm://host?rate=2", "unknown option 'rate', there are none"),
    ],
)
def test_a_wrong_one_is_one_sentence(own, address, words):
    with error_names(HandSimError, words):
        open_source(address)
