from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handsim.errors import HandSimError
from render.illustrations.captions import pad, side_by_side, spread_out, titled, with_names, write_png


@given(st.lists(st.floats(0.0, 1000.0), max_size=20).map(sorted), st.floats(1.0, 30.0))
def test_names_stand_apart_in_order_and_inside(wanted: list[float], step: float) -> None:
    places = spread_out(np.array(wanted), step, 10.0, 990.0)
    assert (np.diff(places) >= step - 1e-6).all()
    assert (places >= 10.0 - 1e-6).all()
    assert (places <= 990.0 + 1e-6).all()


def test_names_that_do_not_push_stay_where_they_are() -> None:
    wanted = np.array([20.0, 60.0, 62.0, 200.0])
    np.testing.assert_allclose(spread_out(wanted, 10.0, 0.0, 300.0), [20.0, 56.0, 66.0, 200.0])


def test_png_keeps_the_colors(tmp_path: Path, rng: np.random.Generator) -> None:
    picture = rng.integers(0, 256, (12, 17, 3), dtype=np.uint8)
    write_png(tmp_path / "new" / "a.png", picture)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "new" / "a.png"))[..., ::-1], picture)
    with pytest.raises(HandSimError, match=r"ends in \.png"):
        write_png(tmp_path / "a.jpg", picture)


def test_names_are_written_beside_the_picture() -> None:
    picture = np.full((200, 100, 3), 255, dtype=np.uint8)
    pixels = np.array([[10.0, 50.0], [90.0, 50.0], [np.nan, np.nan]])
    named = with_names(picture, pixels, ["left", "right", "nowhere"])
    column = (named.shape[1] - 100) // 2
    paper = pad(picture, (0, 0), (column, column))
    for part in (named[:, : column - 10], named[:, column + 110 :]):
        rows = np.flatnonzero((part != paper[0, 0]).any(axis=(1, 2)))
        assert rows.size
        assert abs(rows.mean() - 50) < 20
    assert named.shape[0] == 200


def test_pictures_of_two_heights_stand_in_a_row() -> None:
    low, high = np.zeros((10, 20, 3), np.uint8), np.zeros((30, 5, 3), np.uint8)
    assert side_by_side([low, high], gap=3).shape == (30, 28, 3)
    assert titled(low, "a").shape[0] > 30
