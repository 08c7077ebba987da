"""`handsim rig list`, `new`, `check` and `import`, as they are typed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from handsim import HandSimWarning, load_rig
from handsim.cli.main import main
from handsim.space.rig import list_rigs
from handsim.space.rig_formats import import_cameras
from tests.handsim.space.known_rig import MCAL, PIXELS, POINT, XCP, written
from train import simulate_take
from train.forecast import rig_plan


def test_every_shipped_rig_is_listed_with_what_it_is(capsys):
    assert main(["rig", "list"]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in list_rigs())
    assert "16" in told and "Figure 5" in told and "1280 x 1280 pixels" in told


def test_a_new_rig_can_be_read_and_has_nothing_suspicious(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    assert main(["rig", "new", str(path)]) == 0
    assert len(load_rig(path).positions) == 4
    assert main(["rig", "check", str(path)]) == 0
    assert "Nothing is suspicious" in capsys.readouterr().out
    assert main(["rig", "new", str(path)]) == 1
    assert "exists already" in capsys.readouterr().err


def test_a_camera_that_looks_away_is_told(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    main(["rig", "new", str(path)])
    text = path.read_text("utf-8").replace("target = [0.0, 0.0, 1.1]\n", "target = [-1.2, 3.0, 2.2]\n", 1)
    path.write_text(text, "utf-8")
    assert main(["rig", "check", str(path)]) == 0
    assert "Suspicious: camera 2 looks away" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["vicon", "motive"])
def test_a_calibration_becomes_a_rig(tmp_path, capsys, kind):
    file, out = written(tmp_path)[kind], tmp_path / "rig.toml"
    assert main(["rig", "import", str(file), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert f"{out}: 2 cameras of 1000 x 800 pixels, 44 x 37 degrees" in said.out.replace("\n", " ")
    assert said.err == ""
    np.testing.assert_allclose(load_rig(out).project(POINT), PIXELS, atol=1e-3)


def test_lenses_are_kept_and_what_is_left_out_is_told(tmp_path, capsys):
    video = XCP[XCP.index("<Camera ") : XCP.index("</Cameras>")].replace("Vantage", "Vue")
    bent = XCP.replace('VICON_RADIAL="0 0"', 'VICON_RADIAL="4e-8 0"').replace(
        "</Cameras>", video + "</Cameras>"
    )
    (tmp_path / "lab.xcp").write_text(bent)
    assert main(["rig", "import", str(tmp_path / "lab.xcp"), "--out", str(tmp_path / "rig.toml")]) == 0
    (sentence,) = capsys.readouterr().err.splitlines()
    assert "video cameras see no markers and are left out: 2100_3, 2101_4" in sentence
    rig = load_rig(tmp_path / "rig.toml")
    assert [(one.name, one.lens.kind) for one in rig.cameras] == [("2100", "brown"), ("2101", "pinhole")]
    with pytest.warns(HandSimWarning, match="are left out"):
        assert rig.cameras == import_cameras(tmp_path / "lab.xcp")


def test_an_imported_rig_with_another_axis_up(tmp_path, capsys):
    (tmp_path / "lab.mcal").write_bytes(MCAL.encode("utf-16"))
    out = tmp_path / "rig.toml"
    assert main(["rig", "import", str(tmp_path / "lab.mcal"), "--out", str(out), "--up", "z"]) == 0
    assert "do not point up on average; is another axis up? --up says which" in capsys.readouterr().err
    np.testing.assert_allclose(load_rig(out).positions, [[0, 1, 3], [4, 2, -1]])


def test_a_score_is_printed_drawn_and_written(tmp_path, capsys):
    page, figures = tmp_path / "six.html", tmp_path / "six.json"
    options = ["--glove", "tips8", "--frames", "60", "--out", str(page), "--json", str(figures)]
    assert main(["rig", "score", "six", *options]) == 0
    told = capsys.readouterr().out
    assert "hand-pen" in told and "matters most" in told and "Error of points" in told
    assert "What to do" in page.read_text("utf-8")
    assert json.loads(figures.read_text("utf-8"))["cameras"] == 6


def test_hands_of_a_take_are_scored_where_they_are(tmp_path, capsys):
    take, page = tmp_path / "take.truth.npz", tmp_path / "page.html"
    simulate_take("single-hand", num_frames=60, glove="tips8").save(take)
    assert main(["rig", "score", "eight", "--take", str(take), "--out", str(page), "--frames", "60"]) == 0
    assert "960 marker-frames of the take take.truth.npz" in page.read_text("utf-8")


def test_a_planned_rig_is_written_and_told(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(rig_plan, "_PEOPLE", 1)
    monkeypatch.setattr(rig_plan, "_FRAMES", 120)
    monkeypatch.setattr(rig_plan, "_TEST_FRAMES", 120)
    out = tmp_path / "mine.toml"
    options = ["--cameras", "2", "--room", "2.4", "1.8", "2.2", "--mounts", "truss", "--glove", "tips8"]
    assert main(["rig", "plan", *options, "--out", str(out)]) == 0
    rig = load_rig(out)
    assert rig.name == "mine" and len(rig.positions) == 2
    told = capsys.readouterr().out
    assert "looks at" in told and "after:  two cameras see" in told and "before" not in told
