"""Faults of a take are named with marker and time, and none is named where there is none."""

from __future__ import annotations

import csv
import dataclasses

import numpy as np
import pytest

from gloves import GloveFit, MarkerLayout, MarkerPlace, Take, load_layout
from gloves.fit import nominal_fit
from gloves.takes.take import TRACKED
from gloves.takes.worn import FormerHands
from handsim import HandSimWarning
from handsim.hand.shape import JOINT_NAMES, JOINTS, PALM
from track import find_suspect_spans, track_capture
from track.alternatives.alternatives import _mirror_orders
from track.kinematics.pose_solver import FEWEST_MARKERS, PoseSolver
from track.takes import take_faults
from track.takes.take_faults import find_faults
from track.takes.take_figures import PageSettings, hand_figures
from track.takes.take_page import write_take_page
from track.takes.take_summary import summarize, suspicions, vouch
from train import simulate_take

FRAMES, RATE = 240, 60.0
HALF = FRAMES // 2
FINGERTIPS = ("index_distal", "middle_distal", "ring_distal", "little_distal")
WITH_THUMB = ("thumb_distal", "little_distal", "index_proximal", "ring_proximal", "middle_distal")


def at_rate(take: Take) -> Take:
    """Every second frame, so that four seconds are few frames."""
    return dataclasses.replace(
        Take.of_truth(
            take.hands, take.qpos[::2], take.points[::2], take.ids[::2], take.labels[::2], rate=RATE
        ),
        settings=take.settings,
    )


@pytest.fixture(scope="module")
def truth() -> Take:
    return at_rate(simulate_take(kind="single-hand", num_frames=2 * FRAMES, seed=5).without_body())


@pytest.fixture(scope="module")
def tracked(truth) -> Take:
    return track_capture(truth, hands=truth.hands, labeler="dense19")


def test_a_joint_that_hardly_moves_is_named_unless_its_angle_is_sure():
    take = simulate_take("free", hands="right", num_frames=900, seed=4)
    take = dataclasses.replace(take, status=np.full_like(take.status, TRACKED))
    qpos = take.qpos.copy()
    qpos[..., [13, 14]] = np.deg2rad([60.0, -10.0])
    for sure, names in ((12.0, {"right:index_PIP_flexion", "right:index_DIP_flexion"}), (3.0, set())):
        spread = np.full((*qpos.shape[:2], 20), np.deg2rad(3.0))
        spread[..., 6:8] = np.deg2rad(sure)
        stiff = dataclasses.replace(take, qpos=qpos, angle_spread=spread, settings={"tracker": {}})
        assert {one.of for one in find_faults(stiff) if "hardly moves" in one.why} == names


def columns_of(truth: Take, frame: int, marker: int) -> np.ndarray:
    return np.flatnonzero(truth.labels[frame] == marker)


def without_marker(take: Take, marker: int, first: int) -> Take:
    """A take whose marker is gone from a frame on."""
    hit = (take.labels == marker) & (np.arange(take.num_frames) >= first)[:, None]
    points, labels, ids = take.points.copy(), take.labels.copy(), take.ids.copy()
    confidence = take.confidence.copy()
    points[hit], labels[hit], ids[hit], confidence[hit] = np.nan, -1, -1, np.nan
    return dataclasses.replace(take, points=points, labels=labels, ids=ids, confidence=confidence)


@pytest.mark.parametrize("seed", [11, 12])
@pytest.mark.parametrize("glove", ["dense19", "sparse13"])
def test_no_fault_is_named_in_a_take_without_one(glove, seed):
    truth = at_rate(simulate_take("hand-hand", glove=glove, num_frames=2 * FRAMES, seed=seed).without_body())
    take = track_capture(truth, glove=glove)
    faults = find_faults(take)
    assert all("at the model's limit" in fault.why for fault in faults)
    for side, joint in (fault.of.split(":") for fault in faults):  # The angle is indeed off.
        column, own = 7 + take.joint_names.index(joint), take.hand_index(side)
        off = take.qpos[:, own, column] - truth.qpos[:, truth.hand_index(side), column]
        assert np.median(np.abs(off)) > np.deg2rad(5.0)


def test_a_truth_has_no_faults(truth):
    assert find_faults(truth) == ()


