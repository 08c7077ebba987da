"""A benchmark has the same bytes whenever it is made, its truth apart, and its parts agree."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.public.answers import BenchmarkError
from benchmarks.public.difficulties import BENCHMARK_KINDS, DIFFICULTIES, SIZES, Plan, PlannedCapture
from benchmarks.public.making import make_benchmark, make_capture, simulate_capture
from benchmarks.public.manifest import (
    MANIFEST,
    capture_path,
    differing_files,
    label_names,
    load_benchmark,
    published_files,
    truth_path,
    user_path,
)
from gloves import load_layout
from handsim import load_rig
from handsim.files.inputs import checksum
from handsim.hand.model import hand_keypoints
from track.kinematics.pose_solver import PoseSolver


def test_made_twice_it_has_the_same_bytes(plan, benchmark, tmp_path):
    again = make_benchmark(plan, tmp_path / "again", workers=1)
    assert again.files == benchmark.files
    assert (tmp_path / "again" / MANIFEST).read_bytes() == (benchmark.folder / MANIFEST).read_bytes()
    assert load_benchmark(tmp_path / "again").captures == benchmark.captures


def test_a_stopped_one_is_finished_with_the_same_bytes(plan, benchmark, tmp_path):
    out = tmp_path / "stopped"
    shutil.copytree(benchmark.folder, out)
    (out / MANIFEST).unlink()
    name = plan.captures[1].name
    (out / truth_path(name)).unlink()
    (out / f"captures/.{name}.tmp-99999999.trc").write_text("what a killed process left")
    with pytest.raises(BenchmarkError, match="holds no finished benchmark"):
        load_benchmark(out)
    done = []
    made = make_benchmark(plan, out, workers=1, progress=lambda *frames: done.append(frames))
    assert made.files == benchmark.files
    assert done == [(120, 120)]
    assert not list(out.glob("**/.*"))


def test_every_file_has_its_checksum_and_no_other_is_there(benchmark):
    there = {
        path.relative_to(benchmark.folder).as_posix()
        for path in benchmark.folder.rglob("*")
        if path.is_file()
    }
    assert there == {*benchmark.files, MANIFEST}
    for file, digest in benchmark.files.items():
        assert checksum(benchmark.folder / file) == digest


def test_the_truth_is_not_among_the_captures(plan, benchmark):
    captures = benchmark.folder / "captures"
    for path in captures.iterdir():
        assert path.suffix in (".trc", ".json", ".toml", ".csv")
        if path.suffix == ".trc":
            text = path.read_text()
            assert not any(name.split(":")[1] in text for name in label_names())
    for one in plan.captures:
        capture, truth = benchmark.capture(one.name), benchmark.truth(one.name)
        assert set(capture.names) == {f"Unlabeled{number + 1}" for number in range(len(capture.names))}
        assert not (np.diff(truth.labels[0][truth.labels[0] >= 0]) > 0).all(), (
            "columns are in order of labels"
        )


def test_points_labels_users_and_joints_agree(plan, benchmark):
    """Poses solved from the labeled points with the users' files are those of the truth."""
    for one in plan.captures:
        capture, truth = benchmark.capture(one.name), benchmark.truth(one.name)
        positions = capture.positions
        assert truth.labels.shape == positions.shape[:2]
        assert not (truth.labels[np.isnan(positions[..., 0])] >= 0).any()
        assert np.isfinite(positions[..., 0]).any(axis=0).all(), "a column without points"
        there = positions[np.isfinite(positions)]
        np.testing.assert_allclose(1e5 * there, np.rint(1e5 * there), atol=1e-6)
        for side, hand in enumerate(benchmark.user(one.name)):
            targets = np.full((capture.num_frames, 19, 3), np.nan)
            frames, columns = np.nonzero((truth.labels >= 19 * side) & (truth.labels < 19 * side + 19))
            targets[frames, truth.labels[frames, columns] - 19 * side] = positions[frames, columns]
            fit = PoseSolver(hand).solve(targets[:1])
            joints = hand_keypoints(hand.model, fit.qpos)[0]
            apart = np.linalg.norm(joints - truth.joints[0, side], axis=-1)
            assert np.median(apart) < 0.001
            assert np.median(np.abs(fit.qpos[0, 7:] - truth.angles[0, side])) < 0.05


