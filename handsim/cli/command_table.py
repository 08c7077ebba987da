"""The table of commands: the one place where modules are named by strings."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

# "module:function", or "module:TABLE" for a dict of functions: sub-commands. Strings, so that nothing heavy
# loads for --help and no package names one above in an import.
COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "demo": (
        "handsim.cli.demo:demo",
        "Run the whole chain on a built-in example; ends with a page of pictures.",
    ),
    "hand": ("handsim.cli.hand:hand", "Write a hand as a MuJoCo model, a URDF or a rigged mesh."),
    "glove": (
        "handsim.cli.glove:GLOVE",
        "List, show, start and check marker layouts; score and improve one before it is worn.",
    ),
    "rig": (
        "handsim.cli.rig:RIG",
        "List, start, check and import camera rigs; forecast what one will miss, and plan a better one.",
    ),
    "generate": ("handsim.cli.generate:generate", "Make a training set; goes on where it was stopped."),
    "train": (
        "handsim.cli.train:train",
        "Train a labeler on a training set; goes on where it was stopped.",
    ),
    "label": ("handsim.cli.label:label", "Label every frame of a marker capture."),
    "export": (
        "handsim.cli.export:export",
        "Write a take's motion for other programs (.glb, .bvh, .usdc, .csv, ...), or a labeler as .onnx.",
    ),
    "evaluate": ("handsim.cli.train:evaluate", "Measure a labeler on a labeled capture."),
    "simulate": ("handsim.cli.simulate:simulate", "Simulate a capture of hands, with its truth."),
    "calibrate": ("handsim.cli.calibrate:calibrate", "Fit hands and gloves to a user, from a capture."),
    "track": ("handsim.cli.track:track", "Follow hands through a marker capture or a live stream."),
    "report": (
        "handsim.cli.report:report",
        "Write a page on a take: joint angles, range of motion, gaps, residuals, doubtful frames.",
    ),
    "replay": ("handsim.cli.replay:replay", "Play a capture as a NatNet server, to try a live set-up."),
    "view": ("handsim.cli.view:view", "Show a file or a live tracker in the browser."),
    "body": ("handsim.cli.body:body", "Write a rigid body's markers as a file, to track it with."),
    "render": ("handsim.cli.render:render", "Draw the hands of a take, with the truth of each picture."),
    "doctor": ("handsim.cli.doctor:doctor", "Say what is missing on this machine, and how to get it."),
}


def load(target: str) -> Any:
    """What "module:name" stands for, imported now and not before."""
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)


@dataclass(frozen=True, slots=True)
class PresetCommand:
    """A command of the table that reads its arguments once before they are parsed.

    A preset must become the default of the other options: compared afterwards, an option that was given and
    equals the usual default cannot be distinguished from one that was not given.
    """

    choose: Callable[[Sequence[str], str], Callable[..., Any]]
    """From the arguments and the program's name for messages to the function that they are parsed for."""


def given_option(args: Sequence[str], option: str) -> str | None:
    """The value of one option among arguments, None where it is not given; nothing else is checked."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(option, dest="value", nargs="?")
    known, _ = parser.parse_known_args(list(args))
    value: str | None = known.value
    return value
