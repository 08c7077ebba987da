from __future__ import annotations

import numpy as np
import trimesh

from handsim.motion_files.motion import corner_normals, split_vertices


def test_edges_of_a_box_stay_sharp():
    box = trimesh.creation.box()
    normals = corner_normals(box.vertices, box.faces)
    np.testing.assert_allclose(normals, np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-12)
    vertices, outward, faces = split_vertices(box.faces, normals)
    assert len(vertices) == 24
    np.testing.assert_allclose(box.vertices[vertices][faces], box.vertices[box.faces])
    np.testing.assert_allclose(outward[faces], normals, atol=1e-12)


def test_a_ball_is_smooth():
    ball = trimesh.creation.icosphere(subdivisions=3)
    normals = corner_normals(ball.vertices, ball.faces)
    np.testing.assert_allclose(normals, ball.vertices[ball.faces], atol=0.02)
    assert len(split_vertices(ball.faces, normals)[0]) == len(ball.vertices)
