"""Functions of users' own: found by module or entry point, and told in one sentence where they fail."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from handsim import HandSimError
from handsim._plugins import call_plugin, is_plugin, list_plugins, load_plugin
from handsim.errors import ArgumentError, PoseError
from tests.sentences import error_names

SOURCE = """
class Maker:
    made = 0

    def __init__(self):
        Maker.made += 1

    def __call__(self, count, *, rng):
        return count * self.made

def plain(count, *, rng):
    return count

def failing(count, *, rng):
    return 1 / 0

def refusing(count, *, rng):
    from handsim.errors import PoseError
    raise PoseError("no pose")

number = 3
"""
GROUP = "handsim.tests"


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module in the current folder, which is not on the path."""
    (tmp_path / "own_things.py").write_text(SOURCE)
    (tmp_path / "broken_things.py").write_text("import nothing_of_that_name\n")
    (tmp_path / "failing_things.py").write_text("raise ValueError('not today')\n")
    info = tmp_path / "own_things-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-things\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\nmine = own_things:plain\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    load_plugin.cache_clear()
    yield tmp_path
    load_plugin.cache_clear()
    sys.modules.pop("own_things", None)


def load(name):
    return load_plugin(name, group=GROUP, noun="thing")


def test_a_function_and_a_class_of_the_current_folder(module):
    assert load("own_things:plain")(4, rng=None) == 4
    maker = load("own_things:Maker")
    assert maker(4, rng=None) == 4 and load("own_things:Maker") is maker, "made once"
    assert sys.path[-1] == str(module), "after everything that is installed"


def test_an_entry_point(module):
    sys.path.append(str(module))
    assert list_plugins(GROUP) == ("mine",)
    assert load("mine")(5, rng=None) == 5
    with pytest.raises(ArgumentError, match=r"unknown thing 'min' \(did you mean 'mine'\?\)"):
        load("min")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nothing_here:f", "thing 'nothing_here:f': No module named 'nothing_here'"),
        ("own_things:absent", "has no attribute 'absent'"),
        ("broken_things:f", "No module named 'nothing_of_that_name'"),
        ("failing_things:f", r"cannot be loaded: ValueError: not today \(.*failing_things.py, line 1\)"),
        ("plain", "unknown thing 'plain'; expected module:name, or a name that a package registers as"),
        ("a/b.py:f", "expected module:name"),
    ],
)
def test_what_is_not_there_is_told(module, name, message):
    with pytest.raises(ArgumentError, match=message):
        load(name)


def test_calls_that_fail_are_told(module):
    rng = np.random.default_rng(0)
    with pytest.raises(HandSimError, match=r"thing 'x' failed: ZeroDivisionError: .*own_things.py, line 15"):
        call_plugin(load("own_things:failing"), "x", "thing", 1, rng=rng)
    with error_names(ArgumentError, "does not take the arguments (int, int, rng=...): too many"):
        call_plugin(load("own_things:plain"), "x", "thing", 1, 2, rng=rng)
    with pytest.raises(ArgumentError, match="thing 'x' is int, expected a function"):
        call_plugin(load("own_things:number"), "x", "thing", 1)
    with pytest.raises(PoseError, match="no pose"):
        call_plugin(load("own_things:refusing"), "x", "thing", 1, rng=rng)


def test_names():
    assert is_plugin("a.b:C.d") and not is_plugin("C:\\run") and not is_plugin("dense19")
