"""`handsim export` from real files of takes: what it writes, what it says, and what it refuses."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from gloves import RigidBody, Take, attach, load_layout, load_take, read_capture
from gloves.takes.take import LOST
from handsim import HandModel, HandSimWarning, join_qpos
from handsim.cli.main import main
from handsim.hand.model import KEYPOINT_NAMES
from handsim.space.transforms import facing, program_axes, random_quaternions

FRAMES, RATE = 12, 120.0
ENDINGS = (".glb", ".bvh", ".usda", ".usdc", ".csv", ".trc", ".mot")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A tracked take whose left hand is lost in two frames, and the truth of a simulated one with a pen."""
    rng, folder = np.random.default_rng(3), tmp_path_factory.mktemp("takes")
    layout = load_layout("dense19")
    fits = tuple(
        attach(layout, HandModel.named(size, side=side)) for size, side in (("S", "right"), ("L", "left"))
    )
    motions = []
    for x in (0.0, 0.4):
        angles = 0.3 + 0.2 * np.sin(np.arange(FRAMES)[:, None] / 8.0 + rng.uniform(0, 6, 20))
        qpos = join_qpos(angles, position=[x, 0.1, 1.0], quaternion=random_quaternions(1, rng=rng)[0])
        qpos[:, 0] += 0.002 * np.arange(FRAMES)
        motions.append(qpos)
    still = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (FRAMES, 1, 1))
    for file, body in (("take.truth.npz", "pen"), ("tracked.npz", "wand")):
        bodies = [RigidBody(body, ("A", "B", "C"), 0.05 * np.eye(3))]
        take = Take.of_poses(fits, np.stack(motions, axis=1), rate=RATE, bodies=bodies, body_poses=still)
        take.save(folder / file)
        motions[1][3:5] = np.nan
    return folder


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_ending_is_written_and_tells_what_is_missing(folder, ending, tmp_path, capsys):
    if ending in (".usda", ".usdc"):
        pytest.importorskip("pxr", reason="usd-core is not installed")
    out = tmp_path / "new" / f"hands{ending}"
    assert main(["export", str(folder / "tracked.npz"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert f"{out}: right and left hands, wand; 12 frames at 120 Hz" in said
    assert "left hand: without a pose in 2 frames, " in said and "right hand: without" not in said
    assert out.stat().st_size > 1000 and [path.name for path in out.parent.iterdir()] == [out.name]


@pytest.mark.parametrize("up", ["y", "z"])
def test_trc_holds_the_keypoints_with_y_up_and_no_gap(folder, up, tmp_path, capsys):
    out = tmp_path / "joints.trc"
    assert main(["export", str(folder / "tracked.npz"), "--out", str(out), "--up", up]) == 0
    assert "left hand: without a pose in 2 frames, held at its last pose there" in capsys.readouterr().out
    with pytest.warns(HandSimWarning, match="repeat their position"):  # our own reader takes these for gaps
        capture = read_capture(out)
    assert capture.rate == RATE and capture.names[:2] == ("right_wrist", "right_thumb_CMC")
    rows = out.read_text().split("\tX1\t")[1].splitlines()[1:]
    found = np.array([row.split("\t")[2:-1] for row in rows if row], dtype=float)
    found = 1e-3 * found.reshape(FRAMES, 2, len(KEYPOINT_NAMES), 3)
    expected = load_take(folder / "tracked.npz").keypoints()
    expected[3:5, 1] = expected[2, 1]
    if up == "z":
        expected = np.stack([expected[..., 0], expected[..., 2], -expected[..., 1]], axis=-1)
    np.testing.assert_allclose(found, expected, atol=1e-8)


@pytest.mark.parametrize("forward", ["x", "-y", "z"])
def test_forward_in_a_file_is_that_of_openxr_in_what_is_sent(folder, forward, tmp_path, capsys):
    up = "y" if forward == "z" else "z"
    out, take = tmp_path / "joints.trc", load_take(folder / "tracked.npz")
    options = ["--up", up, f"--forward={forward}"]
    assert main(["export", str(folder / "tracked.npz"), "--out", str(out), *options]) == 0
    with pytest.warns(HandSimWarning, match="repeat their position"):
        positions = read_capture(out).positions
    axes = program_axes("openxr", up, forward=forward)
    expected = axes.positions(take.keypoints()[:, 0])
    np.testing.assert_allclose(positions[:, : len(KEYPOINT_NAMES)], expected, atol=1e-8)
    turned = take.turned(facing(up, forward))
    sent = axes.quaternions(take.qpos[:, :, 3:7])
    written = program_axes("openxr", up, forward="y" if up == "z" else "-z").quaternions(
        turned.qpos[..., 3:7]
    )
    np.testing.assert_allclose(np.abs((sent * written).sum(axis=-1))[take.status > 0], 1.0, atol=1e-9)
    np.testing.assert_allclose(turned.points[0], take.points[0] @ facing(up, forward).T)
    table = tmp_path / "hands.csv"
    assert main(["export", str(folder / "tracked.npz"), "--out", str(table), *options[2:]]) == 1
    assert f"forward is {forward} and the file" in capsys.readouterr().err


def test_fps_resamples(folder, tmp_path):
    out = tmp_path / "hands.csv"
    assert main(["export", str(folder / "tracked.npz"), "--out", str(out), "--fps", "60"]) == 0
    with out.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["hand"] == "right"]
    np.testing.assert_allclose([float(row["time_s"]) for row in rows], np.arange(6) / 60.0, atol=1e-9)
    qpos = load_take(folder / "tracked.npz").qpos[:, 0]
    np.testing.assert_allclose([float(row["wrist_x_m"]) for row in rows], qpos[::2, 0], atol=1e-9)


def test_a_take_without_a_hand_is_refused(folder, tmp_path, capsys):
    take = load_take(folder / "tracked.npz")
    take.qpos[:], take.status[:] = np.nan, LOST
    take.save(tmp_path / "none.npz")
    assert main(["export", str(tmp_path / "none.npz"), "--out", str(tmp_path / "none.bvh")]) == 1
    assert "there is no hand in any frame, expected one to export" in capsys.readouterr().err
