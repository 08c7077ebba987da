"""The table of commands: the one place where modules are named by strings."""

from __future__ import annotations

import importlib
from typing import Any, Final

# "module:function", or "module:TABLE" for a dict of functions: sub-commands; tables of several modules are
# joined by "+". Strings, so that nothing heavy loads for --help and no package names one above in an import.
COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "demo": (
        "handsim.commands.demo:demo",
        "Run the whole chain on a built-in example; ends with a page of pictures.",
    ),
    "hand": ("track.commands.hand:hand", "Write a hand as a MuJoCo model, a URDF or a rigged mesh."),
    "glove": (
        "render.commands.glove:GLOVE+track.commands.glove_advice:GLOVE",
        "List, show, start and check marker layouts; score and improve one before it is worn.",
    ),
    "rig": (
        "train.commands.rig:RIG+handsim.commands.rig_import:RIG+train.commands.rig_advice:RIG",
        "List, start, check and import camera rigs; forecast what one will miss, and plan a better one.",
    ),
    "generate": ("train.commands.generate:generate", "Make a training set; goes on where it was stopped."),
    "train": (
        "train.commands.train:train",
        "Train a labeler on a training set; goes on where it was stopped.",
    ),
    "label": ("train.commands.label:label", "Label every frame of a marker capture."),
    "export": (
        "track.commands.export:export",
        "Write a take's motion for other programs (.glb, .bvh, .usdc, .csv, ...), or a labeler as .onnx.",
    ),
    "evaluate": ("train.commands.evaluate:evaluate", "Measure a labeler on a labeled capture."),
    "simulate": ("train.commands.simulate:simulate", "Simulate a capture of hands, with its truth."),
    "calibrate": ("track.commands.calibrate:calibrate", "Fit hands and gloves to a user, from a capture."),
    "track": ("track.commands.track:track", "Follow hands through a marker capture or a live stream."),
    "replay": ("track.commands.replay:replay", "Play a capture as a NatNet server, to try a live set-up."),
    "view": ("track.commands.view:view", "Show a file or a live tracker in the browser."),
    "body": ("track.commands.body:body", "Write a rigid body's markers as a file, to track it with."),
    "render": ("render.commands.render:render", "Draw the hands of a take, with the truth of each picture."),
    "reproduce": (
        "track.commands.reproduce:REPRODUCE",
        "Print a table of the paper with our figures beside.",
    ),
    "benchmark": (
        "track.commands.benchmark:BENCHMARK_COMMANDS",
        "Make the public benchmark, run a tracker on it, score anybody's results.",
    ),
    "sweep": (
        "track.commands.sweep:sweep",
        "Train and measure for gloves x rigs x people x seeds, as one job with a table.",
    ),
    "doctor": ("handsim.commands.doctor:doctor", "Say what is missing on this machine, and how to get it."),
}

# The steps of `handsim demo` in the order in which they run and in which their sections stand on the page.
DEMO_STEPS: Final = (
    "render.commands.demo:draw_hands",
    "render.commands.demo:draw_worn_glove",
    "render.commands.demo:draw_camera_view",
    "train.commands.demo:generate_and_label",
    "render.commands.demo:draw_labeled_frame",
    "track.commands.demo:track_take",
    "render.commands.demo:draw_tracked_take",
    "train.commands.demo:figures_section",
)

VIDEO_WRITER: Final = "render.illustrations.clip:write_clip"
"""What draws the video of `handsim view --video`; its package is not imported by that of the command."""


def load(target: str) -> Any:
    """What "module:name" stands for, imported now and not before; tables joined by "+" are one."""
    found = []
    for part in target.split("+"):
        module, _, attribute = part.partition(":")
        found.append(getattr(importlib.import_module(module), attribute))
    return found[0] if len(found) == 1 else {name: one for table in found for name, one in table.items()}
