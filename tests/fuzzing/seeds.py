"""Valid files of every kind, small and the same each time."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import trimesh

from gloves import Capture, GloveFit, RigidBody, Take, attach, load_layout, load_take, write_capture
from gloves.layout import starter_layout
from gloves.takes import points as table
from gloves.takes.archives import GrowingArchive, growing_path
from gloves.takes.corrections import NO_MARKER, Correction, save_corrections
from gloves.takes.take import STATUSES, keypoints_of, take_header, worn_arrays
from handsim import HandModel, sample_shape
from handsim.space.objects import named_object
from track import RigidTemplate, StreamedFrame, User
from track.bodies.rigid_body import save_body
from track.streams.natnet import ServerInfo, pack_frame, pack_server_info

FRAMES, COLUMNS = 4, 24
SETTINGS = {"num_frames": 10, "glove": "dense19", "scenes": {"one": 1.0}}
MOTIVE = """\
Format Version,1.23,Take Name,Take 1,Capture Frame Rate,120.000000,Export Frame Rate,120.000000,\
Rotation Type,Quaternion,Total Frames in Take,3,Total Exported Frames,3,Length Units,Meters,\
Coordinate Space,Global

,,Type,Marker,Marker,Marker,Marker,Marker,Marker
,,Name,Hand:Thumb,Hand:Thumb,Hand:Thumb,Unlabeled 17,Unlabeled 17,Unlabeled 17
,,ID,1,1,1,2,2,2
,,,Position,Position,Position,Position,Position,Position
Frame,Time (Seconds),,X,Y,Z,X,Y,Z
0,0.000000,,0.1,0.2,0.3,0.15,0.25,0.35
1,0.008333,,0.11,0.21,0.31,,,
2,0.016667,,0.12,0.22,0.32,0.16,0.26,0.36
"""


def _rng() -> np.random.Generator:
    return np.random.default_rng(17)


def capture() -> Capture:
    positions = _rng().uniform(0.0, 0.2, size=(12, 7, 3))
    positions[3, 2] = np.nan
    return Capture(("ThumbTip", "*2", "Anna:c", "d", "e", "f", "Unlabeled 7"), positions, 120.0)


def trc(folder: Path) -> list[Path]:
    """As we write it; with commas, twice as many in line 3 trajectories without a name; Excel's; spaces."""
    write_capture(folder / "take.trc", capture())
    lines = (folder / "take.trc").read_text().splitlines()
    lines[2] = lines[2].replace("\t", "\t\t")
    lines[3] = "\t".join(lines[3].split("\t")[: 2 + 3 * 5])
    (folder / "commas.trc").write_text("\n".join(lines).replace("\t", ",") + "\n")
    european = (folder / "take.trc").read_text().replace(".", ",").encode("utf-16")
    (folder / "excel.trc").write_bytes(european)
    words = (
        (folder / "take.trc").read_text().replace("Unlabeled 7", "g").replace("\t" * 4, "\tnan\tnan\tnan\t")
    )
    spaced = "\n".join(" ".join(line.split()) for line in words.splitlines())
    (folder / "spaces.trc").write_text(spaced + "\n")
    return [folder / f"{name}.trc" for name in ("take", "commas", "excel", "spaces")]


def c3d(folder: Path) -> list[Path]:
    """As we write it, and as integers of the other byte order, with analog numbers and gaps."""
    from tests.gloves.captures.test_c3d import SGI
    from tests.gloves.captures.test_c3d import c3d as foreign

    write_capture(folder / "take.c3d", capture())
    data = foreign(processor=SGI, scale=0.125, analog=3, missing=((1, 0),))
    (folder / "integers.c3d").write_bytes(data)
    return [folder / "take.c3d", folder / "integers.c3d"]


