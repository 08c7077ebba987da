"""The page on a take and its tables, against the numbers of the take."""

from __future__ import annotations

import csv
import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from gloves import Take
from gloves.takes.take import COASTING, LOST, STATUSES, TRACKED
from handsim.hand.shape import JOINT_NAMES, JOINTS
from track import track_capture
from track.takes.take_figures import hand_figures
from track.takes.take_page import decimated, shaded, write_take_page
from track.takes.take_tables import table_paths
from train import simulate_take

FRAMES = 60


@pytest.fixture(scope="module")
def truth() -> Take:
    return simulate_take(kind="single-hand", num_frames=FRAMES)


@pytest.fixture(scope="module")
def take(truth) -> Take:
    """A tracked take; its first hand coasts in two frames and is lost in the eight after them."""
    tracked = track_capture(truth, hands=truth.hands, labeler="dense19")
    status, qpos, rms = tracked.status.copy(), tracked.qpos.copy(), tracked.rms.copy()
    labels = tracked.labels.copy()
    status[20:22, 0], status[22:30, 0], qpos[22:30, 0], rms[22:30, 0] = COASTING, LOST, np.nan, np.nan
    first = range(tracked.hands[0].layout.num_markers)
    labels[22:30] = np.where(np.isin(labels[22:30], first), -1, labels[22:30])
    settings = {**tracked.settings, "user": "auto, 180 x 80 mm", "capture": "<b>.c3d"}
    return dataclasses.replace(tracked, status=status, qpos=qpos, rms=rms, labels=labels, settings=settings)


def written(folder: Path, take: Take, source: str = "my take.npz") -> tuple[str, list[list[dict[str, str]]]]:
    """The page, and the rows of its tables."""
    paths = write_take_page(folder / "page.html", take, source=source)
    assert sorted(folder.iterdir()) == sorted(paths)
    tables = [list(csv.DictReader(path.open(encoding="utf-8", newline=""))) for path in paths[1:]]
    return paths[0].read_text(encoding="utf-8"), tables


@pytest.fixture(scope="module")
def report(take, tmp_path_factory):
    """The page on the take and its tables, written once."""
    return written(tmp_path_factory.mktemp("report"), take)


def numbers(rows: list[dict[str, str]], column: str) -> np.ndarray:
    return np.array([float(row[column] or "nan") for row in rows])


def test_the_table_of_frames_has_the_numbers_of_the_take(take, report):
    _, (frames, *_) = report
    assert len(frames) == FRAMES * len(take.hands)
    for number, side in enumerate(take.sides):
        rows = [row for row in frames if row["hand"] == side]
        assert [int(row["frame"]) for row in rows] == list(range(FRAMES))
        np.testing.assert_allclose(numbers(rows, "time_s"), take.times, atol=1e-8)
        assert [row["status"] for row in rows] == [STATUSES[one] for one in take.status[:, number]]
        angles = np.column_stack([numbers(rows, f"{joint}_deg") for joint in JOINT_NAMES])
        np.testing.assert_allclose(angles, np.rad2deg(take.qpos[:, number, 7:]), rtol=1e-5, atol=1e-5)
        seen = np.isfinite(take.observed(side)[..., 0]).sum(axis=1)
        np.testing.assert_array_equal(numbers(rows, "markers_seen"), seen)
    assert np.isnan(angles).sum() == 0 and frames[2 * 25]["thumb_IP_flexion_deg"] == ""


