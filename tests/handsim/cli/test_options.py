"""Every option of every command acts: another value writes something else, or is refused where it cannot."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import tyro

from gloves import write_capture
from gloves.layout import load_layout
from handsim import look_at
from handsim.cli.main import _HELP, _target_of, load, main
from handsim.cli.parsing import PresetCommand, _with_hints, registry
from handsim.space.camera import pinhole
from handsim.space.rig import CameraRig
from render.illustrations import write_video
from tests.film.filmed import SIZE, Filming, moving_take
from tests.handsim.space.known_rig import XCP
from tests.train.simulation.test_options import GENERATE, SIMULATE
from track.settings import nominal_user
from train import generate_dataset, simulate_take
from train.labelers.storage import CARD, WEIGHTS

ELSEWHERE = {
    "demo": "out", "hand": "out mesh", "glove list": "out", "glove check": "out", "glove score": "out",
    "glove improve": "out", "glove learn": "out users", "rig import": "out", "rig score": "out json",
    "rig plan": "out",
    "generate": "out workers cluster sampler", "train": "out threads", "label": "out threads",
    "export": "out scene", "evaluate": "json threads", "simulate": "out cluster",
    "calibrate": "out live seconds", "track": "out live seconds send labelled", "report": "out",
    "replay": "host port rate loop", "view": "host port out video live",
    "body": "out markers forearm elbow landmarks", "doctor": "compile send",
    "detect": "out detector",
    "film": "out format workers detector frames-per-shard openxr frames seed",
    "render": "out merge format workers cluster painter frames-per-shard",
}  # fmt: skip
"""Options that say only where something is or goes, as what, or how quickly."""
SHOWN = {
    "view": "rig time up glove size shape hands body labeler",
    "glove improve": "captures",
    "glove learn": "prove",
}
"""Options of what is shown and not written."""
SEARCHED = {
    "glove improve": "keep rig minutes seed",
    "glove score": "labeler",
    "generate": "like",
    "simulate": "like",
    "export": "guesses frame",
    "report": "guesses",
    "render": "mano",
}
"""Options that are not varied: those of a search may leave its outcome as it is, and it may take long;
guesses are of takes without a marker (tests/track/takes/test_take_faults.py), a frame is that of a scene
(tests/render/test_scene_file.py), and a MANO file is not at hand (tests/render/test_mano.py)."""
SMALL = "--batch 32 --network.width 8 --network.gates 2 --network.depth 1"
QUICK = [
    ("hand", "--out h.xml", "size XL|side left|glove dense19|actuators|shape user.json|take take.npz"),
    ("hand", "--take take.npz --out h.osim", "up y"),
    ("glove check", "dense19 --out g.png", "size XS"),
    ("glove learn", "labeled.trc --out g.toml --start dense19", "start sparse13|hands left"),
    ("rig import", "lab.xcp --out r.toml", "up y"),
    ("export", "take.npz --out x.bvh", "fps 30|up y|forward x"),
    ("export", "take.npz --out x.csv", "neutral 0 0.1|neutral take.npz"),
    ("report", "take.npz --out p.html", "neutral 0 0.1|neutral take.npz|decimal ,|cycles index_PIP_flexion"),
    ("evaluate", "labeled.trc --json f.json --occlude 4 --ghosts 2",
     "glove sparse13|labeler run|occlude 1|ghosts 0|every 7|seed 4"),
    ("evaluate", "labeled.trc --json f.json", "truth single.truth.npz"),
    ("label", "capture.c3d --out l.trc", "hands right"),
    ("train", f"set --out run2 --samples 128 {SMALL}",
     "samples 160|batch 64|optimizer sgd|learning-rate 0.01|schedule steps|weight-decay 9|average 0.1|"
     "average-every 3|precision bf16|jitter 0.05|rig-share 0|occlude 9|ghosts 7|anisotropy 0.5|seed 5|"
     "corruption tests.handsim.cli.test_options:unchanged|"
     "network.width 16|network.gates 4|network.depth 2|network.num-distances 8|network.reach 0.1"),
    ("render", "take.npz --out pics --num-frames 1 --format png --workers 1 --camera vga",
     "passes rgb|dress glove|tones dark|background gradient|depth-sensor kinect1|no-color-sensor|motion-blur|"
     "num-frames 2|frames 4|seed 4|placement orbit|camera sr300|views 2|share 0.6|distance 0.9 1.0|"
     "cameras own.toml|background photo --photos photos"),
    ("render", "take.npz --out pics --num-frames 2 --format png --workers 1 --passes depth", "every 9"),
    ("render", "take.npz --out pics --num-frames 2 --format png --workers 1 --passes rgb", "vary frame"),
    ("render", "take.npz --out pics --num-frames 1 --format png --workers 1 --passes depth --placement rig",
     "rig eight|no-room-depth"),
    ("render", "take.npz --out pics --num-frames 1 --format coco --workers 1 --passes rgb", "openxr"),
    ("render", "--poses poses.npz --out pics --format png --workers 1 --passes depth --frames-per-shard 1",
     "hands left|people 1|glove sparse13|up y"),
]  # fmt: skip
"""Commands, how they are run, and other values of their options; some 50 s of a processor in all."""
SLOW = [
    ("label", "capture.c3d --out l.trc", "glove sparse13|labeler run"),
    ("train", "set --out run2 --samples 32 --batch 16 --labeler cnn",
     "labeler set|knee 0.5|cnn.views random|cnn.reject 0.005|cnn.spread 0.05"),
    ("train", "set --out run2 --samples 32 --batch 16", "preset han2018 --average 0.5"),
    ("track", "capture.c3d --out t.npz",
     "glove sparse13|size XL|shape user.json|hands right|body pen|labeler run|calibrate|no-smooth|"
     "known index_PIP_flexion=60"),
    ("calibrate", "long.c3d --out u.json", "glove sparse13|size XL|hands right|labeler run"),
    ("demo", "--out d --num-frames 200", "seed 3|num-frames 300"),
    ("film", "moving.npz video.mp4 --out f --format png --num-frames 2 --workers 1",
     "camera lens.toml|passes rgb depth|dress skin|every 90|num-frames 3|up y"),
    ("glove score", "starter6 --out s.html --num-frames 100 --captures 0",
     "rig six|motion twins|num-frames 140|captures 1|seed 3"),
    ("glove learn", "labeled.trc --out g.toml --radius-mm 3.2 --no-prove", "radius-mm 4"),
    ("glove improve", "starter6 --out i.toml --minutes 0.02 --captures 0",
     "markers 7"),
    ("rig score", "six --out s.html --json s.json --num-frames 60",
     "volume 1 1 1|center 0.1 0 1.2|take take.npz|glove sparse13|num-frames 90|seed 3"),
    ("rig plan", "--out p.toml --cameras 3 --room 3 3 2.5",
     "cameras 4|room 5 4 3|mounts walls|volume 1.6 1.6 1.2|center 0.2 0 1.2|keep eight --cameras 10|"
     "size 640 480|field-of-view 80|glove sparse13|seed 3"),
]  # fmt: skip
"""Commands that take minutes, how they are run, and other values of their options."""
COMMANDS = [name for name in _HELP if isinstance(_target_of(name), str)]
REFUSED = {
    "evaluate labeled.trc --truth single.truth.npz --glove dense19": "--truth is given with 1 captures",
    "evaluate labeled.trc --truth single.truth.npz --threads 2": "none of --glove, --labeler, --threads",
    "export user.json --out x.glb --fps 30": "given --fps 30 and user.json, expected a take",
    "export dense19 --out x.onnx --up y": "given --up y and dense19, expected a take",
    "export user.json --out x.glb --neutral 0 1": "given --neutral 0 1 and user.json, expected a take",
    "export take.npz --out x.mot --neutral 0 1": "neutral is (0.0, 1.0) and the file x.mot, expected .csv",
    "export take.npz --out x.csv --neutral 7 9": "neutral is 7 to 9 s, where the ",
    "export take.npz --out x.csv --up y": "up is y and the file x.csv, expected a format",
    "export dense19 --out x.onnx --forward x": "given --forward x and dense19, expected a take",
    "render take.npz --out p --passes depth --tones dark": "given tones and the passes depth, expected rgb",
    "render take.npz --out p --passes depth --motion-blur": "given shutter and the passes depth",
    "render take.npz --out p --passes rgb --depth-sensor d435": "given depth_sensor and the passes rgb",
    "render take.npz --out p --background plain --photos photos": "expected the background photo",
    "render take.npz --out p --format exr --openxr": "formats are exr, expected coco or yolo",
    "render take.npz --out p --placement head --share 0.5": "given share and the placement head",
    "render take.npz --out p --placement rig --views 2": "given views and the placement rig",
    "render take.npz --out p --share 0.5 --distance 1 2": "given share 0.5 and distance (1.0, 2.0)",
    "render take.npz --out p --cameras own.toml --share 0.5": "leave out the placement",
    "render take.npz --out p --glove dense19": "--hands, --people and --glove belong to --poses",
    "render --merge a b --out p --glove dense19": "leave out the options of drawing",
    "render --merge a b --out p --people 3": "leave out the options of drawing",
    "view take.npz --glove dense19": "given --glove and the file take.npz, expected --live",
    "view take.npz --size XL": "--size is XL, but take.npz is no marker layout",
    "view user.json --rig six": "--rig is six, but user.json is a user",
    "view dense19 --up y": "--up is y, but dense19 is a layout, in which z points up",
    "view take.npz --video v.mp4 --time 0": "given --time 0 and --video v.mp4",
    "train set --out r --labeler cnn --network.width 32": "given network with the labeler cnn",
    "train set --out r --knee 0.5": "given knee with the labeler set",
    "train set --out r --ghosts 1 --corruption m:f": "given occlude or ghosts beside a corruption",
    "rig plan --out p.toml --cameras 9 --room 4 4 3 --keep six --size 9 9": "given keep six, and size",
}


def unchanged(markers, *, rng):
    """A corruption of one's own that changes nothing."""
    return markers, np.tile(np.arange(markers.shape[1]), (len(markers), 1))


