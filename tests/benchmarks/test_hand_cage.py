from __future__ import annotations

import numpy as np

from benchmarks.hand_cage import DATA, subdivided_loops, text
from handsim.hand.skin import catmull_clark, edge_table
from tests.handsim.hand.test_skin import CUBE


def test_file_is_what_the_script_writes():
    assert DATA.read_text("utf-8") == text()


def test_loop_runs_along_edges_of_the_new_mesh():
    matrix, quads = catmull_clark(CUBE, 8)
    (loop,) = subdivided_loops([np.array([0, 1, 3, 2])], CUBE, 8)
    assert len(loop) == 8 and len(set(loop.tolist())) == 8
    edges = {tuple(edge) for edge in edge_table(quads)[0].tolist()}
    for first, second in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True):
        assert (min(first, second), max(first, second)) in edges
    assert matrix.shape[0] > loop.max()