def test_the_range_of_motion_is_that_of_the_fitted_poses(take, report):
    page, (_, joints, *_) = report
    fitted = np.r_[0:20, 30:FRAMES]  # neither coasting nor lost
    for number, side in enumerate(take.sides):
        rows = [row for row in joints if row["hand"] == side]
        assert [row["joint"] for row in rows] == list(JOINT_NAMES)
        degrees = np.rad2deg(take.qpos[fitted if number == 0 else slice(None), number, 7:])
        expected = {
            "least": degrees.min(axis=0),
            "5th": np.percentile(degrees, 5.0, axis=0),
            "median": np.median(degrees, axis=0),
            "95th": np.percentile(degrees, 95.0, axis=0),
            "largest": degrees.max(axis=0),
            "model_low": np.array([joint.low_deg for joint in JOINTS]),
            "model_high": np.array([joint.high_deg for joint in JOINTS]),
        }
        for name, values in expected.items():
            np.testing.assert_allclose(numbers(rows, f"{name}_deg"), values, rtol=1e-5, atol=1e-5)
        low, high = expected["model_low"] + 0.5, expected["model_high"] - 0.5
        shares = ((degrees < low) | (degrees > high)).mean(axis=0)
        np.testing.assert_allclose(numbers(rows, "at_limits_share"), shares, rtol=1e-5)
        tip = take.hands[number].layout.names.index("IndexTip")
        seen = np.isfinite(take.observed(side)[:, tip, 0]) & (take.status[:, number] > COASTING)
        (dip,) = (row for row in rows if row["joint"] == "index_DIP_flexion")
        assert float(dip["measured_share"]) == pytest.approx(seen.mean(), rel=1e-5)
        longest = max(map(len, re.findall("0+", "".join("01"[int(one)] for one in seen))), default=0)
        assert float(dip["longest_gap_s"]) == pytest.approx(longest / take.rate, rel=1e-5)
    assert f"<td>{np.rad2deg(take.qpos[fitted, 0, 10].max()):.1f}</td>" in page
    assert numbers(joints, "longest_gap_s")[:20].min() == pytest.approx(10 / take.rate, rel=1e-5)
    assert "50 frames have a fitted" in page and "<td>-25 to 95</td>" in page


def test_markers_have_their_gaps_and_residuals(take, report):
    _, (_, _, markers, *_) = report
    for number, (hand, side) in enumerate(zip(take.hands, take.sides, strict=True)):
        rows = [row for row in markers if row["hand"] == side]
        assert [row["marker"] for row in rows] == list(hand.layout.names)
        observed = take.observed(side)
        seen = np.isfinite(observed[..., 0])
        np.testing.assert_allclose(numbers(rows, "seen_share"), seen.mean(axis=0), rtol=1e-5)
        there = take.status[:, number] != LOST
        off = 1e3 * np.linalg.norm(observed[there] - hand.markers(take.qpos[there, number])[0], axis=2)
        np.testing.assert_allclose(numbers(rows, "residual_median_mm"), np.nanmedian(off, axis=0), rtol=1e-5)
        high = np.nanpercentile(off, 95.0, axis=0)
        np.testing.assert_allclose(numbers(rows, "residual_95th_mm"), high, rtol=1e-5)
        lengths = [
            [len(run) for run in re.findall("0+", "".join("01"[int(one)] for one in column).strip("0"))]
            for column in seen.T
        ]
        assert numbers(rows, "gaps").tolist() == [len(runs) for runs in lengths]
        longest = numbers(rows, "longest_gap_frames")
        assert longest.tolist() == [max(runs, default=0) for runs in lengths]
        np.testing.assert_allclose(numbers(rows, "longest_gap_s"), longest / take.rate, rtol=1e-5)
        if number == 0:
            assert (longest >= 8).all(), "it was lost for eight frames"


