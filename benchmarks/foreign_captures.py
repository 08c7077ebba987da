"""Marker files of other programs: read by handsim and by readers of others, and compared.

    python -m benchmarks.foreign_captures FOLDER... [--list]

Every .trc, .c3d, .csv and .tsv under the folders is read by `read_capture` and, a C3D, by ezc3d (in a process
of its own, because a damaged file can end it) and by the package c3d where that is installed; a text by a
plain parser of this script, which knows only where the numbers begin. Prints for each folder how many files
are read with the positions that one of the others reads, read with other positions, refused although another
reader opens them, and refused by all. A position counts as the same within 1e-6 m and 2e-6 of itself; a point
that handsim leaves out as missing has to be missing, negative in its residual or exactly zero for the other
reader. With --list every file that is not read with the same positions is named, with the sentence that
refuses it. No file is part of this repository.
"""

from __future__ import annotations

import argparse
import csv
import io
import re
import resource
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import Final

import numpy as np

from gloves.captures.formats import READABLE, read_capture
from handsim.errors import CaptureError

METERS: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "mete": 1.0, "meters": 1.0, "millimeters": 1e-3}
MOST_SECONDS: Final = 120.0
MOST_BYTES: Final = 4 << 30
KINDS: Final = ("same", "differs", "refused by handsim alone", "refused by all", "read by handsim alone")


