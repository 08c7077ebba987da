"""Training sets: the same bytes however they are made, and damage that is named."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.recfunctions import repack_fields

from gloves import MarkerLayout, MarkerPlace, attach, load_layout
from handsim import HandModel, HandSimWarning, Population, join_qpos, load_rig
from handsim.app.output import CHECKSUMS
from handsim.cli.main import main
from handsim.errors import ArgumentError, DatasetError, PoseError
from handsim.files.inputs import checksum
from handsim.files.signals import Stopped
from handsim.space.rig import ROOM_CENTER, CameraRig
from handsim.space.transforms import rigid
from poses import sample_poses
from poses.shapes import HIGH, LOW
from tests.folders import contents
from tests.rigs import mixed_rig
from tests.sentences import error_names
from tests.waiting import wait_for
from track.viewer.recordings import DatasetRecording
from train import Dataset, GenerateSettings, SceneMix, generate_dataset, simulate_take
from train.data.shards import MANIFEST, hands_name, is_dataset, redrawn_name, rows_name
from train.reports.dataset_page import REPORT, write_dataset_page
from train.simulation import generation, training_frames
from train.simulation.generation import make_dataset
from train.simulation.training_frames import FLESH, NO_GRASP, NO_REST, NO_TOUCH, NOISE

CONFIG = GenerateSettings(num_frames=700, seed=3, frames_per_hand=50)
COMMAND = """
import sys
from pathlib import Path
from train.simulation import generation
from train.simulation.training_frames import GenerateSettings
generation.ROWS_PER_SHARD = 200
if __name__ == "__main__":
    config = GenerateSettings(num_frames=700, seed=3, frames_per_hand=50)
    generation.make_dataset(config, Path(sys.argv[1]), workers=1)
"""

# Workers run a script again only for what it defines, here with its small shards.
OWN = """
make_shard = generation.make_shard
def make_own(config, out, shard):
    return make_shard(config, out, shard)
generation.make_shard = make_own
"""

# Two shards and no more, so that the kill comes before the end however busy the machine is.
STALLED = """
import threading
make_shard = generation.make_shard
def make_two(config, out, shard):
    if shard == 2:
        threading.Event().wait()
    return make_shard(config, out, shard)