@pytest.mark.parametrize("first", [HALF - 5, HALF + 4])
def test_a_marker_that_falls_off_is_named(truth, tracked, first):
    marker = truth.hands[0].layout.names.index("IndexTip")
    take = without_marker(tracked, marker, first)
    (fault,) = find_faults(take)
    when = f"{(first - 1) / RATE:.2f} s, for {(FRAMES - first) / RATE:.1f} s to the end"
    assert fault.words == f"{truth.sides[0]}:IndexTip is not seen after {when}"
    assert fault.first == fault.worst == first and fault.last == FRAMES - 1
    assert find_suspect_spans(take)[0] == fault
    assert any(fault.words in sentence for sentence in suspicions(take))
    figures = hand_figures(take)[0]
    assert next(one for one in figures.markers() if one.name == "IndexTip").longest_gap == FRAMES - first
    dip, pip = take.joint_names.index("index_DIP_flexion"), take.joint_names.index("index_PIP_flexion")
    assert not figures.measured[first:, dip].any() and figures.measured[:first, dip].all()
    assert figures.joints()[dip, 4] == pytest.approx(figures.angles[:first, dip].max())
    assert figures.measured[:, pip].sum() >= figures.measured[:, dip].sum()


def test_labels_are_vouched_for_without_a_marker_that_is_never_seen(tracked):
    take = without_marker(tracked, 6, 0)
    assert [fault.why for fault in find_faults(take)] == ["is never seen"]
    assert vouch(take).listed < 0.1