def csv(folder: Path) -> list[Path]:
    """Two of Motive, with labels of rows and as we write it, one of Vicon among others; two European."""
    from tests.gloves.captures.test_formats import DEVICES, nexus
    from tests.gloves.captures.test_text import rewritten

    (folder / "take.csv").write_text(MOTIVE)
    write_capture(folder / "ours.csv", capture())
    (folder / "vicon.csv").write_text(DEVICES + nexus() + "\n")
    (folder / "quoted.csv").write_text(rewritten(MOTIVE, ",", quoted=True, commas=True))
    (folder / "semicolons.csv").write_text(rewritten(nexus(), ";", commas=True))
    names = ("take.csv", "ours.csv", "vicon.csv", "quoted.csv", "semicolons.csv")
    return [folder / name for name in names]


def tsv(folder: Path) -> list[Path]:
    from tests.gloves.captures.test_formats import qtm

    (folder / "take.tsv").write_text(qtm(version=True, events=("Start",)))
    (folder / "bare.tsv").write_text(qtm(columns=False, leading=False))
    return [folder / "take.tsv", folder / "bare.tsv"]


def layout(folder: Path) -> list[Path]:
    (folder / "starter.toml").write_text(starter_layout())
    load_layout("dense19").save(folder / "dense.toml")
    return [folder / "starter.toml", folder / "dense.toml"]


def rig(folder: Path) -> list[Path]:
    top = 'name = "mine"\nfield_of_view = 60.0\nresolution = 1280\n'
    camera = "[[camera]]\nposition = [{}, 0.0, 2.0]\ntarget = [0.0, 0.0, 1.1]\n"
    (folder / "rig.toml").write_text(top + camera.format(1.5) + camera.format(-1.5))
    return [folder / "rig.toml"]


def camera_files(folder: Path) -> list[Path]:
    top = 'name = "desk"\n[[camera]]\nname = "left"\nsize = [640, 480]\nfocal = [600.0, 601.0]\n'
    lens = 'lens = "brown"\ncoefficients = [0.1, -0.05, 0.001, 0.0, 0.0]\n'
    (folder / "desk.toml").write_text(top + lens + "position = [0.5, 0, 0.2]\ntarget = [0, 0, 0.1]\n")
    for ending in ("yml", "json"):
        file = cv2.FileStorage(str(folder / f"stereo.{ending}"), cv2.FILE_STORAGE_WRITE)
        for name, value in {"image_width": 640, "image_height": 480, "T": np.full((3, 1), 0.05)}.items():
            file.write(name, value)
        for name in ("M1", "M2", "R"):
            file.write(name, np.diag([500.0, 500.0, 1.0]) if name != "R" else np.eye(3))
        file.write("D1", np.array([[0.1, -0.02, 0.001, 0.002, 0.0]]))
        file.release()
    pinhole = "[one]\nsize = [640, 480]\nmatrix = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\n"
    pose = "rotation = [0.1, 0.2, 0.3]\ntranslation = [0.1, 0, 1]\n"
    (folder / "calib.toml").write_text(
        f"{pinhole}distortions = [0.1, 0, 0, 0]\n{pose}[metadata]\nerror = 0.0\n"
    )
    binary = folder / "0"
    binary.mkdir()
    (binary / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 640, 480, 500, 500, 320, 240))
    image = struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 1, 1) + b"one.jpg\0"
    (binary / "images.bin").write_bytes(image + struct.pack("<Qddq", 1, 1.0, 2.0, -1))
    (folder / "info.yaml").write_text(
        "height: 480\nwidth: 640\ndistortion_model: equidistant\nd:\n- 0.1\n- 0.0\n- 0.0\n- 0.0\n"
        "k: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nr: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
        "p: [500, 0, 320, 0, 0, 500, 240, 0, 0, 0, 1, 0]\n---\n"
    )
    nested = {"CameraMatrix": [[500, 0, 320], [0, 500, 240], [0, 0, 1]], "image_size": [640, 480]}
    nested["distortion"] = {"model": "plumb_bob", "k1": 0.1, "k2": 0.0}
    (folder / "nested.json").write_text(json.dumps(nested), "utf-16")
    (folder / "cameras.txt").write_text("# cameras\n1 OPENCV 640 480 500 501 320 240 0.1 0.01 0 0\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0.1 0.2 0.3 1 one.jpg\n\n2 0 1 0 0 0 0 1 1 two.jpg\n\n")
    names = (
        "desk.toml", "stereo.yml", "stereo.json", "cameras.txt", "images.txt", "calib.toml", "info.yaml",
        "nested.json", "0/cameras.bin", "0/images.bin",
    )  # fmt: skip
    return [folder / name for name in names]


