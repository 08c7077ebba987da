"""The list of kernels that commands compile ahead: `python -m benchmarks.kernel_list`.

The commands run without the list and with one cache, the dearest kernels are printed, and the list is written
anew: after a change to a kernel's arguments or to what calls it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

from benchmarks.record import describe
from handsim.app.compiling import KERNELS_FILE

# A later command may read what an earlier one wrote. Names begin with the command's.
COMMANDS: Final = {
    "simulate": "simulate --kind hand-hand --num-frames 240 --seed 3 --out hand.c3d",
    "simulate calibration": "simulate --kind calibration --num-frames 300 --seed 3 --out minute.c3d",
    "label": "label hand.c3d --out labeled.trc",
    "track": "track hand.c3d --out take.npz",
    "render": "render hand.truth.npz --num-frames 4 --workers 1 --seed 5 --out pictures",
    "render orbit": "render hand.truth.npz --num-frames 4 --workers 1 --placement orbit --background plain "
    "--out orbit",
    "generate": "generate --num-frames 500 --workers 1 --seed 1 --out set",
    "demo": "demo --num-frames 500 --out demo",
    "evaluate": "evaluate hand.truth.npz",
    "calibrate": "calibrate hand.c3d --size M --out user.json",
}
RECORD: Final = """
import gc, json, sys, time

from numba.core import event
from numba.core.registry import CPUDispatcher

from benchmarks.kernel_list import type_row
from handsim.app import compiling
from handsim.cli.main import main

compiling.compile_kernels = lambda command: (0, 0)
compiling.plain_shape_errors()
table, seconds, running = [], {}, []


def row_of(kernel, types):
    place = f"{kernel.py_func.__module__}:{kernel.py_func.__qualname__}"
    try:
        return json.dumps([place, [type_row(one, table) for one in types]])
    except ValueError as error:
        print(f"{place} is left out: {error}", file=sys.stderr)


class Listener(event.Listener):
    def on_start(self, found):
        running.append([time.process_time(), 0.0])

    def on_end(self, found):
        began, inner = running.pop()
        took = time.process_time() - began
        if running:
            running[-1][1] += took
        kernel = found.data["dispatcher"]
        if kernel.targetoptions.get("no_cfunc_wrapper"):
            seconds[row_of(kernel, found.data["args"])] = took - inner


table.extend(json.loads(sys.stdin.readline()))
event.register("numba:compile", Listener())
code = main(sys.argv[2:])
ours = [one for one in gc.get_objects() if isinstance(one, CPUDispatcher)]
ours = [one for one in ours if one.targetoptions.get("no_cfunc_wrapper")]
calls = {row_of(one, types): sorted(compiling.needed_kernels(one)) for one in ours for types in one.overloads}
calls.pop(None, None)
seconds.pop(None, None)
with open(sys.argv[1], "w") as file:
    json.dump([table, seconds, calls], file)
sys.exit(code)
"""


def type_row(kind: Any, table: list[Any]) -> int:
    """The row of a type in a table, to which it is added if it is missing; used to record the list.

    Raises:
        ValueError: The list has no words for the type.
    """
    from numba import types

    row: str | list[Any] = kind.name
    if isinstance(kind, types.BaseTuple):
        place = getattr(kind, "instance_class", None)
        name = "" if place is None else f"{place.__module__}:{place.__qualname__}"
        row = [name, *(type_row(part, table) for part in kind)]
    elif isinstance(kind, types.Array):
        row = f"{kind.dtype.name} {kind.ndim} {kind.layout}" + " const" * (not kind.mutable)
    elif isinstance(kind, types.Literal):
        row = f"={json.dumps(kind.literal_value)}"
    elif isinstance(kind, types.Dispatcher):
        row = f"{kind.dispatcher.py_func.__module__}:{kind.dispatcher.py_func.__qualname__}"
    elif getattr(types, kind.name, None) is not kind:
        row = next((name for name, one in vars(types).items() if one is kind), "")
        if not row:
            raise ValueError(f"no words for the type {kind}")
    if row not in table:
        table.append(row)
    return table.index(row)


def main() -> None:
    print(describe("numba"))
    with tempfile.TemporaryDirectory() as made:
        folder, ours = Path(made), str(Path(__file__).parents[1])  # for `type_row`
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": ours}
        table: list[Any] = []
        seconds: dict[str, float] = {}
        users: dict[str, set[str]] = {}
        for name, words in COMMANDS.items():
            command = [sys.executable, "-c", RECORD, "recorded.json", *words.split()]
            given = json.dumps(table) + "\n"
            subprocess.run(command, cwd=folder, env=environment, input=given, text=True, check=True)
            table, compiled, calls = json.loads((folder / "recorded.json").read_text())
            seconds |= compiled
            called = {place for places in calls.values() for place in places}
            for row in seconds:
                if row in calls or json.loads(row)[0] in called:
                    users.setdefault(row, set()).add(name.split()[0])
            print(f"after {name}: {len(seconds)} kernels in {sum(seconds.values()):.0f} s", flush=True)
    kernels = [
        [*json.loads(row), round(took, 2), " ".join(sorted(users.get(row, ())))]
        for row, took in sorted(seconds.items())
    ]
    lines = (",\n  ".join(json.dumps(one) for one in rows) for rows in (table, kernels))
    text = '{{"types": [\n  {}\n], "kernels": [\n  {}\n]}}\n'.format(*lines)
    KERNELS_FILE.write_text(text, encoding="utf-8")
    for place, _, took, commands in sorted(kernels, key=lambda one: -one[2])[:25]:
        print(f"{took:7.2f} s  {place}  ({commands})")


if __name__ == "__main__":
    main()
