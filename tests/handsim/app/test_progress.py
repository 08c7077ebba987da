"""The speed that a progress bar shows."""

from __future__ import annotations

import pytest
from rich.progress import Progress

from handsim.app.progress import _Speed


@pytest.mark.parametrize(
    ("steps", "text"), [([100, 2600], "1,250 frames/s"), ([1, 2], "0.5 frames/s"), ([7], ""), ([], "")]
)
def test_speed_is_of_this_run_alone(steps, text):
    """What a resumed run had before it, told by the first step, is not what it did in that time."""
    clock = [0.0]
    bar = Progress(get_time=lambda: clock[0], disable=True)
    task = bar.add_task("", total=1)
    for done in steps:
        clock[0] += 2.0
        bar.update(task, completed=done, total=5000)
    assert str(_Speed("frames").render(bar.tasks[0])) == text