def options_of(name: str) -> set[str]:
    """The options of a command as they are typed, without the dashes."""
    command = load(_target_of(name))
    if isinstance(command, PresetCommand):
        command = command.choose((), name)
    with pytest.warns(DeprecationWarning):
        parser = tyro.extras.get_parser(_with_hints(command), registry=registry())
    names = {one.option_strings[0] for one in parser._actions if one.option_strings} - {"-h"}
    also = "--frames" in names and "--num-frames" not in names
    return {"num-frames" if name == "--frames" and also else name[2:] for name in names}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_has_its_place(name):
    told = set(" ".join(table.get(name, "") for table in (ELSEWHERE, SHOWN, SEARCHED)).split())
    varied = {one.split()[0] for command, _, others in (*QUICK, *SLOW) if command == name
              for one in others.split("|")}  # fmt: skip
    simulated = {"generate": GENERATE, "simulate": SIMULATE}.get(name, ())
    varied |= {option.replace("_", "-") for option, _ in simulated}
    if "photos" not in varied and name == "render":
        varied |= {"photos", "poses"}  # in the situations above
    named = {one.removeprefix("no-") for one in varied} | ({"num-frames"} if simulated else set())
    assert options_of(name) == named | told
    assert not named & told


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """What the commands read."""
    folder = tmp_path_factory.mktemp("files")
    take = simulate_take(kind="hand-pen", num_frames=48)
    take.save(folder / "take.npz")
    single = simulate_take(num_frames=30)
    single.save(folder / "single.truth.npz")
    write_capture(folder / "labeled.trc", single.labeled_capture(sides=False))
    nominal_user(load_layout("dense19"), "L", ["right"]).save(folder / "user.json")
    (folder / "lab.xcp").write_text(XCP)
    for name, count in (("capture", "60"), ("long", "200")):
        assert main(["simulate", "--num-frames", count, "--out", str(folder / f"{name}.c3d")]) == 0
    generate_dataset(
        folder / "set", num_frames=300, frames_per_hand=20, scenes={"together": 0, "holding": 0}, workers=1
    )
    assert (
        main(["train", str(folder / "set"), "--out", str(folder / "run"), "--samples", "64", *SMALL.split()])
        == 0
    )
    place = take.qpos[0, 0, :3]
    camera = pinhole("own", (320, 240), 200.0).at(look_at(place + [0.1, -0.5, 0.2], place))
    other = dataclasses.replace(camera, name="other").at(look_at(place + [0.4, -0.4, 0.2], place))
    CameraRig("own", (camera, other)).save(folder / "own.toml")
    np.savez(folder / "poses.npz", qpos=take.qpos[:2, 0])
    (folder / "photos").mkdir()
    from render.captions import write_png

    write_png(folder / "photos" / "one.png", np.full((48, 64, 3), 90, np.uint8))
    return folder


