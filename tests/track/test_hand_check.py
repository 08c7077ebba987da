"""Captures of another hand, glove or unit than was asked for: what fits is named."""

from __future__ import annotations

import dataclasses
import warnings

import pytest

from gloves import load_layout
from handsim import HandSimWarning
from handsim.errors import ArgumentError
from track import hand_size, label_capture, measure_hands, track_capture
from track.frames import checked_frames
from track.hand_size import check_scale, sample_frames
from track.user import nominal_user
from train import load_labeler, simulate_take

FRAMES = 90


@pytest.fixture(scope="module")
def capture():
    """A right hand in dense19."""
    return simulate_take("free", num_frames=FRAMES, hands="right", seed=3).capture()


def test_hands_that_fit_are_told_nothing_of_the_one_that_is_not_there(capture):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        take = track_capture(capture)
    right, left = (take.status[:, take.hand_index(side)] for side in ("right", "left"))
    assert (right > 0).mean() > 0.99 and (left > 0).mean() <= 0.005


def test_the_other_side_is_named(capture):
    with pytest.warns(HandSimWarning, match=r"the points fit a right hand better .* \(--hands right\)"):
        track_capture(capture, hands="left")


def test_the_glove_that_is_worn_is_named(capture):
    with pytest.warns(HandSimWarning, match=r"a right hand in glove 'dense19' better .*--glove dense19"):
        label_capture(capture, glove="sparse13")


def test_an_own_glove_in_the_working_folder_is_named(capture, tmp_path, monkeypatch):
    dense = load_layout("dense19")
    own = dataclasses.replace(dense, name="mine", markers=dense.markers[4:])
    own.save(tmp_path / "mine.toml")
    monkeypatch.chdir(tmp_path)
    worn = simulate_take("free", glove=own, num_frames=FRAMES, hands="left", seed=4).capture()
    with pytest.warns(HandSimWarning, match="a left hand in glove 'mine.toml' better"):
        track_capture(worn, glove="sparse13")


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        (0.1, "at 0.1 of their size: the file is probably in centimeters, read as millimeters"),
        (3.2808, "at 3.28 of their size"),
    ],
)
def test_another_unit_is_named(scale, said, monkeypatch):
    few = [(name, load_layout(name)) for name in ("sparse13", "tips8")]  # of all that are shipped
    monkeypatch.setattr(hand_size, "_gloves", lambda: few)
    both = simulate_take("single-hand", num_frames=20).capture()
    with pytest.raises(ArgumentError, match=said):
        track_capture(dataclasses.replace(both, positions=scale * both.positions))


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0, 1 / 0.0254])
def test_a_unit_that_is_far_off_is_named_before_hands_are_measured(scale):
    layout = load_layout("dense19")
    both = simulate_take("hand-hand", num_frames=FRAMES).capture()
    frames = sample_frames(checked_frames(dataclasses.replace(both, positions=scale * both.positions)))
    user, labeler = nominal_user(layout, "M", ("right", "left")), load_labeler(layout, None)
    if scale == 1.0:
        check_scale(frames, user, labeler)
        return
    with pytest.raises(ArgumentError, match=f"the points fit hands at {scale:.3g} of their size"):
        check_scale(frames, user, labeler)


def test_measured_hands_are_not_told_of_what_they_lack(capture):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        measure_hands(capture)
