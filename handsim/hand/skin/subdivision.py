"""Catmull-Clark subdivision of a fixed quad mesh as one sparse matrix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int
from scipy import sparse


def edge_table(quads: Int[np.ndarray, "Q 4"]) -> tuple[Int[np.ndarray, "E 2"], Int[np.ndarray, "Q 4"]]:
    """Edges of a quad mesh (lower vertex first) and the edge from each corner of a quad to the next one."""
    ends = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges, inverse = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
    return edges, inverse.reshape(quads.shape)


def catmull_clark(
    quads: Int[np.ndarray, "Q 4"], num_vertices: int
) -> tuple[sparse.csr_array, Int[np.ndarray, "Q4 4"]]:
    """One step of Catmull-Clark on a closed quad mesh.

    New vertices are the old ones, then one for each row of `edge_table`, then one for each quad.

    Returns:
        Matrix (V + E + Q, V) from old positions to new ones, and the 4 Q new quads with the old winding.
    """
    edges, edge_of_corner = edge_table(quads)
    num_edges, num_quads = len(edges), len(quads)
    corner, quad = quads.ravel(), np.repeat(np.arange(num_quads), 4)

    faces = sparse.csr_array((np.full(corner.size, 0.25), (quad, corner)), (num_quads, num_vertices))
    sides = sparse.csr_array((np.ones(corner.size), (edge_of_corner.ravel(), quad)), (num_edges, num_quads))
    ends = sparse.csr_array(
        (np.ones(edges.size), (np.repeat(np.arange(num_edges), 2), edges.ravel())), (num_edges, num_vertices)
    )
    edge_points = 0.25 * (ends + sides @ faces)

    touching = sparse.csr_array((np.ones(corner.size), (corner, quad)), (num_vertices, num_quads))
    valence = np.asarray(touching.sum(axis=1))
    middles = sparse.diags_array(0.5 / valence**2) @ (ends.T @ ends)  # edge midpoints around each vertex
    vertex_points = (
        sparse.diags_array(1.0 / valence**2) @ (touching @ faces)
        + 2.0 * middles
        + sparse.diags_array((valence - 3.0) / valence)
    )

    here = num_vertices + edge_of_corner
    center = np.broadcast_to(num_vertices + num_edges + np.arange(num_quads)[:, None], quads.shape)
    new_quads = np.stack([quads, here, center, np.roll(here, 1, axis=1)], axis=-1).reshape(-1, 4)
    return sparse.csr_array(sparse.vstack([vertex_points, edge_points, faces])), new_quads


def subdivided_loops(
    loops: Sequence[Int[np.ndarray, "K"]], quads: Int[np.ndarray, "Q 4"], num_vertices: int
) -> list[Int[np.ndarray, "2*K"]]:
    """The vertices that each closed loop of edges passes through after one `catmull_clark` step."""
    edges, _ = edge_table(quads)
    number = {(a, b): num_vertices + index for index, (a, b) in enumerate(edges.tolist())}
    results = []
    for loop in loops:
        result = []
        for first, second in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True):
            result += [first, number[min(first, second), max(first, second)]]
        results.append(np.array(result))
    return results
