"""Captures in general: round trips of both formats, suffixes, the disk, and the golden sentences."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves.captures.capture import Capture, count_gaps, run_lengths
from gloves.captures.formats import READABLE, WRITABLE, read_capture, write_capture
from handsim.errors import CaptureError

WORDS = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=12)
NAMES = st.one_of(WORDS, st.builds("{} {}".format, WORDS, WORDS), st.just("*12"), st.just("Unlabeled 2379"))


@st.composite
def captures(draw: st.DrawFn) -> Capture:
    """Any pattern of gaps, names as users write them, positions up to ten meters."""
    num_frames, num_markers = draw(st.integers(1, 6)), draw(st.integers(1, 5))
    names = draw(st.lists(NAMES, min_size=num_markers, max_size=num_markers))
    positions = draw(hnp.arrays(np.float64, (num_frames, num_markers, 3), elements=st.floats(-10.0, 10.0)))
    positions[(np.abs(positions) < 1e-6).all(axis=-1)] = 1e-3  # zeros are read as missing
    positions[draw(hnp.arrays(np.bool_, (num_frames, num_markers)))] = np.nan
    return Capture(tuple(names), positions, draw(st.sampled_from([24.0, 59.94, 120.0, 1000.0 / 3.0])))


@pytest.mark.parametrize(("suffix", "tolerance"), [(".trc", 1e-8), (".c3d", 1e-6), (".csv", 1e-9)])
@settings(max_examples=60, deadline=None)
@given(capture=captures())
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, tolerance: float, capture: Capture
) -> None:
    """TRC and CSV keep five and six decimals of millimeters, C3D float32: 6e-7 m at ten meters."""
    path = tmp_path_factory.mktemp("capture") / f"take{suffix}"
    write_capture(path, capture)
    again = read_capture(path)
    assert again.names == capture.names
    assert again.rate == pytest.approx(capture.rate, rel=1e-6)
    np.testing.assert_allclose(again.positions, capture.positions, rtol=0.0, atol=tolerance)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", WRITABLE)
def test_frames_without_any_marker_are_legal(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"TAKE{suffix.upper()}"
    write_capture(path, Capture(("a", "b"), np.full((3, 2, 3), np.nan), 120.0))
    again = read_capture(path)
    assert again.positions.shape == (3, 2, 3)
    assert np.isnan(again.positions).all()


def test_same_capture_same_bytes(tmp_path: Path) -> None:
    capture = Capture(("a", "b"), np.arange(12.0).reshape(2, 2, 3), 120.0)
    for folder in ("one", "two"):
        for suffix in WRITABLE:
            write_capture(tmp_path / folder / f"take{suffix}", capture)
    for suffix in WRITABLE:
        one, two = ((tmp_path / folder / f"take{suffix}").read_bytes() for folder in ("one", "two"))
        assert one == two


def test_two_coordinates_are_no_point() -> None:
    positions = np.zeros((2, 2, 3))
    positions[1, 0, 2] = np.nan
    capture = Capture(("a", "b"), positions, 120.0)
    assert np.isnan(capture.positions[1, 0]).all()
    assert np.isfinite(capture.positions[[0, 0, 1], [0, 1, 1]]).all()
    assert np.isfinite(positions[1, 0, :2]).all(), "the caller's array is left alone"


@pytest.mark.skipif(sys.platform == "win32", reason="no file size limits")
@pytest.mark.parametrize("suffix", WRITABLE)
def test_a_full_disk_leaves_nothing(tmp_path: Path, suffix: str) -> None:
    """A file size limit stands in for the full disk."""
    script = (
        "import resource, sys\n"
        "import numpy as np\n"
        "from gloves.captures.capture import Capture\n"
        "from gloves.captures.formats import write_capture\n"
        "from handsim.errors import CaptureError\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))\n"
        "try:\n"
        "    write_capture(sys.argv[1], Capture(('a',), np.ones((1000, 1, 3)), 120.0))\n"
        "except CaptureError as error:\n"
        "    print(error)\n"
    )
    path = tmp_path / f"take{suffix}"
    path.write_text("old")
    result = subprocess.run(
        [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True
    )
    assert "cannot be written" in result.stdout
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "old"


def test_error_sentences(tmp_path: Path, golden: Callable[[str, dict[str, str]], None]) -> None:
    good = Capture(("a", "b"), np.zeros((2, 2, 3)), 120.0)
    (tmp_path / "empty.trc").write_bytes(b"")
    (tmp_path / "folder.trc").mkdir()
    long = Capture(("a" * 300,), np.zeros((1, 1, 3)), 120.0)
    calls: dict[str, Callable[[], object]] = {
        "unknown suffix": lambda: read_capture(tmp_path / "take.tcr"),
        "no suffix": lambda: read_capture(tmp_path / "take"),
        "unknown suffix to write": lambda: write_capture(tmp_path / "take.tsv", good),
        "missing file": lambda: read_capture(tmp_path / "take.trc"),
        "a folder": lambda: read_capture(tmp_path / "folder.trc"),
        "empty file": lambda: read_capture(tmp_path / "empty.trc"),
        "write onto a folder": lambda: write_capture(tmp_path / "folder.trc", good),
        "a name with a tab": lambda: write_capture(
            tmp_path / "x.trc", Capture(("a\tb",), np.zeros((1, 1, 3)), 120.0)
        ),
        "an empty name": lambda: write_capture(tmp_path / "x.trc", Capture(("",), np.zeros((1, 1, 3)), 1.0)),
        "a label too long": lambda: write_capture(tmp_path / "x.c3d", long),
        "wrong shape": lambda: Capture(("a",), np.zeros((2, 2, 3)), 120.0),
        "no frames": lambda: Capture(("a",), np.zeros((0, 1, 3)), 120.0),
        "no markers": lambda: Capture((), np.zeros((2, 0, 3)), 120.0),
        "infinite": lambda: Capture(("a",), np.full((1, 1, 3), np.inf), 120.0),
        "no rate": lambda: Capture(("a",), np.zeros((1, 1, 3)), 0.0),
        "NaN rate": lambda: Capture(("a",), np.zeros((1, 1, 3)), float("nan")),
    }
    actual = {}
    for case, call in calls.items():
        with pytest.raises(CaptureError) as caught:
            call()
        actual[case] = str(caught.value).replace(str(tmp_path), "folder")
    golden("capture_errors", actual)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["empty.trc", "folder.trc"]


def test_every_readable_format_refuses_noise(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for suffix in READABLE:
        path = tmp_path / f"noise{suffix}"
        for size in (1, 3, 511, 512, 5000):
            path.write_bytes(rng.bytes(size))
            with pytest.raises(CaptureError, match=f"(?i)not a .*{suffix[1:]}|damaged"):
                read_capture(path)


def test_gaps_of_a_capture_made_by_hand() -> None:
    present = np.ones((12, 3), dtype=bool)
    present[2:4, 0] = False
    present[3:6, 1] = False  # overlaps: one gap of frames 2 to 5
    present[11, 2] = False
    counts = count_gaps(present)
    assert (counts.frames, counts.gaps) == (12, 2)
    assert counts.average_length == (4 + 1) / 2
    assert counts.average_missing == 6 / 5
    assert sorted(run_lengths(~present)) == [1, 2, 3]


def test_a_capture_without_gaps() -> None:
    counts = count_gaps(np.ones((5, 2), dtype=bool))
    assert counts.gaps == 0 and np.isnan(counts.average_length) and np.isnan(counts.average_missing)


def test_all_missing_is_one_gap() -> None:
    counts = count_gaps(np.zeros((5, 2), dtype=bool))
    assert (counts.gaps, counts.average_length, counts.average_missing) == (1, 5.0, 2.0)


def test_gaps_that_begin_and_end_inside_are_measured():
    columns = ["1111111111", "0110010111", "1000110100", "1010101011", "0000000000"]
    present = np.array([[letter == "1" for letter in column] for column in columns]).T
    assert run_lengths(~present, inside=True).tolist() == [2, 1] + [3, 1] + [1, 1, 1, 1]
    assert run_lengths(np.zeros((5, 2), bool), inside=True).tolist() == []