def test_what_captures_share_can_be_read(benchmark):
    captures = benchmark.folder / "captures"
    assert load_layout(captures / "glove.toml") == load_layout("dense19")
    for name in ("figure5", "eight"):
        ours, shipped = load_rig(captures / f"rig-{name}.toml"), load_rig(name)
        np.testing.assert_allclose(ours.T_world_camera, shipped.T_world_camera, atol=1e-9)
        assert ours == shipped
    card = (benchmark.folder / "README.md").read_text()
    assert card.startswith("# handsim-benchmark-1, ") and "120 frames at 120 Hz" in card
    assert "Attribution 4.0 International" in (benchmark.folder / "LICENSE.txt").read_text()
    table = [line.split(",") for line in (captures / "captures.csv").read_text().splitlines()]
    for row, one in zip(table[1:], benchmark.captures, strict=True):
        assert row[:5] == [one.name, one.kind, one.difficulty, row[3], str(one.num_frames)]
        length, breadth = (getattr(benchmark.user(one.name)[0].shape, name) for name in ("length", "breadth"))
        assert (float(row[5]), float(row[6])) == pytest.approx((1e3 * length, 1e3 * breadth), abs=0.051)


def test_difficulties_share_people_and_motion_and_differ_in_what_is_seen():
    plans = {name: PlannedCapture("single-hand", name, 1, 60) for name in DIFFICULTIES}
    takes = {name: simulate_capture(plan) for name, plan in plans.items()}
    easy, medium, hard = (take.moving_hands()[0] for take in takes.values())
    np.testing.assert_array_equal(easy.qpos, medium.qpos)
    assert easy.shape.length == hard.shape.length
    speeds = [np.abs(np.diff(hand.qpos[:, 7:], axis=0)).max() for hand in (easy, hard)]
    assert speeds[1] > 1.5 * speeds[0]
    ghosts = [(np.isfinite(take.points[..., 0]) & (take.labels < 0)).sum() for take in takes.values()]
    assert ghosts[0] == 0 < ghosts[1] < ghosts[2]
    seen = [take.markers_present().mean() for take in takes.values()]
    assert seen[0] >= seen[1] > seen[2]
    other = simulate_capture(PlannedCapture("single-hand", "easy", 2, 24))
    assert other.hands[0].shape.length != easy.shape.length


def test_the_objects_own_markers_are_left_out(plan, benchmark):
    take = simulate_capture(plan.captures[2])
    assert take.bodies == () and take.labels.max() < 38


def test_a_folder_with_something_else_is_refused(plan, benchmark, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(BenchmarkError, match="is not empty and holds no benchmark"):
        make_benchmark(plan, tmp_path, workers=1)
    other = Plan("tiny", people=1, num_frames=31, kinds=plan.kinds, difficulties=plan.difficulties)
    with pytest.raises(BenchmarkError, match="num_frames: 30 there, 31 here"):
        make_benchmark(other, benchmark.folder, workers=1)


def test_the_published_sizes_have_a_checksum_for_every_file(plan):
    published = published_files()
    assert set(published) == set(SIZES)
    for size, plan_of_size in SIZES.items():
        names = {one.name for one in plan_of_size.captures}
        assert len(names) == len(BENCHMARK_KINDS) * len(DIFFICULTIES) * plan_of_size.people
        wanted = {path(name) for name in names for path in (capture_path, user_path, truth_path)}
        assert wanted <= set(published[size])
        assert all(len(digest) == 64 for digest in published[size].values())


def test_one_that_was_not_published_is_not_compared(benchmark):
    assert differing_files(benchmark) is None


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 7])
def test_captures_are_the_published_ones(number, tmp_path):
    """A change of the simulation that changes them needs another version of the benchmark."""
    make_capture(SIZES["small"], tmp_path, number)
    name = SIZES["small"].captures[number].name
    for path in (capture_path(name), user_path(name), truth_path(name)):
        assert checksum(tmp_path / path) == published_files()["small"][path], Path(path).name
