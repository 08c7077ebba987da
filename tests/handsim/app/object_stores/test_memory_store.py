"""Results in an object store: the bytes of a folder, nothing half there, and words for what is wrong.

The store is fsspec's own in memory.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from upath import UPath

from handsim import HandSimError, HandSimWarning
from handsim.app.output import open_output, place_of
from handsim.app.workers import run_jobs
from handsim.cli.main import main
from handsim.errors import ArgumentError, DatasetError
from handsim.files.signals import Stopped
from render import RenderConfig, render_take
from render.session import left_out_frames
from tests.folders import contents
from tests.handsim.app.object_stores.stored_set import CONFIG, copied, names, write_three
from track.viewer.contents import open_content
from train import Dataset
from train.data.shards import MANIFEST, array_bytes, row_dtype, rows_name, save_array
from train.simulation.generation import make_dataset

pytestmark = [pytest.mark.xdist_group("object stores"), pytest.mark.slow]  # what they share is made once


def test_a_training_set_in_a_store_has_the_bytes_of_a_folder(memory, whole, tmp_path):
    told = []
    manifest = make_dataset(CONFIG, memory, workers=1, progress=lambda *counts: told.append(counts))
    assert told == [(100, 370), (200, 370), (300, 370), (370, 370)]
    assert copied(memory, tmp_path / "copy") == whole
    assert Dataset(tmp_path / "copy").manifest == manifest, "and its checksums are right"
    assert make_dataset(CONFIG, tmp_path / "copy", workers=1) == manifest, "a copy goes on as a folder"


def test_a_stopped_one_goes_on_after_what_is_there(memory, whole, tmp_path):
    def stop(done, total):
        if done == 200:
            raise KeyboardInterrupt

    with pytest.raises(Stopped) as caught:
        make_dataset(CONFIG, memory, workers=1, progress=stop)
    assert caught.value.kept == f"200 of 370 frames are in {memory}, and the same command goes on after them"
    assert MANIFEST not in names(memory)
    (memory / rows_name(0)).write_bytes(b"half")  # what a store would hold that is none
    told = []
    make_dataset(CONFIG, memory, workers=1, progress=lambda *counts: told.append(counts))
    assert told == [(200, 370), (300, 370), (370, 370)], "shards 0, 2 and 3"
    assert copied(memory, tmp_path / "copy") == whole


def test_a_set_grows_and_has_no_manifest_until_it_is_complete(memory, whole, tmp_path):
    make_dataset(dataclasses.replace(CONFIG, num_frames=150), memory, workers=1)
    assert MANIFEST in names(memory)
    with_manifest, told = [], []

    def note(done, _):
        with_manifest.append(MANIFEST in names(memory))
        told.append(done)

    make_dataset(CONFIG, memory, workers=1, progress=note)
    assert told == [200, 300, 370], "the first shard stays, the half one is made again"
    assert with_manifest == [False] * 3
    assert copied(memory, tmp_path / "copy") == whole
    with pytest.raises(DatasetError, match=f"{memory} holds a .*num_frames: 370 there, 150 here"):
        make_dataset(dataclasses.replace(CONFIG, num_frames=150), memory, workers=1)


def test_a_store_that_holds_something_else_is_refused(memory, tmp_path):
    (memory / "mine.txt").write_text("mine")
    with pytest.raises(DatasetError, match=f"{memory} is not empty and holds no training set; name another"):
        make_dataset(CONFIG, memory, workers=1)
    assert names(memory) == {"mine.txt"}


def test_every_command_reads_a_set_in_a_store(memory, tmp_path, capsys):
    make_dataset(CONFIG, memory, workers=1)
    content = open_content(str(memory))
    assert content.kind == "dataset" and len(content.recording.times) == CONFIG.num_frames
    assert main(["evaluate", str(memory), "--glove", "dense19"]) == 0
    assert "hands in frames" in capsys.readouterr().out
    small = "--samples 32 --batch 32 --network.width 16 --network.gates 4 --network.depth 1".split()
    assert main(["train", str(memory), "--out", str(tmp_path / "run"), *small]) == 0
    (memory / rows_name(1)).unlink()
    for command in (["train", "--out", str(tmp_path / "other")], ["evaluate"], ["view"]):
        assert main([command[0], str(memory), *command[1:]]) == 1
        assert f"{memory}/{rows_name(1)} is missing" in capsys.readouterr().err
    (memory / MANIFEST).unlink()
    with pytest.raises(DatasetError, match=f"{memory} is unfinished"):
        Dataset(memory)
    make_dataset(CONFIG, memory, workers=1)
    (memory / "config.json").unlink()
    with pytest.warns(HandSimWarning, match="config.json is missing, and is made again"):
        make_dataset(CONFIG, memory, workers=1)
    assert "config.json" in names(memory) and len(Dataset(memory)) == CONFIG.num_frames


def test_what_says_that_a_job_is_finished_comes_last(memory, monkeypatch):
    puts = []
    put = MemoryFileSystem.put
    monkeypatch.setattr(
        MemoryFileSystem,
        "put",
        lambda store, here, there: (
            puts.append([Path(name).name for name in there]),
            put(store, here, there),
        ),
    )
    with open_output(memory) as output:
        output.claim("config.json", {"x": 1}, noun="thing", error=HandSimError)
        assert list(run_jobs(output.job(write_three, last=["a-*"]), [3, 4], 1)) == [3, 4]
        output.fetch("b-*", names_of=["c-*"])
        brought = sorted(path for path in output.folder.rglob("*-*"))
        assert [path.name for path in brought] == ["b-3", "b-4", "c-3", "c-4"]
        assert [path.stat().st_size for path in brought] == [18, 24, 0, 0]
        here = output.folder.parent
        assert {path.name for path in here.iterdir()} == {"output"}, "jobs remove their folders"
        (output.folder / "made").write_text("of all")
        output.publish("made")
    assert not here.exists()
    assert puts == [["config.json"], ["b-3", "c-3"], ["a-3"], ["b-4", "c-4"], ["a-4"], ["made"]]
    with open_output(memory) as output, pytest.raises(HandSimError, match="reading a-5 failed: "):
        output.checksum("a-5")


def test_what_a_killed_run_left_here_is_removed(memory, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with open_output(memory) as output:
        name = output.folder.parent.name
    killed = tmp_path / f"{name.rpartition('-')[0]}-99999999"
    (killed / "output").mkdir(parents=True)
    with open_output(memory):
        assert not killed.exists()
    assert list(tmp_path.iterdir()) == []


def test_the_length_of_a_file_of_records(tmp_path):
    dtype = row_dtype(19)
    for count in (0, 1, 8192):
        save_array(tmp_path / "rows.npy", np.zeros(count, dtype=dtype))
        assert (tmp_path / "rows.npy").stat().st_size == array_bytes(dtype, count)


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("s3://", "one like s3://bucket/prefix"),
        ("S3://bucket/a", "one like s3://bucket/prefix"),
        ("a b://c", "one like s3://bucket/prefix"),
        ("nothing://b/x", "one like s3://bucket/prefix: Unsupported"),
        ("simplecache::s3://bucket/x", "one without :: and .."),
        ("s3://bucket/../x", "one without :: and .."),
    ],
)
def test_an_address_that_is_none(address, expected, capsys):
    with pytest.raises(ArgumentError, match=f"the address is '{address}', expected {expected}"):
        place_of(address)
    assert main(["generate", "--num-frames", "10", "--out", address]) == 1
    assert capsys.readouterr().err.startswith(f"handsim generate: the address is '{address}'")


def test_a_folder_may_be_an_address(tmp_path, memory):
    for name in (tmp_path, str(tmp_path), tmp_path.as_uri(), UPath(tmp_path)):
        assert place_of(name) == tmp_path and isinstance(place_of(name), Path)
    assert place_of(memory) == memory and place_of(str(memory)) == memory
    with pytest.raises(ArgumentError, match="the address is 3, expected a folder, or one like s3://"):
        place_of(3)


def test_an_address_with_a_password_is_not_repeated():
    with pytest.raises(ArgumentError, match="the ftp:// address holds a password; credentials") as told:
        place_of("ftp://me:geheim@host/sets")
    assert "geheim" not in str(told.value)
    assert str(place_of("s3://sets@account.host/a/")) == "s3://sets@account.host/a"


def test_without_the_packages_a_sentence_says_how_to_get_them(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)
    with pytest.raises(ArgumentError, match=r"s3://b/x needs a package .* run `pip install 'handsim\[obj"):
        make_dataset(CONFIG, "s3://b/x")


def test_what_merges_goes_to_a_folder(memory, tmp_path, capsys):
    assert main(["render", "--merge", str(tmp_path), "--out", str(memory)]) == 1
    assert f"--merge copies into a folder, and {memory} is none" in capsys.readouterr().err


def test_pictures_in_a_store_have_the_bytes_of_a_folder(memory, take, tmp_path):
    config = RenderConfig(depth_sensor=None, color_sensor=None, every=6, frames_per_shard=2)
    formats = ("png", "coco", "yolo", "webdataset")
    assert render_take(take, tmp_path / "here", formats, config, workers=1) == 4

    def stop(done, total):
        if done:
            raise KeyboardInterrupt

    with pytest.raises(Stopped, match=f"2 of 4 images are in {memory}"):
        render_take(take, memory, formats, config, workers=1, progress=stop)
    told = []
    done = render_take(take, memory, formats, config, workers=1, progress=lambda *counts: told.append(counts))
    assert (done, told) == (4, [(2, 4), (4, 4)]), "one shard was there"
    assert copied(memory, tmp_path / "there") == contents(tmp_path / "here")
    assert left_out_frames(memory) == []
