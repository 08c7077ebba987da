"""Every reader of files and packets, and how it is called."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from gloves import load_layout, load_take, read_capture
from gloves.takes.corrections import applied_corrections, load_corrections
from handsim import CameraRig, HandSimError, HandSimWarning, load_rig
from handsim.files.inputs import load_json
from handsim.files.outputs import claim
from handsim.space.objects import load_object
from handsim.space.rig_formats import import_cameras, load_cameras
from render import PoseFile
from render.scenery.backgrounds import draw_photo, photo_files
from render.subject import subject_of
from tests.fuzzing import seeds
from tests.fuzzing.engine import Target
from tests.fuzzing.mutations import mutate_archive, mutate_checkpoint, mutate_tail, mutate_take
from track import load_user
from track.bodies.rigid_body import load_body
from track.streams.natnet import DamagedPacket, Kind, parse_frame, parse_server_info, unpack

_CLOUD: Final = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.07, 0.0], [0.0, 0.02, 0.08]])


def _read_settings(path: Path) -> None:
    load_json(path)
    claim(path, seeds.SETTINGS, noun="training set", error=HandSimError)


def _read_take(path: Path) -> None:
    """Every part of it, as commands use them."""
    take = load_take(path)
    if take.numbers is None:
        assert take.capture().num_frames == take.num_frames
    assert all(take.poses_alone().status.shape)
    assert len(take.without_body().label_names) <= len(take.label_names)
    applied_corrections(take)


def _read_qualisys(path: Path) -> None:
    """A data packet, which comes by TCP: what the client's library makes of it."""
    from qtm_rt import QRTPacket

    from track.streams.qualisys import frame_of

    frame = frame_of(QRTPacket(path.read_bytes()))
    assert frame.points.shape == (len(frame.ids), 3)


def _read_packet(path: Path) -> None:
    kind, payload = unpack(path.read_bytes())
    if kind == Kind.SERVER_INFO or path.name == "info":
        parse_server_info(payload)
    else:
        frame = parse_frame(payload, (4, 1) if path.name.endswith("4.1") else (3, 0))
        assert np.isfinite(frame.points).all() and len(frame.points) == len(frame.ids)


def _read_photo(path: Path) -> None:
    photo_files.cache_clear()
    with _silence():
        photo_files(path.parent)
        draw_photo(path, (16, 12), np.random.default_rng(0))


@contextmanager
def _silence() -> Iterator[None]:
    """Without the messages that the libraries of OpenCV write themselves."""
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def _read_weights(path: Path) -> None:
    from train import load_labeler

    load_labeler(path.parent).label_frames([_CLOUD])


def _read_onnx(path: Path) -> None:
    from train import load_labeler

    load_labeler(path).label_frames([_CLOUD])


def _read_dataset(path: Path) -> None:
    """With checksums of what is there, so that more than the checksum is tried."""
    from train import Dataset
    from train.data.shards import MANIFEST

    manifest = path.with_name(MANIFEST)
    if path != manifest:
        content = json.loads(manifest.read_text())
        content["files"][path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
        manifest.write_text(json.dumps(content))
    dataset = Dataset(path.parent)
    rows = dataset.rows()
    hands = dataset.hands(0)
    assert len(rows) and len(rows["markers"]) and len(hands)


def _read_checkpoint(path: Path) -> None:
    from tests.fuzzing.training import state

    state(path.parent).restore(path)


def _read_calibration(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HandSimWarning)
        CameraRig("lab", import_cameras(path))


_ALL: Final = (
    Target("c3d", seeds.c3d, read_capture),
    Target("trc", seeds.trc, read_capture),
    Target("csv", seeds.csv, read_capture),
    Target("tsv", seeds.tsv, read_capture),
    Target("layout", seeds.layout, load_layout),
    Target("rig", seeds.rig, load_rig),
    Target("cameras", seeds.camera_files, load_cameras),
    Target("calibrations", seeds.calibrations, _read_calibration),
    Target("poses", seeds.own_poses, lambda path: subject_of(PoseFile(path), seed=0), mutate_archive),
    Target("body", seeds.body, load_body),
    Target("mesh", seeds.mesh, load_object),
    Target("truth", seeds.truth, _read_take, mutate_take),
    Target("tracked", seeds.tracked, _read_take, mutate_take),
    Target("recording", seeds.recording, _read_take),
    Target("corrections", seeds.corrections, load_corrections),
    Target("user", seeds.user, load_user),
    Target("weights", seeds.weights, _read_weights),
    Target("onnx", seeds.onnx, _read_onnx),
    Target("dataset", seeds.dataset, _read_dataset),
    Target("checkpoint", seeds.checkpoint, _read_checkpoint, mutate_checkpoint),
    Target("settings", seeds.settings, _read_settings),
    Target("packet", seeds.packets, _read_packet, refusals=(DamagedPacket,)),
    Target("qualisys", seeds.qualisys_packets, _read_qualisys, mutate_tail, (struct.error, ValueError)),
    Target("photo", seeds.photos, _read_photo),
)
TARGETS: Final = {target.name: target for target in _ALL}
"""By name."""
