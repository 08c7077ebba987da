"""Makes a benchmark: captures that a tracker may read, and their truth apart from them."""

from __future__ import annotations

import dataclasses
import functools
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from jaxtyping import Float, Int

from benchmarks.public.answers import Answers, BenchmarkError, poses_of, save_answers
from benchmarks.public.difficulties import BENCHMARK, DIFFICULTIES, GLOVE, Plan, PlannedCapture
from benchmarks.public.manifest import (
    LICENSE,
    MANIFEST,
    Benchmark,
    capture_path,
    truth_path,
    user_path,
    write_manifest,
)
from gloves import Capture, GloveFit, Take, load_layout, write_capture
from gloves.captures.capture import UNLABELED
from handsim import HandModel, load_rig
from handsim.files.outputs import atomic_write, check_free, claim, remove_leftovers
from poses.motion import RATE
from track import User, load_user
from train.simulation.room import record_take
from train.simulation.scenes import Kind, sample_real_like_scene
from train.simulation.takes import sample_scene

Progress = Callable[[int, int], None]
"""Called with frames done and frames expected."""
PLAN: Final = "plan.json"
CAPTURES: Final = "captures/captures.csv"
_CARD: Final = """\
# {name}, {size}

{captures} simulated captures of two hands in marker gloves, {frames:,} frames at {rate:g} Hz, made by
handsim: unlabeled points, as an optical system with several cameras exports them. A tracker may read
`captures/`, and nothing else; `truth/` is for `python -m benchmarks.public score THIS_FOLDER RESULTS`.

benchmarks/public/README.md in handsim's sources describes the files, the forms of results, what is counted,
and the limits. With results name the benchmark, its size, and whether users were calibrated. Do not train on
these captures. `python -m benchmarks.public make --size {size}` makes them again.

License: CC BY 4.0, see `LICENSE.txt`. Credit: the handsim authors.
"""
_LICENSE_FILE: Final = "LICENSE.txt"
_GLOVE_FILE: Final = "captures/glove.toml"
_BYTES_PER_FRAME: Final = 2500
_POINT_DECIMALS: Final = 5  # of a point or joint [m]: 0.01 mm, below the noise of the cameras
_ANGLE_DECIMALS: Final = 4  # of a true joint angle [rad]
_HAND_DECIMALS: Final = 9  # of hands and gloves [m]


def make_benchmark(
    plan: Plan, out: Path, *, workers: int | None = None, progress: Progress | None = None
) -> Benchmark:
    """Make a benchmark, or finish a stopped one; the bytes depend on the plan alone.

    Args:
        plan: Which captures.
        out: Folder to make it in.
        workers: Processes; all cores when not given.
        progress: Called after every capture.

    Raises:
        BenchmarkError: `out` holds something else, or its disk is too small.
    """
    captures = plan.captures
    total = sum(one.num_frames for one in captures)
    check_free(out, _BYTES_PER_FRAME * total, f"{total} frames", "ask for --size small", error=BenchmarkError)
    claim(out / PLAN, _settings(plan), noun="benchmark", error=BenchmarkError, result=out / MANIFEST)
    todo = [number for number, one in enumerate(captures) if not _finished(out, one)]
    done = total - sum(captures[number].num_frames for number in todo)
    make, workers = functools.partial(make_capture, plan, out), workers or os.cpu_count()
    with ProcessPoolExecutor(workers, get_context("spawn")) if workers != 1 else nullcontext() as pool:
        for number in (pool.map if pool else map)(make, todo):
            done += captures[number].num_frames
            if progress is not None:
                progress(done, total)
    remove_leftovers(out)  # of processes that were killed
    return _complete(plan, out)


def make_capture(plan: Plan, out: Path, number: int) -> int:
    """Write one capture, its user and its truth; they depend on its number in the plan alone."""
    planned = plan.captures[number]
    take = simulate_capture(planned)
    capture, labels = _published_points(take)
    hands = tuple(_rounded(hand) for hand in take.hands)
    joints, angles = poses_of(hands, take.qpos)
    rounded = _round(joints, _POINT_DECIMALS), _round(angles, _ANGLE_DECIMALS)
    write_capture(out / capture_path(planned.name), capture)
    _as_published(out / capture_path(planned.name))
    notes = "The true hands and gloves of this capture, as a perfect calibration finds them."
    User(hands, notes).save(out / user_path(planned.name))
    save_answers(out / truth_path(planned.name), Answers(labels, *rounded))  # last: it is finished now
    return number