def calibrations(folder: Path) -> list[Path]:
    """Of camera systems: Vicon's, Qualisys', Motive's, and OpenCV's of many cameras."""
    from tests.handsim.space.known_rig import written

    return list(written(folder).values())


def own_poses(folder: Path) -> list[Path]:
    qpos = np.zeros((FRAMES, 27))
    qpos[:, 3] = 1.0
    people = {"person": np.arange(FRAMES) % 2, "hand_size": np.array([[0.19, 0.085], [0.17, 0.08]])}
    np.savez(folder / "poses.npz", qpos=qpos, times=np.arange(FRAMES) / 30.0, **people)
    return [folder / "poses.npz"]


def body(folder: Path) -> list[Path]:
    save_body(folder / "body.toml", RigidTemplate.of(named_object("controller")))
    return [folder / "body.toml"]


def corrections(folder: Path) -> list[Path]:
    made = [
        Correction(3, 7, (0.1, -0.2, 1.0), "right:ThumbTip"),
        Correction(0, 0, (0.0, 0.0, 0.0), NO_MARKER),
    ]
    save_corrections(folder / "take.corrections.toml", made)
    return [folder / "take.corrections.toml"]


def mesh(folder: Path) -> list[Path]:
    box = trimesh.creation.box((0.05, 0.06, 0.07))
    for ending in ("stl", "obj", "ply", "glb"):
        box.export(folder / f"box.{ending}")
    return [folder / f"box.{ending}" for ending in ("stl", "obj", "ply", "glb")]


def hands() -> tuple[GloveFit, ...]:
    rng = _rng()
    shapes = [sample_shape(side=side, rng=rng) for side in ("left", "right")]
    return tuple(attach(load_layout("sparse13"), HandModel(shape)) for shape in shapes)


def take_of_truth() -> Take:
    qpos = np.zeros((FRAMES, 2, 27))
    qpos[..., 3] = 1.0
    columns = np.tile(np.arange(COLUMNS), (FRAMES, 1))
    points = _rng().uniform(0.0, 0.2, size=(FRAMES, COLUMNS, 3))
    return Take.of_truth(
        hands(), qpos, points, columns, columns, rate=120.0, settings={"kind": "single-hand"}
    )


def truth(folder: Path) -> list[Path]:
    take_of_truth().save(folder / "take.truth.npz")
    return [folder / "take.truth.npz"]


def tracked(folder: Path) -> list[Path]:
    take = dataclasses.replace(
        take_of_truth(),
        rms=np.full((FRAMES, 2), 1e-3),
        bodies=(RigidBody("pen", ("Pen1", "Pen2", "Pen3"), 0.05 * np.eye(3)),),
        body_poses=np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (FRAMES, 1, 1)),
        body_status=np.full((FRAMES, 1), STATUSES.index("tracked"), dtype=np.int8),
        body_rms=np.full((FRAMES, 1), 1e-3),
        settings={"glove": "sparse13"},
    )
    take.save(folder / "take.npz")
    return [folder / "take.npz"]


