"""No output is written over an input, whatever it is called."""

from __future__ import annotations

import os

import pytest

from handsim.cli.main import main
from handsim.errors import ArgumentError, DatasetError
from handsim.files.outputs import available_bytes, check_free, check_memory, check_outputs, shown_bytes


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


def test_links_that_lead_nowhere_are_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "self.c3d").symlink_to("self.c3d")
    (tmp_path / "one").symlink_to("two")
    (tmp_path / "two").symlink_to("one")
    (tmp_path / "gone").symlink_to("nothing")
    for name, link in (("self.c3d", "self.c3d"), ("one/a.c3d", "one"), ("./two", "two")):
        with pytest.raises(
            ArgumentError, match=rf"{name} cannot be written: .*{link} is a link that leads to itself"
        ):
            check_outputs([], [tmp_path / name])
    with pytest.raises(ArgumentError, match=r"gone is a link to a folder that is not there"):
        check_outputs([], [tmp_path / "gone" / "a.c3d"])
    check_outputs([], [tmp_path / "gone"])  # the file that it points to will be written
    assert main(["label", "take.c3d", "--out", "self.c3d"]) == 1
    assert "self.c3d is a link that leads to itself" in capsys.readouterr().err


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


def test_what_does_not_fit_is_refused(tmp_path):
    check_free(tmp_path / "new" / "set", 10, "2 frames", "ask for fewer", error=DatasetError)
    with pytest.raises(
        DatasetError, match=r"2 frames need 1 EB, but the disk of .*set has .* free; ask for fewer or"
    ):
        check_free(tmp_path / "new" / "set", 10**18, "2 frames", "ask for fewer", error=DatasetError)


@pytest.mark.parametrize(("count", "text"), [(0, "0 bytes"), (1234, "1.23 kB"), (7.01e11, "701 GB")])
def test_bytes_with_units(count, text):
    assert shown_bytes(count) == text


def test_free_memory_is_less_than_what_is_built_in():
    built_in = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert 0 < available_bytes() <= built_in


def test_memory_that_is_not_there_is_refused_with_both_sizes():
    check_memory(1000, "1 frames", "ask for fewer frames")
    with pytest.raises(ArgumentError, match=r"^5 frames need 1e\+03 EB of memory, but .* are free; ask for"):
        check_memory(10**21, "5 frames", "ask for fewer frames")
