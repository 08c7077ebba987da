"""How fast the capture room is: people, gloves and motions, then every line of sight, then the optics.

    python -m benchmarks.room [--frames 2048 --repeats 5]

Two hands and an object (hand-pen, hand-controller), two hands (hand-hand), all past triangle meshes, and one
hand alone past capsules as in training sets; whole captures on one core and in two processes side by side,
then the stages one by one in microseconds of processor time a frame. Each figure is the median of the
repeats, each with people and motions of its own; the compiled code is warm. The floor of a frame is what no
room leaves out: its lines times the boxes they pass, and the bytes of its skins.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from benchmarks.record import Figures, add_save, describe, save_figures
from gloves import OpticsConfig, load_layout
from gloves.fit import wear
from gloves.optics.reconstruction import reconstruct
from gloves.optics.visibility import clear_of_mesh, facing_cameras, hand_tree, visible_cameras
from handsim import join_qpos, load_rig
from handsim.space.transforms import random_quaternions
from poses.shapes import sample_valid_angles
from train import GenerateSettings, simulate_take
from train.simulation.room import (
    SKIN_CHUNK,
    TWINS,
    SceneSight,
    marker_radii,
    mirror_images,
    pack_take,
    sample_light_sources,
    stray_reflections,
)
from train.simulation.takes import sample_scene
from train.simulation.training_frames import sample_hands

KINDS = ("hand-pen", "hand-controller", "hand-hand")
ALONE = "one hand alone"
PEOPLE = GenerateSettings()


class Stopwatch:
    """Processor time [s] of stages, a number a repeat each."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}
        self.lines: list[int] = []

    def __call__(self, name: str, job: Callable[[], Any]) -> Any:
        """What a job returns, timed."""
        start = time.process_time()
        result = job()
        self.note(name, time.process_time() - start)
        return result

    @property
    def lines_a_second(self) -> float:
        """Lines of sight decided in a second, those in view and facing, each past all meshes."""
        return float(np.median(np.divide(self.lines, self.times["  lines"])))

    def note(self, name: str, seconds: float) -> None:
        """Keep one repeat's time of a stage."""
        self.times.setdefault(name, []).append(seconds)

    def last(self, *names: str) -> float:
        """This repeat's time of some stages."""
        return sum(self.times[name][-1] for name in names)


