"""`handsim rig list`, `new` and `check`, as they are typed."""

from __future__ import annotations

import pytest

from handsim.cli.main import main
from handsim.space.cameras import list_rigs, load_rig


def test_every_shipped_rig_is_listed_with_what_it_is(capsys):
    assert main(["rig", "list"]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in list_rigs())
    assert "16" in told and "Figure 5" in told and "[deg]" in told


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


@pytest.mark.parametrize("name", ["mine.txt", "seven"])
def test_names_that_are_no_rig_are_refused(name, capsys):
    assert main(["rig", "check", name]) == 1
    assert "or the path of a .toml file" in capsys.readouterr().err
