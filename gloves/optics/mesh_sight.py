"""Lines of sight past moving triangle meshes: a skin in every frame, or a rigid body."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from gloves.optics.mesh_lines import clear_lines
from gloves.optics.mesh_tree import MeshTree
from handsim._checks import check_array
from handsim.errors import ArgumentError


def clear_of_mesh(
    tree: MeshTree,
    vertices: Float[np.ndarray, "T V 3"],
    points: Float[np.ndarray, "T P 3"] | Float[np.ndarray, "T P C 3"],
    cameras: Float[np.ndarray, "C 3"],
    needed: Bool[np.ndarray, "T P C"],
) -> Bool[np.ndarray, "T P C"]:
    """Which of the needed lines from point to camera, in the world, meet no triangle of their frame's mesh.

    A line that starts inside a closed mesh is not clear. NaN points are never clear. Points [m] are one for
    all cameras, or one for each. Lines that are not needed cost nothing and count as not clear.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    starts, ends = _check_lines(points, cameras, needed)
    expected_shape = (len(needed), *tree.vertices.shape)
    if vertices.shape != expected_shape:
        raise ArgumentError(f"vertices has shape {vertices.shape}, expected {expected_shape}")
    if not np.isfinite(vertices.sum()):
        raise ArgumentError("vertices holds NaN or infinite values, expected finite numbers")
    nodes, spots = (tree.faces, tree.first, tree.skip), (tree.spots, tree.spots_start)
    lines = (starts, ends[None], np.asarray(needed, dtype=np.bool_))
    clear: NDArray[np.bool_] = clear_lines(vertices, lines, nodes, spots, np.empty_like(tree.boxes))
    return clear


def clear_of_body(
    tree: MeshTree,
    T_world_body: Float[np.ndarray, "T 4 4"],
    points: Float[np.ndarray, "T P 3"] | Float[np.ndarray, "T P C 3"],
    cameras: Float[np.ndarray, "C 3"],
    needed: Bool[np.ndarray, "T P C"],
) -> Bool[np.ndarray, "T P C"]:
    """`clear_of_mesh` for a rigid body: lines are transformed into its frame, the tree is used as built."""
    poses = check_array("T_world_body", T_world_body, (len(needed), 4, 4))
    starts, ends = _check_lines(points, cameras, needed)
    rotations, positions = poses[:, :3, :3], poses[:, None, :3, 3]
    if not np.allclose(rotations.transpose(0, 2, 1) @ rotations, np.eye(3), atol=1e-6):
        raise ArgumentError("T_world_body scales or shears, expected rotations and translations alone")
    starts = np.ascontiguousarray((starts - positions[:, None]) @ rotations[:, None])
    ends = np.ascontiguousarray((ends - positions) @ rotations)
    nodes, no_refit = (tree.faces, tree.first, tree.skip), (tree.spots[:0], tree.spots_start)
    lines = (starts, ends, np.asarray(needed, dtype=np.bool_))
    clear: NDArray[np.bool_] = clear_lines(tree.vertices[None], lines, nodes, no_refit, tree.boxes)
    return clear


def _check_lines(
    points: NDArray[np.float64], cameras: NDArray[np.float64], needed: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Starts (T, P, 1 or C, 3), which may be NaN, and ends (C, 3) of the lines."""
    starts = np.ascontiguousarray(points, dtype=np.float64)
    ends = np.ascontiguousarray(check_array("cameras", cameras, (None, 3)))
    shapes = ((*needed.shape[:2], 3), (*needed.shape, 3))
    if needed.ndim != 3 or starts.shape not in shapes or ends.shape != (needed.shape[2], 3):
        raise ArgumentError(
            f"points {starts.shape}, cameras {ends.shape} and needed {needed.shape} do not fit together, "
            "expected (T, P, 3) or (T, P, C, 3), (C, 3) and (T, P, C)"
        )
    return (starts[:, :, None] if starts.ndim == 3 else starts), ends
