"""Corrections find their points in a take, and a file that cannot be meant is told in one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves import PointList
from gloves.takes.corrections import (
    FREE,
    NO_MARKER,
    Correction,
    corrections_of,
    corrections_path,
    find_pins,
    load_corrections,
    pin_labels,
    save_corrections,
    unfitting_sentences,
)
from handsim.errors import CaptureError
from tests.sentences import error_names

NAMES = ("right:ThumbTip", "right:IndexTip", "pen:Pen1")
FRAMES = 60


@pytest.fixture
def points(rng) -> np.ndarray:
    """Three points that wander past each other at 5 mm a frame."""
    steps = rng.normal(scale=0.003, size=(FRAMES, 3, 3))
    return np.cumsum(steps, axis=0) + rng.uniform(0.0, 0.3, (3, 3))


def place(points, frame, column) -> tuple[float, float, float]:
    return tuple(points[frame, column].tolist())


def listed(points, ids, labels=None) -> PointList:
    return PointList.of_tables(
        points, ids, np.full(ids.shape, -1) if labels is None else labels, np.ones(ids.shape)
    )


corrections = st.builds(
    lambda first, length, place, label: Correction(first, first + length, place, label),
    st.integers(0, 10**6), st.integers(0, 10**6),
    st.tuples(*(st.floats(-10.0, 10.0).map(lambda value: round(value, 9)) for _ in range(3))),
    st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), max_size=20),
)  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(st.lists(corrections, max_size=4))
def test_a_file_gives_back_what_was_saved(tmp_path_factory, given_corrections):
    path = tmp_path_factory.mktemp("c") / "a.corrections.toml"
    save_corrections(path, given_corrections)
    again = load_corrections(path)
    assert [one.record() for one in again] == [one.record() for one in given_corrections]
    for one, other in zip(again, given_corrections, strict=True):
        np.testing.assert_allclose(one.place, other.place, atol=1e-9)


def test_a_take_without_a_file_has_none(tmp_path):
    assert corrections_of(tmp_path / "take.npz") == ()
    assert corrections_path(Path("a/tracked.npz")) == Path("a/tracked.corrections.toml")


def test_an_id_leads_through_columns_and_gaps(points):
    ids = np.tile([10, 11, 12], (FRAMES, 1))
    points = points.copy()
    points[30:, [0, 1]], ids[30:, [0, 1]] = points[30:, [1, 0]], ids[30:, [1, 0]]  # columns of a stream
    points[20:25, 0] = np.nan
    pins = find_pins([Correction(15, 40, place(points, 15, 0), NAMES[1])], listed(points, ids), NAMES)
    expected = np.full((FRAMES, 3), FREE)
    expected[15:20, 0] = expected[25:30, 0] = expected[30:41, 1] = 1
    np.testing.assert_array_equal(listed(points, ids).table(pins.labels, FREE), expected)
    assert pins.unfitting == ()


def test_a_point_without_an_id_is_followed_from_place_to_place(points, rng):
    truth, ids = points.copy(), np.full((FRAMES, 3), -1)
    order = np.array([rng.permutation(3) for _ in range(FRAMES)])
    shuffled = np.take_along_axis(truth, order[..., None], axis=1)
    shuffled[50:] += 1.0  # everything is gone
    pins = find_pins([Correction(5, 59, place(truth, 5, 2), NO_MARKER)], listed(shuffled, ids), NAMES)
    frames, columns = np.nonzero(pins.labels.reshape(FRAMES, 3) == -1)
    np.testing.assert_array_equal(frames, np.arange(5, 50))
    np.testing.assert_array_equal(order[frames, columns], 2)


def test_the_later_of_two_about_one_point_counts(points):
    ids = np.tile([1, 2, 3], (FRAMES, 1))
    both = [Correction(0, 9, place(points, 0, 0), NAMES[0]), Correction(5, 9, place(points, 5, 0), NO_MARKER)]
    pins = find_pins(both, listed(points, ids), NAMES)
    np.testing.assert_array_equal(pins.labels.reshape(FRAMES, 3)[:11, 0], [0] * 5 + [-1] * 5 + [FREE])


def test_who_had_the_label_loses_it_in_these_frames_alone():
    points = listed(np.zeros((2, 3, 3)), np.zeros((2, 3), dtype=int), [[0, 1, -1], [0, 1, -1]])
    pinned = np.array([FREE, FREE, FREE, FREE, FREE, 1])
    np.testing.assert_array_equal(pin_labels(points, pinned), [0, 1, -1, 0, -1, 1])
    pinned[3:] = [1, 0, FREE]
    np.testing.assert_array_equal(pin_labels(points, pinned)[3:], [1, 0, -1])


def test_what_no_longer_fits_is_told(points, tmp_path):
    ids = np.tile([1, 2, 3], (FRAMES, 1))
    moved = Correction(7, 9, (5.0, 5.0, 5.0), NAMES[0])
    pins = find_pins([moved], listed(points, ids), NAMES)
    assert (pins.labels == FREE).all() and pins.unfitting == (moved,)
    (sentence,) = unfitting_sentences(tmp_path / "a.corrections.toml", pins.unfitting)
    assert "the correction to right:ThumbTip in frames 7 to 9 no longer fits" in sentence


def test_what_cannot_be_meant_is_told_in_one_sentence(points):
    ids = np.tile([1, 2, 3], (FRAMES, 1))
    first, second = place(points, 3, 0), place(points, 3, 1)
    for wrong, words in (
        ([Correction(3, 60, first, NAMES[0])], "1 is for frames 3 to 60, expected frames from 0 to 59"),
        ([Correction(3, 4, first, "right:ThumbTop")], "1: unknown label 'right:ThumbTop' (did you"),
        (
            [Correction(3, 9, first, NAMES[0]), Correction(3, 9, second, NAMES[0])],
            "two points of frame 3 are corrected to right:ThumbTip, expected one point",
        ),
    ):
        with error_names(CaptureError, words):
            find_pins(wrong, listed(points, ids), NAMES)


def test_a_damaged_file_is_told_in_one_sentence(tmp_path):
    good = '[[correction]]\nframes = [1, 2]\nplace_mm = [1, 2, 3]\nlabel = "none"\n'
    for text, words in (
        ("frames = 3", "the file has an unknown key 'frames'"),
        (good.replace("[1, 2]\n", "[2, 1]\n"), "1: frames is [2, 1], expected whole"),
        (good.replace("[1, 2]\n", "[1, 2.5]\n"), "frames is [1, 2.5], expected whole"),
        (good.replace("[1, 2]\n", "[-1, 2]\n"), "frames is [-1, 2], expected whole"),
        (good.replace("[1, 2, 3]", "[1, 2]"), "place_mm is [1, 2], expected three numbers"),
        (good + "[[correction]]\nlabel = 3", "correction 2 lacks the key 'frames'"),
        (good.replace('"none"', "3"), "correction 1: label is 3, expected text"),
        ("not toml", "not a TOML file"),
    ):
        path = tmp_path / "take.corrections.toml"
        path.write_text(text)
        with error_names(CaptureError, f"{path} | {words}"):
            corrections_of(tmp_path / "take.npz")
