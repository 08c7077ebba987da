"""Jobs on real workers of a Dask scheduler: the same bytes, whatever dies, and words for what is wrong."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import signal
import socket
import socketserver
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from handsim import HandSimError
from handsim.app.output import open_output
from handsim.app.workers import ClusterExecutor, _Task, _versions, check_worker, chosen_workers, run_jobs
from handsim.cli.main import main
from handsim.errors import ArgumentError, LayoutError
from render import RenderConfig, render_take
from tests.folders import contents
from tests.handsim.app.object_stores.stored_set import CONFIG, ROWS, two_workers
from tests.programs import ROOT, run_python
from tests.sentences import error_names
from tests.waiting import LONG
from train import simulate_take
from train.simulation import generation
from train.simulation.generation import make_dataset

distributed = pytest.importorskip("distributed", reason="needs `pip install 'handsim[cluster]'`")
LARGER = dataclasses.replace(CONFIG, num_frames=12 * ROWS - 30)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with two_workers(tmp_path_factory.mktemp("preload")) as started:
        yield started


@pytest.fixture(scope="module")
def client(cluster):
    with distributed.Client(cluster, set_as_default=False) as connected:
        yield connected


@pytest.fixture
def small_shards(monkeypatch):
    monkeypatch.setattr(generation, "ROWS_PER_SHARD", ROWS)


@contextmanager
def killing(client):
    """Called, this kills one of the workers."""

    def kill(*_) -> None:
        if not killed:
            killed.append(next(iter(client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    killed: list[int] = []
    yield kill
    assert killed


def test_training_sets_have_the_same_bytes_also_when_a_worker_is_killed(
    cluster, client, small_shards, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # workers have another folder
    make_dataset(LARGER, Path("here"), workers=1)
    expected = contents(tmp_path / "here")
    assert len([name for name in expected if name.startswith("rows-")]) == 12
    there, killed = Path("there"), Path("killed")
    lines, counts = [], []
    with chosen_workers(cluster.scheduler_address, None, lines.append) as workers:
        make_dataset(LARGER, there, workers=workers, progress=lambda done, _: counts.append(done))
        assert contents(there) == expected
        assert counts == sorted(counts) and counts[-1] == LARGER.num_frames and len(counts) == 12
        (line,) = lines
        assert "2 workers; dashboard of the cluster: http" in line
        with killing(client) as kill:
            make_dataset(LARGER, killed, workers=workers, progress=kill)
        assert contents(killed) == expected


def test_pictures_have_the_same_bytes(client, tmp_path):
    take = tmp_path / "take.truth.npz"
    simulate_take(num_frames=24).save(take)
    config = RenderConfig(passes=("depth",), depth_sensor=None, every=6, frames_per_shard=1)
    assert render_take(take, tmp_path / "here", ["png"], config, workers=1) == 4
    executor = client.get_executor()  # Dask's own does as well
    assert render_take(take, tmp_path / "there", ["png"], config, workers=executor) == 4
    assert contents(tmp_path / "there") == contents(tmp_path / "here")


def fail_at_two(folder: Path, number: int) -> int:
    if number == 2:
        with (folder / "tries").open("a") as file:
            file.write("x")
        raise LayoutError("number 2 does not fit")
    return number


def test_what_a_job_raises_comes_back_and_is_not_tried_again(client, tmp_path):
    with pytest.raises(LayoutError, match="number 2 does not fit"):
        list(run_jobs(functools.partial(fail_at_two, tmp_path), range(5), ClusterExecutor(client)))
    assert (tmp_path / "tries").read_text() == "x"


def echo(number: int) -> int:
    return number


def die(number: int) -> int:
    os._exit(3)


def test_a_job_that_ends_every_worker_is_told(cluster, client):
    client.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", 0))
    try:
        with (
            pytest.raises(HandSimError, match="a job was begun 1 times; its worker died each time"),
            chosen_workers(cluster.scheduler_address, None, print) as workers,
        ):
            list(run_jobs(die, [7], workers))
    finally:
        client.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", 3))
        client.wait_for_workers(1, timeout=LONG)  # its nanny starts another


def test_a_scheduler_that_ends_is_told(tmp_path):
    with (
        pytest.raises(HandSimError, match="the workers are gone; run the same command again"),
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as short,
        distributed.Client(short, set_as_default=False) as client,
    ):
        jobs = run_jobs(functools.partial(wait_after_one, tmp_path), range(3), ClusterExecutor(client))
        assert next(jobs) == 0
        short.close()
        list(jobs)


def wait_after_one(folder: Path, number: int) -> int:
    if number:
        time.sleep(600)
    return number


def test_a_worker_of_another_version_is_named(cluster, client, tmp_path):
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
            client.wait_for_workers(len(present) + 1, timeout=LONG)
            (late,) = set(client.nthreads()) - present
            executor = ClusterExecutor(client)
            with pytest.raises(HandSimError, match=f"the worker {late} has handsim 0.0.1, this machine has"):
                executor._executor.submit(_Task(echo, _versions(), tmp_path), 1, workers=[late]).result(LONG)
            with pytest.raises(HandSimError, match=f"the worker {late} has handsim 0.0.1, this machine has"):
                list(run_jobs(echo, range(100), executor))
        finally:
            process.kill()


def test_a_worker_that_does_not_share_the_folder_is_named(client, tmp_path):
    with open_output(tmp_path / "set") as output:
        output.claim("config.json", {"x": 1}, noun="thing", error=HandSimError)
        job = output.job(leave)
        (tmp_path / "set/config.json").write_text("another folder of this name")
        with pytest.raises(HandSimError, match=f"the worker on .* does not see .* {tmp_path}/set;"):
            list(run_jobs(job, [1], ClusterExecutor(client)))


def leave(folder: Path, number: int) -> int:
    return number


def lack_a_file(number: int) -> int:
    raise FileNotFoundError(f"take-{number}.npz is not there")


def test_a_worker_that_lacks_a_file_is_named(client, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("handsim.app.workers.Path.cwd", lambda: tmp_path / "nowhere")
        done = ClusterExecutor(client).submit(lack_a_file, 3)
    with pytest.raises(HandSimError, match=r"^on .*, which does not see .*nowhere: take-3\.npz is not"):
        done.result(LONG)


def test_a_worker_with_threads_is_refused():
    check_worker("tcp://one:1", 1, {"numpy": "2"}, {"numpy": "2"})
    with pytest.raises(HandSimError, match="the worker tcp://one:1 has 8 threads, expected 1; start workers"):
        check_worker("tcp://one:1", 8, {}, {})


def chosen(address, workers=None):
    """An executor of this address that does one job."""
    with chosen_workers(address, workers, print) as executor:
        return list(run_jobs(echo, [1], executor))


@pytest.mark.parametrize("address", ["scheduler:none", "http://a:1", "tcp://a:b", "tls://a:b"])
def test_an_address_that_is_none(address):
    with pytest.raises(HandSimError, match=f"answers at {address}: .*; expected tcp://host:port, tls://"):
        chosen(address)


def test_nobody_at_the_address(tmp_path):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # taken, and nobody listens
        address = f"tcp://127.0.0.1:{closed.getsockname()[1]}"
        (tmp_path / "scheduler.json").write_text(f'{{"address": "{address}"}}')
        for name in (address, str(tmp_path / "scheduler.json")):
            with error_names(HandSimError, f"no Dask scheduler answers at {address}: Connection refu"):
                chosen(name)


@contextmanager
def listening(backlog=5):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(backlog)
        yield listener, f"127.0.0.1:{listener.getsockname()[1]}"


def test_somebody_who_says_nothing(monkeypatch):
    monkeypatch.setattr("handsim.app.workers._TIMEOUT", 0.2)
    with listening() as (_, address):
        with pytest.raises(HandSimError, match=f"answers at tcp://{address}: none within 0.2 s; expected"):
            chosen(f"tcp://{address}")
        with pytest.raises(HandSimError, match=f"answers at tls://{address}: .*TLS config.*; expected"):
            chosen(f"tls://{address}")


def test_an_address_that_times_out(monkeypatch):
    monkeypatch.setattr("handsim.app.workers._TIMEOUT", 0.2)
    with listening(backlog=0) as (listener, address), socket.socket() as waiting:
        waiting.connect(listener.getsockname())  # and for another there is no room
        with pytest.raises(HandSimError, match=f"answers at tcp://{address}: timed out; expected"):
            chosen(f"tcp://{address}")


class Greeting(socketserver.StreamRequestHandler):
    """Speaks first, as SSH does, and stays until the other has left."""

    def handle(self):
        with contextlib.suppress(ConnectionError):
            self.wfile.write(b"SSH-2.0-OpenSSH_9.6\r\n")
            self.rfile.read()


def test_something_else_at_the_address():
    with socketserver.TCPServer(("127.0.0.1", 0), Greeting) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        address = f"tcp://127.0.0.1:{server.server_address[1]}"
        try:
            with pytest.raises(HandSimError, match=f"at {address}: something else listens there; expected"):
                chosen(address)
        finally:
            server.shutdown()
            thread.join(LONG)


def test_a_scheduler_that_does_not_answer_leaves_nothing_behind():
    """The garbage collector runs all the time, also while the next connection is made."""
    script = """
