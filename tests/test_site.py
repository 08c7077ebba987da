"""The site of documents: it builds without a warning, and has a page for every command from its help."""

from __future__ import annotations

import html
import re
import subprocess
import sys
from pathlib import Path

import pytest

from handsim.cli.main import COMMANDS, load

pytestmark = pytest.mark.xdist_group("site")  # what they share is made once
ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", str(ROOT / "docs"), str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out


def shown(page: Path) -> str:
    return html.unescape(re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8")))


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_has_a_page_of_its_help(name: str, site: Path) -> None:
    text = shown(site / "help" / f"{name}.html")
    command = load(COMMANDS[name][0])
    programs = [f"handsim {name}"]
    programs += [f"handsim {name} {part}" for part in command] if isinstance(command, dict) else []
    for program in programs:
        assert f"usage: {program} [-h]" in text
    assert "show this help message" in text
    assert "\x1b" not in text


@pytest.mark.slow
def test_the_site_can_be_searched(site: Path) -> None:
    assert (site / "search.html").is_file()
    assert "tutorials/my_captures" in (site / "searchindex.js").read_text(encoding="utf-8")