def with_ezc3d(path: Path) -> np.ndarray | None:
    """Positions (T, N, 3) [m] by ezc3d, or None where it fails or finds no point."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "points.npy"
        command = [sys.executable, __file__, "--ezc3d", str(path), str(out)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=MOST_SECONDS, check=False)
        except subprocess.TimeoutExpired:
            return None
        return np.load(out) if done.returncode == 0 and out.exists() else None


def _write_ezc3d(path: Path, out: Path) -> None:
    import ezc3d

    # A damaged file makes it take all the memory there is.
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    content = ezc3d.c3d(str(path))
    units = content["parameters"]["POINT"].get("UNITS", {"value": []})["value"]
    points = np.moveaxis(content["data"]["points"][:3], (0, 1, 2), (2, 1, 0))
    if points.size:
        np.save(out, points * METERS.get(units[0].strip().lower() if units else "mm", 1e-3))


def with_c3d(path: Path) -> np.ndarray | None:
    """Positions (T, N, 3) [m] by the package c3d, or None where it is absent, fails or finds no point."""
    try:
        import c3d
    except ImportError:
        return None
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reader = c3d.Reader(file)
            frames = np.array([points for _, points, _ in reader.read_frames(copy=True)], dtype=np.float64)
            units = reader.get("POINT:UNITS")
            unit = units.string_array[0].strip(" \0").lower() if units is not None else "mm"
    except Exception:  # it asserts much of a file
        return None
    if frames.size == 0:
        return None
    positions = frames[..., :3] * METERS.get(unit, 1e-3)
    positions[frames[..., 3] < 0.0] = np.nan
    return positions


def with_plain_parser(path: Path) -> np.ndarray | None:
    """Positions (T, N, 3) [m] of a text: the columns under X, Y, Z, or behind frame and time."""
    text = path.read_bytes().decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    delimiter = max(",;\t", key=text[:20_000].count)
    rows = list(csv.reader(io.StringIO("\n".join(lines).replace("\0", "")), delimiter=delimiter))
    try:
        if path.suffix.lower() == ".trc":
            values = [cell.strip() for cell in rows[2] if cell.strip()]
            unit = next(cell for cell in values if cell.lower() in METERS)
            axes = len([cell for cell in rows[4] if cell.strip()])
            return _positions(rows[5:], 2, None, METERS[unit.lower()], least=axes)
        if path.suffix.lower() == ".tsv":
            header = next(row for row in rows if row and row[0] == "DATA_INCLUDED")
            names = next(row for row in rows if row and row[0] == "MARKER_NAMES")
            begin = next(index for index, row in enumerate(rows) if row and re.fullmatch(r"-?[\d.]+", row[0]))
            if header[1] != "3D":
                return None
            count = 3 * len([name for name in names[1:] if name])
            leading = len([cell for cell in rows[begin] if cell]) - count
            return _positions(rows[begin:], leading, count, 1e-3)
        return _motive(rows) if rows[0][0] == "Format Version" else _vicon(rows)
    except (StopIteration, IndexError, ValueError):
        return None


def _positions(
    rows: list[list[str]], leading: int, count: int | None, scale: float, *, least: int = 0
) -> np.ndarray | None:
    """Numbers of rows behind the leading cells, three a point; without a count as many as the longest has."""
    cells = [[cell.strip() for cell in row[leading:]] for row in rows if any(cell.strip() for cell in row)]
    filled = [index + 1 for row in cells for index, cell in enumerate(row) if cell]
    width = count if count is not None else -(-max([*filled, least]) // 3) * 3
    if not cells or not width:
        return None
    table = np.full((len(cells), width), np.nan)
    for line, row in zip(table, cells, strict=True):
        line[: len(row[:width])] = [float(cell) if cell else np.nan for cell in row[:width]]
    return table.reshape(len(table), -1, 3) * scale


def _motive(rows: list[list[str]]) -> np.ndarray | None:
    stated = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    begin = next(index for index, row in enumerate(rows) if row and row[0] == "Frame")
    types = next(row for row in rows if "Marker" in row or "Type" in row[:2])
    columns = [
        index
        for index, (kind, what) in enumerate(zip(types, rows[begin - 1], strict=False))
        if kind == "Marker" and what == "Position"
    ]
    picked = [["0", *(row[index] for index in columns)] for row in rows[begin + 1 :] if row]
    return _positions(picked, 1, len(columns), METERS[stated["Length Units"].lower()]) if columns else None


def _vicon(rows: list[list[str]]) -> np.ndarray | None:
    begin = next(index for index, row in enumerate(rows) if row and row[0].lower() == "trajectories")
    axes = rows[begin + 3]
    columns = [index for index, cell in enumerate(axes) if cell in {"X", "Y", "Z"}]
    at = begin + (4 if rows[begin + 4][0] else 5)
    end = next((index for index in range(at, len(rows)) if not any(rows[index])), len(rows))
    picked = [["0", *(row[index] for index in columns)] for row in rows[at:end]]
    return _positions(picked, 1, len(columns), 1e-3)


def same(ours: np.ndarray, other: np.ndarray) -> bool:
    """Whether two readers found the same positions; empty trajectories at the end may be left out."""
    if len(ours) != len(other):
        return False
    width = max(ours.shape[1], other.shape[1])
    ours, other = (
        np.pad(array, ((0, 0), (0, width - array.shape[1]), (0, 0)), constant_values=np.nan)
        for array in (ours, other)
    )
    missing = np.isnan(ours[..., 0])
    gone = np.isnan(other).any(axis=-1) | (other == 0.0).all(axis=-1)
    return bool(gone[missing].all() and np.allclose(ours[~missing], other[~missing], rtol=2e-6, atol=1e-6))


def compare(path: Path) -> tuple[str, str]:
    """Which of KINDS a file is, and a sentence about it."""
    readers = [with_ezc3d, with_c3d] if path.suffix.lower() == ".c3d" else [with_plain_parser]
    others = [found for reader in readers if (found := reader(path)) is not None]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ours = read_capture(path).positions
    except CaptureError as error:
        return (KINDS[2] if others else KINDS[3]), str(error)
    if not others:
        return KINDS[4], f"{path}: {ours.shape}"
    if any(same(ours, other) for other in others):
        return KINDS[0], ""
    return KINDS[1], f"{path}: {ours.shape}, others {[other.shape for other in others]}"


def main() -> None:
    if sys.argv[1:2] == ["--ezc3d"]:
        _write_ezc3d(Path(sys.argv[2]), Path(sys.argv[3]))
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--list", action="store_true", help="name every file that is not read the same")
    arguments = parser.parse_args()
    total: Counter[str] = Counter()
    for folder in arguments.folders:
        counts: Counter[str] = Counter()
        for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in READABLE):
            kind, text = compare(path)
            counts[kind] += 1
            if arguments.list and kind != KINDS[0]:
                print(f"  {kind}: {text}", flush=True)
        print(f"{folder.name}: " + ", ".join(f"{counts[kind]} {kind}" for kind in KINDS), flush=True)
        total += counts
    opened = sum(total[kind] for kind in KINDS[:3])
    print("all: " + ", ".join(f"{total[kind]} {kind}" for kind in KINDS))
    share = 100 * total[KINDS[0]] / max(1, opened)
    print(f"of {opened} files that another reader opens, {share:.1f} % are the same")


if __name__ == "__main__":
    main()
