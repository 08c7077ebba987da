from __future__ import annotations

import numpy as np
import trimesh

from handsim.motion_files.motion import changes, corner_normals, posed_bodies, posed_hands, split_vertices


def test_the_last_pose_is_held(motion):
    left = list(posed_hands(motion))[1]
    assert left.side == "left" and np.flatnonzero(~left.present).tolist() == [0, 1, 5, 6]
    np.testing.assert_array_equal(left.qpos[left.present], motion.qpos[left.present, 1])
    np.testing.assert_array_equal(left.qpos[[0, 1, 5, 6]], motion.qpos[[2, 2, 4, 4], 1])
    pen = next(posed_bodies(motion))
    assert pen.shape is not None and np.flatnonzero(~pen.present).tolist() == [7, 8]
    np.testing.assert_array_equal(pen.T_world_body[[7, 8]], pen.T_world_body[[6, 6]])


def test_changes_are_where_something_appears_or_goes(motion):
    left = list(posed_hands(motion))[1]
    assert changes(left.present).tolist() == [0, 2, 5, 7]


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