def written(command: str, line: str, files: Path, folder: Path) -> dict[str, object]:
    """What a command writes, run in a folder of copies of the files."""
    if command == "film" and not (files / "video.mp4").exists():
        filming, take = Filming(seed=21, seconds=8.0, rate=12.0, readout=0.0), moving_take()
        take.save(files / "moving.npz")
        pictures = filming.pictures(take, "skin")
        write_video(files / "video.mp4", iter(pictures), rate=filming.rate, size=SIZE)
        camera, pushed = filming.cameras()
        smaller = dataclasses.replace(pushed, name="smaller", size=(320, 240))
        CameraRig("lens", (camera, smaller)).save(files / "lens.toml")
    shutil.copytree(files, folder)
    before = set(folder.rglob("*"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for page in ("run_page", "dataset_page", "hand_plot"):
            patch.setattr(f"train.reports.{page}.picture", lambda *drawn: "data:,")
        code = main([*command.split(), *line.split()])
    if command in ("track", "calibrate") and code == 1:
        return {}  # a glove that the hands do not wear, or a labeler of no use, is refused
    assert code == 0, line
    made = {path.relative_to(folder).as_posix(): path for path in set(folder.rglob("*")) - before}
    if command == "train":  # other files hold times
        card = json.loads(made[f"run2/{CARD}"].read_text())
        return {"weights": made[f"run2/{WEIGHTS}"].read_bytes(), "figures": card["held_out_simulated"]}
    settings = ("render.json", "checksums")  # they name the options
    return {
        name: path.read_bytes() for name, path in made.items()
        if path.is_file() and not path.name.startswith(settings)
    }  # fmt: skip


def cases(table: list[tuple[str, str, str]]) -> Iterator[object]:
    for command, line, others in table:
        for other in others.split("|"):
            marks = pytest.mark.slow if table is SLOW else ()
            yield pytest.param(command, line, other, id=f"{command} --{other}", marks=marks)


@pytest.fixture(scope="module")
def usual(files, tmp_path_factory):
    known: dict[str, dict[str, object]] = {}

    def usual(command: str, line: str) -> dict[str, object]:
        if (key := f"{command} {line}") not in known:
            known[key] = written(command, line, files, tmp_path_factory.mktemp("usual") / "work")
            assert known[key], f"handsim {key} wrote nothing"
        return known[key]

    return usual


@pytest.mark.filterwarnings("ignore::handsim.HandSimWarning")
@pytest.mark.parametrize(("command", "line", "other"), [*cases(QUICK), *cases(SLOW)])
def test_every_option_acts(command, line, other, usual, files, tmp_path):
    assert written(command, f"{line} --{other}", files, tmp_path / "work") != usual(command, line)


@pytest.mark.parametrize("line", REFUSED)
def test_what_cannot_act_is_refused(line, files, tmp_path, monkeypatch, capsys):
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    assert main(line.split()) == 1
    assert REFUSED[line] in capsys.readouterr().err