def simulate_capture(planned: PlannedCapture) -> Take:
    """The take of a planned capture, without the points of a rigid body, which systems track themselves."""
    rng, difficulty, layout = planned.rng("motion"), DIFFICULTIES[planned.difficulty], load_layout(GLOVE)
    if planned.kind == "real-like":
        scene = sample_real_like_scene(layout, planned.num_frames, rng=rng)
    else:
        kind, frames = cast("Kind", planned.kind), difficulty.speed * planned.num_frames
        scene = sample_scene(kind, layout, frames, rng=rng).faster(difficulty.speed)
    optics = difficulty.room.optics.worn(layout.radius)
    room = dataclasses.replace(difficulty.room, optics=optics)
    take = record_take(scene, load_rig(difficulty.rig), room, {"glove": GLOVE}, rng=planned.rng("optics"))
    return take.without_body()


def _published_points(take: Take) -> tuple[Capture, Int[np.ndarray, "T N"]]:
    """The points (T, N, 3) as they are written, and their labels (T, N), without columns that are empty."""
    used = np.isfinite(take.points[..., 0]).any(axis=0)
    names = tuple(f"{UNLABELED}{number + 1}" for number in range(int(used.sum())))
    points = _round(take.points[:, used], _POINT_DECIMALS)
    return Capture(names, points, take.rate), take.labels[:, used]


def _rounded(fit: GloveFit) -> GloveFit:
    """A hand in its glove with lengths to a nanometer, which do not depend on the last bits of a machine.

    Its layout is the glove as designed, as after a calibration: where markers slipped is in their positions.
    """

    def rounded(owner: Any, *without: str) -> Any:
        fields = {field.name: getattr(owner, field.name) for field in dataclasses.fields(owner)}
        numbers = {
            name: _round(value, _HAND_DECIMALS)
            if isinstance(value, np.ndarray)
            else round(value, _HAND_DECIMALS)
            for name, value in fields.items()
            if name not in without
        }
        return dataclasses.replace(owner, **numbers)

    model = HandModel(rounded(fit.shape, "side"))
    worn = dataclasses.replace(fit.attachment, layout=load_layout(GLOVE))
    return GloveFit(model, rounded(worn, "layout", "bone_indices"))


def _round(array: Float[np.ndarray, "*shape"], decimals: int) -> Float[np.ndarray, "*shape"]:
    """Rounded numbers, never -0.0."""
    rounded: np.ndarray = np.round(array, decimals) + 0.0
    return rounded


def _finished(out: Path, planned: PlannedCapture) -> bool:
    paths = (capture_path(planned.name), user_path(planned.name), truth_path(planned.name))
    return all((out / path).is_file() for path in paths)


def _settings(plan: Plan) -> dict[str, Any]:
    difficulties = {name: dataclasses.asdict(DIFFICULTIES[name]) for name in plan.difficulties}
    return {"benchmark": BENCHMARK, **dataclasses.asdict(plan), "settings": difficulties}


def _complete(plan: Plan, out: Path) -> Benchmark:
    """Write what captures share, the data card and the manifest."""
    load_layout(GLOVE).save(out / _GLOVE_FILE)
    files = [PLAN, _GLOVE_FILE, CAPTURES, _LICENSE_FILE, "README.md"]
    for name in sorted({DIFFICULTIES[name].rig for name in plan.difficulties}):
        files.append(f"captures/rig-{name}.toml")
        load_rig(name).save(out / files[-1])
    _write(out / CAPTURES, _table_of_captures(plan, out))
    with atomic_write(out / _LICENSE_FILE) as temporary:
        shutil.copyfile(Path(__file__).with_name(f"{LICENSE}.txt"), temporary)
    frames = sum(one.num_frames for one in plan.captures)
    card = _CARD.format(name=BENCHMARK, size=plan.size, captures=len(plan.captures), frames=frames, rate=RATE)
    _write(out / "README.md", card)
    for one in plan.captures:
        files += [capture_path(one.name), user_path(one.name), truth_path(one.name)]
    return write_manifest(out, plan, files)


def _table_of_captures(plan: Plan, out: Path) -> str:
    """What a tracker may know of every capture beside its points."""
    lines = ["capture,kind,difficulty,rig,frames,hand_length_mm,hand_breadth_mm"]
    for one in plan.captures:
        shape = load_user(out / user_path(one.name))[0].shape
        size = f"{1e3 * shape.length:.1f},{1e3 * shape.breadth:.1f}"
        rig = DIFFICULTIES[one.difficulty].rig
        lines.append(f"{one.name},{one.kind},{one.difficulty},{rig},{one.num_frames},{size}")
    return "\n".join(lines)


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text.rstrip("\n") + "\n", encoding="utf-8")


def _as_published(path: Path) -> None:
    """Write a .trc as this version of the benchmark has it: without a tab at the end of its lines."""
    lines = path.read_text("utf-8").split("\n")
    path.write_text("\n".join([*lines[:3], *(line.removesuffix("\t") for line in lines[3:])]), "utf-8")
