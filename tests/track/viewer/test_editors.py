"""Labels and layouts that are corrected in the page are in the page and in the saved files."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest

from gloves import load_layout, load_take
from gloves.fit import attach_markers
from gloves.layout import starter_layout
from gloves.takes.corrections import corrections_of, corrections_path
from handsim import HandModel, HandSimWarning
from handsim.errors import ArgumentError, CaptureError, LayoutError
from handsim.hand.shape import BONE_NAMES
from track.viewer.contents import open_content, show_recording
from track.viewer.editors import Corrector, LayoutEditor, edited_path
from track.viewer.recordings import TakeRecording

TIP = "right:ThumbTip"


@pytest.fixture
def path(tracked, tmp_path):
    """A take whose third point has the label of the fourth's marker in frames 8 to 14, and the other way."""
    labels = tracked.labels.copy()
    labels[8:15, [2, 3]] = labels[8:15, [3, 2]]
    dataclasses.replace(tracked, labels=labels).save(tmp_path / "tracked.npz")
    return tmp_path / "tracked.npz"


@pytest.fixture
def open_page(server, page_of, path):
    """The page of the take, served from a thread."""
    ended = threading.Event()
    run = open_content(str(path)).show(server)
    serving = threading.Thread(target=run, args=(ended.is_set,))
    serving.start()
    yield page_of(server)
    ended.set()
    serving.join()


def click(page, point) -> None:
    page.send(
        "SceneNodeClickMessage", name="/points", instance_index=None, owner="", modifier=None,
        ray_origin=(np.asarray(point) + [0.0, 0.0, 0.5]).tolist(), ray_direction=[0.0, 0.0, -1.0],
        screen_pos=[0.5, 0.5],
    )  # fmt: skip


def value(page, label):
    (found,) = [props["value"] for props in page.panel.values() if props.get("label") == label]
    return found


def test_a_click_two_labels_and_a_save(open_page, path, tracked):
    page, names = open_page, tracked.label_names
    page.press("frame", 10)
    page.wait(lambda: page.says("**frame 10** of 30"))
    click(page, tracked.points[10, 2])
    page.wait(lambda: page.says(f"**ID 2: {names[3]}**, 99 %, with this label in frames 8 to 14"))
    page.settle()
    assert list(value(page, "frames")) == [8, 14] and value(page, "right label") == names[3]
    np.testing.assert_allclose(page.places["/chosen"], tracked.points[10, 2])
    assert "/chosen" not in page.hidden
    page.press("right label", names[2])
    page.settle()
    page.press("Correct")
    page.wait(lambda: page.says(f"corrected: {names[2]} in frames 8 to 14"))
    page.press("point", "ID 3: none")  # it lost the label to the other point
    page.wait(lambda: value(page, "right label") == "none")
    page.press("right label", names[3])
    page.settle()
    page.press("Correct")
    page.wait(lambda: page.says(f"corrected: {names[3]}"))
    page.press("Save take")
    page.wait(lambda: page.says("saved "))
    saved = load_take(path)
    np.testing.assert_array_equal(saved.labels, tracked.labels)
    assert (saved.confidence[8:15, 2:4] == 1.0).all()
    np.testing.assert_allclose(saved.markers("right")[8:15, 2:4], tracked.points[8:15, 2:4])
    assert [one.label for one in corrections_of(path)] == [names[2], names[3]]
    again = Corrector(path, saved)
    assert again.take is saved, "what the take has is not made again"


def test_a_bad_correction_is_told_before_it_is_saved(open_page, path, tracked):
    page = open_page
    page.press("point", f"ID 5: {tracked.label_names[5]}")
    page.wait(lambda: page.says("**ID 5:"))
    page.press("right label", next(name for name in tracked.label_names if name.endswith("PinkyTip")))
    page.settle()
    page.press("Correct")
    page.wait(lambda: page.says("right RMS was "))
    assert page.says("Undo takes it back") and not corrections_path(path).exists()
    page.press("Undo")
    page.wait(lambda: page.says("taken back"))