def one_hand(frames: int, seed: int, watch: Stopwatch) -> None:
    """What a training set would cost with full optics: a new person every 128 frames, poses of no motion."""
    rng = np.random.default_rng(seed)
    layout, rig = load_layout("dense19"), load_rig("figure5")
    spent: dict[str, float] = {}

    def timed(name: str, job: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = job()
        spent[name] = spent.get(name, 0.0) + time.process_time() - start
        return result

    count = PEOPLE.frames_per_hand
    for _ in range(frames // count):
        model = timed("people", lambda: sample_hands(PEOPLE.population, rng=rng)[0])
        glove = timed("gloves", lambda model=model: wear(layout, model, along=0.1, around=0.17, rng=rng))
        angles = timed("poses", lambda model=model: sample_valid_angles(model, count, rng=rng))
        qpos = join_qpos(
            angles, position=np.array([0.0, 0.0, 1.1]), quaternion=random_quaternions(count, rng=rng)
        )
        bones = timed("bones, markers", lambda m=model, q=qpos: m.forward_kinematics(q))
        markers, normals = timed("bones, markers", lambda g=glove, m=model, b=bones: g.markers(m, b))
        flesh = model.capsules.posed(bones), model.capsules.radii
        seen = timed(
            "lines past capsules", lambda m=markers, n=normals, f=flesh: visible_cameras(m, n, rig, *f)
        )
        timed(
            "optics",
            lambda m=markers, s=seen: reconstruct(m, s, rig, OpticsConfig(), continuous=False, rng=rng),
        )
    for name, seconds in spent.items():
        watch.note(name, seconds)


def room_of(kind: str, frames: int, seed: int, watch: Stopwatch) -> None:
    """The stages of `train.simulation.takes.simulate_take`."""
    rng = np.random.default_rng(seed)
    rig, config = load_rig("figure5"), TWINS[kind].room
    layout, optics = load_layout("dense19"), config.optics
    scene = watch("people, gloves, motions", lambda: sample_scene(kind, layout, frames, rng=rng))
    sight = watch("bones, markers", lambda: _prepared(SceneSight(scene, rig)))
    radii = marker_radii(scene, optics)
    watch("all lines of sight", lambda: sight.visible_markers(optics.partial * radii, rng=rng))
    watch(
        "mirrors and strays",
        lambda: (
            mirror_images(sight, radii, config.reflectance, rng=rng),
            stray_reflections(sight, config, rng=rng),
        ),
    )
    state = rng.bit_generator.state
    sources = sample_light_sources(sight, config, rng=rng)
    positions, visible, sizes = sources.positions, sources.visible, sources.radii
    watch(
        "optics",
        lambda: reconstruct(positions, visible, rig, optics, radii=sizes, continuous=True, rng=rng),
    )
    rng.bit_generator.state = state
    start = time.process_time()
    pack_take(scene, sample_light_sources(sight, config, rng=rng), rig, config, {}, rng=rng)
    taken = time.process_time() - start
    watch.note("packing", taken - watch.last("all lines of sight", "mirrors and strays", "optics"))
    watch.note("whole", taken + watch.last("people, gloves, motions", "bones, markers"))
    _lines(sight, watch)


def _prepared(sight: SceneSight) -> SceneSight:
    """With what is computed once."""
    _ = sight.markers, sight.obstacles
    return sight


def _lines(sight: SceneSight, watch: Stopwatch) -> None:
    """Parts of the lines of sight: facing and spots, skins, boxes refitted, and the lines themselves."""
    markers, normals = sight.markers
    cameras = sight.rig.positions
    facing = facing_cameras(markers, normals, sight.rig)
    pieces = [slice(first, first + SKIN_CHUNK) for first in range(0, sight.scene.num_frames, SKIN_CHUNK)]
    starts = np.repeat(markers[:, :, None], len(cameras), axis=2)
    nothing = np.zeros_like(facing[:SKIN_CHUNK])

    def skins() -> None:
        for piece in pieces:
            for hand in sight.scene.hands:
                hand.fit.model.skin(hand.qpos[piece])

    def refits() -> None:
        for piece in pieces:
            few = len(starts[piece])
            for hand in sight.scene.hands:
                skin = hand.fit.model.skin(hand.qpos[piece])
                clear_of_mesh(hand_tree(), skin, starts[piece], cameras, nothing[:few])

    watch("  skins", skins)
    watch("  boxes refitted", refits)
    watch.times["  boxes refitted"][-1] -= watch.last("  skins")
    watch("  lines", lambda: [sight.clear_lines(piece, starts[piece], facing[piece]) for piece in pieces])
    watch.times["  lines"][-1] -= watch.last("  skins", "  boxes refitted")
    watch.lines.append(int(facing.sum()))
    watch.note(
        "  facing, spots of markers",
        watch.last("all lines of sight") - watch.last("  skins", "  boxes refitted", "  lines"),
    )


@numba.njit  # type: ignore[untyped-decorator]
def boxes_met(starts: Any, ends: Any, skip: Any, boxes: Any) -> int:
    """Boxes that lines are tested against, hits not cut short."""
    tested = 0
    for line in range(len(starts)):
        node = 0
        while node < len(skip):
            tested += 1
            near, far = 0.0, 1.0
            for i in range(3):
                way = ends[line, i] - starts[line, i]
                a, b = (boxes[node, i] - starts[line, i]) / way, (boxes[node, 3 + i] - starts[line, i]) / way
                near, far = max(near, min(a, b)), min(far, max(a, b))
            node = skip[node] if near > far else node + 1
    return tested


def floor(frames: int) -> None:
    """Lines, boxes and bytes of a frame of two hands and a controller."""
    rng = np.random.default_rng(0)
    scene = sample_scene("hand-controller", load_layout("dense19"), frames, rng=rng)
    sight = SceneSight(scene, load_rig("figure5"))
    markers, normals = sight.markers
    facing = facing_cameras(markers, normals, sight.rig)
    tree, tested = hand_tree(), 0
    for frame in range(frames):
        marker, camera = np.nonzero(facing[frame])
        starts, ends = markers[frame, marker], sight.rig.positions[camera]
        for hand in sight.scene.hands:
            skin = hand.fit.model.skin(hand.qpos[frame : frame + 1])
            clear_of_mesh(
                tree, skin, markers[frame : frame + 1], sight.rig.positions, facing[frame : frame + 1]
            )
            corners = skin[0][tree.faces]
            tested += boxes_met(starts, ends, tree.skip, _boxes(corners, tree))
    lines = facing.sum() / frames
    size = len(scene.hands) * tree.vertices.nbytes
    print(
        f"floor of a frame of two hands and a controller: {markers.shape[1]} markers x "
        f"{len(sight.rig.positions)} cameras, {lines:.0f} lines in view and facing, each past two skins: "
        f"{tested / frames:,.0f} boxes tested ({tested / frames / lines:.0f} a line), "
        f"{2 * len(tree.skip):,} boxes moved, {size:,} bytes of skin written and read"
    )


def _boxes(corners: np.ndarray, tree: Any) -> np.ndarray:
    """Every node's box around the triangles below it."""
    boxes = np.empty((len(tree.skip), 6))
    low, high = corners.min(axis=1), corners.max(axis=1)
    for node in range(len(tree.skip)):
        last = tree.skip[node]
        rows = slice(tree.first[node], tree.first[last])
        boxes[node, :3], boxes[node, 3:] = low[rows].min(axis=0), high[rows].max(axis=0)
    return boxes


def whole(kind: str, frames: int, seed: int) -> None:
    """One capture, or as many frames of hands alone."""
    if kind == ALONE:
        one_hand(frames, seed, Stopwatch())
    else:
        simulate_take(kind=kind, num_frames=frames, seed=seed)  # type: ignore[arg-type]


def worker(kind: str, frames: int, seeds: list[int], barrier: Any, queue: Any) -> None:
    """Wall and processor time [s] of captures that begin together with those of the other processes."""
    whole(kind, 256, 99)  # compiled code is loaded, trees are built
    for seed in seeds:
        barrier.wait()
        start, busy = time.perf_counter(), time.process_time()
        whole(kind, frames, seed)
        queue.put((seed, time.perf_counter() - start, time.process_time() - busy))


def side_by_side(kind: str, processes: int, frames: int, repeats: int) -> tuple[float, float]:
    """Frames a second of all processes together, and processor time a frame [us]; medians."""
    context = multiprocessing.get_context("spawn")
    barrier, queue = context.Barrier(processes), context.Queue()
    jobs = [
        context.Process(
            target=worker, args=(kind, frames, [10 * r + p for r in range(repeats)], barrier, queue)
        )
        for p in range(processes)
    ]
    for job in jobs:
        job.start()
    results = [queue.get(timeout=600) for _ in range(processes * repeats)]
    for job in jobs:
        job.join()
    slowest = [max(wall for seed, wall, _ in results if seed // 10 == r) for r in range(repeats)]
    busy = [cpu / frames for *_, cpu in results]
    return processes * frames / float(np.median(slowest)), 1e6 * float(np.median(busy))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=2048)
    parser.add_argument("--repeats", type=int, default=5)
    add_save(parser)
    arguments = parser.parse_args()
    frames, repeats = arguments.frames, arguments.repeats
    print(describe("mujoco", "numba", "scipy"))
    floor(256)
    print(f"\nwhole captures of {frames} frames, people and motions included, medians of {repeats}")
    figures: Figures = {}
    for kind in (*KINDS, ALONE):
        rates = []
        for processes in (1, 2):
            rate, busy = side_by_side(kind, processes, frames, repeats)
            rates.append((rate, busy))
            print(
                f"  {kind:16s} {processes} process(es): {rate:6,.0f} frames/s on the clock, {busy:5.0f} us "
                "of processor time a frame"
            )
        what = f"{kind}: frames/s of one process | processor time [us] | frames/s of two processes together"
        figures[kind.split("-")[1]] = (what, [*rates[0], rates[1][0]])
    save_figures(arguments.save, figures)
    for kind in (*KINDS, ALONE):
        watch = Stopwatch()
        for seed in range(-1, repeats):
            if seed == 0:
                watch = Stopwatch()  # the first was to warm up
            if kind == ALONE:
                one_hand(frames, seed + 1, watch)
            else:
                room_of(kind, frames, seed + 1, watch)
        stages = {name: 1e6 / frames * float(np.median(times)) for name, times in watch.times.items()}
        print(f"\n{kind}, us of processor time a frame")
        for name, microseconds in stages.items():
            print(f"  {name:28s} {microseconds:6.0f}")
        if watch.lines:
            print(f"  {1e-6 * watch.lines_a_second:.1f} million lines/s once the boxes are in place")


if __name__ == "__main__":
    main()
