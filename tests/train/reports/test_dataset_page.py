"""The report of a training set: its numbers, and the page that shows them."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from handsim.cli.main import main
from handsim.hand.shape import JOINT_NAMES, JOINTS
from handsim.space.rig import CameraRig, load_rig
from tests.programs import run_python
from tests.train.reports.conftest import pictures
from train import Dataset, generate_dataset
from train.data.shards import row_dtype
from train.reports import dataset_page as report

pytestmark = pytest.mark.filterwarnings("error::UserWarning")  # matplotlib's, for a figure that does not fit


@pytest.fixture
def rows():
    """Four frames of three markers in a line: 30 mm and 40 mm apart, and 10 mm and 60 mm in the last."""
    made = np.zeros(4, row_dtype(3))
    made["markers"][..., 0] = [[0.0, 0.030, 0.070]] * 3 + [[0.0, 0.010, 0.070]]
    made["ghosts"] = np.nan
    return made


def test_angles_are_counted_over_the_joints_own_range(rows):
    index, low, high = JOINT_NAMES.index("index_MCP_flexion"), -25.0, 95.0
    assert (JOINTS[index].low_deg, JOINTS[index].high_deg) == (low, high)
    rows["qpos"][:, 7 + index] = np.deg2rad([low, -16.0, 1.0, high])  # bins of 12 degrees
    shares = report.angle_shares(rows, bins=10)
    np.testing.assert_array_equal(shares[index], [0.5, 0, 0.25, 0, 0, 0, 0, 0, 0, 0.25])
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    assert shares[0].argmax() == 4  # the thumb's zero in -33 to 35
    assert shares[0].max() == 1.0


def test_cameras_are_counted_by_marker(rows):
    rows["cameras"][:, 1] = [0b0, 0b100, 0b101, 0b111]
    rows["cameras"][:, 2] = 0b110
    shares = report.camera_shares(rows, 3)
    np.testing.assert_array_equal(shares, [[1, 0, 0, 0], [0.25, 0.25, 0.25, 0.25], [0, 0, 1, 0]])


def test_ghosts_are_counted_and_measured_to_the_nearest_marker(rows):
    assert report.ghost_distances(rows).shape == (0,)
    rows["ghosts"][0, 2] = (0.075, 0.0, 0.012)  # 13 mm from the third marker
    rows["ghosts"][3, :2] = [(-0.003, 0.004, 0.0), (0.010, 0.0, 0.020)]
    np.testing.assert_array_equal(report.ghost_counts(rows), [2, 1, 1, 0, 0])
    np.testing.assert_allclose(report.ghost_distances(rows), [0.013, 0.005, 0.020], rtol=1e-6)


def test_nearest_neighbors(rows):
    apart = report.neighbor_distances(np.tile(rows, 300))  # in several parts
    expected = [[0.03, 0.03, 0.04]] * 3 + [[0.01, 0.01, 0.06]]
    np.testing.assert_allclose(apart, np.tile(expected, (300, 1)), rtol=1e-6)


def test_a_take_with_gaps_is_drawn_beside_the_published_figures(dataset, tmp_path, without_pictures):
    present = np.ones((1000, 2), bool)
    present[100:103, 0] = present[200:240, 1] = present[:7, 1] = False
    section = report.gap_section(present, 240.0)
    assert "1,000 frames at 240 Hz. Of its 2 markers 2.50 % are missing, in 2 gaps" in section.text
    assert len(section.pictures) == 1
    assert report.gap_section(np.ones((9, 2), bool), 120.0).pictures == ()
    page = report.write_dataset_page(tmp_path / "page.html", dataset, present=present, rate=240.0)
    assert len(pictures(page)) == 6


def test_a_large_set_is_sampled_evenly_over_its_shards(dataset):
    assert [len(shard) for shard in dataset.shards] == [150, 150, 100]
    rows = dataset.rows()
    assert report.sample_rows(dataset, 40).tobytes() == rows[::10].tobytes()
    assert report.sample_rows(dataset, 400).tobytes() == rows.tobytes()
    assert report.sample_rows(dataset).tobytes() == rows.tobytes()
    assert report.sample_rows(dataset, 3).tobytes() == rows[[0, 133, 266]].tobytes()


def test_the_page_shows_the_sets_figures_and_is_the_same_every_time(dataset, tmp_path):
    page = report.write_dataset_page(tmp_path / "one.html", dataset)
    text = page.read_text("utf-8")
    assert "<title>Training set small</title>" in text
    drawn = pictures(page)
    assert len(drawn) == 5
    for picture in drawn:
        assert len(list(ElementTree.fromstring(picture).iter())) > 100
    assert drawn[0].count('<g id="axes_') == 20  # a panel a hinge
    rows = dataset.rows()
    found = np.isfinite(rows["observed"][..., 0]).sum() / len(rows)
    left = np.mean(
        [
            dataset.hands(shard)[row["hand"]].side == "left"
            for shard in range(3)
            for row in dataset.shards[shard]
        ]
    )
    size = sum(path.stat().st_size for path in dataset.path.glob("*.npy"))
    for figure in ("<td>400</td>", "<td>8</td>", f"{100 * left:.1f} %", f"{found:.2f} of 19", f"{size:,}"):
        assert figure in text
    again = tmp_path / "two.html"
    again.write_text("an old report")
    assert report.write_dataset_page(again, dataset).read_bytes() == page.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.html", "two.html"]


def test_a_rig_of_ones_own_is_named_in_a_word(tmp_path, without_pictures):
    rig = CameraRig("garage", load_rig("figure5").cameras[:9])
    made = generate_dataset(tmp_path / "set", num_frames=20, frames_per_hand=20, rig=rig, workers=1)
    text = report.write_dataset_page(tmp_path / "page.html", made).read_text("utf-8")
    (lead,) = re.findall(r'<p class="lead">(.*?)</p>', text)
    assert lead == "20 frames of glove dense19 before the 9 cameras of rig garage, seed 0."


def test_generate_leaves_a_report_that_is_no_part_of_the_set(tmp_path, capsys, without_pictures):
    out = tmp_path / "set"
    command = ["generate", "--num-frames", "1", "--ghosts.stray-rate", "0", "--ghosts.mirror-rate", "0"]
    command += ["--out", str(out), "--workers", "1"]
    assert main(command) == 0
    assert f"report in {out / 'report.html'}" in capsys.readouterr().out
    first = (out / "report.html").read_bytes()
    assert "report.html" not in Dataset(out).manifest.files
    (out / "report.html").write_text("an old report")
    assert main(command) == 0  # the same command goes on in a folder that holds a report
    assert (out / "report.html").read_bytes() == first
    assert sorted(path.name for path in out.iterdir()) == [
        "checksums-00000.json", "config.json", "hands-00000.npy", "manifest.json", "redrawn-00000.json",
        "report.html", "rows-00000.npy",
    ]  # fmt: skip


def test_only_drawing_loads_matplotlib_and_nothing_loads_pyplot():
    code = """
import sys
import handsim.cli.generate, handsim.cli.train, train.simulation.generation
import handsim.pages, train.reports.dataset_page, train.reports.run_page
assert not [name for name in sys.modules if name.startswith("matplotlib")]
handsim.pages.picture((1, 1), lambda figure: figure.subplots())
assert "matplotlib.figure" in sys.modules and "matplotlib.pyplot" not in sys.modules
"""
    run_python(code)
