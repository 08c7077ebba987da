"""`handsim doctor`: what is missing on this machine, and how to get it."""

from __future__ import annotations

import ctypes.util
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qsl, urlsplit

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from handsim._imports import CACHE_VARIABLE, SIBLINGS, is_writable, kernel_cache, shadowed_siblings
from handsim._plugins import EGL_PACKAGES
from handsim.app.workers import usable_cores

_PROBE_SECONDS: Final = 120.0
_HAND_RATE: Final = 60.0  # frame rate of the pointing hand [Hz]
_POINTING_FRAMES: Final = 120  # frames for which the hand points in each direction
_WRIST: Final = (0.1, 0.2, 0.3)  # wrist of the pointing hand in the room: forward, left, up [m]
_FLEXION: Final = 1.2  # flexion of the fingers that do not point [rad]
# These programs run in processes of their own, because a broken driver kills its process.
_DRAW_PROGRAM: Final = """
import os
os.environ["PYOPENGL_PLATFORM"] = "egl"
import numpy, pyrender
from OpenGL.GL import GL_RENDERER, glGetString
scene = pyrender.Scene()
scene.add(pyrender.PerspectiveCamera(yfov=1.0), pose=numpy.eye(4))
renderer = pyrender.OffscreenRenderer(16, 16)
renderer.render(scene, flags=pyrender.RenderFlags.DEPTH_ONLY)
print(glGetString(GL_RENDERER).decode())
"""
_GPU_PROGRAM: Final = """
import torch
print(torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none; the CPU does it, slower")
"""


_EXTRA_PURPOSES: Final = {
    "view": "handsim view",
    "send": "--send osc://, ws:// and lsl:",
    "qualisys": "--live qtm://",
    "onnx": ".onnx labelers, training a detector",
    "mediapipe": "--detector mediapipe",
    "usd": "export to .usdc",
    "cluster": "--cluster",
    "object-stores": "folders in s3://",
}
"""What each extra of handsim is for."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report."""

    what: str
    found: str
    expected: str = ""
    """Requirement in words or as limits of a version; empty if there is none."""
    remedy: str = ""
    """Advice to the user; empty if the requirement is met."""
    needed: bool = True
    """Whether commands fail without the remedy."""


def doctor(compile: bool = False, send: str | None = None) -> int:
    """Say what is missing on this machine, and how to get it.

    Args:
        compile: Compile all kernels instead, so that no command has to wait for that.
        send: Send a hand instead that points forward, left and up in the room in turn, to an address as of
            handsim track --send, and say what should be seen; Ctrl-C ends it.

    Returns:
        0 when everything that the commands need is there, else 1.
    """
    from handsim.app.messages import named_steps, print_line

    if send is not None:
        from handsim.files.signals import interrupt_flag

        with interrupt_flag() as ended:
            send_pointing_hand(send, ended, print_line)
        return 0
    if compile:
        from handsim.app.compiling import compile_kernels

        with named_steps("looking for kernels"):
            compiled, missing = compile_kernels()
        print_line(f"{compiled} kernels compiled, {missing} missing; they are kept in {kernel_cache()[0]}")
        return int(missing > 0)

    with named_steps("drawing a picture and looking for a GPU"):
        findings = examine()
    _print_report(findings)
    return int(any(finding.needed and finding.remedy for finding in findings))


