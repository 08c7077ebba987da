"""Kept help pages: what is printed is what the command's own help is, and a stale page is made again."""

from __future__ import annotations

import os

import pytest

from handsim.cli.kept_help import print_help
from tests.programs import ROOT, run_python

HELP = "import sys; from handsim.cli.main import main; sys.exit(main(sys.argv[1:]))"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "handsim" / "help"


def told(page: str):
    def make() -> None:
        print(page)
        raise SystemExit(0)

    return make


def printed(capsys, prog: str, page: str) -> str:
    try:
        print_help(prog, told(page))
    except SystemExit as end:
        assert end.code == 0
    return capsys.readouterr().out


def test_a_page_is_made_once(cache, capsys):
    assert printed(capsys, "handsim glove list", "first") == "first\n"
    assert [path.name for path in cache.iterdir()] == ["handsim-glove-list.txt"]
    assert printed(capsys, "handsim glove list", "second") == "first\n"
    assert printed(capsys, "handsim glove show", "second") == "second\n"


@pytest.mark.parametrize("changed", [("COLUMNS", "50"), ("TERM", "another")])
def test_another_terminal_has_another_page(cache, capsys, monkeypatch, changed):
    printed(capsys, "handsim x", "first")
    monkeypatch.setenv(*changed)
    assert printed(capsys, "handsim x", "second") == "second\n"


def test_a_changed_source_makes_the_page_anew(cache, capsys):
    source = ROOT / "gloves" / "__init__.py"
    before = source.stat()
    printed(capsys, "handsim x", "first")
    try:
        os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
        assert printed(capsys, "handsim x", "second") == "second\n"
    finally:
        os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns))


def test_a_mistake_and_a_damaged_page_are_not_kept(cache, capsys, tmp_path):
    def fail() -> None:
        raise SystemExit(2)

    with pytest.raises(SystemExit):
        print_help("handsim x", fail)
    assert not cache.exists()
    printed(capsys, "handsim x", "first")
    (cache / "handsim-x.txt").write_bytes(b"\xff\xfe\n")
    assert printed(capsys, "handsim x", "second") == "second\n"


def test_help_without_a_place_to_keep_it(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert printed(capsys, "handsim x", "first") == "first\n"


def test_the_kept_page_is_the_commands_own_and_needs_no_parser(cache):
    first = run_python(HELP, "rig", "check", "--help").stdout
    code = HELP.replace("sys.exit(main(sys.argv[1:]))", "main(sys.argv[1:]); print('tyro' in sys.modules)")
    assert run_python(code, "rig", "check", "--help").stdout == first + "False\n"
    assert first.startswith("usage: handsim rig check")
