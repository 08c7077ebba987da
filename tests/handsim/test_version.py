"""What a copy of handsim says of its version: beside git, from a wheel, without either."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from gloves import attach, load_layout
from gloves.takes.take import Take
from handsim import HandModel, __version__
from handsim._version import BAKED, describe, full_version
from handsim.pages import write_sections
from tests.programs import ROOT

RELEASE = "1.2.0"


def git(folder: Path, *arguments: str) -> str:
    stated = ("user.name=a", "user.email=a@b", "commit.gpgsign=false", "tag.gpgsign=false")
    own = [word for one in stated for word in ("-c", one)]
    command = ["git", "-C", str(folder), *own, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """The folder of a package in a repository of two commits."""
    package = tmp_path / "checkout" / "handsim"
    package.mkdir(parents=True)
    git(package.parent, "init", "--quiet")
    for number in range(2):
        (package / "code.py").write_text(f"number = {number}")
        git(package.parent, "add", ".")
        git(package.parent, "commit", "--quiet", "-m", "a change")
    return package


def test_a_checkout_names_its_commit(package):
    commit = git(package.parent, "rev-parse", "--short", "HEAD")
    assert describe(package, RELEASE) == f"{RELEASE}+g{commit}"
    (package / "code.py").write_text("number = 3")
    assert describe(package, RELEASE) == f"{RELEASE}+g{commit}.dirty"


def test_commits_are_counted_from_the_tag_of_the_release(package):
    commit = git(package.parent, "rev-parse", "--short", "HEAD")
    git(package.parent, "tag", f"v{RELEASE}")
    assert describe(package, RELEASE) == RELEASE
    git(package.parent, "tag", "--delete", f"v{RELEASE}")
    git(package.parent, "tag", f"v{RELEASE}", "HEAD~1")
    assert describe(package, RELEASE) == f"{RELEASE}+1.g{commit}"
    assert describe(package, "9.0") == f"9.0+g{commit}", "a tag of another release"


def test_variables_of_git_lead_nowhere_else(package, tmp_path, monkeypatch):
    before = describe(package, RELEASE)
    monkeypatch.setenv("GIT_DIR", str(ROOT / ".git"))
    assert describe(package, RELEASE) == before


@pytest.mark.parametrize("reason", ["no checkout", "another's repository", "no git", "a broken repository"])
def test_without_git_the_release_remains(package, tmp_path, monkeypatch, reason):
    if reason == "no git":
        monkeypatch.setenv("PATH", str(tmp_path))
    elif reason == "a broken repository":
        (package.parent / ".git" / "HEAD").write_text("nonsense")
    else:
        package = (package.parent if reason == "another's repository" else tmp_path) / "site" / "handsim"
        package.mkdir(parents=True)
    assert describe(package, RELEASE) == RELEASE


def test_what_was_baked_counts_more_than_git(package):
    (package / BAKED).write_text("1.2.0+7.gabc\n")
    assert describe(package, RELEASE) == "1.2.0+7.gabc"


def test_takes_and_pages_state_the_version(tmp_path):
    assert re.fullmatch(rf"{re.escape(__version__)}(\+[a-z0-9.]+)?", full_version())
    fit = attach(load_layout("sparse13"), HandModel.named("M"))
    qpos = np.tile(np.eye(1, 27, 3), (4, 1, 1))
    take = Take.of_poses([fit], qpos, rate=100.0)
    take.save(tmp_path / "take.npz")
    with np.load(tmp_path / "take.npz") as stored:
        assert json.loads(str(stored["header"]))["handsim"] == full_version()
    write_sections(tmp_path / "page.html", [], title="a", lead="b")
    assert f"Made by handsim {full_version()}." in (tmp_path / "page.html").read_text()
