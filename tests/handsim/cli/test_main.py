"""The command as users type it: exit codes, one sentence for a mistake, and help that loads little."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path

import pytest

from handsim._version import full_version
from handsim.cli.main import COMMANDS, load, main, run
from handsim.errors import LayoutError
from handsim.files.signals import Stopped
from tests.programs import ROOT, run_python

FULL = "handsim: the disk is full; free some space and run the same command again\n"
NO_FULL = pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
LIGHT = (
    "body", "calibrate", "demo", "doctor", "evaluate", "export", "glove", "hand", "label", "replay", "report",
    "rig", "track", "view",
)  # fmt: skip


@pytest.fixture
def invoke(monkeypatch):
    """Runs a function (or dict of functions) as the command `fake` of a table of its own."""

    def invoke(command, *args):
        module = types.ModuleType("fake_commands")
        module.command = command
        monkeypatch.setitem(sys.modules, "fake_commands", module)
        return run({"fake": ("fake_commands:command", "Do nothing much.")}, ["fake", *args])

    return invoke


def raising(error: BaseException) -> Callable[[], None]:
    def command() -> None:
        raise error

    return command


def greet(name: str, *, times: int = 1) -> None:
    """Greet somebody.

    Args:
        name: Who is greeted.
        times: How often.
    """
    print("hello", name * times)


@pytest.mark.parametrize("args", [[], ["--help"], ["-h"], ["help"]])
def test_overview_lists_every_command(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(args) == 0
    out = capsys.readouterr().out
    assert all(f"  {name} " in out for name in COMMANDS)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"handsim {full_version()}\n"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("trian", "handsim: unknown command 'trian' (did you mean 'train'?); valid names: demo,"),
        ("--verison", "handsim: unknown option '--verison' (did you mean '--version'?)"),
    ],
)
def test_what_is_unknown_is_usage_and_offers_the_nearest(given, said, capsys):
    assert main([given]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith(said)


def test_arguments_reach_the_function(invoke: Callable[..., int], capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(greet, "--name", "ab", "--times", "2") == 0
    assert capsys.readouterr().out == "hello abab\n"


def test_help_of_a_command(invoke: Callable[..., int], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        invoke(greet, "--help")
    assert stop.value.code in (0, None)
    out = capsys.readouterr().out
    assert "usage: handsim fake" in out
    assert "Greet somebody." in out
    assert "How often." in out


@pytest.mark.parametrize("args", [[], ["--name", "x", "--tims", "3"], ["--name", "x", "--times", "often"]])
def test_wrong_options_are_usage(args, invoke, capsys):
    with pytest.raises(SystemExit) as stop:
        invoke(greet, *args)
    assert stop.value.code == 2
    assert "handsim fake --help" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--tims", "3"], "unknown option '--tims' (did you mean '--times'?); valid names: --help, --name, "),
        (["-t", "3"], "unknown option '-t' (did you mean '--times'?); valid names: --help, --name, "),
        (["--times", "3", "4"], "'4' after '3' is one value too many; valid options: --help, --name, "),
        (["x"], "'x' after 'y' is one value too many; valid options: --help, --name, --times; see "),
    ],
)
def test_what_a_command_does_not_take_is_named_with_what_it_takes(args, said, invoke, capsys):
    with pytest.raises(SystemExit) as stop:
        invoke(greet, "--name", "y", *args)
    assert stop.value.code == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1 and told.err.startswith(f"handsim fake: {said}")


def test_a_table_of_functions_becomes_subcommands(invoke, capsys):
    table = {"greet": greet, "fail": raising(LayoutError("no"))}
    assert invoke(table, "greet", "--name", "x") == 0
    assert capsys.readouterr().out == "hello x\n"
    assert invoke(table, "fail") == 1
    with pytest.raises(SystemExit) as stop:
        invoke(table, "gret")
    assert stop.value.code == 2


def test_a_returned_number_is_the_exit_code(invoke: Callable[..., int]) -> None:
    assert invoke(lambda: 1) == 1
    assert invoke(lambda: None) == 0
    assert invoke(lambda: Path("out")) == 0


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (LayoutError("marker 'X'\nis not on the hand"), 1, "marker 'X' is not on the hand"),
        (OSError(28, "No space left on device"), 1, "the disk is full"),
        (FileNotFoundError(2, "No such file", "a/b.trc"), 1, "a/b.trc: no such file or folder"),
        (PermissionError(13, "Permission denied", b"out"), 1, "out: permission denied"),
        (OSError(5, "Input/output error", "x"), 1, "x: input/output error"),
        (OSError("the server does not answer"), 1, "the server does not answer"),
        (MemoryError(), 1, "out of memory"),
        (ImportError("no libEGL"), 1, "no libEGL; `handsim doctor` says what is missing"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_what_a_user_can_set_right_is_told_in_one_line(error, code, line, invoke, capsys):
    assert invoke(raising(error)) == code
    err = capsys.readouterr().err
    assert err.startswith(f"handsim fake: {line}")
    assert err.count("\n") == 1


def test_errors_name_the_whole_command(capsys):
    assert main(["rig", "check", "nothing"]) == 1
    assert capsys.readouterr().err.startswith("handsim rig check: ")


def test_our_own_mistakes_are_one_line_and_a_log(invoke, capsys):
    assert invoke(lambda: 1 // 0) == 1
    said = capsys.readouterr().err
    words = "this is a bug in handsim; please report it"
    found = re.fullmatch(rf"handsim fake: unexpected ZeroDivisionError: .*; {words} and attach (\S+)\n", said)
    assert found is not None, said
    log = Path(found[1])
    assert "Traceback (most recent call last)" in log.read_text() and "test_main.py" in log.read_text()
    log.unlink()


def test_a_signal_is_told_with_what_is_kept(invoke, capsys):
    assert invoke(raising(Stopped(15, "3 of 8 frames are in out"))) == 143
    assert capsys.readouterr().err == "handsim fake: ended by SIGTERM; 3 of 8 frames are in out\n"


def test_names_that_are_no_text_are_printed(invoke, monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="utf-8"))
    assert invoke(lambda: print("take\udcff.trc")) == 0
    assert raw.getvalue() == b"take\\udcff.trc\n"


def shell(line: str) -> subprocess.CompletedProcess[str]:
    command = f"{sys.executable} -c 'import handsim.cli.main as c; raise SystemExit(c.main())'"
    line = line.replace("handsim", command)
    return subprocess.run(["bash", "-c", line], capture_output=True, text=True, cwd=ROOT, check=False)


@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        pytest.param("handsim --version > /dev/full", 1, FULL, marks=NO_FULL),
        ("(sleep 0.5; handsim --version) | true; exit ${PIPESTATUS[0]}", 141, ""),
        ("(sleep 0.5; handsim train --help) | true; exit ${PIPESTATUS[0]}", 141, ""),
        ("handsim --help >&-; true", 0, ""),
        ("handsim trian >&- 2>&-", 2, ""),
    ],
)
def test_full_disks_and_closed_streams_are_no_traceback(line, code, said):
    result = shell(line)
    assert (result.returncode, result.stderr) == (code, said)


def test_completion_knows_commands_and_options(tmp_path: Path) -> None:
    script = tmp_path / "completion.bash"
    assert shell(f"handsim --print-completion bash > {script}").returncode == 0

    def complete(*words: str) -> list[str]:
        typed = " ".join(f"'{word}'" for word in words)
        line = f"source {script}; COMP_WORDS=({typed}); COMP_CWORD={len(words) - 1}; _tyro_handsim; "
        asked = ["bash", "-c", line + 'echo "${COMPREPLY[@]}"']
        return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.split()

    assert sorted(complete("handsim", "tra")) == ["track", "train"]
    assert complete("handsim", "train", "--thr") == ["--threads"]
    assert complete("handsim", "track", "--si") == ["--size"]
    assert "list" in complete("handsim", "glove", "")
    assert shell("handsim --print-completion ksh").returncode == 2


def helps() -> list[object]:
    found = []
    for name, (target, _) in COMMANDS.items():
        command = load(target)
        words = [[name, inner] for inner in command] if isinstance(command, dict) else []
        found += [pytest.param(one, id=" ".join(one)) for one in [[name], *words]]
    return found


@pytest.mark.parametrize("words", helps())
def test_help_shows_no_types_and_no_empty_defaults(words, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        main([*words, "--help"])
    assert not stop.value.code
    said = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    assert f"usage: handsim {words[0]}" in said
    for odd in ("{None}", "None|", "(default: )", "(default: None)", "(fixed", "~T", "<class"):
        assert odd not in said, odd


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from handsim.cli.main import main\n"
        "heavy = {'torch', 'mujoco', 'numpy', 'pyrender', 'tyro'}\n"
        "for name in sys.argv[1:]:\n"
        "    try: main([name, '--help'])\n"
        "    except SystemExit: pass\n"
        "    assert not heavy & set(sys.modules), (name, heavy & set(sys.modules))\n"
        "    heavy = {'torch', 'numba', 'mujoco', 'scipy', 'matplotlib', 'cv2'}\n"
    )
    run_python(code, "--help", *LIGHT)


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["~/anna"], "hello /home/of/me/anna"),
        (["--name=~/anna"], "hello /home/of/me/anna"),
        (["--name", "~/anna"], "hello /home/of/me/anna"),
        (["--name=~"], "hello /home/of/me"),
        (["--name=a~/b"], "hello a~/b"),
        (["--name=~nobody-of-this-name/b"], "hello ~nobody-of-this-name/b"),
    ],
)
def test_the_tilde_is_the_home_folder(invoke, monkeypatch, capsys, args, said):
    monkeypatch.setenv("HOME", "/home/of/me")
    args = args if args[0].startswith("--") else ["--name", *args]
    assert invoke(greet, *args) == 0
    assert capsys.readouterr().out.strip() == said


@pytest.mark.parametrize("args", [["--name", ""], ["--name="], ["--name", "anna", "--times="]])
def test_an_empty_argument_is_no_folder(invoke, capsys, args):
    assert invoke(greet, *args) == 2
    assert "an argument is empty" in capsys.readouterr().err


@pytest.mark.parametrize("columns", ["0", "00", ""])
def test_a_terminal_without_a_width_shows_everything(columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", columns)
    assert main(["glove", "list"]) == 0
    assert "dense19" in capsys.readouterr().out