def recording(folder: Path) -> list[Path]:
    """A recording that was cut off, as it grows."""
    (path,) = tracked(folder)
    take = load_take(path)
    path.unlink()
    header = take_header(take.hands, take.bodies, None, {"glove": "sparse13"})
    sizes = {"H": len(take.hands), "B": len(take.bodies)}
    growing = (*table.FRAMES, *table.POINTS, table.NUMBERS, table.KEYPOINTS)
    columns = [column.sized(sizes) for column in growing]
    keypoints = keypoints_of(take.hands, take.qpos)
    path = growing_path(path)
    path.unlink(missing_ok=True)
    with GrowingArchive(path, header, worn_arrays(take.hands, take.bodies), columns) as archive:
        for row in range(take.num_frames):
            values = {
                column.name: getattr(take, column.name)[row] for column in (*table.FRAMES, *table.POINTS)
            }
            archive.add(values | {"numbers": row, "keypoints": keypoints[row]}, COLUMNS)
            archive.flush()
    return [path]


def user(folder: Path) -> list[Path]:
    User(hands(), "calibrated").save(folder / "user.json")
    return [folder / "user.json"]


def settings(folder: Path) -> list[Path]:
    (folder / "config.json").write_text(json.dumps(SETTINGS))
    return [folder / "config.json"]


def packets(folder: Path) -> list[Path]:
    rng = _rng()
    frame = StreamedFrame(7, 1.25, rng.uniform(size=(9, 3)), np.array([*range(8), -1]))
    info = ServerInfo("Motive", (3, 1), 1511, "239.255.42.99")
    contents = {
        "frame-3.0": pack_frame(frame, (3, 0)),
        "frame-4.1": pack_frame(frame, (4, 1)),
        "info": pack_server_info(info),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return [folder / name for name in contents]


def qualisys_packets(folder: Path) -> list[Path]:
    from tests.track.streams.test_qualisys import frame

    (folder / "packet").write_bytes(frame(7)[8:])  # without the header of the stream
    return [folder / "packet"]


def photos(folder: Path) -> list[Path]:
    picture = _rng().integers(0, 256, size=(24, 32, 3), dtype=np.uint8)
    names = ("photo.jpg", "photo.png", "photo.webp", "photo.bmp", "photo.tif")
    for name in names:
        cv2.imwrite(str(folder / name), picture)
    return [folder / name for name in names]


def small_network():
    import torch

    from train import SetLabelerConfig
    from train.labelers.networks import new_network

    torch.manual_seed(0)
    return new_network(SetLabelerConfig(num_labels=4, width=8, gates=2, depth=1, num_distances=4))


def weights(folder: Path) -> list[Path]:
    from train.labelers.storage import CARD, WEIGHTS, save_network

    save_network(folder, small_network(), {"marker_names": list("abcd")})
    return [folder / WEIGHTS, folder / CARD]


def onnx(folder: Path) -> list[Path]:
    from train.labelers.storage import export_onnx

    export_onnx(small_network(), tuple("abcd"), folder / "labeler.onnx")
    return [folder / "labeler.onnx"]


def dataset(folder: Path) -> list[Path]:
    from handsim.hand.shape import HAND_DTYPE, pack_hand
    from train.data.shards import CONFIG, MANIFEST, Manifest, hands_name, row_dtype, rows_name, save_array

    names = load_layout("sparse13").names
    rows = np.zeros(3, dtype=row_dtype(len(names)))
    rows["qpos"][:, 3] = 1.0
    rows["markers"] = rows["observed"] = _rng().uniform(0.0, 0.2, size=(3, len(names), 3))
    save_array(folder / rows_name(0), rows)
    save_array(folder / hands_name(0), np.array([pack_hand(hands()[1].shape)], dtype=HAND_DTYPE))
    files = [folder / rows_name(0), folder / hands_name(0)]
    sums = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
    manifest = Manifest({"glove": "sparse13"}, names, 3, 3, sums)
    for name, content in ((MANIFEST, dataclasses.asdict(manifest)), (CONFIG, {"glove": "sparse13"})):
        (folder / name).write_text(json.dumps(content, indent=1))
    return [*files, folder / MANIFEST]


def checkpoint(folder: Path) -> list[Path]:
    from tests.fuzzing.training import state

    state(folder).save(folder / "checkpoint.pt")
    return [folder / "checkpoint.pt"]