def send_pointing_hand(address: str, ended: Callable[[], bool], report: Callable[[str], None]) -> None:
    """Send a right hand whose index finger points along the room's axes in turn, until it is ended."""
    import numpy as np

    from gloves.fit import nominal_fit
    from gloves.takes.points import Status
    from handsim.hand.model import KEYPOINT_NAMES, hand_keypoints, join_qpos
    from handsim.hand.shape import JOINT_NAMES
    from handsim.space.transforms import DIRECTIONS, UpAxis, program_axes, room_axes, rotation_quaternions
    from track.frames import StreamedFrame, TrackedFrame, TrackedHand
    from track.output.live_message import Content
    from track.output.sinks import open_sinks

    bent = [name.startswith(("middle", "ring", "little")) and "flexion" in name for name in JOINT_NAMES]
    with open_sinks(address) as sinks:
        asked = dict(parse_qsl(urlsplit(address).query))  # `open_sinks` has checked it
        up: UpAxis = "y" if asked.get("up") == "y" else "z"
        wanted: dict[str, Any] = {key: asked[key] for key in ("axes", "unit", "forward") if key in asked}
        content = Content(up=up, **wanted)
        axes, hand = content.program or program_axes("ros", "z"), nominal_fit("dense19", "M", "right")
        room = room_axes(up, content.forward)
        sinks.start([hand], [])
        number = 0
        while not ended():
            along = number // _POINTING_FRAMES % 3
            pointing, back = room[along], room[(along + 1) % 3]
            turn = np.stack([pointing, np.cross(back, pointing), back], axis=1)[None]
            qpos = join_qpos(
                _FLEXION * np.array([bent]), position=_WRIST @ room, quaternion=rotation_quaternions(turn)
            )
            if number % _POINTING_FRAMES == 0:
                tip = axes.positions(hand_keypoints(hand.model, qpos)[0, KEYPOINT_NAMES.index("index_tip")])
                place = " ".join(f"{value:.3f}" for value in tip)
                seen = axes.turn @ pointing
                axis = f"{'-' if seen.sum() < 0 else '+'}{'xyz'[np.abs(seen).argmax()]}"
                where = f"{DIRECTIONS[along]}, along {axis}"
                report(f"the index finger points {where}, its tip is at {place} {axes.unit}")
            nobody = np.empty((0, 3)), np.empty(0, dtype=np.int64)
            frame = StreamedFrame(number, number / _HAND_RATE, *nobody, arrived=time.monotonic())
            shown = TrackedHand("right", Status.TRACKED, qpos[0], np.nan, *nobody)
            sinks.send(frame, TrackedFrame(frame.time, (shown,), nobody[1], np.empty(0)))
            time.sleep(1.0 / _HAND_RATE)
            number += 1


def examine() -> list[Finding]:
    """All findings about this machine, in the order of the report; this takes a few seconds."""
    drawing, gpu = _start(_DRAW_PROGRAM), _start(_GPU_PROGRAM)
    return [
        *check_requirements(),
        *check_names(metadata.packages_distributions(), shadowed_siblings()),
        check_drawing(*_finish(drawing)),
        check_gpu(*_finish(gpu)),
        check_kernel_cache(),
        check_learned_gloves(),
        *check_room(),
    ]


def check_requirements() -> Iterator[Finding]:
    """Python itself and each dependency of the installed handsim."""
    try:
        limits = metadata.metadata("handsim")["Requires-Python"]
    except metadata.PackageNotFoundError:
        yield Finding("handsim", "not installed", remedy="run `pip install -e .` in handsim's folder")
        return
    python = ".".join(map(str, sys.version_info[:3]))
    fits = SpecifierSet(limits).contains(python)
    remedy = "" if fits else "make a virtual environment with one of these versions"
    yield Finding("Python", python, limits, remedy)
    stated = [Requirement(requirement) for requirement in metadata.requires("handsim") or ()]
    yield from (check_requirement(str(one)) for one in stated if one.marker is None)
    for extra, purpose in _EXTRA_PURPOSES.items():
        needed = [one for one in stated if one.marker is not None and one.marker.evaluate({"extra": extra})]
        yield check_extra(extra, purpose, [f"{one.name}{one.specifier}" for one in needed])


def check_requirement(requirement: str) -> Finding:
    """One dependency, written as in pyproject.toml: a name, then limits joined by commas."""
    asked = Requirement(requirement)
    limits, remedy = str(asked.specifier), f"run `pip install '{requirement}'`"
    try:
        found = metadata.version(asked.name)
    except metadata.PackageNotFoundError:
        return Finding(asked.name, "missing", limits, remedy)
    fits = asked.specifier.contains(found, prereleases=True)
    return Finding(asked.name, found, limits, "" if fits else remedy)


def check_extra(extra: str, purpose: str, requirements: Sequence[str]) -> Finding:
    """One of handsim's extras, with what it is for and what it requires."""
    found = [check_requirement(requirement) for requirement in requirements]
    lacking = ", ".join(f"{one.what} {one.found}" for one in found if one.remedy)
    remedy = f"run `pip install 'handsim[{extra}]'` if you want it" if lacking else ""
    return Finding(purpose, lacking or "installed", f"handsim[{extra}]", remedy, needed=False)


