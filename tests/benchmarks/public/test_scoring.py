"""Scores: the truth is perfect, what is shuffled scores what is counted by hand, what is missing is zero."""

from __future__ import annotations

import dataclasses
import json
import shutil
import warnings

import numpy as np
import pytest

from benchmarks.public.__main__ import COMMANDS
from benchmarks.public.answers import Answers, BenchmarkError, save_answers
from benchmarks.public.manifest import MANIFEST, load_benchmark, truth_path
from benchmarks.public.scoring import score_results
from benchmarks.record import run_commands
from handsim import HandSimWarning
from handsim.hand.model import KEYPOINT_NAMES

PERFECT = ("frame_accuracy", "slot_accuracy", "point_accuracy", "macro_f1", "posed", "within_5mm")


def command(words):
    return run_commands("benchmarks.public", "", COMMANDS, words)


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "180")


def write(benchmark, out, change=lambda name, truth: truth):
    """Results that are the truth, changed."""
    out.mkdir(exist_ok=True)
    for one in benchmark.captures:
        save_answers(out / f"{one.name}.npz", change(one.name, benchmark.truth(one.name)))
    return out


def test_a_perfect_result_has_a_perfect_score(benchmark, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        score = score_results(benchmark, write(benchmark, tmp_path / "results"))
    for one in score.captures:
        assert {name: one.figures[name] for name in PERFECT} == dict.fromkeys(PERFECT, 1.0)
        assert one.figures["mpjpe"] == one.figures["angle_error"] == 0.0
        assert (one.joint_errors == 0.0).all() and not one.missing


def test_shuffled_labels_score_what_is_counted_by_hand(benchmark, tmp_path, rng):
    def shuffled(name, truth):
        labels = truth.labels.copy()
        present = np.isfinite(benchmark.capture(name).positions[..., 0])
        for frame in rng.choice(len(labels), 10, replace=False):
            some = rng.choice(np.flatnonzero(present[frame]), 12, replace=False)
            labels[frame, some] = labels[frame, rng.permutation(some)]
        return dataclasses.replace(truth, labels=labels)

    results = write(benchmark, tmp_path / "results", shuffled)
    score = score_results(benchmark, results)
    means = {"slot_accuracy": [], "point_accuracy": [], "frame_accuracy": []}
    for one in score.captures:
        given = np.load(results / f"{one.capture.name}.npz")["labels"]
        true = np.load(benchmark.folder / truth_path(one.capture.name))["labels"]
        present = np.isfinite(benchmark.capture(one.capture.name).positions[..., 0])
        slots, points, frames = 0, 0, 0
        for frame in range(30):
            holds = [
                {label: column for column, label in enumerate(labels[frame].tolist()) if label >= 0}
                for labels in (given, true)
            ]
            right = [holds[0].get(label) == holds[1].get(label) for label in range(38)]
            same = [given[frame, column] == true[frame, column] for column in np.flatnonzero(present[frame])]
            slots, points, frames = (
                slots + sum(right),
                points + sum(same),
                frames + (all(right) and all(same)),
            )
        counted = (slots / (30 * 38), points / present.sum(), frames / 30)
        for name, share in zip(means, counted, strict=True):
            assert one.figures[name] == pytest.approx(share)
            means[name].append(share)
        assert one.figures["frame_accuracy"] < 1.0
    for name, shares in means.items():
        assert score.mean()[name] == pytest.approx(np.mean(shares))


def test_joints_are_counted_where_they_are_given(benchmark, tmp_path):
    def moved(name, truth):
        joints = truth.joints + np.array([0.0, 0.003, 0.0])
        joints[:, 0, 5] += [0.0, 0.0, 0.010]
        joints[:15, 1] = np.nan
        return dataclasses.replace(truth, joints=joints, angles=truth.angles + 0.1)

    score = score_results(benchmark, write(benchmark, tmp_path / "results", moved))
    far = np.hypot(0.003, 0.010)
    for one in score.captures:
        assert one.figures["posed"] == pytest.approx(0.75)
        assert one.figures["within_5mm"] == pytest.approx(0.75 - 1 / 42)
        assert one.figures["mpjpe"] == pytest.approx((915 * 0.003 + 30 * far) / 945, abs=1e-6)
        assert one.figures["angle_error"] == pytest.approx(0.1, abs=1e-6)
        expected = np.full(21, 0.003)
        expected[5] = (30 * far + 15 * 0.003) / 45
        np.testing.assert_allclose(one.joint_errors, expected, atol=1e-6)


def test_what_is_missing_is_told_and_counts_as_zero(benchmark, tmp_path):
    results = write(benchmark, tmp_path / "results")
    (results / "single-hand-easy-1.npz").unlink()
    (results / "single-hand-harder-1.npz").touch()
    with pytest.warns(HandSimWarning) as told:
        score = score_results(benchmark, results)
    assert [str(one.message).split(": ", 1)[1] for one in told] == [
        "no results of 1 capture, which count as zero: single-hand-easy-1",
        "not counted, because they are of no capture of this benchmark: single-hand-harder-1.npz",
    ]
    means = score.mean()
    assert means["frame_accuracy"] == means["slot_accuracy"] == means["within_5mm"] == 0.75
    assert means["macro_f1"] == pytest.approx(0.75) and means["mpjpe"] == 0.0
    assert score.mean(difficulty="easy")["point_accuracy"] == 0.5
    assert score.mean(kind="hand-controller")["point_accuracy"] == 1.0


def test_results_without_joints_have_labels_alone(benchmark, tmp_path):
    results = write(benchmark, tmp_path / "results", lambda name, truth: Answers(truth.labels))
    figures = score_results(benchmark, results).mean()
    assert figures["frame_accuracy"] == 1.0
    assert np.isnan([figures[name] for name in ("posed", "within_5mm", "mpjpe", "angle_error")]).all()
    save_answers(results / "single-hand-easy-1.npz", benchmark.truth("single-hand-easy-1"))
    figures = score_results(benchmark, results).mean()
    assert figures["posed"] == figures["within_5mm"] == 0.25


def test_the_command_prints_and_saves_the_score(benchmark, tmp_path, capsys):
    def changed(name, truth):
        labels = truth.labels.copy()
        labels[0][labels[0] == 7] = -1
        return dataclasses.replace(truth, labels=labels, joints=truth.joints + np.array([0.002, 0.0, 0.0]))

    results = write(benchmark, tmp_path / "mine", changed)
    file = tmp_path / "score.json"
    assert command(["score", str(benchmark.folder), str(results), "--json", str(file)]) == 0
    said = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in said.splitlines() if "│" in line]
    all_row = next(row for row in rows if row[0] == "all")
    assert all_row[1] == "96.67" and all_row[5:] == ["100.00", "2.00", "100.00", "0.00"]
    assert {row[0] for row in rows} >= {"easy", "hard", "single-hand", "hand-controller"}
    saved = json.loads(file.read_text())
    assert saved["benchmark"] == "handsim-benchmark-1" and saved["size"] == "tiny"
    assert saved["results"] == "mine" and saved["missing"] == []
    assert saved["all"]["frame_accuracy"] == pytest.approx(29 / 30)
    assert saved["all"]["mpjpe_mm"] == pytest.approx(2.0, abs=1e-3)
    assert list(saved["joint_errors_mm"]) == list(KEYPOINT_NAMES)
    assert set(saved["captures"]) == {one.name for one in benchmark.captures}


