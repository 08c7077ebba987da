"""The command `handsim demo`: the whole chain on a built-in example, and a page that shows it.

This orchestrates only. Packages above this one are named by strings and
loaded when needed, as in `handsim.app.cli`.
"""

from __future__ import annotations

import os
import platform
import tempfile
import time
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from handsim._version import __version__
from handsim.app.cli import load
from handsim.app.page import Section, write_page
from handsim.errors import HandSimError
from handsim.hand.model import HandModel, join_qpos
from handsim.space.cameras import named_rig

GLOVE: Final = "dense19"
GESTURES: Final = ("fist", "spread", "pinch_index", "relaxed", "pinch_little")
"""Drawn in a row; the last one is the thumb's opposition to the little finger."""
_PAPER_DROPS, _PAPER_GHOSTS = 5, 2
_RAISED: Final = np.deg2rad(35.0)
_LABELED_AT_ONCE: Final = 1024
_TRACKED: Final = 120


# What the page shows, and the ratio without which there was nothing to find.
_FIGURES: Final = {
    "slot_accuracy": "",
    "point_accuracy": "",
    "occlusion_precision": "occlusion_ratio",
    "occlusion_recall": "occlusion_ratio",
    "ghost_precision": "ghost_ratio",
    "ghost_recall": "ghost_ratio",
}


@dataclass(frozen=True, slots=True, eq=False)
class _Chain:
    """What the run made: frames, labels and how long they took."""

    dataset: Any
    rows: np.ndarray
    labeler: Any
    figures: dict[str, dict[str, float]]
    generated_a_second: float
    labeled_a_second: float


def demo(out: Path = Path("demo"), seed: int = 0, num_frames: int = 2000) -> None:
    """Run the whole chain on a built-in example: generate, label, draw; ends with a page of pictures.

    Args:
        out: Folder for index.html and its pictures.
        seed: Of the generated frames and of everything drawn at random.
        num_frames: Frames to generate and label.
    """
    if num_frames < 1:
        raise HandSimError(f"num_frames is {num_frames}, expected at least 1")
    if seed < 0:
        raise HandSimError(f"seed is {seed}, expected 0 or more")
    out.mkdir(parents=True, exist_ok=True)
    console, progress = Console(), Console(stderr=True)
    with tempfile.TemporaryDirectory(prefix=".frames-", dir=out) as folder:
        with progress.status("generating and labeling frames") as status:
            chain = _run_chain(Path(folder), seed, num_frames, status)
        with progress.status("drawing") as status:
            sections = [
                _draw_hands(out, status),
                _draw_glove(out),
                _draw_camera(out, status),
                _draw_frame(out, chain, seed),
                _draw_pictures(out, chain, seed, status),
            ]
    table = _figures_table(chain)
    _print_table(console, table, title=f"{num_frames} generated frames, glove {GLOVE}")
    speed = (
        f"generated {chain.generated_a_second:,.0f} frames/s (start included), "
        f"labeled {chain.labeled_a_second:,.0f} frames/s"
    )
    page = out / "index.html"
    sections.append(_figures_section(table, num_frames, seed, speed))
    write_page(
        page,
        sections,
        title="handsim demo",
        lead="A hand wears a marker glove, strikes poses before simulated cameras, and a labeler trained on "
        "nothing else names the points that they see.",
    )
    console.print(speed)
    console.print(f"page: {page.resolve()}", soft_wrap=True, markup=False)


def _run_chain(folder: Path, seed: int, num_frames: int, status: Any) -> _Chain:
    labeler = load("train.labelers.storage:load_labeler")(GLOVE)  # before the work, should it be missing
    config = load("train.simulation.synthesis:DatasetConfig")(glove=GLOVE, num_frames=num_frames, seed=seed)

    def told(done: int, total: int) -> None:
        status.update(f"generating frames: {done} of {total}")

    start = time.perf_counter()
    load("train.simulation.synthesis:generate_dataset")(config, folder, progress=told)
    generated = num_frames / (time.perf_counter() - start)
    dataset = load("train.data.shards:Dataset")(folder)
    rows = dataset.rows()
    markers = rows["markers"].astype(np.float64)
    evaluate, corruption = (
        load("train.evaluation.labeler_evaluation:evaluate_labeler"),
        load("train.data.augmentation:Corruption"),
    )
    figures = {}
    for title, drops, ghosts in (("clean", 0, 0), ("occluded", _PAPER_DROPS, _PAPER_GHOSTS)):
        status.update(f"labeling {num_frames} frames, {title}")
        rng = np.random.default_rng(seed)
        figures[title] = evaluate(labeler, markers, corruption(drops, ghosts), rng=rng).figures
    status.update("timing the labeler")
    some = list(markers[:_LABELED_AT_ONCE])
    start = time.perf_counter()
    labeler.label_frames(some)
    labeled = len(some) / (time.perf_counter() - start)
    return _Chain(dataset, rows, labeler, figures, generated, labeled)


