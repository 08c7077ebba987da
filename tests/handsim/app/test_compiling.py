"""Kernels are compiled ahead, in processes of their own, from a list that may be wrong."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from numba import types
from numba.core.registry import CPUDispatcher

from benchmarks.kernel_list import type_row
from handsim.app import compiling
from handsim.app.compiling import ListedKernel, compile_kernels, known_types, read_list
from handsim.callbacks import before_compiling
from handsim.kernels import align_rigid, horn_matrix
from tests.programs import run_python

# Only rotations and the like, which take some seconds.
SOME = """
from handsim.app import compiling
some = {n: one for n, one in enumerate(compiling.read_list()) if one.name.startswith("handsim.kernels:")}
compiling.missing_kernels = lambda listed, missing=compiling.missing_kernels: missing(some)
print(len(some), *compiling.compile_kernels())
"""


def start(folder: Path, program: str, **options: object) -> subprocess.Popen[str]:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    return subprocess.Popen(
        [sys.executable, "-c", program],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        **options,  # type: ignore[call-overload]
    )


@pytest.fixture(autouse=True)
def no_leftovers():
    yield
    before_compiling.clear()


def test_nearly_everything_on_the_list_is_there():
    """`python -m benchmarks.kernel_list` writes it anew; few that are gone cost next to nothing."""
    known, listed, gone = known_types(), read_list(), 0.0
    for one in listed:
        try:
            kernel = compiling.resolve_name(one.name)
        except (AttributeError, ImportError):
            gone += one.seconds
            continue
        assert isinstance(kernel, CPUDispatcher), one.name
        if not all(isinstance(known[row], types.Type) for row in one.types):
            gone += one.seconds
    assert gone < 0.03 * sum(one.seconds for one in listed)


def test_kernels_of_usual_options_are_on_the_list():
    """A calibration's touches, and the walls of a room around a camera that moves."""
    users = {one.name: one.commands.split() for one in read_list()}
    assert "simulate" in users["poses.touch:_overlaps"]
    assert "render" in users["render.scenery.backgrounds:_find_walls"]


def test_a_type_is_written_and_read():
    from track.kinematics.marker_kinematics import HandArrays

    vector = types.Array(types.float32, 1, "C")
    fixed = types.Array(types.int64, 2, "A", readonly=True)
    hand = types.BaseTuple.from_types([vector, fixed] * 5, HandArrays)
    some = [
        vector,
        fixed,
        hand,
        types.boolean,
        types.literal(3),
        types.literal(True),
        types.UniTuple(fixed, 2),
    ]
    some.append(types.Dispatcher(horn_matrix))
    table: list[object] = []
    rows = [type_row(one, table) for one in some]
    known: list[object] = []
    for row in json.loads(json.dumps(table)):
        known.append(compiling._type_of(row, known))
    assert [known[row] for row in rows] == some
    with pytest.raises(ValueError, match="no words"):
        type_row(types.ListType(vector), table)


def test_a_kernel_calls_others():
    assert "handsim.kernels:horn_matrix" in compiling.needed_kernels(align_rigid)


def test_an_empty_cache_is_filled_by_processes(tmp_path):
    process = start(tmp_path, SOME)
    out, errors = process.communicate(timeout=300)
    count, compiled, missing = map(int, out.split())
    assert count == compiled > 3 and missing == 0
    first, *_ = errors.splitlines()
    assert first == f"compiling {count} kernels, once on this machine"
    assert len(list(tmp_path.rglob("*.nbc"))) == count
    again = start(tmp_path, SOME)
    out, errors = again.communicate(timeout=300)
    assert out.split() == [str(count), "0", "0"] and errors == ""


def test_ctrl_c_ends_the_processes(tmp_path):
    process = start(tmp_path, SOME, start_new_session=True)
    assert process.stderr is not None and process.stderr.readline().startswith("compiling")
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=20)
    assert process.returncode != 0
    with pytest.raises(ProcessLookupError):  # All end; multiprocessing's tracker does a moment later.
        for _ in range(100):
            os.killpg(process.pid, 0)
            time.sleep(0.1)


def test_processes_that_die_break_nothing(monkeypatch, capsys):
    row = next(row for row, one in enumerate(read_list()) if one.name == "handsim.kernels:horn_matrix")
    monkeypatch.setattr(compiling, "missing_kernels", lambda listed: {row: read_list()[row]})
    monkeypatch.setattr(compiling, "_compile_row", os._exit)
    assert compile_kernels() == (0, 1)
    assert "compiling 1 kernels" in capsys.readouterr().err


def test_a_few_kernels_are_compiled_where_they_are_called(monkeypatch, capsys):
    monkeypatch.setattr(compiling, "missing_kernels", lambda listed: dict(list(listed.items())[:1]))
    monkeypatch.setattr(compiling, "_MIN_SECONDS", 100.0)
    monkeypatch.setattr(compiling, "_compile_all", None)
    assert compile_kernels("label") == (0, 1)
    (tell,) = before_compiling
    tell()
    assert "compiling what is new" in capsys.readouterr().err


def test_what_is_gone_is_left_out(monkeypatch):
    gone = {0: ListedKernel("handsim.kernels:gone", [], 1.0, ""), 1: ListedKernel("gone:gone", [], 1.0, "")}
    assert compiling.missing_kernels(gone) == {}


def test_slices_bring_no_words_into_kernels():
    """It fails when numba no longer calls what `plain_shape_errors` replaces."""
    program = """
import numba, numpy as np
from handsim.app.compiling import plain_shape_errors

plain_shape_errors()

@numba.njit
def fill(one, other):
    one[:] = other

try:
    fill(np.zeros(3), np.zeros(4))
except ValueError as error:
    assert str(error) == "cannot assign slice from input of different size", error
(code,) = fill.inspect_llvm().values()
assert "unicode" not in code
"""
    run_python(program)


@pytest.mark.slow
def test_after_compiling_ahead_a_command_compiles_nothing(tmp_path):
    program = """
import sys
from numba.core import event
from handsim.cli.main import main
class Listener(event.Listener):
    def on_start(self, found):
        if found.data["dispatcher"].targetoptions.get("no_cfunc_wrapper"):
            print("late", found.data["dispatcher"].py_func.__qualname__)
    def on_end(self, found):
        pass
event.register("numba:compile", Listener())
assert main(["simulate", "--kind", "hand-hand", "--num-frames", "240", "--out", "hand.c3d"]) == 0
assert main(["label", "hand.c3d", "--out", "labeled.trc"]) == 0
"""
    out, errors = start(tmp_path / "cache", program, cwd=tmp_path).communicate(timeout=900)
    assert out.count("late") <= 5, out  # few are not on the list
    assert "compiling" in errors
