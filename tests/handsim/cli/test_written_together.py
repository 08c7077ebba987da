"""Commands that write several files write all of them or none, whatever happens to one."""

from __future__ import annotations

import shutil
import signal

import pytest

from handsim.cli.main import main
from tests.folders import contents
from tests.renames import fails_at

COMMANDS = {
    "simulate": ("simulate --kind single-hand --num-frames 20 --out out/a.c3d", 2),
    "track": ("track take.c3d --size M --out out/a.npz --labeled out/a.trc", 2),
    "report": ("report take.truth.npz --out out/a.html", 7),
    "hand": ("hand --out out/a.urdf --mesh out/a.stl", 2),
    "rig score": ("rig score six --frames 60 --out out/a.html --json out/a.json", 2),
    "demo": ("demo --out out --num-frames 50", 7),
}
"""Each command, and the number of its files."""
SLOW = ("track", "report", "rig score", "demo")


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    work = tmp_path_factory.mktemp("work")
    out = str(work / "take.c3d")
    assert main(["simulate", "--kind", "single-hand", "--num-frames", "30", "--out", out]) == 0
    return work


@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=pytest.mark.slow) if one in SLOW else one for one in COMMANDS]
)
def test_all_new_or_all_old(name, work, monkeypatch):
    monkeypatch.chdir(work)
    text, count = COMMANDS[name]
    command, out = text.split(), work / "out"
    shutil.rmtree(out, ignore_errors=True)
    with monkeypatch.context() as patch:
        fails_at(patch, count - 1)
        assert main(command) == 1
    assert not contents(out), "no file was there before"
    with monkeypatch.context() as patch:
        names = fails_at(patch, 0, signal.SIGTERM)
        assert main(command) == 128 + signal.SIGTERM
    assert len(names) == count and sorted(contents(out)) == sorted(file.name for file in names)
    for place in (1,) if name in SLOW else range(min(count, 3)):
        old = {file.name: f"older {place}".encode() for file in names}
        for file, content in old.items():
            (out / file).write_bytes(content)
        with monkeypatch.context() as patch:
            fails_at(patch, place)
            assert main(command) == 1
        assert contents(out) == old
