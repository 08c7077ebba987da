"""Tables 5 and 7, and few cameras: the paper's rows beside those of all our trackers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.command_line import run
from benchmarks.paper import comparison, tracking_tables
from benchmarks.paper.comparison import (
    NEED_FIRST_LABELS,
    OURS,
    PAPERS_LOOP,
    USERS,
    compare_trackers,
    measure_with_body,
)
from benchmarks.paper.printed import CAMERAS, HAN, TABLE3, TABLE5, TABLE7
from benchmarks.paper.tracking_tables import TRACKING_TABLES, print_errors, print_trials, table5_figures
from benchmarks.paper.trials import FEWEST_FRAMES
from handsim.errors import ArgumentError
from train import load_labeler, simulate_take
from train.simulation.room import TWINS
from train.simulation.scenes import KINDS

pytestmark = pytest.mark.xdist_group("reproduce")  # what they share is made once
METHODS = (OURS, PAPERS_LOOP, *NEED_FIRST_LABELS)
WITH_BODY = "handsim, controller too"


def command(words):
    return run("benchmarks.paper", "", TRACKING_TABLES, words)


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")


@pytest.fixture(scope="module")
def measured():
    """The same captures, but short, and once for both tables."""
    return tracking_tables._measure(tracking_tables.TableConfig(num_frames=6))


@pytest.fixture
def quick(monkeypatch, measured):
    monkeypatch.setattr(tracking_tables, "_measure", lambda *args, **options: measured)


def rows(text: str) -> dict[tuple[str, str], list[list[str]]]:
    """Cells by method and hands, a list a table."""
    found: dict[tuple[str, str], list[list[str]]] = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.split("│")[1:-1]]
        if len(cells) > 2:
            found.setdefault((cells[0], cells[1]), []).append(cells[2:])
    return found


def test_the_papers_tables_agree_with_each_other():
    assert tuple(TABLE3) == KINDS
    for kind in KINDS:
        assert TABLE3[kind].frames == TWINS[kind].num_frames
        valid, right = TABLE7["calibrated"][kind]
        assert TABLE5[HAN][kind] == pytest.approx(valid * right, abs=0.01 if kind == "hand-pen" else 4e-4)
        assert (valid * right) > np.prod(TABLE7["uncalibrated"][kind])
    assert np.prod(CAMERAS) == pytest.approx(0.882, abs=5e-4)


@pytest.mark.slow
def test_table_5_has_a_row_a_tracker_and_kind_of_hands(capsys, quick, measured):
    assert command(["table5"]) == 0
    tables = rows(capsys.readouterr().out)
    assert tables["Alexanderson 2017", "calibrated"] == [["90.49", "29.62", "8.91", "52.21"]]
    assert tables["Han 2018", "calibrated"] == [["100.00", "93.63", "99.25", "98.26"]]
    for users in USERS:
        assert tables[WITH_BODY, users] == [["", "", "", "100.00"]], "the controller's labels count"
    kept = {name: value for name, (_, value) in table5_figures(measured[1]).items()}
    for method, key in zip(METHODS, ("", "loop_", "nearest_", "hungarian_"), strict=True):
        for users, who in (("calibrated", "true"), ("uncalibrated", "size")):
            shares, joints, angles, waits = tables[method, users]
            assert shares == [f"{share:.2f}" for share in kept[f"right_{key}{who}"]]
            errors = kept[f"errors_{key}{who}"]
            assert joints == ["" if np.isnan(joint) else f"{joint:.2f}" for joint, _ in errors]
            assert angles == ["" if np.isnan(angle) else f"{angle:.2f}" for _, angle in errors]
            assert waits == [""] * 6 and "loop_starts" not in kept, "the captures are too short for trials"
    assert kept["right_true"][0] == 100.0
    assert kept["errors_true"][0][0] < 0.5 < kept["errors_size"][0][0]


@pytest.mark.slow
def test_table_7_tells_hands_that_fit_and_right_ones_of_them(capsys, quick):
    assert command(["table7"]) == 0
    tables = rows(capsys.readouterr().out)
    assert tables[HAN, "uncalibrated"] == [
        ["98.27 / 95.62", "95.56 / 85.18", "99.29 / 77.12", "97.58 / 89.54"]
    ]
    assert tables[OURS, "calibrated"][0][0] == "100.00 / 100.00"
    assert len(tables) == 2 + 2 * len(METHODS)


@pytest.mark.slow
def test_few_cameras(capsys):
    assert command(["cameras", "--num-frames", "8"]) == 0
    said = capsys.readouterr().out
    take = simulate_take(kind="single-hand", num_frames=8, rig="six")
    missing = 100 * (1.0 - take.markers_present().mean())
    assert f"{missing:.2f} % of the markers missing" in said
    tables = rows(said)
    assert tables[HAN, "calibrated"] == [["95.55", "92.32", "88.21", "", ""]]
    assert set(tables) == {(HAN, "calibrated"), *((name, users) for name in METHODS for users in USERS)}


def test_trials_are_made_of_takes_that_are_long_enough(monkeypatch):
    monkeypatch.setattr(comparison, "USERS", {"calibrated": USERS["calibrated"]})
    take = simulate_take(kind="single-hand", num_frames=FEWEST_FRAMES).without_body()
    measured = compare_trackers({"single-hand": take}, load_labeler("dense19"), seed=0, trials=1)
    by_name = {one.method: one for one in measured}
    assert by_name[OURS].initialization[0] <= 3 and by_name[OURS].recovery[0] <= 3
    for name in NEED_FIRST_LABELS:
        assert not len(by_name[name].initialization), "they are told how it begins"
        assert np.isnan(by_name[name].recovery[0])
    ours = [by_name[OURS]]
    joints, _ = print_errors(ours)
    assert list(joints.columns[2].cells) == [f"{1e3 * ours[0].report.by_occlusion()[0, 0][1]:.2f}"]
    waits = print_trials([by_name[NEED_FIRST_LABELS[0]]])
    assert [next(iter(column.cells)) for column in waits.columns[2:]] == [
        "",
        "",
        "",
        "never",
        "never",
        "0.00",
    ]


@pytest.mark.slow
def test_a_body_that_is_followed_must_have_its_labels():
    labeler = load_labeler("dense19")
    take = simulate_take(kind="hand-controller", num_frames=20)
    first, second, *_ = measure_with_body("controller", take, labeler)
    assert (first.users, second.users) == tuple(USERS) and first.report.right.all()
    labels = take.labels.copy()
    labels[7][labels[7] == take.hand_labels[-1].stop + 1] = -1
    other = dataclasses.replace(take, labels=labels)
    wrong = measure_with_body("controller", other, labeler)[0].report.right
    assert np.flatnonzero(~wrong).tolist() == [7]
    with pytest.raises(ArgumentError, match="controller: the take has no body"):
        measure_with_body("controller", take.without_body(), labeler)
