"""Recordings are fetched from one commit of a git repository, and their bytes are checked."""

from __future__ import annotations

import subprocess

import pytest

from benchmarks.real.__main__ import digest, fetch, recordings
from handsim import HandSimError


def git(folder, *words: str) -> str:
    own = ["-c", "user.name=Ann", "-c", "user.email=ann@example.org", "-c", "commit.gpgsign=false"]
    return subprocess.run(
        ["git", "-C", str(folder), *own, *words], check=True, capture_output=True, text=True
    ).stdout.strip()


@pytest.fixture
def published(tmp_path, monkeypatch):
    """A set of one file, published in a repository whose newest commit has another one."""
    home = tmp_path / "published"
    (home / "data" / "Ann").mkdir(parents=True)
    git(tmp_path, "init", "--quiet", str(home))
    file = home / "data" / "Ann" / "one.trc"
    file.write_text("first")
    (home / "large.bin").write_text("not wanted")
    git(home, "add", ".")
    git(home, "commit", "--quiet", "-m", "first")
    commit = git(home, "rev-parse", "HEAD")
    files, sha256 = digest(home / "data", ["Ann"])
    file.write_text("second")
    git(home, "commit", "--quiet", "-am", "second")
    one = {"what": "a file", "address": home.as_uri(), "commit": commit, "folder": "data", "parts": ["Ann"],
           "license": "CC0", "files": files, "sha256": sha256}  # fmt: skip
    monkeypatch.setattr("benchmarks.real.__main__.recordings", lambda: {"ann": one})
    return one


def test_the_stated_commit_is_fetched_and_its_license_told(published, tmp_path, capsys):
    fetch("ann", tmp_path / "ann")
    assert [path.name for path in (tmp_path / "ann").rglob("*") if path.is_file()] == ["one.trc"]
    assert (tmp_path / "ann" / "Ann" / "one.trc").read_text() == "first"
    assert "license CC0" in capsys.readouterr().out
    fetch("ann", tmp_path / "ann")  # checks what is there


def test_other_bytes_names_and_addresses_are_refused(published, tmp_path):
    fetch("ann", tmp_path / "ann")
    (tmp_path / "ann" / "Ann" / "one.trc").write_text("changed")
    with pytest.raises(HandSimError, match="expected 1 of"):
        fetch("ann", tmp_path / "ann")
    with pytest.raises(HandSimError, match="ann"):
        fetch("bob", tmp_path / "bob")
    published["address"] = (tmp_path / "nowhere").as_uri()
    with pytest.raises(HandSimError, match="nowhere"):
        fetch("ann", tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_the_stated_checksum_is_that_of_the_captures(sig18):
    one = recordings()["sig18"]
    assert digest(sig18, one["parts"]) == (one["files"], one["sha256"])
