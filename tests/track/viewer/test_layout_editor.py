"""A marker that is dragged in the page is where it was let go, in the page and in the saved file."""

from __future__ import annotations

import numpy as np
import pytest

from gloves import load_layout
from gloves.fit import attach_markers
from gloves.layout import starter_layout
from handsim import HandModel
from handsim.errors import ArgumentError, LayoutError
from track.viewer.contents import open_content
from track.viewer.editors import LayoutEditor, edited_path


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

    target = page.places["/move"] + [0.01, 0.008, 0.02]
    page.send("TransformControlsDragStartMessage", name="/move")
    for share in (0.2, 0.6, 1.0):
        position = (share * target + (1 - share) * page.places["/move"]).tolist()
        page.send("TransformControlsUpdateMessage", name="/move", wxyz=(1, 0, 0, 0), position=position)
    page.wait(lambda: editor.changed)
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
