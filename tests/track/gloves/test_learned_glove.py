from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
import pytest

from gloves import Capture, MarkerLayout, attach, load_layout
from handsim import HandModel, HandSimError, write_page
from handsim.hand.shape import BONE_NAMES
from tests.track.gloves.trials import OTHERS, lab_trial
from track import learn_glove
from track.gloves.learned_page import marker_residuals, marker_rows

NEAR_JOINT = 0.005  # [m] A marker this near to a joint may be described from either of its bones.


@pytest.fixture(
    scope="module",
    params=[("calibration", 2), ("single-hand", 1)],
    ids=["all joints move", "ten seconds of gestures"],
)
def learned(request):
    """A glove that was learned from a lab's own capture, and the marker of each column."""
    kind, seed = request.param
    capture, truth = lab_trial(kind, 1200, seed)
    return learn_glove(capture, radius_mm=3.2, hands=("right",)), truth


def in_order_of(names: Iterable[str], truth: dict[str, str]) -> MarkerLayout:
    """dense19 with other names, in their order."""
    known = {marker.name: marker for marker in load_layout("dense19").markers}
    markers = tuple(dataclasses.replace(known[truth[name]], name=name) for name in names)
    return dataclasses.replace(load_layout("dense19"), markers=markers)


@pytest.mark.slow
def test_markers_are_found_whatever_their_columns_are_called(learned):
    found, truth = learned
    assert set(found.layout.names) == set(truth)
    assert found.layout.sides == ("right",)
    (hand,) = found.hands
    assert (hand.capture, hand.hand.side) == (0, "right")


@pytest.mark.slow
def test_markers_sit_on_their_bones(learned):
    found, truth = learned
    designed = in_order_of(found.layout.names, truth)
    lengths = HandModel.named("M").skeleton.lengths
    wrong = {
        f"{mine.name} ({truth[mine.name]}): {mine.bone}, not {right.bone}"
        for mine, right in zip(found.layout.markers, designed.markers, strict=True)
        if mine.bone != right.bone
        and min(abs(right.along), abs(1.0 - right.along)) * lengths[BONE_NAMES.index(right.bone)] > NEAR_JOINT
    }
    assert wrong == set()


@pytest.mark.slow
def test_markers_are_within_ten_millimeters_of_their_places(learned):
    found, truth = learned
    layouts = (found.layout, in_order_of(found.layout.names, truth))
    points = [attach(layout, "M").attachment.points for layout in layouts]
    off = np.linalg.norm(points[0] - points[1], axis=1)
    assert off.max() < 0.01, dict(zip(found.layout.names, (1e3 * off).round(1), strict=True))


@pytest.mark.slow
def test_columns_that_are_no_markers_are_left_out_and_named(learned):
    found, _ = learned
    assert not set(OTHERS) & set(found.layout.names)
    for name in OTHERS:
        assert any(name in sentence for sentence in found.left_out), name


@pytest.mark.slow
def test_a_page_shows_markers_and_hands(learned, tmp_path):
    found, _ = learned
    assert (marker_residuals(found) < 0.002).all()
    write_page(tmp_path / "mine.html", found)
    page = (tmp_path / "mine.html").read_text("utf-8")
    assert "data:image/svg+xml" in page and all(f"<td>{name}</td>" in page for name in found.layout.names)
    size = found.hands[0].hand.model.shape
    assert f"<td>{1e3 * size.length:.0f}</td><td>{1e3 * size.breadth:.0f}</td>" in page
    assert all(row[-1] == "-" for row in marker_rows(found)[1:])  # one hand alone does not differ


@pytest.mark.slow
def test_a_rigid_object_is_no_hand():
    rng = np.random.default_rng(0)
    object_ = rng.uniform(-0.06, 0.06, (8, 3))
    turned = np.linalg.qr(rng.normal(size=(300, 3, 3)))[0]
    turned *= np.linalg.det(turned)[:, None, None]
    points = object_ @ turned.swapaxes(1, 2) + [0.0, 0.0, 1.0]
    capture = Capture(tuple(f"Box{number}" for number in range(8)), points, 120.0)
    with pytest.raises(HandSimError, match="no hand is in the captures"):
        learn_glove(capture, radius_mm=3.2)


