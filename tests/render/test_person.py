"""The person in pictures: a closed body of human proportions, out of focus, and without an id."""

import numpy as np
import pytest
import trimesh

from gloves import Take
from handsim import look_at
from handsim.space.camera import pinhole
from render import draw
from render.painting.figures import sample_appearance
from render.painting.painter import paint, paint_blurred
from render.person import person_figure
from render.scenery.lights import Lighting
from render.user_body import UserBody
from train import simulate_take


@pytest.fixture(scope="module")
def take() -> Take:
    return simulate_take(kind="hand-hand", num_frames=60, seed=3)


@pytest.fixture(scope="module")
def user(take) -> UserBody:
    return UserBody(take)


def one_handed(take: Take) -> Take:
    return Take.of_poses(take.hands[:1], take.qpos[:, :1], rate=take.rate)


@pytest.mark.parametrize("hands", [1, 2])
def test_the_body_is_closed_and_has_the_proportions_of_people(take, hands):
    user = UserBody(take if hands == 2 else one_handed(take))
    figure = person_figure(user, sample_appearance(False, tones=(-50.0, 60.0), rng=np.random.default_rng(0)))
    triangles = figure.triangles
    solid = trimesh.Trimesh(triangles.vertices, triangles.faces)
    assert solid.is_watertight and solid.volume > 0.0
    across, ahead, up = ((triangles.vertices - user.neck) @ user.directions.T / user.stature).T
    assert 0.18 < up.max() < 0.2, "the head ends 0.182 of the stature above the shoulders"
    assert 0.26 < np.ptp(across) < 0.34, "shoulders are 0.259 apart, and have flesh"
    assert -0.15 < ahead.min() < -0.05 and 0.05 < ahead.max() < 0.1
    assert not any(ids.any() for ids in (triangles.parts, triangles.instances, triangles.markers))
    assert not len(figure.casting), "it casts no shadow"


def test_the_person_is_behind_hands_and_has_depth_but_no_id(take, user):
    (frame,) = draw(take, passes=("rgb", "depth", "ids"), background="plain", num_frames=1)
    ends = frame.camera.project(user.trunk[:4].reshape(-1, 3))
    chest = frame.camera.local(user.trunk[:4].mean(axis=(0, 1)))[2]
    assert ((ends >= 0.0) & (ends < frame.camera.size)).any(), "the picture shows a part of the trunk"
    person = (frame.ids == 0) & (np.abs(frame.depth - chest) < 0.2)
    assert person.mean() > 0.03
    (bare,) = draw(take, passes=("depth", "ids"), num_frames=1, room_depth=False)
    np.testing.assert_array_equal(bare.ids > 0, bare.depth > 0.0)


def test_a_camera_in_the_head_does_not_see_the_person(take):
    (frame,) = draw(take, view={"placement": "head"}, passes=("depth", "ids"), num_frames=1)
    walls = np.linalg.norm(np.diff(frame.depth, axis=1))
    assert frame.depth[frame.ids == 0].min() > 0.6 and walls > 0.0


def test_what_is_out_of_focus_is_painted_alone_and_blurred(take, user):
    (frame,) = draw(take, passes=("ids",), num_frames=1)
    look = sample_appearance(False, tones=(-50.0, 60.0), rng=np.random.default_rng(0))
    drawn, lighting = [person_figure(user, look)], Lighting((), (0.5,) * 3)
    sharp, soft = paint(frame.camera, drawn, lighting), paint_blurred(frame.camera, drawn, lighting)
    assert not sharp.any() and (soft[..., 3] == 255).any()
    assert len(np.unique(soft[..., 3])) > 50, "edges are soft"


def test_people_stand_where_they_hide_no_hand_from_cameras_of_ones_own(take, user):
    palms = np.nanmean(take.qpos[..., :3], axis=(0, 1))
    back = (user.eyes - palms) * (1.0, 1.0, 0.0)
    behind = pinhole("behind", (320, 240), 300.0).at(look_at(palms + 3.0 * back, palms))
    for frame in draw(take, camera=behind, passes=("depth", "ids"), num_frames=2):
        assert np.mean([hand.visible.any() for hand in frame.hands]) == 1.0
        assert (frame.ids > 0).mean() > 0.02
