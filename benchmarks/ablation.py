"""What the numbers of the tracker are worth: each is changed, and short captures are labeled and tracked.

python -m benchmarks.ablation GROUND [--data FOLDER] [--level 1] [--minutes 60] [--only track/association]
    [--variants half double zero large] [--save ablation]

GROUND is a folder for captures and results, outside this repository. The first call makes the captures; each
later call goes on where the one before stopped. FOLDER holds recordings of real hands: real/grasp-*.npz with
real/grasp21.toml, and Mocap_SIG18_Data as sig18. Without it, all captures are simulated. Level 2 has more and
longer captures, also of hands that touch; it is for numbers that change nothing on level 1.

A variant runs in a process of its own. A number that only functions of its own module read is set there. For
another number, its module is compiled with the other value before anything imports it, so that copies and
derived values follow; kernels that read it, and their callers, are compiled in a folder of the variant's own,
which takes minutes, so these numbers come last.
Numbers that no line reads change nothing; they are not varied.
"""

from __future__ import annotations

import ast
import functools
import gc
import importlib
import json
import os
import resource
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, Final

import numpy as np

from benchmarks.ablation_numbers import ROOT, Number, Sources, numbers
from benchmarks.record import Figures, run, save_figures

MODULES: Final = (
    *(f"track/{name}" for name in ("association", "tracker.py", "alternatives", "takes", "captures.py")),
    *(f"track/{name}" for name in ("frames.py", "bodies/constellation.py", "live/live_sizing.py")),
    *(f"track/{name}" for name in ("kinematics", "calibration", "hand_size.py")),
    *(f"train/labelers/{name}.py" for name in ("matching", "pose_prior", "networks", "storage")),
    *(f"gloves/captures/{name}.py" for name in ("capture", "coordinates", "pieces")),
)
"""Modules and folders whose numbers are varied, in this order."""
CHANGES: Final[dict[str, Callable[[Any], Any]]] = {
    "half": lambda value: 0.5 * value,
    "double": lambda value: 2.0 * value,
    "zero": lambda value: 0.0 * value,
    "large": lambda value: 1e6 * value,
}
COLUMNS: Final = (
    "frames right, mean and worst [points], keypoints [mm], captures of other labels and doubt, time [s]"
)
_THIRD_PARTY: Final = ("mujoco", "numba", "scipy.optimize", "scipy.spatial", "torch", "tyro")  # loaded once
_SLOWEST: Final = 300  # [s] of processor time, after which a variant is given up


def varied(change: Callable[[Any], Any], value: Any) -> Any:
    """A number, or a tuple or array of numbers, changed; whole numbers change by one at least."""
    if isinstance(value, tuple | list):
        return type(value)(varied(change, one) for one in value)
    if isinstance(value, np.ndarray):
        return change(value).astype(value.dtype)
    changed = change(value)
    if isinstance(value, int) and abs(changed - value) < 1.0:
        return value + (1 if changed > value else -1)
    return type(value)(changed)


class _Varying(SourceFileLoader):
    """Loads a module with another value of one of its numbers, and finds that module."""

    number: Number
    change: Callable[[Any], Any]

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != self.name:
            return None
        spec = PathFinder.find_spec(name, path)
        assert spec is not None
        spec.loader = self
        return spec

    def get_code(self, fullname: str) -> CodeType:
        tree = ast.parse(Path(self.path).read_text("utf-8"))
        node: Any = next(one for one in tree.body if one.lineno == self.number.line)
        owner, field = (node, None) if self.number.part is None else (node.value.elts, self.number.part)
        old = node.value if field is None else owner[field]
        new = ast.copy_location(ast.Call(ast.Name("_varied", ast.Load()), [old], []), old)
        if field is None:
            node.value = new
        else:
            owner[field] = new
        return compile(ast.fix_missing_locations(tree), self.path, "exec", dont_inherit=True)

    def exec_module(self, module: ModuleType) -> None:
        vars(module)["_varied"] = functools.partial(varied, self.change)
        super().exec_module(module)


def in_child(job: Callable[[], Any], result: Path, limit: int = _SLOWEST) -> Any:
    """What a job returns in a child of this process, kept as JSON; the reason if it fails."""
    if not result.exists():
        child = os.fork()
        if not child:
            end = limit + int(time.process_time())
            resource.setrlimit(resource.RLIMIT_CPU, (end, end + 5))
            with result.with_suffix(".log").open("w") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            try:
                found = job()
            except BaseException as error:
                traceback.print_exc()
                found = {"failed": f"{type(error).__name__}: {error}"[:200]}
            result.write_text(json.dumps(found), "utf-8")
            os._exit(0)
        os.waitpid(child, 0)
        if not result.exists():
            result.write_text(json.dumps({"failed": f"ended, or took more than {limit} s"}), "utf-8")
    return json.loads(result.read_text("utf-8"))


def measured(captures: Path, kernels: Path) -> Any:
    """Figures of the captures, with kernels of a cache folder."""
    import numba

    numba.config.CACHE_DIR = str(kernels)
    return importlib.import_module("benchmarks.ablation_ground").measure(captures)