generation.make_shard = make_two
"""
MANIFESTS = {
    "marker_names": (5, "marker_names is 5, expected a tuple"),
    "num_frames": (float("nan"), "num_frames is nan, expected a whole number"),
    "files": ({"../../etc/passwd": "0"}, "files is not a table of names of files in this folder"),
    "config": (None, "config is not a table"),
    "redrawn": ([1], "redrawn is not a table of counts"),
}
DIGITS = ("thumb", "index", "middle", "ring", "little")
LAYOUT = MarkerLayout(
    "mine",
    (
        *(MarkerPlace(f"{digit}_tip", f"{digit}_distal", 0.5, 0.0) for digit in DIGITS),
        MarkerPlace("back", "palm", 0.5, 0, 0.2),
    ),
    radius=0.004,
)
ALONE = {"together": 0, "holding": 0}


@pytest.fixture(autouse=True)
def small_shards(monkeypatch):
    monkeypatch.setattr(generation, "ROWS_PER_SHARD", 200)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("sets") / "undisturbed"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generation, "ROWS_PER_SHARD", 200)
        make_dataset(CONFIG, out, workers=1)
    return out


def test_rows_are_what_they_say(finished):
    dataset = Dataset(finished)
    rows = dataset.rows()
    assert len(rows) == 700
    assert dataset.marker_names[4] == "IndexMCP"
    first = dataset.shards[0]
    assert [shape.side for shape in dataset.hands(0)[:4]] == ["left", "right"] * 2
    rows_a_person = np.bincount(first["hand"] // 2)
    assert (rows_a_person[:-1] == 50).all()
    for number in np.unique(first["hand"]):
        shape = dataset.hands(0)[number]
        model, mine = HandModel(shape), first[first["hand"] == number]
        qpos = mine["qpos"].astype(np.float64)
        assert (qpos[:, 7:] > LOW - 1e-6).all()
        assert (qpos[:, 7:] < HIGH + 1e-6).all()
        assert model.penetration(join_qpos(qpos[:, 7:])).max() < 0.001 + 1e-6
        reach = np.linalg.norm(mine["markers"] - qpos[:, None, :3], axis=-1)
        assert 0.01 < reach.min() < reach.max() < 1.3 * shape.length
    assert {0, 1} == set(rows["hand"] % 2)
    assert (rows["cameras"] > 0).mean() > 0.9
    off = np.linalg.norm(rows["observed"] - rows["markers"], axis=-1)
    assert 0.85 < np.isfinite(off).mean() < 1.0
    assert np.nanmedian(off) < 0.0005
    assert 0.1 < np.isfinite(rows["ghosts"][..., 0]).sum(axis=1).mean() < 2.0


def test_gloves_are_kept_as_each_person_wore_them(finished):
    dataset, usual = Dataset(finished), load_layout("dense19")
    slips = []
    for shard, rows in enumerate(dataset.shards):
        hands, gloves = dataset.hands(shard), dataset.gloves(shard)
        assert len(gloves) == len(hands)
        used = np.unique(rows["hand"])
        assert [number for number, glove in enumerate(gloves) if glove is not None] == used.tolist()
        for number in used:
            mine = rows[rows["hand"] == number]
            fit = attach(gloves[number], hands[number])
            markers = fit.markers(mine["qpos"].astype(np.float64))[0]
            np.testing.assert_allclose(markers, mine["markers"], atol=1e-5)
            slips += [
                one.along - two.along for one, two in zip(fit.layout.markers, usual.markers, strict=True)
            ]
    assert 0.05 < np.std(slips) < 0.12
    assert all((finished / hands_name(shard)).stat().st_size < 20_000 for shard in range(len(dataset.shards)))


def test_markers_move_with_flesh_where_that_is_asked_for(tmp_path):
    given = {"num_frames": 200, "frames_per_hand": 50, "workers": 1}
    plain, moved = (generate_dataset(tmp_path / str(flesh), flesh=flesh, **given) for flesh in (False, True))
    assert "flesh" not in plain.manifest.config and moved.manifest.config["flesh"] is True
    (rows,), hands, gloves = moved.shards, moved.hands(0), moved.gloves(0)
    away = []
    for number in np.unique(rows["hand"]):
        mine = rows[rows["hand"] == number]
        away.append(mine["markers"] - attach(gloves[number], hands[number]).markers(mine["qpos"])[0])
    assert np.sqrt((np.concatenate(away) ** 2).mean()) == pytest.approx(np.hypot(NOISE, FLESH), rel=0.15)


def with_hands_of(finished: Path, folder: Path, fields: list[str]) -> Dataset:
    """A copy of the set whose first hands file has these fields alone, as an earlier version wrote it."""
    copy = shutil.copytree(finished, folder / "copy")
    path, manifest = copy / hands_name(0), json.loads((copy / MANIFEST).read_text())
    records = np.load(path)
    np.save(path, repack_fields(records[fields]))
    manifest["files"][hands_name(0)] = checksum(path)
    (copy / MANIFEST).write_text(json.dumps(manifest))
    return Dataset(copy)


@pytest.mark.parametrize("lost", ["nothing", "person", "places"])
def test_sets_of_earlier_versions_are_read(finished, tmp_path, lost):
    names = list(np.load(finished / hands_name(0)).dtype.names)
    old = with_hands_of(finished, tmp_path, names[: {"nothing": None, "person": -1, "places": -2}[lost]])
    new = Dataset(finished)
    assert old.hands(0)[3].length == new.hands(0)[3].length
    np.testing.assert_array_equal(old.people(), new.people())
    if lost == "places":
        with pytest.raises(DatasetError, match=r"hands-00000\.npy holds no places of markers"):
            old.gloves(0)
    else:
        assert old.gloves(0) == new.gloves(0)


def test_both_hands_of_a_person_have_the_number_of_the_person(finished):
    dataset, known = Dataset(finished), []
    for shard, rows in enumerate(dataset.shards):
        hands = np.load(finished / hands_name(shard))
        known.append(hands["person"][rows["hand"]])
        assert (hands["person"][0::2] == hands["person"][1::2]).all()
        assert hands["left"].tolist() == [True, False] * (len(hands) // 2)
    np.testing.assert_array_equal(np.concatenate(known), dataset.people())
    assert np.bincount(dataset.people()).tolist() == [50] * 14


def without(folder: Path, *names: str) -> Path:
    for name in names:
        for file in folder.glob(name):
            file.unlink()
    return folder


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        ((), None),
        (("config.json",), None),
        (("manifest.json",), "is unfinished; run handsim generate again"),
        (("manifest.json", "rows-00002.npy", "checksums-00003.json"), "is unfinished"),
        (("rows-00001.npy",), "rows-00001.npy is missing; run handsim generate again"),
        (("config.json", "hands-00000.npy"), "hands-00000.npy is missing; run handsim generate again"),
    ],
)
@pytest.mark.filterwarnings("ignore::handsim.HandSimWarning")
def test_what_is_lost_of_a_set_is_made_again_and_opening_it_says_so(finished, tmp_path, names, sentence):
    copy = without(shutil.copytree(finished, tmp_path / "set"), *names)
    if sentence is None:
        assert len(Dataset(copy)) == 700
    else:
        with pytest.raises(DatasetError, match=sentence):
            Dataset(copy)
    assert is_dataset(copy)
    make_dataset(CONFIG, copy, workers=1)
    assert contents(copy) == contents(finished)


def test_settings_that_are_lost_are_those_of_the_manifest(finished, tmp_path):
    copy = without(shutil.copytree(finished, tmp_path / "set"), "config.json")
    with (
        pytest.warns(HandSimWarning, match=r"config\.json is missing, and is made again from manifest\.json"),
        pytest.raises(DatasetError, match="begun with other settings"),
    ):
        make_dataset(dataclasses.replace(CONFIG, seed=4), copy, workers=1)
    with pytest.raises(DatasetError, match="is not empty and holds no training set"):
        make_dataset(CONFIG, without(copy, "*.json"), workers=1)
    with pytest.raises(DatasetError, match="holds none; handsim generate makes one"):
        Dataset(copy)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (Path.touch, "is a file, expected the folder of a training set"),
        (Path.mkdir, "holds none; handsim generate makes one"),
        (lambda path: None, "holds none; handsim generate makes one"),
    ],
)
def test_a_place_that_holds_no_set(tmp_path, make, sentence, capsys):
    make(tmp_path / "set")
    with pytest.raises(DatasetError, match=sentence):
        Dataset(tmp_path / "set")
    assert main(["train", str(tmp_path / "set"), "--out", str(tmp_path / "run")]) == 1
    assert sentence in capsys.readouterr().err
    assert not is_dataset(tmp_path / "set") and not (tmp_path / "run").exists()


def test_hands_are_where_the_center_is(finished, tmp_path):
    shift, rig = np.array([0.5, -2.0, 0.25]), load_rig("figure5")
    cameras = (camera.at(rigid(np.eye(3), shift) @ camera.T_world_camera) for camera in rig.cameras)
    there = CameraRig("elsewhere", tuple(cameras))
    made = dataclasses.replace(CONFIG, num_frames=400, rig=there, center=tuple(ROOM_CENTER + shift))
    make_dataset(made, tmp_path / "set", workers=1)
    rows, usual = Dataset(tmp_path / "set").rows(), Dataset(finished).rows()[:400]
    np.testing.assert_allclose(rows["qpos"][:, :3], usual["qpos"][:, :3] + shift, atol=1e-5)
    np.testing.assert_allclose(rows["markers"], usual["markers"] + shift, atol=1e-5)
    assert (rows["cameras"] == usual["cameras"]).mean() > 0.99
    assert np.nanmedian(np.linalg.norm(rows["observed"] - usual["observed"] - shift, axis=-1)) < 1e-5
    with pytest.raises(ArgumentError, match="camera"):
        make_dataset(dataclasses.replace(CONFIG, center=tuple(rig.positions[3])), tmp_path / "other")


def test_two_workers_make_the_same_bytes(finished, tmp_path, monkeypatch):
    out = tmp_path / "two"
    script = tmp_path / "make.py"
    script.write_text(COMMAND.replace("workers=1", "workers=2").replace("if __name__", OWN + "if __name__"))
    subprocess.run([sys.executable, script, out], check=True, env=environment())
    assert contents(out) == contents(finished)


def environment() -> dict[str, str]:
    root = str(Path(__file__).resolve().parents[3])
    return {**os.environ, "PYTHONPATH": root}


def test_a_killed_run_goes_on_to_the_same_bytes(finished, tmp_path):
    out, script = tmp_path / "killed", tmp_path / "make.py"
    script.write_text(COMMAND.replace("if __name__", STALLED + "if __name__"))
    process = subprocess.Popen([sys.executable, script, out], env=environment())
    try:
        wait_for((out / rows_name(1)).exists)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    (out / ".rows-00002.tmp-1.npy").write_bytes(
        b"half a shard"
    )  # what a kill in the middle of a write leaves
    with pytest.raises(DatasetError, match="is unfinished; run handsim generate again"):
        Dataset(out)
    make_dataset(CONFIG, out, workers=1)
    assert contents(out) == contents(finished)


@pytest.mark.parametrize("name", [rows_name(1), hands_name(2)])
@pytest.mark.parametrize("num_frames", [700, 900])
def test_a_damaged_file_is_told_and_made_again(finished, tmp_path, name, num_frames):
    out = tmp_path / "damaged"
    shutil.copytree(finished, out)
    content = bytearray((out / name).read_bytes())
    content[-40:-36] = b"\x00\x01\x02\x03"
    (out / name).write_bytes(content)
    with pytest.raises(DatasetError, match=rf"{name} is damaged .* run handsim generate again"):
        Dataset(out)
    with pytest.warns(HandSimWarning, match=rf"{name} are not what manifest.json lists"):
        make_dataset(dataclasses.replace(CONFIG, num_frames=num_frames), out, workers=1)
    assert checksum(out / name) == checksum(finished / name)
    assert len(Dataset(out)) == num_frames


def test_a_set_of_a_version_without_checksums_of_shards_is_checked_against_its_manifest(finished, tmp_path):
    out = tmp_path / "older"
    shutil.copytree(finished, out)
    for path in out.glob(CHECKSUMS):
        path.unlink()
    kept = (out / rows_name(0)).stat().st_mtime_ns
    (out / rows_name(1)).write_bytes((out / rows_name(1)).read_bytes()[::-1])
    with pytest.warns(HandSimWarning, match=r"rows-00001.npy are not what manifest.json lists"):
        grown = make_dataset(dataclasses.replace(CONFIG, num_frames=900), out, workers=1)
    assert (
        grown.files.items()
        > {name: checksum(finished / name) for name in (rows_name(0), rows_name(1))}.items()
    )
    assert (out / rows_name(0)).stat().st_mtime_ns == kept and len(Dataset(out)) == 900


def test_the_gloves_radius_reaches_the_optics(tmp_path):
    lost = {}
    for radius in (0.0032, 0.008):
        glove = tmp_path / f"{radius}.toml"
        dataclasses.replace(load_layout("dense19"), radius=radius).save(glove)
        config = dataclasses.replace(CONFIG, num_frames=200, glove=str(glove))
        manifest = make_dataset(config, tmp_path / f"set{radius}", workers=1)
        assert manifest.config["optics"]["marker_radius"] == radius
        lost[radius] = np.isnan(Dataset(tmp_path / f"set{radius}").rows()["observed"][..., 0]).mean()
    assert lost[0.008] > 1.5 * lost[0.0032]


def test_redraws_are_counted_in_the_manifest(tmp_path, monkeypatch):
    def no_touch(*args, **kwargs):
        raise PoseError("no valid pose of these two hands was found")

    monkeypatch.setattr(training_frames, "sample_two_hand_poses", no_touch)
    monkeypatch.setattr(training_frames, "settle_hold", no_touch)
    config = GenerateSettings(
        num_frames=600,
        frames_per_hand=20,
        population=Population(girth_spread=0.2),
        scenes=SceneMix(alone=0.0, together=1.0, holding=1.0),
    )
    manifest = make_dataset(config, tmp_path / "set", workers=1)
    assert manifest.redrawn is not None and set(manifest.redrawn) == {NO_REST, NO_TOUCH, NO_GRASP}
    assert manifest.redrawn[NO_TOUCH] + manifest.redrawn[NO_GRASP] == 30
    assert Dataset(tmp_path / "set").manifest == manifest
    for shard in (0, 2):
        (tmp_path / "set" / rows_name(shard)).unlink()
    assert make_dataset(config, tmp_path / "set", workers=1) == manifest, "a resumed run counts the same"


def test_errors_other_than_poses_out_of_reach_stop_the_generation(tmp_path, monkeypatch):
    def broken(*args, **kwargs):
        raise ArgumentError("qpos has shape (3,), expected (..., 27)")

    monkeypatch.setattr(training_frames, "sample_two_hand_poses", broken)
    config = GenerateSettings(num_frames=20, scenes=SceneMix(alone=0.0, together=1.0, holding=0.0))
    with pytest.raises(ArgumentError, match="qpos has shape"):
        make_dataset(config, tmp_path / "set", workers=1)


def test_people_are_not_drawn_for_ever(rng, monkeypatch):
    monkeypatch.setattr(training_frames, "rests_easily", lambda model: False)
    with pytest.raises(ArgumentError, match="the fingers of all 1000 people drawn"):
        training_frames.sample_hands(Population(), rng=rng)


def test_a_set_without_counts_of_redraws_is_read(finished, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    content = json.loads((copy / MANIFEST).read_text())
    del content["redrawn"]
    (copy / MANIFEST).write_text(json.dumps(content))
    assert Dataset(copy).manifest.redrawn is None
    (copy / redrawn_name(1)).unlink()
    assert make_dataset(CONFIG, copy, workers=1).redrawn is None, "an older version made one of the shards"


def test_a_set_of_a_rig_of_ones_own_holds_its_cameras_and_is_drawn(tmp_path):
    rig = mixed_rig()
    config = GenerateSettings(num_frames=40, frames_per_hand=20, rig=rig, seed=3)
    make_dataset(config, tmp_path / "set", workers=1)
    dataset = Dataset(tmp_path / "set")
    assert load_rig(dataset.manifest.config["rig"]) == rig
    assert DatasetRecording(dataset).rig == rig
    write_dataset_page(dataset.path / REPORT, dataset)
    rig.save(tmp_path / "mixed.toml")  # the same cameras, whatever names them
    same = dataclasses.replace(config, rig=str(tmp_path / "mixed.toml"))
    make_dataset(same, tmp_path / "set", workers=1)
    with pytest.raises(DatasetError, match=r"begun with other settings \(rig"):
        make_dataset(dataclasses.replace(config, rig="six"), tmp_path / "set", workers=1)


def test_a_set_of_a_rig_that_a_release_changed_is_not_resumed(tmp_path):
    make_dataset(CONFIG, tmp_path / "set", workers=1)
    settings = json.loads((tmp_path / "set" / "config.json").read_text())
    digest = settings.pop("rig_digest")
    for older in ({}, {"rig_digest": digest[::-1]}):
        (tmp_path / "set" / "config.json").write_text(json.dumps(settings | older))
        with pytest.raises(DatasetError, match=r"other settings \(rig_digest: .* there, .* here\)"):
            make_dataset(CONFIG, tmp_path / "set", workers=1)


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(DatasetError, match="is not empty and holds no training set"):
        make_dataset(CONFIG, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_full_disk_is_told_and_leaves_nothing_half_written(tmp_path, monkeypatch, capsys):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device", str(tmp_path / "set" / rows_name(0)))

    monkeypatch.setattr(np.lib.format, "write_array_header_1_0", full)
    code = main(["generate", "--num-frames", "300", "--out", str(tmp_path / "set"), "--workers", "1"])
    assert code == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert [path.name for path in (tmp_path / "set").iterdir()] == ["config.json"]


def test_a_set_grows_to_the_bytes_of_one_made_at_once(finished, tmp_path):
    """700 frames are three shards of 200 and one of 100, which is made again."""
    out = tmp_path / "grown"
    make_dataset(dataclasses.replace(CONFIG, num_frames=300), out, workers=1)
    kept = (out / rows_name(0)).stat().st_mtime_ns
    assert make_dataset(CONFIG, out, workers=1) == Dataset(finished).manifest
    assert contents(out) == contents(finished)
    assert (out / rows_name(0)).stat().st_mtime_ns == kept
    with pytest.raises(DatasetError, match=r"num_frames: 700 there, 300 here\).*num_frames may only grow"):
        make_dataset(dataclasses.replace(CONFIG, num_frames=300), out, workers=1)
    with pytest.raises(DatasetError, match=r"\(num_frames: 700 there, 9 here; seed: 3 there, 9 here\)"):
        make_dataset(dataclasses.replace(CONFIG, seed=9, num_frames=9), out, workers=1)


def test_a_growth_that_was_killed_is_unfinished_and_goes_on(finished, tmp_path, monkeypatch):
    out = tmp_path / "grown"
    make_dataset(dataclasses.replace(CONFIG, num_frames=300), out, workers=1)

    def killed(*args):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(generation, "make_shard", killed)
        with pytest.raises(Stopped) as caught:
            make_dataset(CONFIG, out, workers=1)
    assert caught.value.kept == f"200 of 700 frames are in {out}, and the same command goes on after them"
    with pytest.raises(DatasetError, match="is unfinished; run handsim generate again"):
        Dataset(out)
    make_dataset(CONFIG, out, workers=1)
    assert contents(out) == contents(finished)


def test_a_set_that_the_disk_has_no_space_for_is_refused(tmp_path):
    config = dataclasses.replace(CONFIG, num_frames=10**18)
    with pytest.raises(DatasetError, match=r"10{18} frames need 7\d\d EB, but the disk of .* has .* free"):
        make_dataset(config, tmp_path / "set")
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize("field", MANIFESTS)
def test_a_manifest_of_wrong_types_is_told(finished, tmp_path, field):
    content = json.loads((finished / MANIFEST).read_text())
    value, sentence = MANIFESTS[field]
    (tmp_path / MANIFEST).write_text(json.dumps(content | {field: value}))
    with pytest.raises(DatasetError, match=f"is damaged: {sentence}"):
        Dataset(tmp_path)
    del content[field]
    (tmp_path / MANIFEST).write_text(json.dumps(content))
    with pytest.raises(DatasetError, match=f"the field {field} is missing|is missing; run"):
        Dataset(tmp_path)


@pytest.mark.parametrize("kind", ["floats", "text", "pickle", "short"])
def test_a_shard_of_other_records_is_told(finished, tmp_path, kind):
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    if kind == "text":
        (copy / rows_name(1)).write_text("no array")
    else:
        rows = {
            "floats": np.zeros(200),
            "pickle": np.array([None] * 200),
            "short": np.load(copy / rows_name(1))[:7],
        }[kind]
        np.save(copy / rows_name(1), rows)
    content = json.loads((copy / MANIFEST).read_text())
    content["files"][rows_name(1)] = checksum(copy / rows_name(1))
    (copy / MANIFEST).write_text(json.dumps(content))
    with pytest.raises(
        DatasetError, match=r"holds other records|is damaged: it is no .npy file|shards hold 507"
    ):
        Dataset(copy)


def fists(model, num_poses, *, rng):
    low, high = model.skeleton.ranges.T
    return low + (high - low) * rng.beta(4, 2, (num_poses, 20))


def above(model, num_poses, *, rng):
    qpos = sample_poses(model, num_poses, rng=rng)
    qpos[:, :3] = 0.1, 0.2, 1.1
    return qpos


def degrees(model, num_poses, *, rng):
    return np.full((num_poses, 20), 45.0)


class Flat:
    def __call__(self, model, num_poses, *, rng):
        return np.zeros((num_poses, 20))


def make(out, **options):
    return generate_dataset(
        out, **{"glove": LAYOUT, "num_frames": 60, "scenes": ALONE, "workers": 1, **options}
    )


def test_a_set_of_objects_is_what_they_say(tmp_path):
    dataset = make(tmp_path / "set", sampler=fists, rig=load_rig("six"))
    assert len(dataset) == 60 and dataset.layout == LAYOUT and dataset.marker_names == LAYOUT.names
    settings = json.loads((tmp_path / "set" / "config.json").read_text())
    assert settings["sampler"] == f"{__name__}:fists" and settings["glove"] == "mine"
    assert settings["rig"] == "six", "a rig that comes with the package is its name"
    again = make(tmp_path / "other", sampler=fists, rig="six")
    assert again.rows().tobytes() == dataset.rows().tobytes()
    assert len(make(tmp_path / "set", sampler=fists, rig="six", num_frames=90)) == 90, "it grows"
    with pytest.raises(DatasetError, match=r"begun with other settings \(sampler: "):
        make(tmp_path / "set", sampler=Flat(), rig="six", num_frames=90)


def test_whole_poses_say_where_the_hands_are(tmp_path):
    wrists = make(tmp_path / "placed", sampler=above).rows()["qpos"][:, :7]
    np.testing.assert_allclose(wrists, np.tile([0.1, 0.2, 1.1, 1, 0, 0, 0], (60, 1)), atol=1e-6)
    spread = make(tmp_path / "anywhere", sampler=sample_poses_at_the_origin).rows()["qpos"][:, :3]
    assert np.ptp(spread, axis=0).min() > 0.3 and np.abs(spread.mean(axis=0) - [0, 0, 1.1]).max() < 0.2


def sample_poses_at_the_origin(model, num_poses, *, rng):
    return sample_poses(model, num_poses, rng=rng)


def test_a_sampler_that_no_process_can_import_is_told_when_several_were_asked_for(tmp_path):
    with pytest.warns(HandSimWarning, match="cannot be imported by other processes, so that this one does"):
        dataset = make(
            tmp_path / "set", sampler=lambda model, count, *, rng: np.zeros((count, 20)), workers=2
        )
    assert len(dataset) == 60


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"sampler": 5}, "sampler is 5, expected a function (model, num_poses, *, rng)"),
        ({"sampler": degrees}, "holds an angle of 45 rad; are these degrees?"),
        ({"scenes": {"togeter": 1}}, "unknown setting of scenes 'togeter' (did you mean 'together'?)"),
        ({"scenes": 3}, "scenes is 3, expected a SceneMix"),
        ({"volum": 1.0}, "unknown setting of a training set 'volum' (did you mean 'volume'?)"),
        ({"num_frames": "many"}, "num_frames is 'many', expected a whole number"),
    ],
)  # fmt: skip
def test_mistakes_are_told_before_anything_is_written(tmp_path, options, sentence):
    with error_names(ArgumentError, sentence):
        make(tmp_path / "set", **options)
    assert not (tmp_path / "set").exists()


def test_a_take_of_objects():
    take = simulate_take("free", glove=LAYOUT, rig=load_rig("eight"), num_frames=4, hands="right", seed=1)
    assert take.num_frames == 4 and take.hands[0].layout.names == LAYOUT.names
    named = simulate_take("free", glove=LAYOUT, rig="eight", num_frames=4, hands=("right",), seed=1)
    np.testing.assert_array_equal(named.points, take.points)
    blind = simulate_take("free", glove=LAYOUT, num_frames=4, optics={"blob_loss": 0.9})
    assert blind.markers_present().mean() < 0.7
    assert blind.settings["room"]["optics"]["blob_loss"] == 0.9
