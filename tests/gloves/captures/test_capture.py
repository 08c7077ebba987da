"""Captures in general: round trips of both formats, suffixes, the disk, and what mistakes are told."""

from __future__ import annotations

import warnings
from pathlib import Path

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gloves import Capture, read_capture, write_capture
from gloves.captures.capture import check_place, run_lengths, unit_fault
from gloves.captures.coordinates import settled
from gloves.captures.formats import READABLE, WRITABLE
from handsim import HandSimError, HandSimWarning
from handsim.errors import CaptureError
from tests.sentences import assert_names, error_names

WORDS = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=12)
NAMES = st.one_of(WORDS, st.builds("{} {}".format, WORDS, WORDS), st.just("*12"), st.just("Unlabeled 2379"))
MISTAKES = [
    (lambda at: read_capture(at / "take.tcr"), "folder/take.tcr | '.tcr' | '.trc' | .c3d, .csv, .tsv"),
    (lambda at: read_capture(at / "take"), "folder/take | '' | .trc, .c3d, .csv, .tsv"),
    (lambda at: read_capture(at / "take.trc"), "folder/take.trc | No such file"),
    (lambda at: read_capture(at / "own.npy"), "own.npy | gloves.Capture(names, positions, rate)"),
    (lambda at: read_capture(at / "own.npz"), "own.npz | load_take | gloves.Capture(names, positions, rate)"),
    (lambda at: read_capture(at / "folder.trc"), "folder/folder.trc | this is a folder"),
    (lambda at: read_capture(at / "empty.trc"), "folder/empty.trc | empty"),
    (lambda at: write_capture(at / "take.tsv", alone()), "folder/take.tsv | '.tsv' | .trc, .c3d, .csv"),
    (lambda at: write_capture(at / "folder.trc", alone()), "folder/folder.trc | this is a folder"),
    (lambda at: write_capture(at / "x.trc", alone("a\tb")), "folder/x.trc | 'a\\tb' | printable"),
    (lambda at: write_capture(at / "x.trc", alone("")), "folder/x.trc | '' | printable"),
    (lambda at: write_capture(at / "x.c3d", alone("a" * 300)), "folder/x.c3d | aaaa...aaaa | 255 bytes"),
    (lambda at: alone(shape=(2, 2, 3)), "(2, 2, 3) | (T, 1, 3) | 1 names"),
    (lambda at: alone(shape=(0, 1, 3)), "at least one frame | 0 frames of 1"),
    (lambda at: Capture((), np.zeros((2, 0, 3)), 120.0), "at least one frame | 2 frames of 0"),
    (lambda at: alone(fill=np.inf), "infinite | finite numbers or NaN"),
    (lambda at: alone(rate=0.0), "0 Hz | 1 to 5000"),
    (lambda at: alone(rate=np.nan), "nan Hz | 1 to 5000"),
    (lambda at: alone(rate=np.full(2, 120.0)), "an array (2,) | 1 to 5000"),
]
NAMES_PLAUSIBILITY = tuple(f"marker{number}" for number in range(19))


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
def test_round_trip(tmp_path_factory, suffix, tolerance, capture):
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


def alone(
    name: str = "a", *, shape: tuple[int, ...] = (1, 1, 3), fill: float = 0.0, rate: float = 120.0
) -> Capture:
    """A capture of one marker."""
    return Capture((name,), np.full(shape, fill), rate)


@pytest.mark.parametrize(("call", "words"), MISTAKES)
def test_mistakes_are_told(tmp_path, call, words):
    (tmp_path / "empty.trc").write_bytes(b"")
    (tmp_path / "folder.trc").mkdir()
    with pytest.raises(CaptureError) as caught:
        call(tmp_path)
    assert_names(str(caught.value).replace(str(tmp_path), "folder"), words)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["empty.trc", "folder.trc"]


def test_the_rate_may_come_from_an_archive_of_numpy(tmp_path: Path) -> None:
    np.savez(tmp_path / "own.npz", names=["a"], positions=np.zeros((2, 1, 3)), rate=120.0)
    with np.load(tmp_path / "own.npz") as own:
        rate = Capture(tuple(own["names"].tolist()), own["positions"], own["rate"]).rate
    assert type(rate) is float
    assert rate == 120.0


