"""The help of every command: defaults where there are some, and no type of Python shines through."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from handsim.cli.main import COMMANDS, load, main


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


LIGHT = (
    "body", "calibrate", "demo", "doctor", "evaluate", "export", "glove", "hand", "label", "replay", "report",
    "track", "view",
)  # fmt: skip


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from handsim.cli.main import main\n"
        "for name in sys.argv[1:]:\n"
        "    try: main([name, '--help'])\n"
        "    except SystemExit: pass\n"
        "    heavy = sorted(set(sys.modules) & {'torch', 'numba', 'mujoco', 'scipy', 'matplotlib', 'cv2'})\n"
        "    assert not heavy, (name, heavy)\n"
    )
    subprocess.run([sys.executable, "-c", code, "--help", *LIGHT], capture_output=True, text=True, check=True)
