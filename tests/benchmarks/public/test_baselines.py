"""Our trackers as participants: what they write is scored like any other results."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.command_line import run
from benchmarks.public.__main__ import COMMANDS
from benchmarks.public.baselines import ABOUT, TRACKERS, run_baseline
from benchmarks.public.scoring import score_results
from handsim.errors import FileError


def command(words):
    return run("benchmarks.public", "", COMMANDS, words)


@pytest.mark.parametrize("tracker", TRACKERS)
def test_a_baseline_writes_results_that_can_be_scored(tracker, benchmark, tmp_path):
    done = []
    run_baseline(benchmark, tracker, tmp_path / "results", users="calibrated", progress=done.append)
    assert done == [30] * 4
    score = score_results(benchmark, tmp_path / "results")
    easy = score.mean(difficulty="easy")
    assert easy["frame_accuracy"] > 0.9 and easy["posed"] > 0.9
    assert easy["mpjpe"] < 0.002
    assert json.loads((tmp_path / "results" / ABOUT).read_text())["tracker"] == tracker


@pytest.mark.slow
def test_the_size_of_the_hands_is_measured(benchmark, tmp_path, capsys):
    out = tmp_path / "results"
    assert command(["run", str(benchmark.folder), "--out", str(out)]) == 0
    assert "results of 4 captures" in capsys.readouterr().out
    joints = score_results(benchmark, out).mean(difficulty="easy")
    assert joints["frame_accuracy"] > 0.9
    assert 0.0005 < joints["mpjpe"] < 0.01, "measured hands are not the true ones"
    before = {path.name: path.stat().st_mtime_ns for path in out.glob("*.npz")}
    assert command(["run", str(benchmark.folder), "--out", str(out)]) == 0
    assert {path.name: path.stat().st_mtime_ns for path in out.glob("*.npz")} == before
    with pytest.raises(FileError, match="begun with other settings"):
        run_baseline(benchmark, "paper", out)


def test_results_do_not_go_into_the_benchmark(benchmark, capsys):
    out = benchmark.folder / "captures"
    assert command(["run", str(benchmark.folder), "--out", str(out)]) == 1
    assert "is the input" in capsys.readouterr().err
    assert not (out / ABOUT).exists()


def test_what_is_no_benchmark_is_told(tmp_path, capsys):
    (tmp_path / "results").mkdir()
    for words in (["score", str(tmp_path), str(tmp_path / "results")], ["run", str(tmp_path), "--out", "x"]):
        assert command(words) == 1
        assert "holds no finished benchmark, expected a folder from python -m benchmarks.public make" in (
            capsys.readouterr().err
        )
    assert not np.any([path.suffix == ".npz" for path in tmp_path.rglob("*")])
