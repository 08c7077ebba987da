"""The steps of `handsim demo`, each of which makes a section of its page."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Final

import numpy as np

from gloves.fit import nominal_fit
from gloves.layout import load_layout
from handsim._version import full_version
from handsim.app.workers import usable_cores
from handsim.hand.model import HandModel, join_qpos
from handsim.pages import Section
from handsim.space.rig import load_rig
from poses.shapes import gesture
from render.captions import contact_sheet, write_png
from render.config import RenderConfig
from render.drawing import draw
from render.illustrations import PosedHand, draw_camera, draw_gestures, draw_glove, draw_labels, draw_sizes
from track.captures import track_capture
from train.data.batches import Corruption, corrupt
from train.data.shards import Dataset
from train.evaluation import CLEAN, SEEN, evaluate_labeler, percent
from train.labelers.protocol import Labeler
from train.labelers.storage import load_labeler
from train.simulation.generation import generate_dataset
from train.simulation.takes import simulate_take

GLOVE: Final = "dense19"
GESTURES: Final = ("fist", "spread", "pinch_index", "relaxed", "pinch_little")
"""Gestures in the picture; the last one is the thumb's opposition to the little finger."""
_RAISED_PITCH: Final = np.deg2rad(35.0)  # pitch of the hand in front of the camera
_CAMERA: Final = 4
_TRACKED: Final = 120  # frames of the capture
_PAPER: Final = Corruption(occlude=5, ghosts=2)  # Han et al. 2018, section 5

_SHOWN_FIGURES: Final = (
    "slot_accuracy",
    "point_accuracy",
    "occlusion_precision",
    "occlusion_recall",
    "ghost_precision",
    "ghost_recall",
)


def demo_sections(
    pictures: Path, work: Path, *, seed: int, num_frames: int, report: Callable[[str], None]
) -> Iterator[Section]:
    """Run the whole chain and make the sections of the page in order.

    The pictures go to the folder `pictures`, and the training set to `work`; `report` shows the running step.
    """
    labeler = load_labeler(GLOVE)  # first, so that a missing labeler is reported before any work
    report("drawing hands")
    yield _draw_hands(pictures)
    report("drawing the glove")
    yield _draw_worn_glove(pictures)
    report("drawing what a camera sees")
    yield _draw_camera_view(pictures)
    dataset, figures = _generate_and_label(work, labeler, seed, num_frames, report)
    report("drawing a labeled frame")
    yield _draw_labeled_frame(pictures, dataset, labeler, seed)
    report("tracking a simulated capture")
    yield _track_and_draw(pictures, labeler, seed)
    yield figures


def _draw_hands(out: Path) -> Section:
    """Draw the five sizes and some gestures."""
    write_png(out / "sizes.png", draw_sizes())
    write_png(out / "gestures.png", draw_gestures(HandModel.named("M"), GESTURES))
    return Section(
        "The hand",
        "A MuJoCo hand of 26 degrees of freedom. Its skeleton, flesh and skin follow from its measures.",
        pictures=[
            ("sizes.png", "Five sizes, length by breadth, at one scale."),
            ("gestures.png", "Some of the named gestures; the last one opposes thumb and little finger."),
        ],
    )


def _draw_worn_glove(out: Path) -> Section:
    """Draw the glove from two sides, with the names of its markers."""
    fit = nominal_fit(load_layout(GLOVE), "M", "right")
    write_png(out / "glove.png", draw_glove(fit, sides=("back", "thumb side")))
    return Section(
        "The glove",
        f"{GLOVE}: {fit.layout.num_markers} markers of {2e3 * fit.layout.radius:.1f} mm that move with the "
        "skin. The same file fits every hand. A layout of your own is one TOML file: "
        "<code>handsim glove new</code>.",
        pictures=[("glove.png", "Names of the markers that each side shows, colored by digit.")],
    )


def _draw_camera_view(out: Path) -> Section:
    """Draw a raised hand as one camera of the rig sees it."""
    fit, rig = nominal_fit(load_layout(GLOVE), "M", "right"), load_rig("figure5")
    half = _RAISED_PITCH / 2
    raised = np.array([np.cos(half), 0.0, -np.sin(half), 0.0])  # about y: fingers up
    qpos = join_qpos(gesture("ok")[None], position=np.array([0.0, 0.0, 1.1]), quaternion=raised)[0]
    picture, seen = draw_camera(fit, qpos, rig, _CAMERA)
    write_png(out / "camera.png", picture)
    return Section(
        "What a camera sees",
        "A ray from every marker to every camera, tested against the hand's own flesh, decides which camera "
        "sees which marker. A marker gives a point when at least two cameras see it.",
        pictures=[
            (
                "camera.png",
                f"Camera {_CAMERA + 1} of {len(rig.positions)} of the rig, zoomed in: {int(seen.sum())} "
                f"markers seen (green), {int((~seen).sum())} turned away or hidden (red).",
            )
        ],
    )