def test_the_page_is_whole_and_leads_to_the_frames_to_look_at(take, report):
    page, (_, joints, _, doubts, *_) = report
    side = take.sides[0]
    (doubt,) = doubts
    assert (doubt["first_frame"], doubt["last_frame"]) == ("22", "29"), "the frames in which it was lost"
    assert doubt["of"] == side and doubt["why"].startswith("lost, ") and 22 <= int(doubt["frame"]) <= 29
    worst = take.times[int(doubt["frame"])]
    assert (
        f"<td>22 to 29</td><td>{take.times[22]:.3f}</td><td>{take.times[29]:.3f}</td><td>{side}</td>" in page
    )
    assert (
        f"<td>frame {doubt['frame']}, {worst:.3f} s</td><td>handsim view &#x27;my take.npz&#x27; --time "
        in page
    )
    assert "1 rows; 13.3 % of the frames have doubtful labels." in page
    assert "After a look at the first 1, 99" in page
    assert "Capture &lt;b&gt;.c3d, glove dense19, hands right and left" in page
    assert "measured size 180 x 80 mm; 60 frames, 0.5 s at 120 Hz" in page
    assert "are not calibrated" in page and "handsim calibrate minute.c3d" in page
    assert not re.search(r"(src|href)=\"(?!data:)", page) and "<script" not in page
    assert "prefers-color-scheme: dark" in page and "@media print" in page
    assert page.count("<img ") == 3 * len(take.hands)
    budget = take.settings["budget"]["right"][0]
    # Of hands that are not calibrated three parts change: an angle in a frame, its mean, peak and range.
    factors = [(1.39, 0.25, 0.3), (0.73, 0.22, 0.25), (1.56, 0.27, 0.5), (2.01, 0.31, 0.5)]
    error, *others = (np.linalg.norm(np.array(factor) * budget[2:]) for factor in factors)
    cells = [np.linalg.norm(budget), *budget, error, *(2.772 * one for one in (error, *others))]
    assert "".join(f"<td>{cell:.1f}</td>" for cell in cells) in page
    (thumb, *_) = (row for row in joints if row["hand"] == "right")
    cutoff = take.settings["filter"]["right"][0]
    for column, value in (("sem_deg", error), ("mdd_range_deg", 2.772 * others[-1]), ("cutoff_hz", cutoff)):
        assert float(thumb[column]) == pytest.approx(value, rel=1e-3)


def test_the_page_ends_with_the_methods_and_what_the_take_was_made_of(take, report, tmp_path):
    page, tables = report
    text = page[page.index("<h2>Methods</h2>") :]
    radius, cutoffs = take.hands[0].layout.radius, np.array(take.settings["filter"]["right"])
    assert f"recorded at 120 Hz by N cameras (SYSTEM) with 19 markers of {2e3 * radius:.1f} mm" in text
    assert f"handsim {take.settings['handsim']} labeled the markers" in text
    assert f"(median residual {1e3 * np.nanmedian(take.rms):.1f} mm)" in text
    assert "measured by their markers" in text and "zero in the flat hand of the model" in text
    both = np.append(cutoffs, take.settings["filter"]["left"])
    assert f"(-6 dB at {both.min():.1f} to {both.max():.1f} Hz, by joint)" in text
    assert "doubtful (13.3 %) were LEFT OUT" in text
    made = f"handsim {take.settings['handsim']}, {take.settings['date']}"
    assert f"Made of: {made}" in text
    for rows in tables[:5]:
        assert rows[0]["made of"].startswith(made) and not any(row["made of"] for row in rows[1:])
    assert all(row["made of"].startswith(made) for row in tables[5])
    page, _ = written(tmp_path, dataclasses.replace(take, settings={**take.settings, "filter": {}}))
    assert "Each frame was solved by itself, without a filter." in page


def test_a_gap_shows_in_the_angles(take):
    first, second = hand_figures(take)
    assert np.isnan(first.angles[22:30]).all() and np.isfinite(first.angles[20:22]).all()
    assert np.flatnonzero(~first.fitted).tolist() == list(range(20, 30)) and second.fitted.all()


def test_whose_hands_they_are(take, tmp_path, monkeypatch):
    monkeypatch.setattr("track.takes.take_page.picture", lambda *drawn, **options: "data:,")
    for user, words in {
        "S": "mean hands of size S, in a glove as designed",
        "user.json": "a user&#x27;s, as calibrated or given: user.json.",
        "": "the take does not say whether they are calibrated",
    }.items():
        page, _ = written(tmp_path, dataclasses.replace(take, settings={**take.settings, "user": user}))
        assert words.replace("user&#x27;s", "user's") in page
        assert user != "user.json" or page.count(user) == 1, "the notes on a user are told once"
        assert ("handsim calibrate" in page) == (user == "S")


