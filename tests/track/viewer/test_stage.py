"""What a browser computes from the packets that it gets is the hand that the model says."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from handsim.space.transforms import quaternion_matrix, room_axes, rotated_poses
from track.viewer.contents import first_look, show_recording
from track.viewer.recordings import TakeRecording, write_video
from track.viewer.stage import FrameView


@pytest.fixture
def show(server, tracked):
    """Shows a frame of the take in the page."""
    recording = TakeRecording(tracked)
    view = FrameView(server, recording)
    return lambda index: view.show(recording.frame(index))


def test_bones_in_the_page_carry_the_skin_to_where_the_model_has_it(server, page_of, show, tracked):
    show(0)
    page = page_of(server)
    for index in (0, 7, 3, 29, 12):
        show(index)
        page.settle()
        for number, hand in enumerate(tracked.hands):
            name = f"/hands/{number}"
            qpos = tracked.qpos[index, number]
            assert (name in page.hidden) == bool(np.isnan(qpos).any())
            if name not in page.hidden:
                np.testing.assert_allclose(page.skin(name), hand.model.skin(qpos[None])[0], atol=5e-5)


def test_a_frame_sends_poses_and_never_a_mesh_again(server, page_of, show, tracked):
    show(0)
    page = page_of(server)
    before, meshes = page.bytes, page.counts["SkinnedMeshMessage"]
    assert meshes == 2 and before > 100_000
    show(1)
    page.settle()
    assert 0 < page.bytes - before < 15_000
    before = page.counts.total()
    show(1)
    page.settle()
    assert page.counts.total() == before, "nothing changed, so nothing is sent"
    assert page.counts["SkinnedMeshMessage"] == meshes


def test_points_have_their_places_colors_and_sizes(server, page_of, show, tracked):
    page = page_of(server)
    show(20)
    page.settle()
    balls = page.nodes["/points"]
    places, sizes = (balls[name].reshape(-1, width) for name, width in
                     (("batched_positions", 3), ("batched_scales", 1)))  # fmt: skip
    colors = balls["batched_colors"].reshape(-1, 3)
    there = np.isfinite(tracked.points[20, :, 0])
    count = int(there.sum())
    np.testing.assert_allclose(places[:count], tracked.points[20, there], atol=1e-6)
    np.testing.assert_allclose(places[count], tracked.markers("right")[20, 4], atol=1e-6)  # filled in
    assert (sizes[:count] == 1.0).all() and 0.0 < sizes[count, 0] < 1.0 and (sizes[count + 1 :] == 0.0).all()
    assert np.ptp(colors[count - 1]) == 0, "a ghost is gray"
    assert np.ptp(colors[0]) > 100 and (colors[0] == colors[18]).all(), "one marker of two hands, one color"
    assert tracked.label_names[0].split(":")[1] == tracked.label_names[19].split(":")[1]


def test_bodies_are_where_they_are_tracked_and_hidden_where_they_are_lost(server, page_of, show, tracked):
    page = page_of(server)
    show(0)
    page.settle()
    assert "/bodies/controller" in page.hidden
    show(1)
    page.settle()
    assert "/bodies/controller" not in page.hidden
    np.testing.assert_allclose(page.places["/bodies/controller"], tracked.body_poses[1, 0, :3])


def test_switches_take_things_away_and_names_follow_their_points(server, page_of, show, tracked):
    show(5)
    page = page_of(server)
    page.press("names")
    page.press("unlabeled points", False)
    page.press("filled-in markers", False)
    page.press("skin", False)
    page.wait(lambda: "/hands" in page.hidden and "/points/names/0" in page.places)
    page.wait(lambda: (page.nodes["/points"]["batched_scales"] > 0).sum() == 37)  # each switch draws anew
    assert page.nodes["/points/names/0"]["text"] == "ThumbCMC"
    np.testing.assert_allclose(page.places["/points/names/0"], tracked.points[5, 0], atol=1e-6)
    show(29)
    page.settle()
    assert "/points/names/19" in page.hidden, "the left hand is lost"


def test_the_eye_is_led_to_the_hands(server, page_of, show, tracked):
    show(29)
    page = page_of(server)
    page.press("Look at the hands")
    page.wait(lambda: page.counts["SetCameraLookAtMessage"] > 0)
    page.settle()
    right = np.concatenate([tracked.qpos[29, :1, :3], tracked.markers("right")[29]])
    np.testing.assert_allclose(page.camera["look_at"], right.mean(axis=0), atol=0.02)
    np.testing.assert_allclose(page.camera["position"] - page.camera["look_at"], [1, 1, 1], atol=1e-6)


def test_a_slider_in_the_page_leads_to_a_frame(server, page_of, tracked):
    labels = tracked.labels.copy()
    labels[13:19, 0] = -1
    run = show_recording(server, TakeRecording(dataclasses.replace(tracked, labels=labels)))
    page = page_of(server)
    page.press("frame", 21)
    run(lambda: page.says("**frame 21** of 30"))
    assert page.says("**right** tracked, RMS 1.00 mm")
    rows = [props["label"] for props in page.panel.values() if "label" in props]
    doubts = [row for row in rows if ": " in row]
    assert doubts[0].startswith("13-") and "right:ThumbCMC without a label, " in doubts[0]


def test_a_take_with_y_up_stands_as_the_same_take_with_z_up(server, page_of, tracked):
    back = room_axes("y").T
    points = dataclasses.replace(tracked.point_list, points=tracked.point_list.points @ back.T)
    lying = dataclasses.replace(
        tracked,
        qpos=rotated_poses(tracked.qpos, back),
        body_poses=rotated_poses(tracked.body_poses, back),
        point_list=points,
    )
    looks, clips = [], []
    for take, up in ((tracked, "z"), (lying, "y")):
        recording = TakeRecording(take)
        show_recording(server, recording, up=up)
        page, camera = page_of(server), server.initial_camera
        turn = room_axes(up)
        looks.append([turn @ getattr(camera, name) for name in ("position", "look_at", "up")])
        looks[-1].append(turn @ page.places["/ground"])
        looks[-1].append(turn @ quaternion_matrix(page.turns.get("/ground", np.eye(4)[0]))[:, 2])

        def clip(path, pictures, *, shown, **_):
            values = [shown]
            for hands, points, *_ in pictures:
                poses = np.array([pose for _, pose in hands])
                values += [points, poses[:, :3], quaternion_matrix(poses[:, 3:7]), poses[:, 7:]]
            clips.append(values)

        write_video("v.mp4", recording, first_look(recording), up=up, write_clip=clip)
    np.testing.assert_allclose(looks[1], looks[0], atol=1e-6)
    np.testing.assert_allclose(looks[0][2], [0, 0, 1])
    for one, other in zip(*clips, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-6)
