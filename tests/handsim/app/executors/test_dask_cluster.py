"""Jobs on real workers of a Dask scheduler: the same bytes, whatever dies, and words for what is wrong."""

from __future__ import annotations

import functools
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from handsim.app.executors.dask_cluster import DaskCluster, _folder_trouble, _Task
from handsim.app.executors.executor import Processes, choose_executor
from handsim.app.executors.worker_check import WorkerCheck, check_threads, versions_here
from handsim.cli.main import main
from handsim.errors import ArgumentError, HandSimError, LayoutError
from handsim.files.inputs import checksum
from render.config import RenderConfig
from render.session import render_take
from train.simulation import generation
from train.simulation.dataset_config import DatasetConfig
from train.simulation.frame_scenes import SceneMix
from train.simulation.generation import make_dataset
from train.simulation.takes import simulate_take

distributed = pytest.importorskip("distributed", reason="needs `pip install 'handsim[cluster]'`")
ROOT = Path(__file__).resolve().parents[4]
ROWS = 100
PRELOAD = f"from train.simulation import generation\ngeneration.ROWS_PER_SHARD = {ROWS}\n"
CONFIG = DatasetConfig(
    num_frames=12 * ROWS - 30,
    seed=5,
    frames_per_hand=50,
    scenes=SceneMix(alone=1.0, together=0.0, holding=0.0),
)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Two worker processes with one thread each, and a client of the tests' own."""
    preload = tmp_path_factory.mktemp("preload") / "small_shards.py"
    preload.write_text(PRELOAD)
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        preload=[str(preload)],
        silence_logs="CRITICAL",
    ) as started:
        yield started


@pytest.fixture(scope="module")
def client(cluster):
    with distributed.Client(cluster, set_as_default=False) as connected:
        yield connected


@pytest.fixture
def small_shards(monkeypatch):
    monkeypatch.setattr(generation, "ROWS_PER_SHARD", ROWS)


def contents(folder: Path) -> dict[str, str]:
    """Checksums of all files, hidden ones too."""
    return {
        path.relative_to(folder).as_posix(): checksum(path) for path in folder.rglob("*") if path.is_file()
    }


class Killing:
    """An executor that kills a worker once the first job is done."""

    def __init__(self, cluster, client):
        self.cluster, self.client = cluster, client

    def run(self, job, todo):
        victim = next(iter(self.client.run(os.getpid).values()))
        done = self.cluster.run(job, todo)
        yield next(done)
        os.kill(victim, signal.SIGKILL)
        yield from done


def test_training_sets_have_the_same_bytes_also_when_a_worker_is_killed(
    cluster, client, small_shards, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # workers have another folder
    make_dataset(CONFIG, Path("here"), workers=1)
    expected = contents(tmp_path / "here")
    assert len([name for name in expected if name.startswith("rows-")]) == 12
    there, killed = Path("there"), Path("killed")
    lines, counts = [], []
    executor = DaskCluster(cluster.scheduler_address, there, tell=lines.append)
    make_dataset(CONFIG, there, workers=executor, progress=lambda done, _: counts.append(done))
    assert contents(there) == expected
    assert counts == sorted(counts) and counts[-1] == CONFIG.num_frames and len(counts) == 12
    assert all("dashboard" in line for line in lines)
    before = set(client.run(os.getpid).values())
    executor = DaskCluster(cluster.scheduler_address, killed)
    make_dataset(CONFIG, killed, workers=Killing(executor, client))
    assert contents(killed) == expected
    assert set(client.run(os.getpid).values()) != before, "one was killed"


def test_pictures_have_the_same_bytes(cluster, tmp_path):
    take = tmp_path / "take.truth.npz"
    simulate_take(num_frames=24).save(take)
    config = RenderConfig(passes=("depth",), depth_sensor=None, every=6, frames_per_shard=1)
    executor = DaskCluster(cluster.scheduler_address, tmp_path / "there")
    assert render_take(take, tmp_path / "here", ["png"], config, workers=1) == 4
    assert render_take(take, tmp_path / "there", ["png"], config, workers=executor) == 4
    assert contents(tmp_path / "there") == contents(tmp_path / "here")


def fail_at_two(folder: Path, number: int) -> int:
    if number == 2:
        with (folder / "tries").open("a") as file:
            file.write("x")
        raise LayoutError("number 2 does not fit")
    return number


def test_what_a_job_raises_comes_back_and_is_not_tried_again(cluster, tmp_path):
    executor = DaskCluster(cluster.scheduler_address, tmp_path)
    with pytest.raises(LayoutError, match="number 2 does not fit"):
        list(executor.run(functools.partial(fail_at_two, tmp_path), range(5)))
    assert (tmp_path / "tries").read_text() == "x"
    assert [path.name for path in tmp_path.iterdir()] == ["tries"]


def echo(number: int) -> int:
    return number


def test_more_jobs_than_the_scheduler_is_given_at_once(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr("handsim.app.executors.dask_cluster._IN_FLIGHT", 5)
    executor = DaskCluster(cluster.scheduler_address, tmp_path)
    assert sorted(executor.run(echo, range(3, 40))) == list(range(3, 40))
    assert list(executor.run(echo, [])) == []


def die(number: int) -> int:
    os._exit(3)


def test_a_job_that_ends_every_worker_is_told(tmp_path, cluster, client):
    executor = DaskCluster(cluster.scheduler_address, tmp_path)
    client.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", 0))
    try:
        with pytest.raises(HandSimError, match="shard 7 was begun 1 times, and its worker died each time"):
            list(executor.run(die, [7]))
    finally:
        client.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", 3))
        client.wait_for_workers(1, timeout=30)  # its nanny starts another


def test_a_worker_of_another_version_is_named(cluster, client, tmp_path):
    """At the start of a run, and by the worker itself when it comes later."""
    about = tmp_path / "old" / "handsim-0.0.1.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: handsim\nVersion: 0.0.1\n")
    path = os.pathsep.join([str(about.parent), str(ROOT)])
    options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path)]
    command = [sys.executable, "-m", "distributed.cli.dask_worker", cluster.scheduler_address, *options]
    present = set(client.nthreads())
    with subprocess.Popen(
        command, env=os.environ | {"PYTHONPATH": path}, stderr=subprocess.PIPE, cwd=tmp_path
    ) as process:
        try:
            deadline = time.monotonic() + 30.0
            while not set(client.nthreads()) - present and time.monotonic() < deadline:
                time.sleep(0.05)
            (late,) = set(client.nthreads()) - present
            sentence = f"the worker {late} has handsim 0.0.1, this machine has {versions_here()['handsim']}"
            with pytest.raises(HandSimError, match=sentence):
                list(DaskCluster(cluster.scheduler_address, tmp_path).run(echo, [1]))
            check = WorkerCheck(tuple(versions_here().items()), tmp_path, tmp_path / "token", "")
            with pytest.raises(HandSimError, match=sentence):
                client.submit(_Task(echo, check), 1, workers=[late], pure=False).result(30)
        finally:
            process.kill()