def test_what_was_not_saved_is_taken_back(open_page, path, tracked):
    page = open_page
    page.press("point", f"ID 5: {tracked.label_names[5]}")
    page.wait(lambda: page.says("**ID 5:"))
    page.press("shown frame is", "last")
    page.wait(lambda: list(value(page, "frames")) == [0, 0])
    page.press("right label", "none")
    page.settle()
    page.press("Correct")
    page.wait(lambda: page.says("none in frames 0 to 0, not saved"))
    page.wait(lambda: np.ptp(page.nodes["/points"]["batched_colors"][12:15]) == 0)  # column 4 has no point
    page.press("Undo")
    page.wait(lambda: page.says("taken back"))
    page.wait(lambda: np.ptp(page.nodes["/points"]["batched_colors"][12:15]) > 0)
    assert not corrections_path(path).exists()


def test_what_is_not_saved_at_the_end_is_told(server, path):
    corrector = Corrector(path, load_take(path))
    run = show_recording(server, TakeRecording(corrector.take), corrector)
    corrector.add(10, 2, (8, 14), TIP)
    with pytest.warns(HandSimWarning, match=rf"tracked\.npz: not saved: {TIP} in frames 8 to 14"):
        run(lambda: True)


def test_a_marker_that_was_not_seen_has_no_point_to_correct(open_page, tracked):
    click(open_page, tracked.markers("right")[0, 4])
    open_page.wait(lambda: open_page.says("That marker was not seen"))
    open_page.press("Correct")
    open_page.wait(lambda: open_page.says("Choose a point first"))


def test_the_span_is_cut_to_where_the_point_is(path):
    corrector = Corrector(path, load_take(path))
    assert corrector.span_of(0, 20) == (0, 24), "the left hand is lost from frame 25 on"
    correction = corrector.add(3, 20, (0, 29), "none")
    assert (correction.first, correction.last) == (0, 24)
    with pytest.raises(CaptureError, match="the point is not there in frames 26 to 29"):
        corrector.add(3, 20, (26, 29), "none")


def test_one_label_for_two_points_is_refused_until_one_of_them_gives_it_back(path):
    corrector = Corrector(path, load_take(path))
    corrector.add(10, 2, (8, 14), TIP)
    with pytest.raises(CaptureError, match="two points of frame 9 are corrected to right:ThumbTip"):
        corrector.add(10, 3, (9, 9), TIP)
    assert len(corrector.added) == 1
    corrector.add(10, 2, (9, 9), "none")
    corrector.add(10, 3, (9, 9), TIP)
    assert len(corrector.added) == 3


def test_files_that_changed_meanwhile_are_not_overwritten(path, tracked):
    corrector = Corrector(path, load_take(path))
    corrector.add(10, 2, (8, 14), "none")
    tracked.save(path)
    with pytest.raises(CaptureError, match="have changed since they were opened"):
        corrector.save()
    assert not corrections_path(path).exists()


def test_a_file_that_the_take_does_not_know_is_applied_and_told(path, tracked, recwarn):
    x, y, z = (1e3 * tracked.points[8, 2]).tolist()
    corrections_path(path).write_text(
        f'[[correction]]\nframes = [8, 14]\nplace_mm = [{x}, {y}, {z}]\nlabel = "{TIP}"\n'
        '[[correction]]\nframes = [8, 14]\nplace_mm = [0, 0, 0]\nlabel = "none"\n'
    )
    open_content(str(path))
    assert "none in frames 8 to 14 no longer fits" in str(recwarn.pop().message)
    corrector = Corrector(path, load_take(path))
    index = tracked.label_names.index(TIP)
    assert (corrector.take.labels[8:15, 2] == index).all()
    corrections_path(path).write_text(
        '[[correction]]\nframes = [8, 99]\nplace_mm = [0, 0, 0]\nlabel = "none"\n'
    )
    with pytest.raises(CaptureError, match=r"tracked\.corrections\.toml: correction 1 is for frames 8 to 99"):
        open_content(str(path))


def test_only_a_take_with_a_file_can_be_corrected(server, page_of, tracked):
    show_recording(server, TakeRecording(tracked))
    assert not any(props.get("label") == "Correct labels" for props in page_of(server).panel.values())


@pytest.fixture
def glove(tmp_path):
    path = tmp_path / "glove.toml"
    path.write_text(starter_layout())
    return path


