"""Gap counting against captures made by hand."""

import numpy as np

from gloves.captures.gaps import count_gaps, run_lengths


def test_gaps_of_a_capture_made_by_hand() -> None:
    present = np.ones((12, 3), dtype=bool)
    present[2:4, 0] = False
    present[3:6, 1] = False  # overlaps: one gap of frames 2 to 5
    present[11, 2] = False
    counts = count_gaps(present)
    assert (counts.frames, counts.gaps) == (12, 2)
    assert counts.average_length == (4 + 1) / 2
    assert counts.average_missing == 6 / 5
    assert sorted(run_lengths(~present)) == [1, 2, 3]


def test_a_capture_without_gaps() -> None:
    counts = count_gaps(np.ones((5, 2), dtype=bool))
    assert counts.gaps == 0 and np.isnan(counts.average_length) and np.isnan(counts.average_missing)


def test_all_missing_is_one_gap() -> None:
    counts = count_gaps(np.zeros((5, 2), dtype=bool))
    assert (counts.gaps, counts.average_length, counts.average_missing) == (1, 5.0, 2.0)


def test_gaps_that_begin_and_end_inside_are_measured():
    columns = ["1111111111", "0110010111", "1000110100", "1010101011", "0000000000"]
    present = np.array([[letter == "1" for letter in column] for column in columns]).T
    assert run_lengths(~present, inside=True).tolist() == [2, 1] + [3, 1] + [1, 1, 1, 1]
    assert run_lengths(np.zeros((5, 2), bool), inside=True).tolist() == []
