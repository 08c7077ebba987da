"""No output is written over an input, whatever it is called."""

from __future__ import annotations

import os

import pytest

from handsim.cli.main import main
from handsim.errors import ArgumentError
from handsim.files.outputs import check_outputs


def test_an_input_is_refused_by_every_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = tmp_path / "take.c3d"
    source.write_text("x")
    os.link(source, tmp_path / "hard.c3d")
    (tmp_path / "soft.c3d").symlink_to(source)
    (tmp_path / "folder").mkdir()
    for name in ("take.c3d", "hard.c3d", "soft.c3d", "folder/../take.c3d", str(source)):
        with pytest.raises(ArgumentError, match=r"is the input take\.c3d, expected another file"):
            check_outputs([None, "dense19", "take.c3d"], [None, tmp_path / name])
    (tmp_path / "same.c3d").write_text("x")
    check_outputs([source, "dense19"], [tmp_path / "same.c3d", tmp_path / "new.c3d", None])


def test_an_output_below_a_file_is_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "take.c3d").write_text("x")
    for name in ("take.c3d/x.npz", "take.c3d/folder/x.npz", str(tmp_path / "take.c3d" / "x.npz")):
        with pytest.raises(
            ArgumentError, match=r"x\.npz lies in take\.c3d, which is a file, expected a folder"
        ):
            check_outputs([], [tmp_path / name])
    check_outputs([], [tmp_path / "new" / "folder" / "x.npz"])


def test_commands_refuse_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "take.c3d").write_text("x")
    (tmp_path / "take.json").symlink_to("take.c3d")
    (tmp_path / "take.npz").symlink_to("take.c3d")
    (tmp_path / "take.toml").symlink_to("take.c3d")
    for command in (
        ["label", "take.c3d", "--out", "take.c3d"],
        ["label", "take.c3d", "--out", "./take.c3d"],
        ["evaluate", "take.c3d", "--json", "take.json"],
        ["track", "take.c3d", "--out", "take.npz"],
        ["track", "take.c3d", "--out", "new.npz", "--labeled", "take.c3d"],
        ["calibrate", "take.c3d", "--out", "take.json"],
        ["body", "take.c3d", "--out", "take.toml"],
    ):
        assert main(command) == 1
        assert "is the input take.c3d, expected another file" in capsys.readouterr().err
    assert (tmp_path / "take.c3d").read_text() == "x"
