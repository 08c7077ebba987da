"""A live session loses no frame through faults without saying so."""

from __future__ import annotations

import pytest

from tests.live_faults import run


@pytest.mark.slow
def test_every_frame_of_a_session_with_faults_is_in_the_take_or_counted():
    counts = run(2400, 120.0)
    assert counts["unexplained"] == 0
    assert counts["frames"] > 20 and counts["restarts"] >= 1 and counts["cut_frames"] > 0
    assert counts["refused_connections"] > 200
    assert counts["damaged_packets"] >= 50 and counts["foreign_packets"] >= 100
    assert counts["lines_on_stderr"] < 40, "each fault is told in a sentence"
