"""Frames that pictures are drawn of."""

from __future__ import annotations


def test_a_frame_is_printed_without_its_arrays(make_frame):
    width, height = make_frame().camera.size
    told = repr(make_frame(3, ("right", "left")))
    assert told.startswith("RenderedFrame(") and told.endswith(
        f"_000003 at 0.050 s, {width} x {height}: right and left; 4 points)"
    )
    assert "no hands; 4 points" in repr(make_frame(sides=()))