def test_a_truth_has_no_doubt_and_residuals_of_its_noise(truth, tmp_path):
    page, (frames, _, _, doubts, *_) = written(tmp_path, truth)
    assert doubts == [] and "No label is probably wrong or missing" in page and "nothing to calibrate" in page
    for side, hand in zip(truth.sides, truth.hands, strict=True):
        off = truth.observed(side) - hand.markers(truth.qpos[:, truth.hand_index(side)])[0]
        rms = 1e3 * np.sqrt(np.nanmean(np.square(off).sum(axis=2), axis=1))
        rows = [row for row in frames if row["hand"] == side]
        np.testing.assert_allclose(numbers(rows, "residual_rms_mm"), rms, rtol=1e-5)


def test_hands_that_are_not_there_and_points_that_are_not(take, truth, tmp_path):
    lost = dataclasses.replace(
        take,
        status=np.full_like(take.status, LOST),
        qpos=np.full_like(take.qpos, np.nan),
        rms=np.full_like(take.rms, np.nan),
        labels=np.full_like(take.labels, -1),
    )
    page, (frames, joints, markers, doubts, *_) = written(tmp_path, lost)
    assert page.count("It has no pose in any frame.") == 2 and "not there" in page and "<img" not in page
    assert {row["status"] for row in frames} == {"lost"} and doubts == []
    assert np.isnan(numbers(joints, "median_deg")).all() and (numbers(markers, "gaps") == 0).all()
    unseen = Take.of_poses(truth.hands, truth.qpos, rate=truth.rate)
    page, (frames, *_) = written(tmp_path, unseen)
    assert page.count("None of its markers has a point.") == 2
    assert (numbers(frames, "markers_seen") == 0).all() and frames[0]["status"] == STATUSES[TRACKED]
    one = truth.cut(0, 1)
    assert len(written(tmp_path, one)[1][0]) == 2


def test_tables_have_names_beside_the_page():
    assert [path.name for path in table_paths(Path("a.b.html"))] == [
        "a.b.frames.csv", "a.b.joints.csv", "a.b.markers.csv", "a.b.doubts.csv", "a.b.reach.csv",
        "a.b.angles.csv"
    ]  # fmt: skip


def test_a_short_curve_is_drawn_as_it_is(rng):
    times, values = np.arange(1500) / 120.0, rng.normal(size=1500)
    drawn = decimated(times, values)
    np.testing.assert_array_equal(drawn[0], times)
    np.testing.assert_array_equal(drawn[1], values)


def test_a_long_curve_keeps_its_peaks_and_its_gaps(rng):
    times, values = np.arange(10_000) / 120.0, rng.normal(size=10_000)
    values[4321], values[8765], values[5000:5400] = 50.0, -60.0, np.nan
    drawn_times, drawn = decimated(times, values)
    assert len(drawn) <= 1500 and (np.diff(drawn_times) > 0.0).all()
    assert np.nanmax(drawn) == 50.0 and np.nanmin(drawn) == -60.0
    for peak, frame in ((50.0, 4321), (-60.0, 8765)):
        (place,) = drawn_times[drawn == peak]
        assert place == pytest.approx(times[frame], abs=14 / 120.0)
    gap = drawn_times[np.isnan(drawn)]
    assert times[5000] <= gap[0] < times[5030] and times[5370] < gap[-1] <= times[5400]


@pytest.mark.parametrize("num_frames", [30, 10_000])
def test_what_is_shaded_is_what_is_flagged(num_frames):
    times, flags = np.arange(num_frames) / 100.0, np.zeros(num_frames, dtype=bool)
    flags[5], flags[-10:] = True, True
    first, last = shaded(times, flags)
    width = 1 if num_frames == 30 else 14
    assert first[0] <= times[5] < first[0] + first[1] <= times[5 + width] + 1e-9
    assert times[-10 - width] < last[0] <= times[-10] and sum(last) == pytest.approx(num_frames / 100.0)
    assert shaded(times, np.zeros(num_frames, dtype=bool)) == []
    assert shaded(times[:1], np.ones(1, dtype=bool)) == [(0.0, 1.0)], "a take of one frame"