def check_names(owners: Mapping[str, Sequence[str]], shadowed: Mapping[str, str]) -> Iterator[Finding]:
    """Whether the generic import names and pyrender's belong to the right distributions.

    `owners` holds the distributions of each import name, `shadowed` the paths of siblings from elsewhere.
    """
    for name in ("handsim", *SIBLINGS):
        strangers = sorted(set(owners.get(name, ())) - {"handsim"})
        if strangers:
            remedy = f"run `pip uninstall {' '.join(strangers)}`, then install handsim anew"
            yield Finding(f"import {name}", f"also owned by {', '.join(strangers)}", "handsim alone", remedy)
        elif name in shadowed:
            yield Finding(f"import {name}", shadowed[name], "beside handsim", "rename that, or go elsewhere")
    remedy = "run `pip uninstall pyrender pyrender-maintained`, then `pip install pyrender-maintained`"
    flavors = sorted(set(owners.get("pyrender", ())))
    broken = _pyrender_version() == "0.1.45"  # cannot draw beside NumPy 2 on Python 3.12 and later
    if broken or len(flavors) > 1:
        found = "0.1.45" if broken else " and ".join(flavors)
        yield Finding("import pyrender", found, "pyrender-maintained alone", remedy)


def _pyrender_version() -> str:
    """The version in pyrender's files, which may differ from that of its distribution."""
    spec = util.find_spec("pyrender")
    if spec is None or spec.origin is None:
        return ""
    file = Path(spec.origin).with_name("version.py")
    stated = re.search(r"__version__ = ['\"](.+)['\"]", file.read_text()) if file.exists() else None
    return stated.group(1) if stated else ""


def check_drawing(code: int, output: str) -> Finding:
    """Whether a drawing without a screen succeeded, by its exit code and output."""
    what, expected = "drawing (EGL)", "an OpenGL driver"
    if code == 0:
        return Finding(what, output, expected)
    if sys.platform != "linux":
        return Finding(what, output, expected, "drawing without a screen needs Linux; all else works here")
    found = "libEGL is missing" if ctypes.util.find_library("EGL") is None else output
    return Finding(what, found, expected, f"run `apt-get install {EGL_PACKAGES}` as root")


def check_gpu(code: int, output: str) -> Finding:
    """The device that torch computes on; only a torch that cannot be imported is a fault."""
    remedy = "" if code == 0 else "install torch anew; CONTRIBUTING.md says how to get its CPU build"
    return Finding("GPU for training", output, remedy=remedy)


def check_kernel_cache() -> Finding:
    """The folder of compiled kernels, which are compiled anew at each start if it does not last."""
    folder, lasts = kernel_cache()
    writable = is_writable(folder)
    remedy = "" if lasts and writable else f"set {CACHE_VARIABLE} to a folder of yours that lasts"
    found = str(folder) if writable else f"{folder}, which cannot be written"
    return Finding("compiled kernels", found, "a folder that lasts", remedy, needed=False)


def check_learned_gloves() -> Finding:
    """The number and folder of labelers that were trained for gloves while labeling."""
    try:
        from train.labelers.protocol import learned_folder, learned_gloves
    except ImportError:  # another finding names the missing dependency
        return Finding("learned gloves", "unknown")
    folder = learned_folder()
    writable = is_writable(folder)
    remedy = (
        "" if writable else "set XDG_CACHE_HOME to a folder of yours, or a glove is learned in every call"
    )
    found = f"{len(learned_gloves())} in {folder}" if writable else f"{folder}, which cannot be written"
    return Finding("learned gloves", found, "a folder of yours", remedy, needed=False)


def check_room() -> Iterator[Finding]:
    """The number of cores, and the free space on the disk of the current folder."""
    yield Finding("CPU cores", str(usable_cores()))
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    remedy = "" if free >= 1.0 else "free some space, or give --out on another disk"
    yield Finding("free disk here", f"{free:.1f} GB", "1 GB", remedy, needed=False)


def _start(code: str) -> subprocess.Popen[str]:
    # With -P, files in the current folder are not imported as numpy or torch.
    command = [sys.executable, "-P", "-c", code]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _finish(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and last line of the output, or of the errors of a failed process."""
    try:
        output, errors = process.communicate(timeout=_PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return 1, f"no answer in {_PROBE_SECONDS:g} s"
    lines = (output if process.returncode == 0 else errors).strip().splitlines()
    return process.returncode, lines[-1] if lines else f"died with code {process.returncode}"


def _print_report(findings: Sequence[Finding]) -> None:
    from rich.text import Text

    from handsim.app.messages import print_line, print_table

    rows: list[list[str | Text]] = [["", "what", "found", "expected"]]
    for finding in findings:
        bad = Text("missing", "red") if finding.needed else Text("note", "yellow")
        mark = bad if finding.remedy else Text("ok", "green")
        rows.append([mark, finding.what, finding.found, finding.expected])
    print_table(rows, left=4, wraps=True)
    troubles = [f"{finding.what}: {finding.remedy}." for finding in findings if finding.remedy]
    print_line(*(troubles or ["Nothing is missing."]))