def measured_variant(
    number: Number, change: str, stale: set[tuple[str, str]], captures: Path, kernels: Path
) -> Any:
    """Figures of the captures with another value of a number; nothing that reads it may be imported yet."""
    if stale:
        own = kernels.with_name("kernels_of_variant")
        shutil.rmtree(own, ignore_errors=True)
        kernels = Path(shutil.copytree(kernels, own))
        for file, function in stale:
            for kept in own.rglob(f"{Path(file).stem}.{function}-*"):
                kept.unlink()
    loader = _Varying(number.file.removesuffix(".py").replace("/", "."), str(ROOT / number.file))
    loader.number, loader.change = number, CHANGES[change]
    sys.meta_path.insert(0, loader)
    return measured(captures, kernels)


def measured_plainly(number: Number, change: str, captures: Path) -> Any:
    """The same in a process that has loaded everything, for a plain number: see `Sources.is_plain`."""
    for one in gc.get_objects():
        if isinstance(one, functools._lru_cache_wrapper) and one.__module__.startswith(("track", "poses")):
            one.cache_clear()
    module = sys.modules[number.file.removesuffix(".py").replace("/", ".")]
    setattr(module, number.name, varied(CHANGES[change], getattr(module, number.name)))
    return importlib.import_module("benchmarks.ablation_ground").measure(captures)


def traced(job: Callable[[], Any]) -> list[tuple[str, int]]:
    """The lines of this repository that a job runs, as file and number."""
    lines = set[tuple[str, int]]()

    def on_line(frame: Any, event: str, argument: Any) -> Any:
        lines.add((frame.f_code.co_filename, frame.f_lineno))
        return on_line

    def on_call(frame: Any, event: str, argument: Any) -> Any:
        return on_line(frame, event, argument) if frame.f_code.co_filename.startswith(str(ROOT)) else None

    sys.settrace(on_call)
    job()
    sys.settrace(None)
    return sorted((Path(file).relative_to(ROOT).as_posix(), line) for file, line in lines)


def told(row: dict[str, Any], base: dict[str, Any]) -> list[float] | str:
    """What a variant changes, see `COLUMNS`; the reason if it failed."""
    if "failed" in row:
        return str(row["failed"])
    frames = [row[name]["frames"] - one["frames"] for name, one in base.items()]
    errors = [
        row[name]["error"] - one["error"] for name, one in base.items() if one["error"] and row[name]["error"]
    ]
    labels, doubts = (
        sum(row[name][key] != one[key] for name, one in base.items()) for key in ("digest", "doubt")
    )
    seconds = sum(one["seconds"] for one in row.values())
    return [float(np.mean(frames)), min(frames), float(np.mean(errors or 0.0)), labels, doubts, seconds]


def main(
    ground: Path,
    data: Path | None = None,
    level: int = 1,
    minutes: float = 60.0,
    only: tuple[str, ...] = MODULES,
    variants: tuple[str, ...] = ("half", "double"),
    save: str | None = None,
) -> None:
    for name in _THIRD_PARTY:
        importlib.import_module(name)
    until, captures, kernels = time.time() + 60.0 * minutes, ground / f"captures{level}", ground / "kernels"
    results = ground / f"results{level}"
    for folder in (results, kernels):
        folder.mkdir(parents=True, exist_ok=True)

    def make() -> None:
        importlib.import_module("benchmarks.ablation_ground").make_ground(captures, data, level)

    job = functools.partial(measured, captures, kernels)
    in_child(make, results / "made.json", 4000)
    in_child(job, results / "compiled.json", 4000)
    base = in_child(job, results / "base.json", 4000)
    print({name: list(one.values()) for name, one in base.items()}, flush=True)
    ran = {
        (file, line) for file, line in in_child(functools.partial(traced, job), results / "lines.json", 4000)
    }
    sources = Sources()
    figures: Figures = {}
    read = {number: sources.kernels_of(number) for number in numbers(only) if sources.is_read(number, ran)}
    plain = {number for number in read if sources.is_plain(number)}
    print(f"{len(list(numbers(only)))} numbers, {len(read)} read, {len(plain)} of them plainly", flush=True)

    def result(number: Number, variant: str) -> Path:
        return results / f"{number.key.replace('/', '.')}.{variant}.json"

    def try_plain() -> None:
        measured(captures, kernels)
        for number in (one for one in read if one in plain):
            for variant in variants if time.time() < until else ():
                found = in_child(
                    functools.partial(measured_plainly, number, variant, captures), result(number, variant)
                )
                print(number.key, number.value, variant, told(found, base), flush=True)

    left = any(not result(number, variant).exists() for number in plain for variant in variants)
    if left and time.time() < until:
        (results / "plain.json").unlink(missing_ok=True)
        in_child(try_plain, results / "plain.json", 10**6)
    for number, stale in sorted(read.items(), key=lambda item: len(item[1])):
        for variant in variants if number not in plain else ():
            if time.time() < until or result(number, variant).exists():
                job = functools.partial(measured_variant, number, variant, stale, captures, kernels)
                found = in_child(job, result(number, variant))
                print(number.key, number.value, variant, told(found, base), flush=True)
    for number in numbers(only):
        known = [variant for variant in CHANGES if result(number, variant).exists()]
        for variant in known:
            row = json.loads(result(number, variant).read_text("utf-8"))
            figures[f"{number.key} {variant}"] = f"{number.value}: {COLUMNS}", told(row, base)
        if not known:
            figures[number.key] = number.value, "not tried" if number in read else "not read"
    save_figures(save, figures)


if __name__ == "__main__":
    run(main, __doc__)
