"""What users get wrong, through the command line: one sentence, exit code 1, nothing left behind.

The sentences are a golden file; HANDSIM_RENEW_GOLDEN=1 pytest tests/test_bad_input.py writes it anew.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from gloves import Capture, load_layout, write_capture
from gloves.takes.archives import write_archive
from handsim.app import messages
from handsim.cli.main import main
from train import simulate_take

GOLDEN = Path(__file__).parent / "golden" / "bad_input.json"
MARKER = '[[marker]]\nname = "{}"\nbone = "{}"\nalong = 0.5\naround = 0.0\n'
TOP = 'name = "mine"\nradius_mm = 3.2\n'
RIG = 'name = "mine"\nfield_of_view = 60.0\n'
CAMERA = "[[camera]]\nposition = {}\ntarget = [0.0, 0.0, 1.1]\n"
FIVE = [("a", "index_distal"), ("b", "ring_distal"), ("c", "thumb_distal"), ("d", "little_distal")]


def layout(*markers: tuple[str, str]) -> str:
    return TOP + "\n".join(MARKER.format(*marker) for marker in markers)


def body(*places: str) -> str:
    markers = (f'[[marker]]\nname = "m{n}"\nplace_mm = {place}\n' for n, place in enumerate(places))
    return 'name = "wand"\n' + "".join(markers)


def rig(*positions: list[float]) -> str:
    return RIG + "\n".join(CAMERA.format(position) for position in positions)


def good_capture(folder: Path) -> str:
    path = folder / "good.trc"
    markers = np.random.default_rng(0).uniform(0, 0.1, size=(5, 19, 3))
    write_capture(path, Capture(load_layout("dense19").names, markers, 120.0))
    return path.read_text()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """What users may name, made once."""
    made = tmp_path_factory.mktemp("files")
    text = good_capture(made)
    texts = {
        "unknown_bone.toml": layout(*FIVE, ("e", "indx_middle")),
        "twice.toml": layout(*FIVE, ("a", "index_middle")),
        "two_markers.toml": layout(*FIVE[:2]),
        "one_camera.toml": rig([1.5, 0.0, 2.0]),
        "in_the_way.toml": rig([1.5, 0.0, 2.0], [-1.5, 0.0, 2.0], [0.1, 0.0, 1.3]),
        "at_the_hands.toml": rig([1.5, 0.0, 2.0], [-1.5, 0.0, 2.0], [0.0, 0.65, 1.1]),
        "damaged.truth.npz": "PK",
        "furlongs.trc": text.replace("\tmm\t", "\tfurlongs\t"),
        "millimeters.trc": text.replace("\tmm\t", "\tm\t"),
        "damaged.onnx": "onnx",
        "empty.trc": "\n".join(text.split("\n")[:5]) + "\n",
        "nothing.trc": "",
        "truncated.trc": text[: int(0.9 * len(text))],
        "words.trc": text.replace("\t1\t", "\tone\t", 1) if "\t1\t" in text else text,
        "renamed.trc": text.replace("ThumbIP", "Thumb_IP"),
        "takes.docx": "x",
        "wand.toml": body("[0, 0, 0]", "[50, 0, 0]", "[0, 80, 0]"),
        "in_meters.toml": body("[0, 0, 0]", "[0.05, 0, 0]", "[0, 0.08, 0]"),
        "flat_marker.toml": body("[0, 0]", "[50, 0]", "[0, 80]"),
        "lab.cal": "closed",
        "page.xml": "<html/>",
        "bomb.xcp": '<!DOCTYPE c [<!ENTITY a "b">]><Cameras>&a;</Cameras>',
    }
    for name, content in texts.items():
        (made / name).write_text(content)
    write_archive(made / "older.npz", {"kind": "tracked take", "schema": 2}, {})
    write_archive(made / "newer.npz", {"kind": "take", "schema": 99}, {})
    take = simulate_take(num_frames=2)
    take.save(made / "good.truth.npz")
    dataclasses.replace(take, settings={"tracker": {}}).save(made / "tracked.npz")
    (made / "photos").mkdir()
    (made / "photos" / "broken.jpg").write_text("no picture")
    load_layout("dense19").save(made / "copy.toml")
    return made


@pytest.fixture
def folder(files, tmp_path, monkeypatch):
    """A folder of its own with copies of the files."""
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


CASES = {
    "unknown glove": ["generate", "--glove", "dense91", "--out", "out"],
    "unknown bone": ["glove", "check", "unknown_bone.toml"],
    "two markers of one name": ["glove", "check", "twice.toml"],
    "a layout with two markers": ["generate", "--glove", "two_markers.toml", "--out", "out"],
    "an unknown unit": ["label", "furlongs.trc", "--out", "out.trc"],
    "a capture without rows": ["label", "empty.trc", "--out", "out.trc"],
    "an empty file": ["evaluate", "nothing.trc", "--json", "out.json"],
    "a truncated capture": ["label", "truncated.trc", "--out", "out.trc"],
    "a marker that is not there": ["evaluate", "renamed.trc", "--json", "out.json"],
    "another kind of file": ["label", "takes.docx", "--out", "out.trc"],
    "another kind of output": ["label", "good.trc", "--out", "out.xlsx"],
    "no such file": ["label", "missing.c3d", "--out", "out.trc"],
    "a labeler of another glove": ["label", "good.trc", "--labeler", "sparse13", "--out", "out.trc"],
    "no frames": ["generate", "--num-frames", "0", "--out", "out"],
    "an existing layout": ["glove", "new", "copy.toml"],
    "a rig with one camera": ["generate", "--rig", "one_camera.toml", "--out", "out"],
    "a capture by one camera": ["simulate", "--rig", "one_camera.toml", "--out", "out.c3d"],
    "a camera among the hands": ["generate", "--rig", "in_the_way.toml", "--out", "out"],
    "a camera among the hands of a capture": ["simulate", "--rig", "in_the_way.toml", "--out", "out.c3d"],
    "a camera where two hands may come": ["simulate", "--rig", "at_the_hands.toml", "--out", "out.c3d"],
    "an unknown rig": ["simulate", "--rig", "figure6", "--out", "out.c3d"],
    "an unknown glove of a capture": ["simulate", "--glove", "dense91", "--out", "out.c3d"],
    "a glove file that is none": ["simulate", "--glove", "unknown_bone.toml", "--out", "out.c3d"],
    "a capture without frames": ["simulate", "--num-frames", "0", "--out", "out.c3d"],
    "a negative seed": ["simulate", "--seed", "-1", "--out", "out.c3d"],
    "a capture in another kind of file": ["simulate", "--out", "out.fbx"],
    "a damaged take": ["evaluate", "damaged.truth.npz", "--json", "out.json"],
    "no such take": ["evaluate", "missing.truth.npz", "--json", "out.json"],
    "millimeters said to be meters": ["label", "millimeters.trc", "--out", "out.trc"],
    "millimeters said to be meters, as truth": ["evaluate", "millimeters.trc", "--json", "out.json"],
    "a damaged ONNX file": ["label", "good.trc", "--labeler", "damaged.onnx", "--out", "out.trc"],
    "an export to another kind of file": ["export", "dense19", "--out", "out.pt"],
    "motion in another kind of file": ["export", "good.truth.npz", "--out", "out.fbx"],
    "motion of a take of before": ["export", "older.npz", "--out", "out.glb"],
    "motion of a damaged take": ["export", "damaged.truth.npz", "--out", "out.glb"],
    "a size and a take": ["hand", "--size", "M", "--take", "good.truth.npz", "--out", "out.xml"],
    "an export of an unknown labeler": ["export", "dense91", "--out", "out.onnx"],
    "nothing to track": ["track", "--out", "out.npz"],
    "a capture and a stream": ["track", "good.trc", "--live", "natnet://localhost", "--out", "out.npz"],
    "a time for a capture": ["track", "good.trc", "--seconds", "3", "--out", "out.npz"],
    "a stream that is tracked twice": [
        "track",
        "--live",
        "natnet://localhost",
        "--calibrate",
        "--out",
        "out.npz",
    ],
    "no time for a stream": ["track", "--live", "natnet://localhost", "--seconds", "0", "--out", "out.npz"],
    "an address that is none": ["track", "--live", "localhost:1510", "--out", "out.npz"],
    "a tracked take in another kind of file": ["track", "good.trc", "--out", "out.c3d"],
    "a tracked take in place of the truth": ["track", "good.trc", "--out", "good.truth.npz"],
    "labels in another kind of file": ["track", "good.trc", "--labeled", "out.tsv", "--out", "out.npz"],
    "a hand twice": ["track", "good.trc", "--hands", "left", "left", "--out", "out.npz"],
    "an unknown glove to track": ["track", "good.trc", "--glove", "dense91", "--out", "out.npz"],
    "millimeters said to be meters, to track": ["track", "millimeters.trc", "--out", "out.npz"],
    "a truncated capture to track": ["track", "truncated.trc", "--out", "out.npz"],
    "an unknown body": ["track", "good.trc", "--body", "wand", "--out", "out.npz"],
    "no body's file": ["track", "good.trc", "--body", "missing.toml", "--out", "out.npz"],
    "a body in meters": ["track", "good.trc", "--body", "in_meters.toml", "--out", "out.npz"],
    "a body in a plane of two numbers": [
        "track",
        "good.trc",
        "--body",
        "flat_marker.toml",
        "--out",
        "out.npz",
    ],
    "a body with too few markers": ["track", "good.trc", "--body", "pen", "--out", "out.npz"],
    "a body twice": ["track", "good.trc", "--body", "wand.toml", "--body", "wand.toml", "--out", "out.npz"],
    "a body out of a capture of a hand": ["body", "good.trc", "--out", "out.toml"],
    "a body in another kind of file": ["body", "good.trc", "--out", "out.json"],
    "a body out of a damaged take": ["body", "damaged.truth.npz", "--out", "out.toml"],
    "an unknown user": ["track", "good.trc", "--shape", "missing.json", "--out", "out.npz"],
    "a user's file that is none": ["track", "good.trc", "--shape", "good.trc", "--out", "out.npz"],
    "a user in another kind of file": ["calibrate", "good.trc", "--out", "user.toml"],
    "a capture without hands": ["calibrate", "good.trc", "--out", "user.json"],
    "a tracked take as truth": ["evaluate", "tracked.npz", "--json", "out.json"],
    "a take of another version to draw": ["render", "newer.npz", "--out", "out"],
    "a capture to draw": ["render", "good.trc", "--out", "out"],
    "no take to draw": ["render", "missing.npz", "--out", "out"],
    "a damaged take to draw": ["render", "damaged.truth.npz", "--out", "out"],
    "an unknown pass": ["render", "good.truth.npz", "--passes", "rgb", "heat", "--out", "out"],
    "an unknown format": ["render", "good.truth.npz", "--format", "gif", "--out", "out"],
    "a format twice": ["render", "good.truth.npz", "--format", "png", "png", "--out", "out"],
    "a format without its pictures": [
        *("render", "good.truth.npz", "--format", "coco", "--passes", "depth", "--out", "out"),
    ],
    "an unknown camera": ["render", "good.truth.npz", "--camera", "kinect9", "--out", "out"],
    "an unknown depth sensor": ["render", "good.truth.npz", "--depth-sensor", "sonar", "--out", "out"],
    "an unknown skin tone": ["render", "good.truth.npz", "--tones", "green", "--out", "out"],
    "an unknown rig to draw": [
        *("render", "good.truth.npz", "--placement", "rig", "--rig", "figure6", "--out", "out"),
    ],
    "a camera too near": ["render", "good.truth.npz", "--distance", "0.01", "0.01", "--out", "out"],
    "no folder of photographs": ["render", "good.truth.npz", "--photos", "missing", "--out", "out"],
    "a folder of broken photographs": ["render", "good.truth.npz", "--photos", "photos", "--out", "out"],
    "pictures into a file": ["render", "good.truth.npz", "--out", "good.trc"],
    "a calibration in a closed format": ["rig", "import", "lab.cal", "--out", "out.toml"],
    "a page for a calibration": ["rig", "import", "page.xml", "--out", "out.toml"],
    "a calibration with entities": ["rig", "import", "bomb.xcp", "--out", "out.toml"],
    "a capture for a calibration": ["rig", "import", "good.trc", "--out", "out.toml"],
    "a rig in another kind of file": ["rig", "import", "lab.xcp", "--out", "out.json"],
    "an unfinished training set": ["train", ".", "--out", "out"],
}


@pytest.mark.parametrize("name", CASES)
def test_a_mistake_is_one_sentence(name, folder, capsys, monkeypatch):
    # However slow the machine is, no line of progress comes before the sentence.
    monkeypatch.setattr(messages, "_lines", lambda *_: contextlib.nullcontext())
    before = {path.name for path in folder.iterdir()}
    assert main(CASES[name]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert {path.name for path in folder.iterdir()} == before, "something was left behind"
    golden = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {}
    if os.environ.get("HANDSIM_RENEW_GOLDEN"):
        golden[name] = said.strip()
        GOLDEN.write_text(json.dumps(golden, indent=1, sort_keys=True) + "\n")
    assert said.strip() == golden[name]


USAGE = {
    "an unknown kind of capture": ["simulate", "--kind", "hand-pn", "--out", "out.c3d"],
    "frames that are no number": ["simulate", "--num-frames", "many", "--out", "out.c3d"],
    "no output": ["simulate", "--kind", "hand-pen"],
    "an unknown size": ["track", "good.trc", "--size", "XXL", "--out", "out.npz"],
    "an unknown hand": ["track", "good.trc", "--hands", "middle", "--out", "out.npz"],
}


@pytest.mark.parametrize("name", USAGE)
def test_wrong_usage_is_code_2(name, folder, capsys):
    before = {path.name for path in folder.iterdir()}
    with pytest.raises(SystemExit) as caught:
        main(USAGE[name])
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err
    assert {path.name for path in folder.iterdir()} == before, "something was left behind"