import gc
import threading
from handsim.app.workers import chosen_workers
from handsim.errors import HandSimError
gc.set_threshold(1, 1, 1)
for address in ["tcp://a:b", "tls://localhost:1"] * 3:
    try:
        with chosen_workers(address, None, print):
            pass
    except HandSimError as error:
        print(error)
threads = [thread.name for thread in threading.enumerate()]
assert threads == ["MainThread"], threads
"""
    done = run_python(script, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("no Dask scheduler answers at") == len(done.stdout.splitlines()) == 6


def test_the_command_says_it_in_a_sentence(tmp_path, capsys):
    options = ["--num-frames", "10", "--out", str(tmp_path / "set"), "--cluster", "tcp://a:b"]
    assert main(["generate", *options]) == 1
    said = capsys.readouterr().err.splitlines()[-1]  # after what tells the time on a busy machine
    assert said.startswith("handsim generate: no Dask scheduler answers at tcp://a:b: ")
    assert not (tmp_path / "set").exists()


def test_a_scheduler_file_that_is_none(tmp_path):
    with pytest.raises(HandSimError, match=r"missing\.json"):
        chosen(str(tmp_path / "missing.json"))
    (tmp_path / "other.json").write_text('{"id": 3}')
    with pytest.raises(HandSimError, match=r"other\.json: no address"):
        chosen(str(tmp_path / "other.json"))


def test_without_dask_a_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ArgumentError, match=r"needs the package distributed.* 'handsim\[cluster\]'"):
        chosen("tcp://127.0.0.1:1")


def test_options_choose_the_workers():
    with chosen_workers(None, 3, print) as workers:
        assert workers == 3
    with pytest.raises(ArgumentError, match=r"--workers counts .*, but tcp://a:1 has its own"):
        chosen("tcp://a:1", 3)


def test_a_cluster_of_its_own(tmp_path):
    """Workers are processes with one thread for numpy, and end with the run."""
    pids = tmp_path / "pids"
    with chosen_workers("local", 1, print) as workers:
        assert sorted(run_jobs(functools.partial(note_process, pids), range(2), workers)) == [0, 1]
    process, threads = pids.read_text().split()[:2]
    assert int(process) != os.getpid() and threads == "1"
    with pytest.raises(ProcessLookupError):
        os.kill(int(process), 0)


def note_process(file: Path, number: int) -> int:
    with file.open("a") as log:
        log.write(f"{os.getpid()} {os.environ['OMP_NUM_THREADS']}\n")
    return number
