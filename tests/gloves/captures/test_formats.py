"""Labeled captures of one hand and of two, read as one stack of frames."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.captures.capture import Capture
from gloves.captures.formats import read_markers, write_capture
from handsim.errors import CaptureError

NAMES = ("ThumbTip", "IndexTip", "PinkyTip")


@pytest.fixture
def two_hands(rng):
    positions = rng.uniform(size=(4, 7, 3))
    positions[2, :3] = np.nan  # the right hand was not there
    return positions


def test_two_hands_are_counted_each_by_itself(tmp_path, two_hands):
    columns = [f"{side}:{name}" for side in ("right", "left") for name in NAMES]
    write_capture(tmp_path / "two.trc", Capture((*columns, "Unlabeled1"), two_hands, 120.0))
    markers = read_markers([tmp_path / "two.trc"], NAMES)
    expected = np.concatenate([two_hands[[0, 1, 3], :3], two_hands[:, 3:6]])
    np.testing.assert_allclose(markers, expected, atol=1e-6)


def test_a_hand_that_lacks_a_marker_is_named(tmp_path, two_hands):
    columns = [f"{side}:{name}" for side in ("right", "left") for name in NAMES]
    write_capture(tmp_path / "two.trc", Capture(tuple(columns[:5]), two_hands[:, :5], 120.0))
    with pytest.raises(CaptureError, match=r"two\.trc: columns 'left:\.\.\.': .*PinkyTip"):
        read_markers([tmp_path / "two.trc"], NAMES)
