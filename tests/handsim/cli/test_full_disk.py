"""A file that does not fit is named, whatever library writes it, and an older one stays."""

from __future__ import annotations

import pytest

from gloves.takes.motion_formats import MOTION_FORMATS
from handsim.cli.main import main
from tests.limits import file_size_limit

LIMIT = 2000  # bytes


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work")
    out = str(folder / "take.c3d")
    assert main(["simulate", "--kind", "single-hand", "--num-frames", "30", "--out", out]) == 0
    return folder


@pytest.mark.parametrize(
    ("command", "file"),
    [
        ("simulate --num-frames 20 --out", "a.c3d"),
        ("simulate --num-frames 20 --out", "a.trc"),
        ("simulate --num-frames 20 --out", "a.csv"),
        *(("export take.truth.npz --out", f"a{ending}") for ending in MOTION_FORMATS),
        *(("hand --out", f"a{ending}") for ending in (".xml", ".urdf", ".osim", ".glb")),
        ("export dense19 --out", "a.onnx"),
        pytest.param("label take.c3d --out", "a.c3d", marks=pytest.mark.slow),
        pytest.param("track take.c3d --size M --out", "a.npz", marks=pytest.mark.slow),
        pytest.param("report take.truth.npz --out", "a.html", marks=pytest.mark.slow),
        pytest.param("view take.truth.npz --video", "a.mp4", marks=pytest.mark.slow),
    ],
)
def test_a_file_that_is_too_large_is_named(command, file, folder, monkeypatch, capfd):
    """A limit of sizes stands for a full disk: the same system call fails."""
    monkeypatch.chdir(folder)
    assert main([*command.split(), file]) == 0  # kernels are kept in files too, once
    older, before = (folder / file).read_bytes(), sorted(folder.iterdir())
    capfd.readouterr()
    with file_size_limit(LIMIT):
        assert main([*command.split(), file]) == 1
    *_, said = capfd.readouterr().err.strip().splitlines()
    assert f": {file}: " in said and "file too large" in said.lower()
    assert (folder / file).read_bytes() == older and sorted(folder.iterdir()) == before
