"""The demo's steps of this package: pictures of hands, glove, a camera's view, labels and tracked hands."""

from __future__ import annotations

from typing import Final

import numpy as np

from gloves.fit import nominal_fit
from gloves.layout import load_layout
from gloves.takes.take import load_take
from handsim.app.page import Section
from handsim.cli.demo_run import GLOVE, DemoRun
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.records import unpack_hand
from handsim.space.cameras import named_rig
from poses.shapes.library import gesture
from render.config import RenderConfig
from render.drawing import draw
from render.illustrations.captions import write_png
from render.illustrations.contact_sheet import contact_sheet
from render.illustrations.hands import draw_camera, draw_gestures, draw_glove, draw_labels, draw_sizes
from render.illustrations.scene import PosedHand

GESTURES: Final = ("fist", "spread", "pinch_index", "relaxed", "pinch_little")
"""Drawn in a row; the last one is the thumb's opposition to the little finger."""
_RAISED: Final = np.deg2rad(35.0)
_CAMERA: Final = 4
_PICTURES: Final = 6


def draw_hands(run: DemoRun) -> Section:
    """The five sizes, and some gestures."""
    run.report("drawing hands")
    write_png(run.out / "sizes.png", draw_sizes())
    write_png(run.out / "gestures.png", draw_gestures(HandModel.named("M"), GESTURES))
    return Section(
        "The hand",
        "A MuJoCo hand of 26 degrees of freedom. Its skeleton, flesh and skin follow from its measures.",
        pictures=[
            ("sizes.png", "Five sizes, length by breadth, at one scale."),
            ("gestures.png", "Some of the named gestures; the last one opposes thumb and little finger."),
        ],
    )


def draw_worn_glove(run: DemoRun) -> Section:
    """The glove from two sides, with the names of its markers."""
    run.report("drawing the glove")
    fit = nominal_fit(load_layout(GLOVE), "M", "right")
    write_png(run.out / "glove.png", draw_glove(fit, sides=("back", "thumb side")))
    return Section(
        "The glove",
        f"{GLOVE}: {fit.layout.num_markers} markers of {2e3 * fit.layout.radius:.1f} mm that move with the "
        "skin. The same file fits every hand. A layout of your own is one TOML file: "
        "<code>handsim glove new</code>.",
        pictures=[("glove.png", "Names of the markers that each side shows, colored by digit.")],
    )


def draw_camera_view(run: DemoRun) -> Section:
    """What one camera of the rig sees of a raised hand."""
    run.report("drawing what a camera sees")
    fit, rig = nominal_fit(load_layout(GLOVE), "M", "right"), named_rig("figure5")
    raised = np.array(
        [np.cos(_RAISED / 2), 0.0, -np.sin(_RAISED / 2), 0.0]
    )  # about y: fingers up, back of the hand behind
    qpos = join_qpos(gesture("ok")[None], position=np.array([0.0, 0.0, 1.1]), quaternion=raised)[0]
    picture, seen = draw_camera(fit, qpos, rig, _CAMERA)
    write_png(run.out / "camera.png", picture)
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


def draw_labeled_frame(run: DemoRun) -> Section:
    """One frame as it comes, and with the labels that the labeler gave it."""
    run.report("drawing a labeled frame")
    with np.load(run.labeled_frame, allow_pickle=False) as stored:
        frame = {name: stored[name] for name in stored.files}
    points, labels, truth = frame["points"], frame["labels"], frame["truth"]
    hand = PosedHand(HandModel(unpack_hand(frame["hand"][()])), frame["qpos"], covering="glove")
    write_png(run.out / "labels.png", draw_labels(hand, points, labels, load_layout(GLOVE)))
    right = int((labels == truth).sum())
    return Section(
        "A frame and its labels",
        "A frame is a set of points in random order: some markers are hidden, some points are ghosts, which "
        "no marker made. The labeler labels each point from this one frame alone.",
        pictures=[
            (
                "labels.png",
                f"Left: the labeler's input, {len(points)} points; ghosts: {int((truth < 0).sum())}, "
                f"hidden markers: {int((~frame['seen']).sum())}. Right: its labels, {right} of {len(points)} "
                "right; the hand behind them is the simulation's.",
            )
        ],
    )


def draw_tracked_take(run: DemoRun) -> Section:
    """Pictures of the tracked take."""
    run.report("drawing pictures")
    take = load_take(run.tracked_take)
    frames = np.linspace(0, take.num_frames - 1, _PICTURES).astype(int).tolist()
    config = RenderConfig(seed=run.seed, vary="frame")
    write_png(run.out / "pictures.png", contact_sheet(list(draw(take, config=config, frames=frames))))
    return Section(
        "Pictures of tracked hands",
        "The tracked hands are drawn, with the truth of every pixel.",
        pictures=[("pictures.png", "Colors with keypoints, and depth of a time-of-flight sensor.")],
    )
