"""Tables with a column for every piece of a path: all points come back, in memory for the points."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from gloves import Capture, read_capture, write_capture
from gloves.captures import text
from handsim.errors import CaptureError, HandSimWarning

FRAMES = 300


@pytest.fixture
def scattered(rng) -> Capture:
    """Two named markers, and pieces of others in columns of their own."""
    positions = [rng.normal(size=(FRAMES, 3)) * 0.1 + 1.0 for _ in range(2)]
    positions[1][100:150] = np.nan
    for _ in range(8):
        at = 0
        while at < FRAMES:
            length = int(rng.integers(1, 20))
            piece = np.full((FRAMES, 3), np.nan)
            piece[at : at + length] = rng.normal(size=(FRAMES, 3))[at : at + length] * 0.1 + 1.0
            positions.append(piece)
            at += length + int(rng.integers(1, 5))
    names = ["Glove:ThumbTip", "Glove:Wrist", *(f"Unlabeled {1000 + n}" for n in range(len(positions) - 2))]
    return Capture(tuple(names), np.stack(positions, axis=1), 120.0)


def points_of(capture: Capture) -> list[np.ndarray]:
    frames = (frame[np.isfinite(frame[:, 0])] for frame in capture.positions)
    return [frame[np.lexsort(frame.T)] for frame in frames]


@pytest.mark.parametrize("suffix", [".csv", ".trc"])
def test_pieces_share_columns(scattered, tmp_path, monkeypatch, suffix):
    path = tmp_path / f"take{suffix}"
    write_capture(path, scattered)
    plain = read_capture(path)
    assert plain.names == scattered.names and not plain.findings
    monkeypatch.setattr(text, "_MAX_DENSE_CELLS", 1000)
    pieces = len(scattered.names) - 2
    with pytest.warns(HandSimWarning, match=f"{pieces} columns hold pieces of unlabeled paths"):
        packed = read_capture(path)
    assert packed.findings == {"columns_of_pieces": pieces}
    assert packed.names[:3] == ("Glove:ThumbTip", "Glove:Wrist", "*3")
    np.testing.assert_array_equal(packed.positions[:, :2], plain.positions[:, :2])
    assert len(packed.names) < 2 + 8 + 8
    for one, other in zip(points_of(plain), points_of(packed), strict=True):
        np.testing.assert_array_equal(one, other)
    # no two pieces follow without a blank frame, which would make one path of two
    there = np.isfinite(scattered.positions[..., 0])
    begins = (there & ~np.vstack([np.zeros_like(there[:1]), there[:-1]]))[:, 2:].sum()
    there = np.isfinite(packed.positions[..., 0])
    assert (there & ~np.vstack([np.zeros_like(there[:1]), there[:-1]]))[:, 2:].sum() == begins


def test_a_wide_table_is_read_as_a_narrow_one(scattered, tmp_path, monkeypatch):
    path = tmp_path / "take.csv"
    few = Capture(scattered.names[:20], scattered.positions[:, :20], 120.0)
    write_capture(path, few)
    plain = read_capture(path)
    monkeypatch.setattr(text, "_MAX_DENSE_CELLS", 1000)
    wide = read_capture(path)
    assert wide.names == plain.names
    np.testing.assert_array_equal(wide.positions, plain.positions)
    lines = path.read_text().splitlines()
    for row, words in (
        (lines[7] + ",1.0", "line 8 has 63 cells, expected 62"),
        (lines[7].replace(".", "x", 1), "line 8, column 2"),
        (lines[7].replace("0.000000", "inf", 1), "line 8, column 2 .*: infinite"),
    ):
        path.write_text("\n".join([*lines[:7], row, *lines[8:]]) + "\n")
        with pytest.raises(CaptureError, match=words):
            read_capture(path)


def test_memory_goes_with_the_points(tmp_path):
    num_frames, num_columns = 1200, 2400
    header = ("Type", "Marker"), ("Name", "Unlabeled {}"), ("", "Position")
    lines = ["Format Version,1.23,Export Frame Rate,120,Length Units,Meters", ""]
    for label, cell in header:
        lines.append(f",{label}," + ",".join(cell.format(n // 3) for n in range(3 * num_columns)))
    lines.append("Frame,Time (Seconds)," + ",".join("XYZ" * num_columns))
    for frame in range(num_frames):
        before = 2 * frame  # each column has a point in one frame
        cells = "1.0,0.5,0.25," + f"1.1,0.{frame:04d},0.3," + ",,," * (num_columns - before - 2)
        lines.append(f"{frame},{frame / 120:.6f}," + ",,," * before + cells[:-1])
    (tmp_path / "wide.csv").write_text("\n".join(lines) + "\n")
    size = (tmp_path / "wide.csv").stat().st_size
    tracemalloc.start()
    with pytest.warns(HandSimWarning, match="2400 columns hold pieces"):
        read = read_capture(tmp_path / "wide.csv")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.isfinite(read.positions[..., 0]).sum() == 2 * num_frames
    assert peak < 5 * size < 8 * num_frames * 3 * num_columns