def _generate_and_label(
    work: Path, labeler: Labeler, seed: int, num_frames: int, report: Callable[[str], None]
) -> tuple[Dataset, Section]:
    """Generate a small training set and label it, as seen and corrupted; returns it and a table."""
    start = time.perf_counter()
    dataset = generate_dataset(
        work / "dataset", glove=GLOVE, num_frames=num_frames, seed=seed,
        progress=lambda done, total: report(f"generating frames: {done} of {total}"),
    )  # fmt: skip
    seconds = time.perf_counter() - start
    columns = {}
    for title, corruption in ((SEEN, CLEAN), ("occluded", _PAPER)):
        report(f"labeling {num_frames} frames, {title}")
        rng = np.random.default_rng(seed)
        columns[title] = evaluate_labeler(labeler, dataset, corruption, rng=rng).figures
    report("timing the labeler")
    clouds = list(dataset.rows()["markers"][:1024].astype(np.float64))
    start = time.perf_counter()
    labeler.label_frames(clouds)
    labeled = len(clouds) / (time.perf_counter() - start)
    versions = ", ".join(
        f"{package} {metadata.version(package)}"
        for package in ("mujoco", "numpy", "torch", "pyrender-maintained")
    )
    return dataset, Section(
        "Figures of this run",
        f"{num_frames} freshly generated frames (seed {seed}) of random people, none of whom is in the "
        f"training set. Occluded: 0 to {_PAPER.occlude} markers dropped and 0 to {_PAPER.ghosts} ghosts per "
        "frame.",
        table=[
            ["", *(f"{title} [%]" for title in columns)],
            *(
                [name.replace("_", " ").capitalize(), *(percent(one[name]) for one in columns.values())]
                for name in _SHOWN_FIGURES
            ),
        ],
        notes=[
            f"generated {num_frames / seconds:,.0f} frames/s (start included), "
            f"labeled {labeled:,.0f} frames/s, on {usable_cores()} CPU cores",
            f"handsim {full_version()}, Python {platform.python_version()}, {versions}.",
        ],
    )


def _draw_labeled_frame(out: Path, dataset: Dataset, labeler: Labeler, seed: int) -> Section:
    """Draw one frame with ghosts, as the labeler takes it and with its labels."""
    rows = dataset.rows()
    row = rows[_clear_frame(rows)]
    cloud = corrupt(
        row["observed"][None].astype(np.float64),
        Corruption(0, _PAPER.ghosts),
        ghosts=row["ghosts"][None].astype(np.float64),
        rng=np.random.default_rng(seed),
    )
    present = cloud.present[0]
    points, truth = cloud.points[0][present], cloud.truth[0][present]
    labels = labeler.label_frames([points])[0].labels
    model = HandModel(dataset.hands(0)[int(row["hand"])])
    hand = PosedHand(model, row["qpos"].astype(np.float64), covering="glove")
    write_png(out / "labels.png", draw_labels(hand, points, labels, load_layout(GLOVE)))
    hidden = int(np.isnan(row["observed"][:, 0]).sum())
    return Section(
        "A frame and its labels",
        "A frame is a set of points in random order: some markers are hidden, some points are ghosts, which "
        "no marker made. The labeler labels each point from this one frame alone.",
        pictures=[
            (
                "labels.png",
                f"Left: the labeler's input, {len(points)} points; ghosts: {int((truth < 0).sum())}, "
                f"hidden markers: {hidden}. Right: its labels, {int((labels == truth).sum())} of "
                f"{len(points)} right; the hand behind them is the simulation's.",
            )
        ],
    )


def _clear_frame(rows: np.ndarray) -> int:
    """An early frame with hidden markers, whose seen markers are far apart in a view of the back."""
    best, widest = 0, -1.0
    model = HandModel.named("M")
    for number in range(min(400, len(rows))):
        row = rows[number]
        seen = np.isfinite(row["observed"][:, 0])
        if not 0.7 * len(seen) <= seen.sum() < len(seen):
            continue
        wrist = model.forward_kinematics(row["qpos"][None].astype(np.float64))[0, 0, :3, :3]
        flat = row["markers"][seen] @ wrist[:, :2]
        distances = np.linalg.norm(flat[:, None] - flat, axis=-1) + np.eye(len(flat))
        if distances.min() > widest:
            best, widest = number, float(distances.min())
    return best


def _track_and_draw(out: Path, labeler: Labeler, seed: int) -> Section:
    """Track a simulated capture of two hands, measure the error of the joints, and draw it."""
    take = simulate_take("hand-hand", num_frames=_TRACKED, seed=seed)
    tracked = track_capture(take.capture(), hands=take.hands, labeler=labeler)
    errors = []
    for number, hand in enumerate(take.hands):
        model, found = hand.model, tracked.motion(hand.side).qpos
        joints = [model.forward_kinematics(qpos)[..., :3, 3] for qpos in (found, take.qpos[:, number])]
        errors.append(1e3 * np.linalg.norm(joints[0] - joints[1], axis=-1).mean())
    frames = np.linspace(0, tracked.num_frames - 1, 6).astype(int).tolist()
    drawn = draw(tracked, config=RenderConfig(seed=seed, vary="frame"), frames=frames)
    write_png(out / "pictures.png", contact_sheet(list(drawn)))
    return Section(
        "Tracked hands, drawn",
        f"A simulated capture of two hands, {_TRACKED} frames, is labeled and tracked. The mean error of the "
        f"joints is {np.mean(errors):.2f} mm. The tracked hands are drawn, with the truth of every pixel.",
        pictures=[("pictures.png", "Colors with keypoints, and depth of a time-of-flight sensor.")],
    )
