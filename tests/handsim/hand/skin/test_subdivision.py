import numpy as np
import pytest
from numpy.testing import assert_allclose

from handsim.hand.skin import catmull_clark, edge_table, subdivided_loops

CUBE = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def test_first_step_on_a_cube_has_the_known_points():
    matrix, quads = catmull_clark(CUBE, 8)
    points = matrix @ CORNERS
    assert quads.shape == (24, 4) and points.shape == (8 + 12 + 6, 3)
    assert_allclose(np.abs(points[:8]), 5.0 / 9.0)  # corner: (F + 2 R) / 3 with F = 1/3 and R = 2/3
    assert_allclose(np.sort(np.abs(points[8:20]), axis=1), np.tile([0.0, 0.75, 0.75], (12, 1)))
    assert_allclose(np.sort(np.abs(points[20:]), axis=1), np.tile([0.0, 0.0, 1.0], (6, 1)))


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_mesh_stays_closed_and_weights_are_averages(levels):
    quads, count = CUBE, 8
    for _ in range(levels):
        matrix, quads = catmull_clark(quads, count)
        count = matrix.shape[0]
        assert_allclose(matrix.sum(axis=1), 1.0)
        assert matrix.min() >= 0.0
    edges, _ = edge_table(quads)
    assert count - len(edges) + len(quads) == 2  # Euler: one sphere
    directed = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)  # every edge once in each direction


def test_affine_maps_commute_with_subdivision():
    rng = np.random.default_rng(3)
    matrix, _ = catmull_clark(CUBE, 8)
    linear, shift = rng.standard_normal((3, 3)), rng.standard_normal(3)
    assert_allclose(matrix @ (CORNERS @ linear + shift), (matrix @ CORNERS) @ linear + shift, atol=1e-12)


def test_loop_runs_along_edges_of_the_new_mesh():
    matrix, quads = catmull_clark(CUBE, 8)
    (loop,) = subdivided_loops([np.array([0, 1, 3, 2])], CUBE, 8)
    assert len(loop) == 8 and len(set(loop.tolist())) == 8
    edges = {tuple(edge) for edge in edge_table(quads)[0].tolist()}
    for first, second in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True):
        assert (min(first, second), max(first, second)) in edges
    assert matrix.shape[0] > loop.max()
