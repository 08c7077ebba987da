"""Names of files that are not text: every output is written under them."""

from __future__ import annotations

import dataclasses
import os
import sys

import pytest

from gloves.layout import load_layout
from gloves.takes.take import MOTION_FORMATS
from handsim.cli.main import main
from handsim.files.outputs import as_text, plain_path
from track.user import load_user, nominal_user

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="names are text")
NAME = os.fsdecode(b"t\xe4ke")  # of an old Windows system
SHOWN = "t\N{REPLACEMENT CHARACTER}ke"

SAID = {
    ".mot": f"{SHOWN}\n",
    ".html": "<title>Take t?ke.truth.npz</title>",
}
"""What files say of names, by their endings."""


def test_what_is_not_printable_is_replaced():
    assert as_text(NAME) == SHOWN and as_text("a\tb\n") == as_text("a\nb\t") and as_text("täke 1") == "täke 1"


def test_a_path_that_is_no_text_has_a_link_that_is(tmp_path):
    (tmp_path / NAME).mkdir()
    path = tmp_path / NAME / f"{NAME}.c3d"
    with plain_path(path) as plain:
        assert str(plain).isascii() and plain.suffix == ".c3d"
        plain.write_text("written")
    assert path.read_text() == "written"
    with plain_path(path) as plain:
        assert plain.read_text() == "written"
        (tmp_path / "other").write_text("replaced")
        (tmp_path / "other").replace(plain)
    assert path.read_text() == "replaced" and os.listdir(path.parent) == [path.name]
    with plain_path(tmp_path / "text.c3d") as plain:
        assert plain == tmp_path / "text.c3d"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work") / NAME
    out = str(folder / f"{NAME}.c3d")
    assert main(["simulate", "--kind", "single-hand", "--num-frames", "30", "--out", out]) == 0
    return folder


@pytest.mark.parametrize(
    ("command", "ending"),
    [
        *(
            ("simulate --kind single-hand --num-frames 20 --out", ending)
            for ending in (".trc", ".csv", ".c3d")
        ),
        *(("export {0}.truth.npz --out", ending) for ending in MOTION_FORMATS),
        *(("hand --out", ending) for ending in (".xml", ".urdf", ".osim", ".glb")),
        ("hand --out hand.xml --mesh", ".obj"),
        ("export dense19 --out", ".onnx"),
        ("report {0}.truth.npz --out", ".html"),
        ("rig import rig.toml --out", ".toml"),
        pytest.param("view {0}.truth.npz --video", ".mp4", marks=pytest.mark.slow),
        pytest.param("label {0}.c3d --out", ".c3d", marks=pytest.mark.slow),
    ],
)
def test_commands_write_under_such_a_name(command, ending, folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "rig.toml").unlink(missing_ok=True)
    assert main(["rig", "new", "rig.toml"]) == 0
    out = folder / "new" / f"{NAME}{ending}"
    assert main([*(word.format(NAME) for word in command.split()), str(out)]) == 0
    assert out.stat().st_size > 0
    if ending in SAID:
        assert SAID[ending] in out.read_text("utf-8")
    assert not [one for one in os.listdir(out.parent) if one.startswith(".")]


def test_a_user_calibrated_from_such_a_capture_is_kept(tmp_path):
    user = nominal_user(load_layout("dense19"), "M", ["right"])
    dataclasses.replace(user, notes=f"calibrated from {NAME}.c3d").save(tmp_path / "user.json")
    assert load_user(tmp_path / "user.json").notes == "calibrated from t?ke.c3d"
