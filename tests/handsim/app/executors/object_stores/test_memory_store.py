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

from handsim.app.executors.dask_cluster import DaskCluster, _Task
from handsim.app.executors.executor import Processes, choose_executor
from handsim.app.executors.output import StoredOutput, open_output
from handsim.app.executors.worker_check import WorkerCheck
from handsim.app.interrupts import Stopped
from handsim.cli.main import main
from handsim.errors import ArgumentError, DatasetError, HandSimError
from handsim.files.object_folder import ObjectFolder, folder_or_objects
from render.config import RenderConfig
from render.session import left_out_frames, render_take
from tests.handsim.app.executors.object_stores.stored_set import (
    CONFIG,
    contents,
    copied,
    write_three,
)
from train.data.shards import MANIFEST, Dataset, array_bytes, row_dtype, rows_name, save_array
from train.simulation.generation import make_dataset

pytestmark = pytest.mark.xdist_group("object stores")  # what they share is made once
fsspec = pytest.importorskip("fsspec", reason="needs `pip install 'handsim[object-stores]'`")


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
    assert MANIFEST not in memory.sizes()
    (tmp_path / rows_name(0)).write_bytes(b"half")  # what a store would hold that is none
    memory.put(tmp_path, [rows_name(0)])
    told = []
    make_dataset(CONFIG, memory, workers=1, progress=lambda *counts: told.append(counts))
    assert told == [(200, 370), (300, 370), (370, 370)], "shards 0, 2 and 3"
    assert copied(memory, tmp_path / "copy") == whole


def test_a_set_grows_and_has_no_manifest_until_it_is_complete(memory, whole, tmp_path):
    make_dataset(dataclasses.replace(CONFIG, num_frames=150), memory, workers=1)
    assert MANIFEST in memory.sizes()
    with_manifest, told = [], []

    def note(done, _):
        with_manifest.append(MANIFEST in memory.sizes())
        told.append(done)

    make_dataset(CONFIG, memory, workers=1, progress=note)
    assert told == [200, 300, 370], "the first shard stays, the half one is made again"
    assert with_manifest == [False] * 3
    assert copied(memory, tmp_path / "copy") == whole
    with pytest.raises(DatasetError, match=f"{memory} holds a .*num_frames: 370 there, 150 here"):
        make_dataset(dataclasses.replace(CONFIG, num_frames=150), memory, workers=1)


def test_a_store_that_holds_something_else_is_refused(memory, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    memory.put(tmp_path, ["mine.txt"])
    with pytest.raises(DatasetError, match=f"{memory} is not empty and holds no training set; name another"):
        make_dataset(CONFIG, memory, workers=1)
    assert set(memory.sizes()) == {"mine.txt"}


def test_the_receipt_comes_last_and_tells_whether_all_is_there(memory, monkeypatch):
    puts = []
    put = ObjectFolder.put
    monkeypatch.setattr(ObjectFolder, "put", lambda *given: (puts.append(list(given[2])), put(*given)))
    with open_output(memory) as output:
        output.claim("config.json", {"x": 1}, noun="thing", error=HandSimError)
        assert list(Processes(1).run(output.job(write_three), [3, 4])) == [3, 4]
        output.collect("b-*")
        assert [path.name for path in sorted(output.folder.rglob("b-*"))] == ["b-3", "b-4"]
        here = output.folder.parent
        assert {path.name for path in here.iterdir()} == {"output"}, "jobs remove their folders"
    assert not here.exists()
    assert puts[1:] == [
        ["a-3", "part/b-3", "part/c-3"],
        ["finished/00003.json"],
        ["a-4", "part/b-4", "part/c-4"],
        ["finished/00004.json"],
    ]
    memory.remove("part/b-3")
    with open_output(memory) as output:
        output.claim("config.json", {"x": 1}, noun="thing", error=HandSimError)
        assert set(output.receipts) == {4}
        with pytest.raises(HandSimError, match=f"{memory}: a-3 is gone; run the same command again"):
            output.checksums(["a-4", "a-3"])


@pytest.mark.parametrize(
    "receipt",
    [
        b"{",
        b"[]",
        b'{"files": 3}',
        b'{"files": {"../../x": {"bytes": 1, "sha256": "0"}}}',
        b'{"files": {"/x": {"bytes": 1, "sha256": "0"}}}',
        b'{"files": {"x": {"bytes": "1", "sha256": "0"}}}',
        b'{"files": {"x": 5}}',
    ],
)
def test_a_damaged_receipt_is_none(receipt, memory, tmp_path):
    with open_output(memory) as output:
        output.claim("config.json", {}, noun="thing", error=HandSimError)
    (tmp_path / "finished").mkdir()
    (tmp_path / "finished/00001.json").write_bytes(receipt)
    memory.put(tmp_path, ["finished/00001.json"])
    with open_output(memory) as output:
        output.claim("config.json", {}, noun="thing", error=HandSimError)
        assert isinstance(output, StoredOutput) and output.receipts == {}
        output.collect("*")
        assert sorted(path.name for path in output.folder.iterdir()) == ["config.json", "finished"]


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
        ("file:///tmp/x", "the folder's path alone"),
        ("simplecache::s3://bucket/x", "one like s3://bucket/prefix"),
        ("s3://bucket/../x", "one without :: and .."),
    ],
)
def test_an_address_that_is_none(address, expected, capsys):
    with pytest.raises(ArgumentError, match=f"the address is '{address}', expected {expected}"):
        folder_or_objects(address)
    assert main(["generate", "--num-frames", "10", "--out", address]) == 1
    assert capsys.readouterr().err.startswith(f"handsim generate: the address is '{address}'")