def test_damaged_files_are_told(benchmark, tmp_path, capsys):
    folder = tmp_path / "copy"
    shutil.copytree(benchmark.folder, folder)
    results = write(benchmark, tmp_path / "results")
    truth = folder / truth_path("hand-controller-easy-1")
    data = bytearray(truth.read_bytes())
    data[len(data) // 2] ^= 1
    truth.write_bytes(bytes(data))
    words = ["score", str(folder), str(results)]
    assert command(words) == 1
    assert f"{truth}: its checksum is not that of manifest.json" in capsys.readouterr().err
    truth.unlink()
    assert command(words) == 1
    assert f"{truth}: no such file" in capsys.readouterr().err
    manifest = json.loads((folder / MANIFEST).read_text())
    for change, sentence in (
        ({"benchmark": "handsim-benchmark-0"}, "of benchmark 'handsim-benchmark-0', expected"),
        ({"captures": []}, "a damaged manifest"),
        ({"captures": [{**manifest["captures"][0], "name": "../../etc"}]}, "a damaged manifest"),
        ({"files": None}, "a damaged manifest"),
    ):
        (folder / MANIFEST).write_text(json.dumps(manifest | change))
        with pytest.raises(BenchmarkError, match=sentence):
            load_benchmark(folder)


def test_a_score_is_not_written_over_results(benchmark, tmp_path, capsys):
    results = write(benchmark, tmp_path / "results")
    before = (results / "single-hand-easy-1.npz").read_bytes()
    file = results / "single-hand-easy-1.npz"
    assert command(["score", str(benchmark.folder), str(results), "--json", str(file)]) == 1
    assert "is the input" in capsys.readouterr().err
    assert file.read_bytes() == before


def test_what_is_no_benchmark_is_told(tmp_path, capsys):
    assert command(["score", str(tmp_path), str(tmp_path)]) == 1
    told = "holds no finished benchmark, expected a folder from python -m benchmarks.public make"
    assert told in capsys.readouterr().err
