"""What users get wrong, through the command line: one sentence, exit code 1, nothing left behind."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from gloves import Capture, Take, load_layout, write_capture
from gloves.fit import nominal_fit
from gloves.layout import starter_layout
from gloves.takes.archives import write_archive
from handsim import join_qpos
from handsim.app import messages
from handsim.cli.main import main
from tests.sentences import assert_names
from track import User
from train import simulate_take
from train.simulation.scenes import KINDS

MARKER = '[[marker]]\nname = "{}"\nbone = "{}"\nalong = 0.5\naround = 0.0\n'
TOP = 'name = "mine"\nradius_mm = 3.2\n'
RIG = 'name = "mine"\nfield_of_view = 60.0\n'
CAMERA = "[[camera]]\nposition = {}\ntarget = [0.0, 0.0, 1.1]\n"
FIVE = [("a", "index_distal"), ("b", "ring_distal"), ("c", "thumb_distal"), ("d", "little_distal")]
CASES = {
    "generate --glove dense91 --out out": "'dense91' | 'dense19' | tips8 | path of a .toml file",
    "glove check unknown_bone.toml": "unknown_bone.toml | 'e' | 'indx_middle' | 'index_middle' | palm",
    "glove check twice.toml": "twice.toml | two markers | 'a'",
    "generate --glove two_markers.toml --out out": "two_markers.toml | 5 to 60 | got 2",
    "label furlongs.trc --out out.trc": "furlongs.trc | 'furlongs' | mm, cm, m",
    "label empty.trc --out out.trc": "empty.trc | no frames",
    "evaluate": "no capture was given | folders | training sets | takes",
    "evaluate nothing.trc --json out.json": "nothing.trc | empty",
    "label truncated.trc --out out.trc": "truncated.trc | line 11 | 24 of 60 cells",
    "evaluate renamed.trc --json out.json": "renamed.trc | 'ThumbIP' | 'Thumb_IP' | BackHand3",
    "label takes.docx --out out.trc": "takes.docx | '.docx' | .trc, .c3d, .csv, .tsv",
    "label good.trc --out out.xlsx": "out.xlsx | '.xlsx' | .trc, .c3d, .csv",
    "label --out out.trc": "no capture | out.trc | files or folders",
    "label missing.c3d --out out.trc": "missing.c3d | No such file",
    "label good.trc --labeler sparse13 --out out.trc": "ThumbIP, ThumbTip | 'dense19' | ThumbCMC | --glove",
    "generate --num-frames 0 --out out": "num_frames is 0 | at least 1",
    "generate --workers -3 --out out": "workers is -3 | at least 1",
    "generate --volume nan --out out": "volume is nan | a number from 0 to 10",
    "generate --min-cameras 17 --out out": "min_cameras is 17 | rig 'figure5' has 16",
    "generate --slip-around nan --out out": "slip_around is nan | a number from 0 to 90",
    "generate --population.children 5 --out out": "children is 5 | a number from 0 to 1",
    "generate --blob-loss 0 1.5 --out out": "blob_loss is 1.5 | a number from 0 to 1",
    "generate --seed -1 --out out": "seed is -1 | 0 or more",
    "glove new copy.toml": "copy.toml | exists already | new file",
    "generate --rig one_camera.toml --out out": "one_camera.toml | 'mine' | 1 cameras | 2 to 32",
    "simulate --rig one_camera.toml --out out.c3d": "one_camera.toml | 'mine' | 1 cameras | 2 to 32",
    "generate --rig in_the_way.toml --out out": "camera 3 | 'mine' | 0 m | at least 0.25 m",
    "simulate --rig in_the_way.toml --out out.c3d": "camera 3 | 'mine' | 0 m | at least 0.25 m",
    "simulate --rig at_the_hands.toml --out out.c3d": "camera 3 | 'mine' | 0.15 m | at least 0.25 m",
    "simulate --rig figure6 --out out.c3d": "'figure6' | 'figure5' | eight, figure5, six",
    "simulate --glove dense91 --out out.c3d": "'dense91' | 'dense19' | path of a .toml file",
    "simulate --glove unknown_bone.toml --out out.c3d": "unknown_bone.toml | 'indx_middle' | 'index_middle'",
    "simulate --num-frames 0 --out out.c3d": "num_frames is 0 | at least 1",
    "simulate --seed -1 --out out.c3d": "seed is -1 | 0 or more",
    "simulate --out out.fbx": "out.fbx | '.fbx' | .trc, .c3d, .csv",
    "evaluate damaged.truth.npz --json out.json": "damaged.truth.npz | damaged one",
    "evaluate missing.truth.npz --json out.json": "missing.truth.npz | No such file",
    "label millimeters.trc --out out.trc": "millimeters.trc | 98 m | millimeters",
    "evaluate millimeters.trc --json out.json": "millimeters.trc | 98 m | millimeters",
    "label good.trc --labeler damaged.onnx --out out.trc": "damaged.onnx | handsim export",
    "export dense19 --out out.pt": "'dense19' | 'out.pt' | .onnx | .npz",
    "export good.truth.npz --out out.fbx": "'out.fbx' | .glb, .bvh",
    "export older.npz --out out.glb": "older.npz | schema 2 | schema 4 | again",
    "export damaged.truth.npz --out out.glb": "damaged.truth.npz | damaged one",
    "hand --size M --take good.truth.npz --out out.xml": "--size M | --take good.truth.npz | one of them",
    "export dense91 --out out.onnx": "'dense91' | 'dense19' | sparse13 | module:name",
    "track --out out.npz": "a capture or --live natnet://host",
    "track good.trc --live natnet://localhost --out out.npz": "good.trc | //localhost | a capture or --live",
    "track good.trc --seconds 3 --out out.npz": "--seconds is 3 | --live",
    "track --live natnet://localhost --calibrate --out out.npz": "--calibrate | natnet://localhost | all of",
    "track --live natnet://localhost --seconds 0 --out out.npz": "--seconds is 0 | above 0",
    "track --live localhost:1510 --out out.npz": "'localhost:1510' | natnet://host | qtm://host | module:",
    "track photos --out out.npz": "--out is out.npz | several captures | a folder",
    "track good.trc --out out.c3d": "--out is out.c3d | .npz",
    "track good.trc --out good.truth.npz": "--out is good.truth.npz | not in .truth.npz",
    "track good.trc --labeled out.tsv --out out.npz": "out.tsv | '.tsv' | .trc, .c3d, .csv",
    "track good.trc --hands left left --out out.npz": "'left left' | right, left, or one of each",
    "track good.trc --glove dense91 --out out.npz": "'dense91' | 'dense19' | path of a .toml file",
    "track millimeters.trc --out out.npz": "millimeters.trc | 98 m | millimeters",
    "track truncated.trc --out out.npz": "truncated.trc | line 11 | 24 of 60 cells",
    "track good.trc --body wand --out out.npz": "'wand' | controller, ball, box, mug | path of a .toml file",
    "track good.trc --body missing.toml --out out.npz": "missing.toml | No such file",
    "track good.trc --body in_meters.toml --out out.npz": "in_meters.toml | m0 and m1 | 0.1 mm | 6 mm",
    "track good.trc --body flat_marker.toml --out out.npz": "flat_marker.toml | 'm0' | [0, 0] | three",
    "track good.trc --body pen --out out.npz": "pen | 1 markers | at least 3",
    "track good.trc --body wand.toml --body wand.toml --out out.npz": "wand.toml | 'wand' | left, right",
    "body good.trc --out out.toml": "20 % | rigid body | nothing else",
    "body good.trc --out out.json": "--out is out.json | .toml",
    "body damaged.truth.npz --out out.toml": "damaged.truth.npz | damaged one",
    "track good.trc --shape missing.json --out out.npz": "missing.json | No such file",
    "track good.trc --shape good.trc --out out.npz": "good.trc | not a user's file | calibrate (.json)",
    "calibrate good.trc --out user.toml": "--out is user.toml | .json",
    "calibrate good.trc --out user.json": "no right and no left hand | half a minute",
    "evaluate tracked.npz --json out.json": "tracked.npz | tracked take | simulated capture",
    "evaluate good.trc --truth tracked.npz": "tracked.npz | tracked take | simulated capture",
    "evaluate good.trc --truth missing.truth.npz": "missing.truth.npz | No such file",
    "evaluate good.trc good.trc --truth good.truth.npz": "2 captures | expected one",
    "evaluate good.trc --truth good.truth.npz --ghosts 2": "--truth | none of --glove, --labeler",
    "render newer.npz --out out": "newer.npz | schema 99 | schema 4",
    "render good.trc --out out": "good.trc | .npz | handsim track",
    "render missing.npz --out out": "missing.npz | No such file",
    "render damaged.truth.npz --out out": "damaged.truth.npz | damaged one",
    "render good.truth.npz --passes rgb heat --out out": "'heat' | rgb, depth, normals, ids",
    "render good.truth.npz --format gif --out out": "'gif' | webdataset, coco, yolo",
    "render good.truth.npz --format png png --out out": "png, png | each once",
    "render good.truth.npz --format coco --passes depth --out out": "coco | rgb | passes",
    "render good.truth.npz --camera kinect9 --out out": "'kinect9' | 'kinect2' | vga",
    "render good.truth.npz --every 0 --out out": "every is 0 | at least 1",
    "render good.truth.npz --depth-sensor auto d435 --out out": "'auto' | kinect1 | none",
    "render good.truth.npz --depth-sensor sonar --out out": "'sonar' | kinect1 | none",
    "render good.truth.npz --tones green --out out": "'green' | very-light | dark",
    "render good.truth.npz --placement rig --rig figure6 --out out": "'figure6' | 'figure5' | eight",
    "render good.truth.npz --views 0 --out out": "views is 0 | at least 1",
    "render good.truth.npz --distance 0.8 0.5 --out out": "distance is (0.8, 0.5) | smaller number first",
    "render good.truth.npz --distance 0.01 0.01 --out out": "distance is 0.01 | from 0.05 to 20",
    "render good.truth.npz --photos missing --out out": "missing | folder of photographs",
    "render good.truth.npz --photos photos --out out": "photos | .jpg, .jpeg, .png",
    "render good.truth.npz --out good.trc": "good.trc | a folder",
    "rig import lab.cal --out out.toml": "lab.cal | closed format | .mcal",
    "rig import page.xml --out out.toml": "page.xml | <html> | <Cameras>, <calibration>",
    "rig import bomb.xcp --out out.toml": "bomb.xcp | document type",
    "rig import good.trc --out out.toml": "good.trc | .toml | .xcp | .mcal | cameras.txt",
    "rig import lab.xcp --out out.json": "--out is out.json | .toml",
    "train . --out out": "manifest.json | . holds none | handsim generate",
    "glove new mine.txt": "mine.txt | ends in .toml",
    "glove check gone.toml": "gone.toml | cannot be read",
    "glove learn good.trc --out out.toml": "radius of the markers | radius_mm",
    "glove learn missing.c3d --radius-mm 3 --out out.toml": "missing.c3d | No such file",
    "glove learn good.trc --radius-mm 40 --out out.toml": "radius_mm is 40 | 0.5 to 15",
    "glove learn good.trc --radius-mm 3 --out out.json": "--out is out.json | .toml",
    "glove score mine.toml --motion dance": "'dance' | poses, twins or a take",
    "glove score mine.toml --captures -1": "captures is -1 | 0 or more",
    "glove score mine.toml --frames 1": "frames is 1 | at least 100",
    "glove score mine.toml --out page.pdf": "--out is page.pdf | .html",
    "glove improve mine.toml --out mine.toml": "is the input",
    "glove improve mine.toml --out new.toml --markers 3": "markers is 3 | 5 to 60",
    "glove improve mine.toml --out new.toml --keep Tail": "to be kept are Tail",
    "hand --out hand.txt": ".xml, .urdf, .osim, .glb",
    "hand --mesh hand.fbx": ".glb, .obj, .ply, .stl",
    "hand --glove dense18": "'dense18' | 'dense19'",
    "hand --size S --shape user.json": "--size S | --shape user.json | one of them",
    "hand --take left.npz --side right": "'right' | left",
    "hand --shape user.json --glove dense19": "--glove dense19 | --shape user.json",
    "hand --out hand.urdf --actuators": "--out | .xml",
    "hand --out hand.osim --actuators": "--out | .xml",
    "hand --out hand.urdf --glove dense19": "--out | .xml or .osim",
    "hand --out hand.glb --mesh hand.glb": "two files",
    "hand --shape nobody.json": "nobody.json | cannot be read",
    "rig check mine.txt": "or the path of a .toml file",
    "rig check seven": "or the path of a .toml file",
    "rig score six --out page.pdf": "--out is page.pdf | .html",
    "rig score six --frames 1": "frames is 1 | at least 60",
    "rig score six --volume 1 0 1": "volume is 0 | above 0",
    "rig score six --center nan 0 1": "center is nan | from -50 to 50",
    "rig score six --center 0 0 1100": "center is 1100 | from -50 to 50",
    "rig score six --seed -1": "seed is -1 | 0 or more",
    "rig score six --json figures.html": "--json is figures.html | .json",
    "rig plan --cameras 1 --room 4 4 3 --out new.toml": "cameras is 1 | 2 to 32",
    "rig plan --cameras 6 --room 4 4 3 --keep six --out new.toml": "cameras is 6 | 7 to 32",
    "rig plan --cameras 6 --room 4 0 3 --out new.toml": "room is 4 x 0 x 3 m | three lengths",
    "rig plan --cameras 6 --room 4 4 3 --field-of-view 180 --out new.toml": "field_of_view is 180 | 1 to 170",
    "rig plan --cameras 6 --room 0.8 0.8 1.5 --mounts walls --volume 2 2 3 --out new.toml": "larger room",
    "simulate --num-frames 432000 --out take.tsv": ".trc, .c3d",
    "simulate --num-frames 432000 --out take.npz": ".trc, .c3d",
    "simulate --num-frames 432000 --out take": ".trc, .c3d",
    "simulate --num-frames 1000000000 --out out.c3d": "1000000000 frames need 20 TB | shorter captures",
    "render --out out": "expected a take, --poses or --merge",
    "render good.truth.npz --poses poses.npz --out out": "expected a take, --poses or --merge",
    "render good.truth.npz --people 3 --out out": "belong to --poses",
    "report tracked.npz --out page.pdf": "--out is page.pdf | .html",
    "report missing.npz --out page.html": "missing.npz | cannot be read",
    "report good.trc --out page.html": "good.trc",
    "export tracked.npz --out hands.fbx": ".glb, .bvh, .usda, .usdc, .csv, .trc, .mot",
    "export tracked.npz --out hands.onnx": "cannot write a take",
    "export dense19 --out hands.glb": ".onnx | takes | .npz | .glb",
    "export nobody.json --out hand.xml": "nobody.json | cannot be read",
    "export missing.npz --out hands.glb": "missing.npz | cannot be read",
    "export tracked.npz --out tracked.npz": "a name that ends in",
    "export tracked.npz --out x.glb --fps 0": "the rate [Hz] is 0 | above 0",
    "view": "neither a file nor --live | a file or --live natnet://host",
    "view good.trc --live natnet://127.0.0.1": "--live natnet://127.0.0.1 | a file or --live",
    "view --live natnet://127.0.0.1 --out x.toml": ".npz",
    "view takes.docx": "a file of another kind | a marker layout or camera rig",
    "view dense91": "no such file, folder or shipped name",
    "view dense19 --video x.mp4": "dense19 is a layout | nothing in it moves",
    "view --live natnet://127.0.0.1 --video x.mp4": "a live view is not drawn",
    "view good.truth.npz --video x.avi": ".mp4",
    "view good.trc --rig seven": "'seven'",
    "view good.trc --port 70000": "--port is 70000",
    "demo --out out --num-frames 0": "0",
    "demo --out out --seed -1": "-1",
    "replay good.trc --rate 0": "rate is 0 | above 0",
    "replay good.trc --port 70000": "port is 70000 | 0 to 65535",
    "replay good.trc --host 192.0.2.1": "cannot be listened at on 192.0.2.1",
    "rig import one_camera.toml --out one_camera.toml": "is the input",
    "track good.trc --out take.npz --send http://localhost:1": "'http://localhost:1' | osc://",
    "evaluate good.truth.npz --occlude 3": "leave out the corruption | --occlude",
    "evaluate good.truth.npz --ghosts 1": "leave out the corruption | --occlude",
    "evaluate good.truth.npz --every 2": "leave out the corruption | --occlude",
    "evaluate good.trc --every 0": "every is 0 | at least 1",
    "evaluate good.truth.npz good.trc": ".npz",
    "simulate --optics.noise -1 --out out.c3d": "noise is -1 | at least 0",
    "export tracked.npz --scene scene.usdc --forward=x": "and --scene, expected --out with them",
    "export tracked.npz --scene scene.usdc --fps 60": "and --scene, expected --out with them",
    "export tracked.npz --scene scene.usdc --neutral 0": "and --scene, expected --out with them",
    "export tracked.npz --scene scene.usdc --guesses": "and --scene, expected --out with them",
    "export tracked.npz --out hands.openxr.json": "ends in .glb, .bvh, .usda, .usdc, .csv, .trc, .mot",
    "hand --up y --out hand.osim": "expected --take and an --out that ends in .osim",
    "hand --up y --take left.npz --out hand.glb": "expected --take and an --out that ends in .osim",
    "track": "given neither a capture nor --live",
    "track good.trc": "given the capture good.trc without --out, expected --out FILE.npz",
    "track good.trc --send udp://:9": "given the capture good.trc without --out, expected --out FILE.npz",
    "track --live natnet://host": "--live natnet://host without --out | --out FILE.npz, --send ADDRESS or",
    "track --live qtm://h --seconds 5": "without --out, expected --out FILE.npz, --send ADDRESS or both",
    "track --live qtm://h --send udp://:9 --labeled l.trc": "and --labeled l.trc without --out, expected",
    "track --live qtm://h --known index_PIP_flexion=6 --out o.npz": "--known and --live qtm://h | a capture",
    "track good.trc empty.trc --out out.npz": "out.npz for several captures, expected a folder",
    "track good.trc new.npz": "expected a folder; did you mean --out new.npz?",
    "track good.trc empty.trc --out out --labeled out.trc": "expected one capture",
    "calibrate good.trc empty.trc --out out.json": "out.json for several captures, expected a folder",
    "report good.trc empty.trc --out out.html": "out.html for several captures, expected a folder",
    "label good.trc empty.trc --out out.c3d": "out.c3d for several captures, expected a folder",
    "label twice.c3d twice.tsv --out out": "two outputs are out/twice.c3d, expected two files",
    "label good.trc empty.trc --out .": "is the input",
    "label --out labeled": "no capture outside of labeled is given",
    "label photos --out out": "photos holds no capture",
}


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
        "twice.c3d": "not read",
        "twice.tsv": "not read",
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
    left = nominal_fit(load_layout("dense19"), "M", "left")
    Take.of_poses([left], join_qpos(np.zeros((3, 20)))[:, None], rate=120.0).save(made / "left.npz")
    User((left,)).save(made / "user.json")
    (made / "mine.toml").write_text(starter_layout())
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


@pytest.mark.parametrize("command", CASES)
def test_a_mistake_is_one_sentence(command, folder, capsys, monkeypatch):
    # However slow the machine is, no line of progress comes before the sentence.
    monkeypatch.setattr(messages, "_logged_progress", lambda *_: contextlib.nullcontext())
    before = {path.name for path in folder.iterdir()}
    assert main(command.split()) == 1
    *announced, said = capsys.readouterr().err.splitlines()
    # How far compiling is comes in as many lines as it takes.
    stages = {line for line in announced if not line.startswith("compiling ")}
    assert stages <= {"putting the glove on"}
    words = command.split()
    program = words[: 2 if words[0] in ("glove", "rig") else 1]
    assert said.startswith(f"handsim {' '.join(program)}: ")
    assert_names(said, CASES[command])
    assert {path.name for path in folder.iterdir()} == before, "something was left behind"


@pytest.mark.parametrize(
    "command",
    [
        "simulate --kind hand-pn --out out.c3d",
        "simulate --num-frames many --out out.c3d",
        "simulate --kind hand-pen",
        "track good.trc --size XXL --out out.npz",
        "track good.trc --hands middle --out out.npz",
    ],
)
def test_wrong_usage_is_code_2(command, folder, capsys):
    before = {path.name for path in folder.iterdir()}
    with pytest.raises(SystemExit) as caught:
        main(command.split())
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said and ("hand-pn" not in command or all(kind in said for kind in KINDS))
    assert {path.name for path in folder.iterdir()} == before, "something was left behind"
