import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from gloves import Take, attach
from handsim import HandModel, join_qpos
from handsim.errors import ArgumentError
from handsim.hand.shape import JOINT_NAMES
from poses.touch import touching_angles
from track.takes.take_figures import PageSettings
from track.takes.take_page import write_take_page
from track.takes.trials import cycles_of, find_cycles, mean_and_spread, thumb_reach

RATE = 100.0
PIP = JOINT_NAMES.index("index_PIP_flexion")


def bending(times: np.ndarray, period: float, rest: float = 0.0) -> np.ndarray:
    """An angle that goes from 10 to 70 degrees and back, with rests between."""
    phase = np.mod(times, period + rest) / period
    return np.where(phase < 1.0, 40.0 - 30.0 * np.cos(2.0 * np.pi * phase), 10.0)


@pytest.mark.parametrize("rest", [0.0, 0.3])
def test_a_movement_is_cut_where_its_angle_is_least(rest: float) -> None:
    times = np.arange(0.0, 5.0 * (1.5 + rest) + 0.001, 1.0 / RATE)
    rng = np.random.default_rng(0)
    spans = find_cycles(bending(times, 1.5, rest) + rng.normal(0.0, 0.05, len(times)))
    assert len(spans) == 5
    lengths = np.array([last - first for first, last in spans]) / RATE
    assert lengths == pytest.approx(1.5 + rest, abs=0.31 if rest else 0.1)


def test_a_movement_that_begins_halfway_has_no_cycle_there() -> None:
    times = np.arange(0.75, 5.25, 1.0 / RATE)  # from the largest angle to the largest
    spans = find_cycles(bending(times, 1.5))
    assert [(first / RATE, last / RATE) for first, last in spans] == [
        pytest.approx((0.75, 2.25), abs=0.02),
        pytest.approx((2.25, 3.75), abs=0.02),
    ]


@pytest.mark.parametrize("angle", [np.nan, 20.0])
def test_what_does_not_move_has_no_cycles(angle: float) -> None:
    assert find_cycles(np.full(300, angle)) == []


def test_a_gap_parts_cycles() -> None:
    times = np.arange(0.0, 6.001, 1.0 / RATE)
    angles = bending(times, 1.5)
    angles[200:220] = np.nan  # in the second of four
    assert [round(first / 150) for first, _ in find_cycles(angles)] == [0, 2, 3]


def test_figures_and_curves_are_those_of_the_movement() -> None:
    times = np.arange(0.0, 6.001, 1.0 / RATE)
    angles = np.zeros((len(times), 20))
    angles[:, PIP] = bending(times, 1.5)
    measured = np.ones(angles.shape, dtype=bool)
    measured[160:260, 0] = False  # most of the second cycle
    found = cycles_of(angles, measured, "index_PIP_flexion", RATE)
    assert found.spans == [(0, 150), (150, 300), (300, 450), (450, 600)]
    fastest = 30.0 * 2.0 * np.pi / 1.5
    expected = [1.5, 10.0, 70.0, 60.0, -fastest, fastest]
    assert found.figures[:, PIP] == pytest.approx(np.tile(expected, (4, 1)), rel=0.002)
    assert found.curves[:, PIP, [0, 25, 50, 100]] == pytest.approx(
        np.tile([10, 40, 70, 10], (4, 1)), abs=0.05
    )
    assert np.isfinite(found.curves[:, 0, 0]).tolist() == [True, False, True, True]


def test_mean_and_deviation_leave_out_what_was_not_measured() -> None:
    rows = np.array([[1.0, 5.0, np.nan], [3.0, np.nan, np.nan]])
    (_, mean), (_, spread) = mean_and_spread(rows)
    np.testing.assert_allclose(mean, [2.0, 5.0, np.nan])
    np.testing.assert_allclose(spread, [np.sqrt(2.0), np.nan, np.nan])


@pytest.mark.parametrize("finger", ["index", "little"])
def test_a_touch_has_no_gap(finger: str) -> None:
    model = HandModel.named("M")
    qpos = join_qpos(np.stack([np.zeros(20), touching_angles(model, finger)]))
    take = Take.of_poses([attach("dense19", model)], qpos[:, None], rate=RATE)
    reach = {name: (gap, time) for name, gap, time, _ in thumb_reach(take, "right")}
    gap, time = reach["3, index tip" if finger == "index" else "6, little tip"]
    assert -0.0007 < gap <= 0.00001
    assert time == pytest.approx(0.01)
    assert reach["5, ring tip"][0] > 0.005


def test_gaps_are_between_surfaces() -> None:
    model = HandModel.named("M")
    take = Take.of_poses([attach("dense19", model)], join_qpos(np.zeros((1, 20)))[:, None], rate=RATE)
    (bones,) = model.forward_kinematics(take.qpos[:, 0])
    row = {int(bone): number for number, bone in enumerate(model.capsules.bones)}
    ends = []
    for bone in (3, 5):  # the thumb's last phalanx, the middle phalanx of the index finger
        start, end = model.capsules.starts[row[bone]], model.capsules.ends[row[bone]]
        line = start + np.linspace(0.0, 1.0, 2000)[:, None] * (end - start)
        ends.append(line @ bones[bone][:3, :3].T + bones[bone][:3, 3])
    expected = cdist(*ends).min() - model.capsules.radii[row[3]] - model.capsules.radii[row[5]]
    assert thumb_reach(take, "right")[1][1] == pytest.approx(expected, abs=1e-6)


def test_the_page_has_cycles_if_asked(tmp_path: Path) -> None:
    times = np.arange(0.0, 4.501, 1.0 / RATE)
    angles = np.zeros((len(times), 20))
    angles[:, PIP] = np.deg2rad(bending(times, 1.5))
    worn, qpos = attach("dense19", HandModel.named("M")), join_qpos(angles)
    points, labels = worn.markers(qpos)[0], np.tile(np.arange(19, dtype=np.int32), (len(qpos), 1))
    take = Take.of_truth([worn], qpos[:, None], points, labels, labels, rate=RATE)
    settings = PageSettings(cycles="index_PIP_flexion", person="P1")
    page, *_, table, _ = write_take_page(tmp_path / "page.html", take, settings=settings)
    assert "Right hand: cycles" in page.read_text("utf-8")
    with table.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["joint"] == "index_PIP_flexion"]
    assert [row["cycle"] for row in rows] == ["1", "2", "3", "mean", "SD"]
    assert {row["person"] for row in rows} == {"P1"}
    assert float(rows[3]["range [deg]"]) == pytest.approx(60.0, abs=0.1)
    assert float(rows[3]["50 %"]) == pytest.approx(70.0, abs=0.1)
    assert float(rows[4]["50 %"]) == pytest.approx(0.0, abs=0.05)
    with pytest.raises(ArgumentError, match="unknown joint 'index'; valid names: thumb_metacarpal"):
        write_take_page(tmp_path / "page.html", take, settings=PageSettings(cycles="index"))