def test_a_start_is_corrected_from_a_capture_with_its_names():
    capture, truth = lab_trial("calibration", 400, 3)
    designed = in_order_of(truth, truth)
    wrong = {"IndexMCP": 0.15, "RingPIP": 0.9}
    moved = [
        dataclasses.replace(one, along=wrong.get(truth[one.name], one.along)) for one in designed.markers
    ]
    found = learn_glove(capture, start=dataclasses.replace(designed, markers=moved), name="better").layout
    assert found.name == "better" and found.names == designed.names and found.sides == ("right",)
    points = [attach(layout, "M").attachment.points for layout in (found, designed)]
    off = np.linalg.norm(points[0] - points[1], axis=1)
    assert off.max() < 0.01, dict(zip(found.names, (1e3 * off).round(1), strict=True))


def test_columns_on_a_forearm_are_offered_as_a_body():
    """The elbow moves against them, and a wand is too far; two columns are no body."""
    capture, truth = lab_trial("calibration", 400, 3)
    wrist = np.nanmean(capture.positions[:, [name in truth for name in capture.names]], axis=1)
    places = np.array([[-0.12, 0.0, 0.03], [-0.15, 0.02, 0.03], [-0.17, -0.02, 0.03]])
    arm = wrist[:, None] + places
    designed = in_order_of(truth, truth)
    for count, expected in ((3, "Arm0 Arm1 Arm2"), (2, None)):
        names = tuple(f"Arm{number}" for number in range(count))
        both = np.concatenate([capture.positions, arm[:, :count]], axis=1)
        found = learn_glove(Capture((*capture.names, *names), both, 120.0), start=designed)
        offered = [sentence for sentence in found.left_out if "--forearm right" in sentence]
        assert len(offered) == (expected is not None)
        assert all(f"--markers {expected} --forearm" in sentence for sentence in offered)
    own = capture.positions[:, [capture.names.index(name) for name in designed.names]]
    assert learn_glove(Capture(designed.names, own, 120.0), start=designed).left_out == ()


@pytest.mark.parametrize(
    "pair", [("IndexMCP", "MiddlePIP"), ("IndexPIP", "ThumbTip"), ("RingPIP", "PinkyPIP")]
)
def test_columns_that_are_exchanged_halfway_are_named(pair):
    capture, truth = lab_trial("calibration", 400, 3)
    designed = in_order_of(truth, truth)
    assert learn_glove(capture, start=designed).doubt == ()
    first, second = (next(name for name in truth if truth[name] == one) for one in pair)
    both = [capture.names.index(first), capture.names.index(second)]
    positions = capture.positions.copy()
    positions[200:, both] = positions[200:, both[::-1]]
    (told,) = learn_glove(dataclasses.replace(capture, positions=positions), start=designed).doubt
    assert {first, second} <= set(told.split()) and "exchanged" in told


def test_captures_without_a_radius_are_refused():
    with pytest.raises(HandSimError, match="the radius of the markers is unknown; give radius_mm"):
        learn_glove(Capture(("A", "B"), np.zeros((3, 2, 3)), 120.0))


def test_captures_of_too_few_markers_are_refused():
    points = np.random.default_rng(0).uniform(0.0, 0.1, (20, 4, 3))
    with pytest.raises(HandSimError, match="no hand is in the captures"):
        learn_glove(Capture(tuple("ABCD"), points, 120.0), radius_mm=3.2)


def test_markers_all_over_the_room_are_no_hand():
    points = np.tile(np.arange(24.0).reshape(8, 3), (20, 1, 1))
    with pytest.raises(HandSimError, match="no hand is in the captures"):
        learn_glove(Capture(tuple("ABCDEFGH"), points, 120.0), radius_mm=3.2)


def test_a_capture_that_is_none_is_refused():
    with pytest.raises(HandSimError, match=r"missing\.c3d"):
        learn_glove("missing.c3d", radius_mm=3.2)
    with pytest.raises(HandSimError, match=r"radius_mm is 40, expected .* 0\.5 to 15"):
        learn_glove("missing.c3d", radius_mm=40.0)