def _draw_hands(out: Path, status: Any) -> Section:
    status.update("drawing hands")
    write_png = load("render.illustrations.captions:write_png")
    write_png(out / "sizes.png", load("render.illustrations.hands:draw_sizes")())
    write_png(
        out / "gestures.png", load("render.illustrations.hands:draw_gestures")(HandModel.named("M"), GESTURES)
    )
    return Section(
        "The hand",
        "A MuJoCo hand of 26 degrees of freedom whose skeleton, flesh and skin follow its measures.",
        pictures=[
            ("sizes.png", "Five sizes, length by breadth, at one scale."),
            ("gestures.png", "Some of the named gestures; the last one opposes thumb and little finger."),
        ],
    )


def _draw_glove(out: Path) -> Section:
    model = HandModel.named("M")
    fit = _fit(model)
    picture = load("render.illustrations.hands:draw_glove")(fit, sides=("back", "thumb side"))
    load("render.illustrations.captions:write_png")(out / "glove.png", picture)
    return Section(
        "The glove",
        f"{GLOVE}: {fit.layout.num_markers} markers of {2e3 * fit.layout.radius:.1f} mm, "
        "carried by the skin; the same file fits every hand. Yours is one TOML file away: "
        "<code>handsim glove new</code>.",
        pictures=[("glove.png", "Names of the markers that each side shows, colored by digit.")],
    )


def _draw_camera(out: Path, status: Any) -> Section:
    status.update("drawing what a camera sees")
    model, rig = HandModel.named("M"), named_rig("figure5")
    angles = load("poses.shapes.library:gesture")("ok")[None]
    raised = np.array(
        [np.cos(_RAISED / 2), 0.0, -np.sin(_RAISED / 2), 0.0]
    )  # about y: fingers up, back behind
    qpos = join_qpos(angles, position=np.array([0.0, 0.0, 1.1]), quaternion=raised)[0]
    camera = 4
    picture, seen = load("render.illustrations.hands:draw_camera")(_fit(model), qpos, rig, camera)
    load("render.illustrations.captions:write_png")(out / "camera.png", picture)
    return Section(
        "What a camera sees",
        "A ray from every marker to every camera, against the hand's own flesh, decides who sees what. A "
        "marker exists when at least two cameras see it.",
        pictures=[
            (
                "camera.png",
                f"Camera {camera + 1} of {len(rig.positions)} of the rig, zoomed in: {int(seen.sum())} "
                f"markers seen (green), {int((~seen).sum())} turned away or hidden (red).",
            )
        ],
    )


def _draw_frame(out: Path, chain: _Chain, seed: int) -> Section:
    rng = np.random.default_rng(seed)
    layout = load("gloves.layout:load_layout")(GLOVE)
    row = chain.rows[_telling_frame(chain)]
    seen = np.isfinite(row["observed"][:, 0])
    cloud = load("train.data.augmentation:corrupt")(
        row["observed"][None].astype(np.float64),
        load("train.data.augmentation:Corruption")(0, _PAPER_GHOSTS),
        ghosts=row["ghosts"][None].astype(np.float64),
        rng=rng,
    )
    here = cloud.present[0]
    points, truth = cloud.points[0][here], cloud.truth[0][here]
    labeling = chain.labeler.label_frames([points])[0]
    model = HandModel(chain.dataset.hands(0)[row["hand"]])
    hand = load("render.illustrations.scene:PosedHand")(
        model, row["qpos"].astype(np.float64), covering="glove"
    )
    picture = load("render.illustrations.hands:draw_labels")(hand, points, labeling.labels, layout)
    load("render.illustrations.captions:write_png")(out / "labels.png", picture)
    right = int((labeling.labels == truth).sum())
    return Section(
        "A frame and its labels",
        "A frame is a handful of points in random order: some markers are hidden, some points are ghosts, "
        "which no marker made. The labeler names each point from this one frame alone.",
        pictures=[
            (
                "labels.png",
                f"Left: all that it is given, {len(points)} points; ghosts: {int((truth < 0).sum())}, "
                f"hidden markers: {int((~seen).sum())}. Right: its labels, {right} of {len(points)} right; "
                "the hand behind them is the simulation's.",
            )
        ],
    )


