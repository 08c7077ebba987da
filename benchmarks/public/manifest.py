"""What a benchmark's folder holds: captures, truth, and the checksum of every file."""

from __future__ import annotations

import dataclasses
import json
import platform
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.public.answers import SIDES, Answers, BenchmarkError, load_arrays, unpack_answers
from benchmarks.public.difficulties import BENCHMARK, DIFFICULTIES, GLOVE, Plan
from gloves import Capture, load_layout, read_capture
from handsim import __version__
from handsim.errors import DatasetError
from handsim.files.inputs import checksum, load_json
from handsim.files.outputs import save_json
from handsim.hand.model import KEYPOINT_NAMES
from poses.motion import RATE
from track import User, load_user

MANIFEST: Final = "manifest.json"
LICENSE: Final = "CC-BY-4.0"
_SCHEMA: Final = 1
PUBLISHED: Final = Path(__file__).with_name("published.json")
"""Checksums of the published files."""
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9-]{0,79}")
_MOST_FRAMES, _MOST_CAPTURES = 100_000, 10_000


def label_names() -> tuple[str, ...]:
    """Names of the labels: `right:ThumbCMC` to `left:BackHand3`."""
    return tuple(f"{side}:{name}" for side in SIDES for name in load_layout(GLOVE).names)


def capture_path(name: str) -> str:
    """File of a capture's points in the benchmark's folder."""
    return f"captures/{name}.trc"


def user_path(name: str) -> str:
    """File of the hands and gloves that made it, as a perfect calibration finds them."""
    return f"captures/{name}.user.json"


def truth_path(name: str) -> str:
    """File of its truth."""
    return f"truth/{name}.npz"


@dataclass(frozen=True, slots=True)
class BenchmarkCapture:
    """A capture as the manifest describes it."""

    name: str
    kind: str
    difficulty: str
    num_frames: int


@dataclass(frozen=True, slots=True)
class Benchmark:
    """A benchmark that was made; every file is checked when it is read."""

    folder: Path
    size: str
    captures: tuple[BenchmarkCapture, ...]
    files: dict[str, str]
    """SHA-256 of every file, by its path in the folder."""

    def capture(self, name: str) -> Capture:
        """The points of a capture, which have no labels.

        Raises:
            BenchmarkError: The file is missing or damaged.
        """
        return read_capture(self._checked(capture_path(name)))

    def user(self, name: str) -> User:
        """The right hand and the left one of a capture in their gloves, as they were worn.

        Raises:
            BenchmarkError: The file is missing or damaged.
        """
        return load_user(self._checked(user_path(name)))

    def truth(self, name: str) -> Answers:
        """The truth of a capture.

        Raises:
            BenchmarkError: The file is missing or damaged.
        """
        path = self._checked(truth_path(name))
        try:
            return unpack_answers(load_arrays(path))
        except BenchmarkError as error:
            raise BenchmarkError(f"{path}: {error}") from error

    def _checked(self, file: str) -> Path:
        path = self.folder / file
        if not path.is_file():
            raise BenchmarkError(f"{path}: no such file, expected what {MANIFEST} names; make it again")
        if checksum(path) != self.files.get(file):
            raise BenchmarkError(f"{path}: its checksum is not that of {MANIFEST}; make the benchmark again")
        return path


def write_manifest(out: Path, plan: Plan, files: list[str]) -> Benchmark:
    """Write the manifest of a benchmark's folder and its files, which makes it complete."""
    sums = {file: checksum(out / file) for file in sorted(files)}
    captures = [
        {
            "name": one.name,
            "kind": one.kind,
            "difficulty": one.difficulty,
            "person": one.person,
            "seeds": one.seeds,
            "num_frames": one.num_frames,
        }
        for one in plan.captures
    ]
    content = {
        "schema": _SCHEMA,
        "benchmark": BENCHMARK,
        "size": plan.size,
        "license": LICENSE,
        "rate": RATE,
        "glove": GLOVE,
        "labels": label_names(),
        "joints": KEYPOINT_NAMES,
        "difficulties": {name: dataclasses.asdict(DIFFICULTIES[name]) for name in plan.difficulties},
        "captures": captures,
        "made_with": {
            "handsim": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "machine": platform.machine(),
        },
        "files": {
            file: {"sha256": sums[file], "bytes": (out / file).stat().st_size} for file in sorted(sums)
        },
    }
    save_json(out / MANIFEST, content)
    return load_benchmark(out)


def load_benchmark(folder: Path) -> Benchmark:
    """The benchmark in a folder.

    Raises:
        BenchmarkError: There is none, it is unfinished, of another version, or its manifest is damaged.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise BenchmarkError(
            f"{folder} holds no finished benchmark, expected a folder from python -m benchmarks.public make"
        )
    try:
        content = load_json(path)
    except DatasetError as error:
        raise BenchmarkError(str(error)) from error
    if content.get("benchmark") != BENCHMARK or content.get("schema") != _SCHEMA:
        found = str(content.get("benchmark"))[:80]
        raise BenchmarkError(f"{path}: of benchmark {found!r}, expected {BENCHMARK}")
    try:
        return _unpack(folder, content)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BenchmarkError(f"{path}: a damaged manifest; make the benchmark again") from error


def _unpack(folder: Path, content: dict[str, Any]) -> Benchmark:
    """A benchmark from its manifest; a `ValueError` or the like means that it is damaged."""
    captures = tuple(
        BenchmarkCapture(one["name"], one["kind"], one["difficulty"], one["num_frames"])
        for one in content["captures"]
    )
    for one in captures:
        # Names become paths.
        if not all(_NAME.fullmatch(text) for text in (one.name, one.kind, one.difficulty)):
            raise ValueError("a name that no capture has")
        if type(one.num_frames) is not int or not 1 <= one.num_frames <= _MOST_FRAMES:
            raise ValueError("a number of frames that no capture has")
    if not 1 <= len({one.name for one in captures}) == len(captures) <= _MOST_CAPTURES:
        raise ValueError("no captures, or two of one name")
    files = {str(file): str(entry["sha256"]) for file, entry in content["files"].items()}
    if not isinstance(content["size"], str):
        raise ValueError("the size is no text")
    return Benchmark(folder, content["size"], captures, files)


def differing_files(benchmark: Benchmark) -> list[str] | None:
    """Files whose bytes are not the published ones; None for a size that was not published."""
    published = published_files().get(benchmark.size)
    if published is None:
        return None
    return sorted(name for name, digest in published.items() if benchmark.files.get(name) != digest)


def published_files() -> dict[str, dict[str, str]]:
    """SHA-256 of every file of the published benchmark but its README, by size and path."""
    content: dict[str, dict[str, str]] = json.loads(PUBLISHED.read_text("utf-8"))["files"]
    return content