def test_a_marker_that_is_hardly_seen_is_named_and_shows_no_joint(truth, tracked, tmp_path):
    marker = truth.hands[0].layout.names.index("IndexTip")
    side, dip = truth.sides[0], JOINT_NAMES.index("index_DIP_flexion")
    often, hardly = (without_marker(tracked, marker, FRAMES // part) for part in (10, 30))
    assert not any("% of the hand's frames" in fault.why for fault in find_faults(often))
    (fault,) = find_faults(hardly)
    assert fault.words == f"{side}:IndexTip is seen in 3.3 % of the hand's frames" and not fault.of_labels
    assert often.shown_joints(side).all() and np.flatnonzero(~hardly.shown_joints(side)).tolist() == [dip]
    told = f"{side} hand: no marker was seen beyond the DIP of the index finger: its angles from there on are"
    assert any(line.startswith(told) for line in summarize(hardly)) and not any(
        told in s for s in summarize(often)
    )
    for guesses in (False, True):
        page, *_, angles = write_take_page(
            tmp_path / "page.html", hardly, settings=PageSettings(guesses=guesses)
        )
        with page.with_suffix(".frames.csv").open() as file:
            rows = [row for row in csv.DictReader(file) if row["hand"] == side]
        assert {bool(row["index_DIP_flexion_deg"]) for row in rows} == {guesses}
        assert all(row["index_PIP_flexion_deg"] for row in rows)
        with angles.open() as file:
            mine = [
                one for one in csv.DictReader(file) if (one["side"], one["joint"]) == (side, JOINT_NAMES[dip])
            ]
        assert {(one["value [deg]"], one["share measured"]) for one in mine} == {("", "0")}
        hardly.export(tmp_path / "angles.csv", guesses=guesses)
        with (tmp_path / "angles.csv").open() as file:
            rows = [row for row in csv.DictReader(file) if row["hand"] == side]
        hidden = {
            "index_DIP_flexion_rad",
            "index_DIP_flexion_isb_rad",
            *(f"index_tip_{axis}_m" for axis in "xyz"),
        }
        assert {name for name, cell in rows[9].items() if not cell} == (set() if guesses else hidden)


def test_python_is_warned_of_faults(truth):
    marker = truth.hands[0].layout.names.index("IndexTip")
    with pytest.warns(HandSimWarning, match=f"{truth.sides[0]}:IndexTip is never seen; compare the layout"):
        track_capture(without_marker(truth, marker, 0), hands=truth.hands, labeler="dense19", smooth=False)


def test_a_short_gap_at_the_end_is_no_fault(tracked):
    assert find_faults(without_marker(tracked, 6, FRAMES - 60)) == ()


def slipped(truth: Take, part: str) -> Take:
    """A take whose first glove, or its palm, is 8 mm nearer to the fingertips in the second half."""
    points, hand = truth.points.copy(), truth.hands[0]
    bones, own = hand.model.forward_kinematics(truth.qpos[:, 0]), hand.attachment.main_bones
    for frame in range(HALF, FRAMES):
        for marker in np.flatnonzero(own == PALM) if part == "palm" else range(len(own)):
            points[frame, columns_of(truth, frame, marker)] += 0.008 * bones[frame, own[marker], :3, 0]
    return dataclasses.replace(truth, points=points)


@pytest.mark.parametrize("part", ["palm", "whole"])
def test_a_glove_that_slips_is_named_with_the_time(truth, part):
    take = track_capture(slipped(truth, part), hands=truth.hands, labeler="dense19")
    found = [fault for fault in find_faults(take) if fault.why.startswith("slips by ")]
    assert [fault.of.split(":")[0] for fault in found] == [truth.sides[0]]
    assert abs(found[0].first - HALF) <= 3 and not found[0].of_labels
    assert f"at {found[0].first / RATE:.2f} s" in found[0].why


@pytest.mark.parametrize("shift", [0.0, 0.008])
def test_a_slip_is_told_from_noise_by_all_markers_together(truth, rng, shift):
    (hand, *_), qpos = truth.hands, truth.qpos[:, 0]
    seen = hand.markers(qpos)[0] + rng.normal(0.0, 0.002, (FRAMES, hand.layout.num_markers, 3))
    palm = np.flatnonzero(hand.attachment.main_bones == PALM)
    bones = hand.model.forward_kinematics(qpos)
    seen[HALF:, palm] += shift * bones[HALF:, PALM, None, :3, 0]
    take = as_tracked([hand], PoseSolver(hand).solve(seen).qpos[:, None], seen)
    found = [fault for fault in find_faults(take) if "slips by" in fault.why]
    assert len(found) == (shift > 0.0)
    assert all(abs(fault.first - HALF) <= 3 and fault.of == "the right glove" for fault in found)


def test_a_slip_is_told_of_a_hand_that_was_calibrated_on_both_parts(truth, rng):
    (hand, *_), qpos = truth.hands, truth.qpos[:, 0]
    worn, own = hand.attachment, hand.attachment.main_bones
    half = 0.0025 * hand.model.rest_transforms[own, :3, 0]
    between = GloveFit(hand.model, dataclasses.replace(worn, points=worn.points + half))
    shift = 0.005 * hand.model.forward_kinematics(qpos)[:, :, :3, 0][:, own]
    shift[:HALF] = 0.0
    seen = hand.markers(qpos)[0] + shift + rng.normal(0.0, 0.0005, shift.shape)
    take = as_tracked([between], PoseSolver(between).solve(seen).qpos[:, None], seen)
    (fault,) = (one for one in find_faults(take) if "slips by" in one.why)
    assert abs(fault.first - HALF) <= 3


@pytest.mark.parametrize("shift", [0.0, 0.005])
def test_a_slip_of_the_whole_glove_is_told_on_moving_skin(shift):
    made = at_rate(simulate_take("real-like", num_frames=1200, seed=7).without_body())
    (hand, *_), seen, half = made.hands, made.observed("right"), made.num_frames // 2
    worn, own = hand.attachment, hand.attachment.main_bones
    moved = 0.5 * shift * hand.model.rest_transforms[own, :3, 0]
    between = GloveFit(hand.model, dataclasses.replace(worn, points=worn.points + moved))
    bones = hand.model.forward_kinematics(made.qpos[half:, made.hand_index("right")])
    seen[half:] += shift * bones[:, own][..., :3, 0]
    seen = seen[np.isfinite(seen[..., 0]).sum(axis=1) >= FEWEST_MARKERS]
    take = as_tracked([between], PoseSolver(between).solve(seen).qpos[:, None], seen)
    found = [fault for fault in find_faults(take) if "slips by" in fault.why]
    assert [fault.of for fault in found] == ["the right glove"] * (shift > 0.0)
    assert all(abs(fault.first - half) <= RATE / 2 for fault in found)


@pytest.mark.parametrize("across", [(-0.2, 0.2), (0.2, -0.2)])  # 17 mm
def test_places_that_are_off_are_named(truth, across):
    designed, off = load_layout("dense19"), dict(zip(("BackHand1", "BackHand3"), across, strict=True))
    places = [
        dataclasses.replace(one, across=one.across + off.get(one.name, 0.0)) for one in designed.markers
    ]
    layout = MarkerLayout("drawn", tuple(places), designed.radius)
    take = track_capture(truth, glove=layout, labeler="dense19")
    told = [fault for fault in find_faults(take) if fault.of_labels]
    sides, names = map(set, zip(*(fault.of.split(":") for fault in told), strict=True))
    assert sides == set(take.sides) and names <= off.keys()
    assert all(" mm from where the layout has it" in fault.why for fault in told)
    assert vouch(take).listed > 0.95, "the labels are not vouched for"
    assert any(told[0].words in sentence for sentence in suspicions(take))
    assert summarize(take)[-2].startswith("labels: ")


@pytest.mark.parametrize("beyond", [0.0, 2.0])
def test_a_joint_at_its_limit_is_named(tracked, beyond):
    qpos = tracked.qpos.copy()
    joint = tracked.joint_names.index("ring_MCP_flexion")
    qpos[HALF:, 0, 7 + joint] = np.deg2rad(JOINTS[joint].low_deg - beyond)
    take = dataclasses.replace(tracked, qpos=qpos)
    assert hand_figures(take)[0].joints()[joint, -3] >= 0.49
    (fault,) = (one for one in find_faults(take) if "limit" in one.why)
    assert fault.of == "right:ring_MCP_flexion" and fault.first == HALF and not fault.of_labels


@pytest.fixture(scope="module", params=[FINGERTIPS, WITH_THUMB])
def mirror_like(request) -> Take:
    """A right hand in a glove that is like its own mirror image, as if tracked."""
    places = [MarkerPlace(bone, bone, along=0.7, around=0.0) for bone in request.param]
    back = ((0.3, 0.2), (0.3, -0.2), (0.7, 0.2), (0.7, -0.2))
    places += [
        MarkerPlace(f"Back{n}", "palm", along=x, around=0.0, across=y) for n, (x, y) in enumerate(back)
    ]
    layout = MarkerLayout("mirror8", tuple(places), load_layout("dense19").radius)
    take = simulate_take("single-hand", glove=layout, num_frames=FRAMES, seed=652).without_body()
    right = take.observed("right")
    return as_tracked(take.hands[:1], take.qpos[:, :1], right)


def as_tracked(hands, qpos: np.ndarray, markers: np.ndarray) -> Take:
    labels = np.where(np.isfinite(markers[..., 0]), np.arange(markers.shape[1]), -1)
    return Take.of_truth(hands, qpos, markers, labels, labels, rate=RATE, settings={"tracker": {}})


def test_a_side_that_motion_shows_is_sure(mirror_like):
    assert not [fault for fault in find_faults(mirror_like) if "may be" in fault.why]


@pytest.mark.parametrize("turned", [0, 1])
def test_hands_of_the_wrong_side_are_never_silent(mirror_like, turned):
    (hand,) = mirror_like.hands
    other = hand.with_side("left")
    seen = mirror_like.observed("right")[:, list(_mirror_orders(hand.attachment.points))[turned]]
    (fault,) = (
        one
        for one in find_faults(as_tracked([other], PoseSolver(other).solve(seen).qpos[:, None], seen))
        if one.of == "the left hand"
    )
    assert fault.why.endswith("it is the right hand") and fault.of_labels


def test_hands_of_two_users_are_no_fault(truth, tracked, monkeypatch):
    """Poses of each are judged by their own hands, not those of the last frames; labels are judged once."""
    larger = tuple(nominal_fit(hand.layout, "XL", hand.side) for hand in truth.hands)
    later = track_capture(
        dataclasses.replace(truth, points=enlarged(truth, larger)), hands=larger, labeler="dense19"
    )
    both = dataclasses.replace(
        tracked,
        **{name: np.concatenate([getattr(tracked, name)[:HALF], getattr(later, name)[HALF:]])
           for name in ("qpos", "status", "rms", "points", "ids", "labels", "confidence")},
        hands=larger,
        former=[FormerHands(HALF, tracked.hands, "M")],
    )  # fmt: skip
    judged, doubts_of = [], take_faults.doubts_of
    monkeypatch.setattr(take_faults, "doubts_of", lambda take: judged.append(take) or doubts_of(take))
    assert find_faults(both) == () and len(judged) == 1
    assert find_faults(tracked.cut(0, HALF)) == ()
    mixed = dataclasses.replace(both, former=())
    assert any("where the layout has it" in one.why or "slips" in one.why for one in find_faults(mixed))
    figures, wrong = hand_figures(both)[0], hand_figures(mixed)[0]
    assert np.nanmedian(figures.rms[:HALF]) < 0.5 * np.nanmedian(wrong.rms[:HALF])


def enlarged(truth, hands):
    """The points of a take, with each marker where other hands have it."""
    points = truth.points.copy()
    parts = [hand.markers(truth.qpos[:, number])[0] for number, hand in enumerate(hands)]
    frames, columns = np.nonzero((truth.labels >= 0) & (truth.labels < truth.hand_labels[-1].stop))
    points[frames, columns] = np.concatenate(parts, axis=1)[frames, truth.labels[frames, columns]]
    return points


def test_no_slip_is_told_of_hands_that_are_not_measured(truth):
    """The glove slips on hands that the take calls measured, or not."""
    take = track_capture(slipped(truth, "whole"), hands=truth.hands, labeler="dense19")

    def slips(**settings):
        known = dataclasses.replace(take, settings={**take.settings, **settings})
        return [one.words for one in find_faults(known) if "slips" in one.why]

    assert slips(size="auto", user="auto, 180 x 80 mm") == slips(size="M", user="M") != []
    assert slips(size="auto", user="M") == []
    assert slips(size="auto", user="auto, 180 x 80 mm", size_state="being measured") == []
    followed = dataclasses.replace(take, former=[FormerHands(FRAMES - 10, take.hands, "auto, 180 x 80 mm")])
    some = followed.marker_offsets("right", np.arange(5))  # of one of the hands alone
    np.testing.assert_array_equal(some, take.marker_offsets("right", np.arange(5)))
    assert [one for one in find_faults(followed) if "slips" in one.why] == [], "another user followed"
