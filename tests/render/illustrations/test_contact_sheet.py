from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from handsim.errors import HandSimError
from render.frames import Pictures
from render.illustrations.contact_sheet import colored_depth, contact_sheet, draw_keypoints


def test_the_sheet_has_a_place_for_every_frame(make_frame) -> None:
    frames = [make_frame(number, noisy=number == 1) for number in range(4)]
    sheet = contact_sheet(frames, columns=3)
    cell_width, cell_height = 2 * 96 + 6, 72 + 6
    assert sheet.shape == (2 * cell_height + 6, 3 * cell_width + 6, 3)
    assert sheet.dtype == np.uint8
    blank = sheet[-cell_height:-6, -cell_width:-6]
    assert (blank == blank[0, 0]).all()
    small = contact_sheet(frames, columns=3, width=48)
    assert small.shape == (2 * 42 + 6, 3 * (2 * 48 + 6) + 6, 3)


def test_keypoints_are_where_they_are(make_frame) -> None:
    frame = make_frame()
    black = np.zeros((72, 96, 3), np.uint8)
    hand = dataclasses.replace(frame.hands[0], keypoints=np.full((21, 2), np.nan))
    assert not draw_keypoints(black, [hand]).any()
    pixels = np.full((21, 2), np.nan)
    pixels[8] = (30.5, 20.5)
    drawn = draw_keypoints(black, [dataclasses.replace(hand, keypoints=pixels, visible=np.ones(21, bool))])
    rows, columns = np.nonzero(drawn.any(axis=-1))
    assert (rows.mean(), columns.mean()) == pytest.approx((20.0, 30.0), abs=0.05)
    twice = draw_keypoints(
        np.zeros((144, 192, 3), np.uint8), [dataclasses.replace(hand, keypoints=pixels)], scale=2
    )
    rows, columns = np.nonzero(twice.any(axis=-1))
    assert (rows.mean(), columns.mean()) == pytest.approx((40.5, 60.5), abs=0.3)
    assert not black.any()


def test_near_is_red_far_is_blue_and_nothing_is_background() -> None:
    picture = colored_depth(np.array([[0.0, 0.3, 0.6]], dtype=np.float32))[0].astype(int)
    assert picture[1, 0] > picture[1, 2]
    assert picture[2, 2] > picture[2, 0]
    assert (picture[0] > 240).all()


def test_frames_without_pictures_are_told(make_frame) -> None:
    with pytest.raises(HandSimError, match="at least one frame"):
        contact_sheet([])
    frame = make_frame(3)
    with pytest.raises(HandSimError, match="frame 3 has neither"):
        contact_sheet([dataclasses.replace(frame, ideal=Pictures())])
    depth_only = dataclasses.replace(frame, ideal=Pictures(depth=frame.ideal.depth))
    assert contact_sheet([depth_only]).shape == (72 + 12, 96 + 12, 3)