def test_an_address_with_a_password_is_not_repeated():
    with pytest.raises(ArgumentError, match="the ftp:// address holds a password; credentials") as told:
        ObjectFolder("ftp://me:geheim@host/sets")
    assert "geheim" not in str(told.value)
    assert str(ObjectFolder("abfs://sets@account.host/a")) == "abfs://sets@account.host/a"


def test_without_the_packages_a_sentence_says_how_to_get_them(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "fsspec.core", None)
        with pytest.raises(ArgumentError, match=r"s3://b/x needs the package fsspec.*'handsim\[object-st"):
            make_dataset(CONFIG, ObjectFolder("s3://b/x"))
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)
    with pytest.raises(ArgumentError, match=r"s3://b/x needs a package .* run `pip install 'handsim\[obj"):
        make_dataset(CONFIG, ObjectFolder("s3://b/x"))
    with pytest.raises(HandSimError, match=r"^nothing://b/x: opening failed: Protocol not known: nothing;"):
        make_dataset(CONFIG, ObjectFolder("nothing://b/x"))


def test_options_choose_workers_that_share_no_folder(memory, tmp_path):
    shared, apart = (choose_executor("tcp://a:1", None, out, print) for out in (tmp_path, memory))
    assert isinstance(shared, DaskCluster) and shared.folder == tmp_path
    assert isinstance(apart, DaskCluster) and apart.folder is None


def test_what_renames_its_files_or_merges_goes_to_a_folder(memory, tmp_path, capsys):
    with pytest.raises(HandSimError, match=f"{memory}: freihand renames its .* a folder and copy it"):
        render_take(tmp_path / "take.npz", memory, ["png", "freihand"], RenderConfig())
    assert main(["render", "--merge", str(tmp_path), "--out", str(memory)]) == 1
    assert f"--merge copies into a folder, and {memory} is none" in capsys.readouterr().err


def test_pictures_in_a_store_have_the_bytes_of_a_folder(memory, take, tmp_path):
    config = RenderConfig(depth_sensor=None, color_sensor=None, every=6, frames_per_shard=2)
    formats = ("png", "coco", "interhand", "webdataset")
    assert render_take(take, tmp_path / "here", formats, config, workers=1) == 4

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(Stopped, match=f"2 of 4 images are in {memory}"):
        render_take(take, memory, formats, config, workers=1, progress=stop)
    told = []
    done = render_take(take, memory, formats, config, workers=1, progress=lambda *counts: told.append(counts))
    assert (done, told) == (4, [(4, 4)]), "one shard was there"
    assert copied(memory, tmp_path / "there") == contents(tmp_path / "here")
    assert left_out_frames(memory) == []


def lack_a_file(folder: Path, number: int) -> int:
    raise FileNotFoundError(f"take-{number}.npz is not there")


def test_a_worker_that_lacks_a_file_is_named(memory, tmp_path):
    job, nowhere = StoredOutput(tmp_path / "output", memory).job(lack_a_file), tmp_path / "nowhere"
    task = _Task(job, WorkerCheck((), nowhere, None, ""))
    with pytest.raises(HandSimError, match=r"^on .*, which shares no folder: take-3\.npz is not there$"):
        task._alone(3)
    assert memory.sizes() == {}
    WorkerCheck((), nowhere, None, "").check_folders("tcp://one:1")