def test_a_dragged_marker_is_saved_where_it_was_let_go(server, page_of, glove):
    out = edited_path(glove)
    model = HandModel.named("M")
    editor = LayoutEditor(server, glove, load_layout(glove), model, out)
    page = page_of(server)
    page.press("marker", "BackHand1")
    page.wait(lambda: page.says("**BackHand1** on palm"))
    page.settle()
    assert "/move" not in page.hidden
    index = load_layout(glove).names.index("BackHand1")

    def ball(page):
        return page.nodes["/markers"]["batched_positions"].reshape(-1, 3)[index]

    target, before = page.places["/move"] + [0.01, 0.008, 0.02], editor.fit
    page.send("TransformControlsDragStartMessage", name="/move")
    for share in (0.2, 0.6, 1.0):
        position = (share * target + (1 - share) * page.places["/move"]).tolist()
        page.send("TransformControlsUpdateMessage", name="/move", wxyz=(1, 0, 0, 0), position=position)
    page.wait(lambda: editor.fit is not before)
    page.send("TransformControlsDragEndMessage", name="/move")
    page.wait(lambda: np.allclose(page.places["/move"], ball(page), atol=1e-6))
    page.settle()
    page.press("Save layout")
    page.wait(lambda: page.says("saved "))
    saved = load_layout(out)
    before = load_layout(glove)
    assert saved.names == before.names
    assert [marker for number, marker in enumerate(saved.markers) if number != index] == [
        marker for number, marker in enumerate(before.markers) if number != index
    ]
    center = attach_markers(saved, model).points[index] + editor.shift
    start = attach_markers(before, model).points[index] + editor.shift
    assert center[:2] == pytest.approx(start[:2] + [0.01, 0.008], abs=5e-3), "under the hand that dragged it"
    assert abs(center[2] - start[2]) < 5e-3, "and on the skin"
    np.testing.assert_allclose(ball(page), center, atol=1e-5)
    np.testing.assert_allclose(page.places["/move"], center, atol=1e-5)
    assert out.read_text().count("#") == glove.read_text().count("#"), "remarks are kept"
    assert glove.read_text() == starter_layout()


def test_a_marker_dragged_over_a_joint_moves_with_the_skin_there(server, page_of, glove):
    editor = LayoutEditor(server, glove, load_layout(glove), HandModel.named("M"), edited_path(glove))
    index = editor.fit.layout.names.index("IndexTip")
    transforms, length = editor.fit.model.rest_transforms, editor.fit.model.skeleton.lengths
    for bone in ("index_middle", "index_proximal", "index_distal"):
        number = BONE_NAMES.index(bone)
        middle = transforms[number] @ [0.5 * length[number], 0.0, 0.01, 1.0]
        editor.move(index, middle[:3] + editor.shift)
        assert editor.fit.layout.markers[index].bone == bone


def test_a_click_chooses_the_marker_under_it(server, page_of, glove):
    editor = LayoutEditor(server, glove, load_layout(glove), HandModel.named("M"), edited_path(glove))
    page = page_of(server)
    place = editor.fit.attachment.points[2] + editor.shift
    ray = {"ray_origin": (place + [0.3, 0, 0.4]).tolist(), "ray_direction": (-0.3, 0.0, -0.4)}
    page.send(
        "SceneNodeClickMessage",
        name="/markers",
        instance_index=0,
        screen_pos=(0.5, 0.5),
        modifier=None,
        **ray,
    )
    page.wait(lambda: page.says("**MiddleTip** on middle_distal"))
    page.settle()
    np.testing.assert_allclose(page.places["/move"], place, atol=1e-6)


def test_nothing_is_written_over(glove, tmp_path):
    assert edited_path(glove).name == "glove-edited.toml"
    (tmp_path / "glove-edited.toml").touch()
    assert edited_path(glove).name == "glove-edited-2.toml"
    with pytest.raises(ArgumentError, match="exists already, expected a new name"):
        open_content(str(glove), out=tmp_path / "glove-edited.toml")
    with pytest.raises(ArgumentError, match="is the input"):
        open_content(str(glove), out=glove)


def test_a_file_that_cannot_be_written_is_told_in_the_page(server, page_of, glove, tmp_path):
    editor = LayoutEditor(server, glove, load_layout(glove), HandModel.named("M"), tmp_path)
    with pytest.raises(LayoutError, match="cannot be written"):
        editor.save()
    page = page_of(server)
    page.press("Save layout")
    page.wait(lambda: page.says("cannot be written"))