def test_a_worker_that_does_not_share_the_folders_is_named(client, tmp_path):
    versions, token = tuple(versions_here().items()), tmp_path / "token"
    for check, said in (
        (WorkerCheck(versions, tmp_path, token, "abc"), f"does not see the files in {tmp_path}; write to"),
        (WorkerCheck(versions, tmp_path / "mine", token, ""), f"does not see {tmp_path / 'mine'}, where"),
    ):
        for worker, answer in client.run(_folder_trouble, check).items():
            assert answer.startswith(f"the worker {worker} {said}")
    token.write_text("abc")
    good = WorkerCheck(versions, tmp_path, token, "abc")
    assert set(client.run(_folder_trouble, good).values()) == {""}


def test_a_worker_with_threads_is_refused():
    check_threads("tcp://one:1", 1)
    with pytest.raises(HandSimError, match="the worker tcp://one:1 has 8 threads, expected 1; start workers"):
        check_threads("tcp://one:1", 8)


@pytest.mark.parametrize(
    "address", ["scheduler:8786", "tcp://scheduler", "tcp://:1", "http://a:1", "tcp://a:b"]
)
def test_an_address_that_is_none(address, tmp_path):
    with pytest.raises(ArgumentError, match=f"the cluster is '{address}', expected tcp://host:port"):
        DaskCluster(address, tmp_path)


def test_nobody_at_the_address(tmp_path, capsys, monkeypatch):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # taken, and nobody listens
        address = f"tcp://127.0.0.1:{closed.getsockname()[1]}"
        begun = time.monotonic()
        out = ["--num-frames", "10", "--out", str(tmp_path / "set")]
        assert main(["generate", *out, "--cluster", address]) == 1
        assert time.monotonic() - begun < 20.0
        monkeypatch.setattr("handsim.app.executors.dask_cluster._PATIENCE", 0.2)
        (tmp_path / "scheduler.json").write_text(f'{{"address": "{address}"}}')
        with pytest.raises(HandSimError, match=f"no Dask scheduler answers at {address}"):
            list(DaskCluster(str(tmp_path / "scheduler.json"), tmp_path).run(echo, [1]))
    said = capsys.readouterr().err.strip().splitlines()
    reason = said[-1].removeprefix(f"handsim generate: no Dask scheduler answers at {address}: ")
    assert reason in ("Connection refused", "none within 5 s")  # the second on a busy machine


def test_a_scheduler_file_that_is_none(tmp_path):
    missing = DaskCluster(str(tmp_path / "missing.json"), tmp_path)
    with pytest.raises(HandSimError, match=r"missing\.json"):
        list(missing.run(echo, [1]))
    (tmp_path / "other.json").write_text('{"id": 3}')
    with pytest.raises(HandSimError, match=r"other\.json: no address"):
        list(DaskCluster(str(tmp_path / "other.json"), tmp_path).run(echo, [1]))


def test_without_dask_a_sentence_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ArgumentError, match=r"needs the package distributed.* 'handsim\[cluster\]'"):
        list(DaskCluster("tcp://127.0.0.1:1", tmp_path).run(echo, [1]))


def test_options_choose_the_executor(tmp_path):
    assert choose_executor(None, 3, tmp_path, print) == Processes(3)
    local = choose_executor("local", 3, tmp_path, print)
    assert isinstance(local, DaskCluster) and local.workers == 3
    with pytest.raises(ArgumentError, match=r"--workers counts .*, but tcp://a:1 has its own"):
        choose_executor("tcp://a:1", 3, tmp_path, print)


def test_a_cluster_of_its_own(tmp_path):
    """Workers are processes with one thread for numpy, and end with the run."""
    pids = tmp_path / "pids"
    job = functools.partial(note_process, pids)
    assert sorted(DaskCluster("local", tmp_path, workers=1).run(job, range(2))) == [0, 1]
    process, threads = pids.read_text().split()[:2]
    assert int(process) != os.getpid() and threads == "1"
    with pytest.raises(ProcessLookupError):
        os.kill(int(process), 0)


def note_process(file: Path, number: int) -> int:
    with file.open("a") as log:
        log.write(f"{os.getpid()} {os.environ['OMP_NUM_THREADS']}\n")
    return number