def test_every_readable_format_refuses_noise(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for suffix in READABLE:
        path, kind = tmp_path / f"noise{suffix}", {".csv": "table", ".tsv": "table"}.get(suffix, suffix[1:])
        for size in (1, 3, 511, 512, 5000):
            path.write_bytes(rng.bytes(size))
            with pytest.raises(CaptureError, match=f"(?i)not a .*{kind}|damaged"):
                read_capture(path)


def test_gaps_that_begin_and_end_inside_are_measured():
    columns = ["1111111111", "0110010111", "1000110100", "1010101011", "0000000000"]
    present = np.array([[letter == "1" for letter in column] for column in columns]).T
    assert run_lengths(~present, inside=True).tolist() == [2, 1] + [3, 1] + [1, 1, 1, 1]
    assert run_lengths(np.zeros((5, 2), bool), inside=True).tolist() == []


@pytest.fixture
def hand(rng) -> Capture:
    """Markers on something of a hand's size that moves through a room."""
    path = np.linspace([0.5, 0.5, 1.0], [0.6, 0.7, 1.1], 30)[:, None]
    return Capture(NAMES_PLAUSIBILITY, path + rng.uniform(0.0, 0.15, size=(30, 19, 3)), 120.0)


def scaled(capture: Capture, scale: float) -> Capture:
    return Capture(capture.names, capture.positions * scale, capture.rate)


@pytest.mark.parametrize("suffix", [".trc", ".c3d"])
@pytest.mark.parametrize(
    ("scale", "sentence"),
    [
        (1e-3, r"the points of a frame span 0\.1\d mm; correct that unit, probably to meters"),
        (1e-1, r"the points of a frame span 1\d mm; correct that unit, probably to centimeters"),
        (1e3, r"the points of a frame span 1\d\d m; correct that unit, probably to millimeters"),
        (1e2, r"the points of a frame are \d\.\d m apart; correct that unit, probably to centimeters"),
    ],
)
def test_a_wrong_unit_is_told(hand, tmp_path, suffix, scale, sentence):
    path = tmp_path / f"take{suffix}"
    write_capture(path, scaled(hand, scale))
    with pytest.raises(CaptureError, match=rf"take\{suffix}: by the unit of length .* states, {sentence}"):
        read_capture(path)


def test_hands_bodies_and_strays_are_no_fault(hand, rng):
    assert unit_fault(list(hand.positions)) is None
    body = rng.uniform(0.0, 1.9, size=(30, 40, 3))
    assert unit_fault(list(body)) is None
    strays = np.concatenate([hand.positions, rng.uniform(-200.0, 200.0, size=(30, 1, 3))], axis=1)
    strays[::3, 19] = strays[::3, 0]
    few = [cloud[:4] * 1e-3 for cloud in hand.positions]
    assert unit_fault(few) is None, "four points may be strays"
    assert unit_fault(list(strays[::3])) is None


@pytest.mark.parametrize("suffix", [".trc", ".c3d", ".csv"])
def test_recurring_zeros_are_missing_and_counted(hand, tmp_path, suffix):
    positions = hand.positions.copy()
    positions[3:9, 4] = 0.0
    positions[:, 7] = 0.0  # a marker that was never seen
    path = tmp_path / f"take{suffix}"
    write_capture(path, Capture(NAMES_PLAUSIBILITY, positions, 120.0))
    with pytest.warns(HandSimWarning, match=r"36 points at exactly \(0, 0, 0\) are read as missing"):
        capture = read_capture(path)
    missing = np.isnan(capture.positions[..., 0])
    expected = np.zeros_like(missing)
    expected[3:9, 4] = expected[:, 7] = True
    np.testing.assert_array_equal(missing, expected)


def test_zeros_of_a_single_frame_are_missing(hand, tmp_path):
    positions = hand.positions[:1].copy()
    positions[0, [4, 7]] = 0.0
    write_capture(tmp_path / "still.trc", Capture(NAMES_PLAUSIBILITY, positions, 120.0))
    with pytest.warns(HandSimWarning, match=r"2 points at exactly \(0, 0, 0\) are read as missing"):
        capture = read_capture(tmp_path / "still.trc")
    assert np.flatnonzero(np.isnan(capture.positions[0, :, 0])).tolist() == [4, 7]


def test_a_single_zero_and_what_stands_still_stay(hand):
    positions = hand.positions.copy()
    positions[3, 4] = 0.0
    assert not settled(Capture(NAMES_PLAUSIBILITY, positions, 120.0)).findings
    still = np.zeros((5, 3, 3))
    still[:, 1:] = [[1.0], [2.0]]
    assert not settled(Capture(NAMES_PLAUSIBILITY[:3], still, 120.0)).findings


def test_nothing_is_told_of_a_good_capture(hand, tmp_path):
    write_capture(tmp_path / "take.c3d", hand)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(read_capture(tmp_path / "take.c3d").positions, hand.positions, atol=1e-6)
        check_place(hand, 1e3)


def test_points_far_away_are_counted(hand):
    positions = hand.positions.copy()
    positions[:, 0] += 1500.0
    with pytest.warns(HandSimWarning, match=r"30 of 570 points lie 1000 m or more from the origin"):
        check_place(Capture(NAMES_PLAUSIBILITY, positions, 120.0), 1e3)
    far = Capture(NAMES_PLAUSIBILITY, hand.positions + 1500.0, 120.0)
    with pytest.raises(CaptureError, match=r"570 of 570 points lie 1000 m or more .*; move the origin"):
        check_place(far, 1e3)


def test_a_path_with_brackets_is_told_as_it_is(hand, tmp_path, capsys):
    from handsim.cli.main import main

    folder = tmp_path / "[bold]take[red]"
    folder.mkdir()
    assert main(["hand", "--out", str(folder / "hand.xml")]) == 0
    assert capsys.readouterr().out.startswith(f"{folder / 'hand.xml'}: ")


def test_warnings_of_a_capture_are_lines_of_the_command(hand, tmp_path, capsys):
    from handsim.app.messages import warnings_as_lines

    positions = hand.positions.copy()
    positions[2:5, 0] = 0.0
    path = Path(tmp_path / "take.trc")
    write_capture(path, Capture(NAMES_PLAUSIBILITY, positions, 120.0))
    with warnings_as_lines("handsim label"):
        read_capture(path)
    expected = f"handsim label: warning: {path}: 3 points at exactly (0, 0, 0) are read as missing"
    said = capsys.readouterr().err
    assert said.startswith(expected) and said.count("\n") == 1


def test_all_points_at_the_origin_are_told(tmp_path):
    path = tmp_path / "take.trc"
    write_capture(path, Capture(("a", "b"), np.zeros((20, 2, 3)), 120.0))
    with pytest.raises(CaptureError, match=r"all points are at the origin, \(0, 0, 0\), expected positions"):
        read_capture(path)


def test_masked_points_are_missing(hand):
    mask = np.zeros_like(hand.positions, dtype=bool)
    mask[3:9, 2] = True
    masked = np.ma.array(hand.positions, mask=mask)
    found = Capture(hand.names, masked, hand.rate)
    np.testing.assert_array_equal(np.isnan(found.positions), mask | np.isnan(hand.positions))


@pytest.mark.parametrize(
    ("names", "positions", "findings", "words"),
    [
        (None, np.ones((2, 1, 3)), {}, "a name is None | text"),
        ((1, 2), np.ones((2, 2, 3)), {}, "a name is 1 | text"),
        (("a",), [[["x", 1, 2]]], {}, "positions is | an array of numbers"),
        (("a",), [[[1, 2, 3]], [[1, 2]]], {}, "positions is | an array of numbers"),
        (("a",), np.ones((2, 1, 3)), None, "findings is None | counts"),
        ("abc", np.ones((2, 3, 3)), {}, "shape (2, 3, 3) | 1 names"),
    ],
)
def test_what_is_no_capture_is_told(names, positions, findings, words):
    with error_names(HandSimError, words):
        Capture(names, positions, 100.0, findings)


def test_names_come_from_anything_that_lists_them():
    for names in (iter("ab"), np.array(["a", "b"]), ["a", "b"]):
        assert Capture(names, np.ones((2, 2, 3)), 100.0).names == ("a", "b")
