"""Numbers of modules are found, with what reads them."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest

from benchmarks.ablation import CHANGES, MODULES, _Varying, varied
from benchmarks.ablation_numbers import ROOT, Sources, numbers

FOUND = {number.key: number for number in numbers(MODULES)}


@pytest.fixture(scope="module")
def sources():
    return Sources()


def test_numbers_and_pairs_of_numbers_are_found_and_other_constants_are_not():
    assert FOUND["track/association/hand_state.py:_RETURN_MOST"].part == 1
    assert FOUND["track/association/hand_state.py:_WRIST_ROTATION_SPREAD"].value.startswith("float(")
    assert not any(key.endswith((":_STARTS", ":ALTERNATIVES", ":_USUAL")) for key in FOUND)


def test_whole_numbers_stay_whole_and_always_change():
    assert varied(CHANGES["half"], 1) == 0 and varied(CHANGES["double"], 3) == 6
    assert varied(CHANGES["half"], (0.2, 4)) == (0.1, 2)
    np.testing.assert_array_equal(varied(CHANGES["double"], np.array([1.0, 2.0])), [2.0, 4.0])


def test_kernels_that_read_a_number_are_found_with_their_callers(sources):
    gate = sources.kernels_of(FOUND["track/association/label_consistency.py:_GATE_SQUARE"])
    assert {name for _, name in gate} == {"_gate_in_place", "_worst_label"}
    assert len(sources.kernels_of(FOUND["track/kinematics/marker_kinematics.py:LIMIT_PRECISION"])) > 1
    assert not sources.kernels_of(FOUND["track/tracker.py:_DOUBT_SHARE"])


def test_a_number_is_plain_if_functions_of_its_module_alone_read_it(sources):
    assert sources.is_plain(FOUND["track/tracker.py:_DOUBT_SHARE"])
    assert not sources.is_plain(FOUND["track/association/label_consistency.py:_GATE_SQUARE"])  # a kernel
    assert not sources.is_plain(FOUND["track/takes/take_summary.py:_MOST_SPANS"])  # a default of an argument
    assert not sources.is_plain(FOUND["track/hand_size.py:AT_HAND"])  # another module
    ran = {("track/tracker.py", sources._lines["_DOUBT_SHARE"][0][1])}
    assert sources.is_read(FOUND["track/tracker.py:_DOUBT_SHARE"], ran)
    assert not sources.is_read(FOUND["track/tracker.py:_DOUBT_RMS"], ran)


def test_a_module_is_loaded_with_another_value_and_what_is_derived_follows(monkeypatch):
    name = "track.kinematics.marker_kinematics"
    before = importlib.import_module(name)
    loader = _Varying(name, str(ROOT / "track/kinematics/marker_kinematics.py"))
    loader.number = FOUND["track/kinematics/marker_kinematics.py:MARKER_NOISE"]
    loader.change = CHANGES["double"]
    monkeypatch.setattr(sys, "meta_path", [loader, *sys.meta_path])
    monkeypatch.delitem(sys.modules, name)
    after = importlib.import_module(name)
    monkeypatch.setitem(sys.modules, name, before)
    assert after.MARKER_NOISE == 2.0 * before.MARKER_NOISE
    assert after._MARKER_PRECISION == pytest.approx(0.25 * before._MARKER_PRECISION)
