"""A sweep whose process is killed, moved or extended ends with the same table."""

from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from handsim.errors import HandSimWarning
from handsim.files.json_files import load_json, save_json
from track.evaluation.sweep.cells import cells_of, steps_of
from track.evaluation.sweep.results import PAGE, TABLE, write_results
from track.evaluation.sweep.running import run_sweep
from track.evaluation.sweep.steps import LABELERS, MEASURED, SETS
from track.evaluation.sweep.sweep_file import Sweep, SweepError, load_sweep

pytestmark = pytest.mark.xdist_group("sweep")  # what they share is made once
COMMAND = (sys.executable, "-c", "from handsim.cli.main import main; raise SystemExit(main())", "sweep")


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / TABLE).open(newline="") as file:
        return list(csv.DictReader(file))


def test_every_cell_has_its_figures(finished):
    rows = rows_of(finished)
    assert [(row["train.rig_share"], row["seed"], row["person"]) for row in rows] == [
        ("0", "0", "3"),
        ("1", "0", "3"),
    ]
    for row in rows:
        assert row["glove"] == "sparse13" and row["error"] == ""
        assert 0.5 < float(row["markers_seen"]) <= 1.0
        assert 0.0 <= float(row["slot_accuracy"]) < 1.0 and 0.0 <= float(row["frames_right"]) < 1.0
        assert (finished / LABELERS / row["labeler"] / "labeler.safetensors").is_file()
    assert len({row["labeler"] for row in rows}) == 2
    assert len(list((finished / SETS).iterdir())) == 1
    assert "slots right [%]" in (finished / PAGE).read_text()


def test_killed_while_it_trains_it_ends_with_the_same_table(finished, write_sweep, tmp_path):
    file, out = write_sweep(tmp_path / "sweep.toml"), tmp_path / "out"
    command = [*COMMAND, str(file), "--out", str(out), "--workers", "1"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    until = time.monotonic() + 120
    while not list(out.glob(f"{LABELERS}/*/train.json")) and time.monotonic() < until:
        assert process.poll() is None
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (out / TABLE).exists()
    subprocess.run(command, check=True, capture_output=True)
    assert (out / TABLE).read_bytes() == (finished / TABLE).read_bytes()
    assert (out / PAGE).read_bytes() == (finished / PAGE).read_bytes()


def test_another_seed_adds_its_cells_alone(finished, write_sweep, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    done = []
    rows = run_sweep(
        load_sweep(write_sweep(tmp_path / "sweep.toml", "0, 1")),
        out,
        workers=1,
        progress=lambda *step: done.append(step),
    )
    assert [step for step in done if step[0] != "training sets"] == [
        ("labelers", 3, 4),
        ("labelers", 4, 4),
        ("captures", 3, 4),
        ("captures", 4, 4),
    ]
    assert all(path.stat().st_mtime_ns == then for path, then in before.items())
    write_results(rows, out)
    old, new = rows_of(finished), rows_of(out)
    assert [row for row in new if row["seed"] == "0"] == old
    assert len(new) == 4 and new[0] != new[1]


def test_a_cell_that_fails_is_told_and_tried_again(tmp_path):
    sweep = Sweep(people=(1,), settings={"simulate": {"num_frames": 20}})
    (step,) = steps_of(cells_of(sweep))[2]
    (tmp_path / "out" / MEASURED).mkdir(parents=True)
    save_json(tmp_path / "out" / "sweep.json", {"sweep": 1})
    path = tmp_path / "out" / MEASURED / f"{step.name}.json"
    save_json(path, {"handsim": "0", "error": "none of the people can"})
    (row,) = run_sweep(sweep, tmp_path / "out", workers=1)
    assert row.error == "" and row.figures["slot_accuracy"] > 0.9
    assert "error" not in load_json(path)


def test_figures_of_another_version_are_told(tmp_path):
    sweep, out = Sweep(settings={"simulate": {"num_frames": 20}}), tmp_path
    (step,) = steps_of(cells_of(sweep))[2]
    save_json(out / "sweep.json", {"sweep": 1})
    (out / MEASURED).mkdir()
    save_json(out / MEASURED / f"{step.name}.json", {"handsim": "0.0.1", "figures": {"slot_accuracy": 0.5}})
    with pytest.warns(HandSimWarning, match=r"figures that handsim 0\.0\.1 measured"):
        (row,) = run_sweep(sweep, out, workers=1)
    assert row.figures == {"slot_accuracy": 0.5}


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("x")
    with pytest.raises(SweepError, match="is not empty and holds no sweep"):
        run_sweep(Sweep(), tmp_path)
