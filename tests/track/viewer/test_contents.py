"""Every kind of file opens by its content; anything else is told in one sentence."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gloves import Capture, write_capture
from gloves.layout import starter_layout
from handsim import HandModel, HandSimError, load_rig
from handsim.errors import ArgumentError, CaptureError
from tests.rigs import mixed_rig
from tests.sentences import error_names
from track import User
from track.viewer.contents import ACCEPTED, open_content
from track.viewer.recordings import CaptureRecording, DatasetRecording, TakeRecording
from track.viewer.stage import camera_counts
from train import Dataset, generate_dataset


@pytest.fixture(scope="module")
def training_set(tmp_path_factory):
    out = tmp_path_factory.mktemp("set") / "set"
    generate_dataset(out, glove="sparse13", num_frames=40, frames_per_hand=16, workers=1)
    return out


@pytest.fixture
def capture():
    rng = np.random.default_rng(1)
    positions = rng.uniform(0.0, 0.3, (50, 6, 3))
    positions[3, 2] = np.nan
    names = ("Anna:ThumbTip", "*12", "Unlabeled 7", "IndexTip", "anna:Unlabeled3", "_unlabeled_4")
    return Capture(names, positions, 100.0)


@pytest.fixture
def files(tmp_path, tracked, simulated, capture, training_set):
    """One file of each kind, by kind."""
    tracked.save(tmp_path / "a.npz")
    simulated.save(tmp_path / "b.npz")
    write_capture(tmp_path / "c.trc", capture)
    write_capture(tmp_path / "d.c3d", capture)
    (tmp_path / "e.toml").write_text(starter_layout())
    cameras = "\n".join(f"[[camera]]\nposition = [{x}, 0, 1]\ntarget = [0, 0, 1]" for x in (-1, 1))
    (tmp_path / "f.toml").write_text(f'name = "pair"\nfield_of_view = 60\n{cameras}\n')
    User((tracked.hands[0], tracked.hands[0].with_side("left"))).save(tmp_path / "g.json")
    return {
        "take": tmp_path / "a.npz",
        "take truth": tmp_path / "b.npz",
        "capture": tmp_path / "c.trc",
        "capture c3d": tmp_path / "d.c3d",
        "layout": tmp_path / "e.toml",
        "rig": tmp_path / "f.toml",
        "user": tmp_path / "g.json",
        "dataset": training_set,
        "layout shipped": "sparse13",
        "rig shipped": "six",
    }


def test_every_kind_opens_and_fills_a_page(files, server, page_of):
    expected = {
        "take": "/hands/1", "take truth": "/bodies/pen", "capture": "/points", "capture c3d": "/points",
        "layout": "/markers", "rig": "/cameras/2", "user": "/before/left/skin", "dataset": "/hands/0",
        "layout shipped": "/hand", "rig shipped": "/coverage",
    }  # fmt: skip
    for name, path in files.items():
        server.scene.reset()
        server.gui.reset()
        content = open_content(str(path))
        assert content.kind == name.split()[0]
        run = content.show(server)
        run(lambda: True)
        assert expected[name] in page_of(server).nodes, name


def test_anything_else_is_told_in_one_sentence(tmp_path, capture):
    (tmp_path / "wand.toml").write_text('name = "wand"\n')
    (tmp_path / "notes.txt").write_text("remember the milk")
    for name in ("wand.toml", "notes.txt"):
        with error_names(ArgumentError, f"{ACCEPTED} | {name}"):
            open_content(str(tmp_path / name))
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(CaptureError):
        open_content(str(tmp_path / "other.npz"))
    with pytest.raises(HandSimError, match="holds none"):
        open_content(str(tmp_path))
    write_capture(tmp_path / "take.trc", capture)
    with pytest.raises(ArgumentError, match="is no marker layout: nothing would be saved"):
        open_content(str(tmp_path / "take.trc"), out=tmp_path / "new.toml")


def test_names_that_systems_give_to_unnamed_points_are_no_labels(capture):
    recording = CaptureRecording(capture)
    assert recording.label_names == ("Anna:ThumbTip", "IndexTip")
    frame = recording.frame(3)
    np.testing.assert_array_equal(frame.labels, [0, -1, 1, -1, -1])
    np.testing.assert_array_equal(frame.points[2], capture.positions[3, 3])
    assert recording.most_points == 6 and frame.time == pytest.approx(0.03)


def test_a_training_set_shows_its_rows_and_who_sees_them(training_set):
    dataset = Dataset(training_set)
    recording, rig = DatasetRecording(dataset), load_rig("figure5")
    for index in (39, 0, 17):
        row, frame = dataset.rows()[index], recording.frame(index)
        observed = np.isfinite(row["observed"][:, 0])
        np.testing.assert_array_equal(frame.seen[:13], observed)
        np.testing.assert_array_equal(frame.points[:13][observed], row["observed"][observed])
        np.testing.assert_array_equal(frame.points[:13][~observed], row["markers"][~observed])
        assert frame.hands[0].shape.length == pytest.approx(dataset.hands(0)[row["hand"]].length)
        assert len(frame.rays) == sum(int(bits).bit_count() for bits in row["cameras"])
        for marker, camera in frame.rays:
            number = int(np.linalg.norm(row["markers"] - marker, axis=1).argmin())
            eye = int(np.linalg.norm(rig.positions - camera, axis=1).argmin())
            assert row["cameras"][number] >> eye & 1


def test_a_rig_of_a_take_is_shown_if_it_is_shipped_or_in_the_take(simulated):
    assert TakeRecording(simulated).rig.name == "six"
    own = dataclasses.replace(simulated, settings={"rig": mixed_rig().record()})
    assert TakeRecording(own).rig == mixed_rig()
    for name in ("/etc/passwd", 3, None):
        assert TakeRecording(dataclasses.replace(simulated, settings={"rig": name})).rig is None


def test_places_are_counted_by_the_cameras_that_see_them():
    rig = load_rig("six")
    places, counts = camera_counts(rig)
    assert counts.min() == 2 and counts.max() <= 6 and len(places) > 50
    np.testing.assert_array_equal(rig.in_view(places).sum(axis=1), counts)


def test_the_size_of_the_hand_under_a_layout_is_chosen(tmp_path, server, page_of):
    (tmp_path / "glove.toml").write_text(starter_layout())
    open_content(str(tmp_path / "glove.toml"), size="XL").show(server)
    vertices = page_of(server).nodes["/hand"]["vertices"].reshape(-1, 3)
    np.testing.assert_allclose(vertices, HandModel.named("XL").surface.vertices, atol=1e-6)


def test_a_take_opens_at_a_time(files, server, page_of):
    content = open_content(str(files["take"]), time=0.1)
    content.show(server)(lambda: True)
    (slider,) = [one for one in page_of(server).panel.values() if one.get("label") == "frame"]
    times = content.recording.times
    assert slider["value"] == np.abs(times - 0.1).argmin() > 0
    with pytest.raises(ArgumentError, match=r"--time is 99 s, but .*a\.npz lasts from 0 to 0\.\d+ s"):
        open_content(str(files["take"]), time=99.0)
    with pytest.raises(ArgumentError, match="--time is 1, but sparse13 is a layout: nothing in it moves"):
        open_content("sparse13", time=1.0)