def _draw_pictures(out: Path, chain: _Chain, seed: int, status: Any) -> Section:
    """A simulated capture, tracked and drawn."""
    status.update("tracking a simulated capture")
    truth = load("train.simulation.twins:simulate_twin")(
        load("train.simulation.twins:TwinConfig")(kind="hand-hand", num_frames=_TRACKED, seed=seed)
    )
    columns = tuple(f"*{number}" for number in range(truth.points.shape[1]))
    capture = load("gloves.captures:Capture")(columns, truth.points, truth.rate)
    tracker = load("track.tracker:Tracker")(
        load("track.evaluation.take_evaluation:true_users")(truth), chain.labeler
    )
    tracked = load("track.capture_tracking:track")(capture, tracker)
    off = []
    for hand in truth.hands:
        found = tracked.motion(hand.side).qpos
        joints = [hand.fit.model.forward_kinematics(qpos)[..., :3, 3] for qpos in (found, hand.qpos)]
        off.append(1e3 * np.linalg.norm(joints[0] - joints[1], axis=-1).mean())
    status.update("drawing pictures")
    config = load("render.session:RenderConfig")(seed=seed, vary="frame")
    shown = load("render.shown_take:show_tracked")(tracked)
    some = np.linspace(0, _TRACKED - 1, 6).astype(int).tolist()
    frames = load("render.session:draw_frames")(shown, config, some)
    picture = load("render.illustrations.contact_sheet:contact_sheet")(list(frames))
    load("render.illustrations.captions:write_png")(out / "pictures.png", picture)
    return Section(
        "Pictures of tracked hands",
        f"A simulated capture of {_TRACKED} frames, labeled and tracked: joints are {np.mean(off):.2f} mm "
        "off in the mean. What was tracked is drawn, with the truth of every pixel.",
        pictures=[("pictures.png", "Colors with keypoints, and depth as a time-of-flight sensor has it.")],
    )


def _telling_frame(chain: _Chain) -> int:
    """An early frame with hidden markers, whose seen markers lie well apart when seen from the back."""
    best, widest = 0, -1.0
    model = HandModel.named("M")
    for number in range(min(400, len(chain.rows))):
        row = chain.rows[number]
        seen = np.isfinite(row["observed"][:, 0])
        if not 0.7 * len(seen) <= seen.sum() < len(seen):
            continue
        wrist = model.forward_kinematics(row["qpos"][None].astype(np.float64))[0, 0, :3, :3]
        flat = row["markers"][seen] @ wrist[:, :2]
        gaps = np.linalg.norm(flat[:, None] - flat, axis=-1) + np.eye(len(flat))
        if gaps.min() > widest:
            best, widest = number, float(gaps.min())
    return best


def _fit(model: HandModel) -> Any:
    return load("gloves.fit:attach")(load("gloves.layout:load_layout")(GLOVE), model)


def _figures_table(chain: _Chain) -> list[list[str]]:
    """Header and rows; a dash where there was nothing to find."""
    table = [["", *(f"{title} [%]" for title in chain.figures)]]
    for name, ratio in _FIGURES.items():
        cells = (
            "-" if ratio and figures[ratio] == 0 else f"{100 * figures[name]:.2f}"
            for figures in chain.figures.values()
        )
        table.append([name.replace("_", " ").capitalize(), *cells])
    return table


def _print_table(console: Console, table: list[list[str]], *, title: str) -> None:
    printed = Table(title=title)
    for number, column in enumerate(table[0]):
        printed.add_column(Text(column), justify="right" if number else "left")
    for row in table[1:]:
        printed.add_row(*row)
    console.print(printed)


def _figures_section(table: list[list[str]], num_frames: int, seed: int, speed: str) -> Section:
    versions = ", ".join(
        f"{package} {metadata.version(package)}"
        for package in ("mujoco", "numpy", "torch", "pyrender-maintained")
    )
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return Section(
        "Figures of this run",
        f"{num_frames} freshly generated frames (seed {seed}) of random people, none of them seen in "
        f"training. Occluded: 0 to {_PAPER_DROPS} draws of a marker to drop and "
        f"0 to {_PAPER_GHOSTS} ghosts a frame.",
        table=table,
        notes=[
            f"Speed: {speed}, on {cores} CPU cores.",
            f"handsim {__version__}, Python {platform.python_version()}, {versions}.",
        ],
    )
