"""What is a measured point, and what is not: every kind of finding, in every format, and what stays."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path

import ezc3d
import numpy as np
import pytest

from gloves import Capture, read_capture, write_capture
from gloves.captures.c3d import read_c3d
from gloves.captures.capture import select_markers
from gloves.captures.coordinates import findings_sentence, settled
from gloves.captures.formats import WRITABLE
from handsim.errors import CaptureError, HandSimWarning
from tests.gloves.captures.test_c3d import POINTS, c3d
from tests.gloves.captures.test_formats import nexus

FRAMES, MARKERS = 120, 12


@pytest.fixture
def moving(rng) -> Capture:
    """Markers of a hand that moves through a room, with the noise of an optical system."""
    seconds = np.arange(FRAMES) / 120.0
    path = 0.3 * np.sin(seconds[:, None] * [2.0, 3.1, 1.3]) + [0.5, 0.2, 1.1]
    markers = path[:, None] + rng.uniform(0.0, 0.15, size=(MARKERS, 3))
    names = tuple(f"m{number}" for number in range(MARKERS))
    return Capture(names, markers + 2e-5 * rng.normal(size=markers.shape), 120.0)


def with_positions(capture: Capture, positions: np.ndarray) -> Capture:
    return dataclasses.replace(capture, positions=positions)


def untouched(capture: Capture, **findings: int) -> None:
    """Nothing else is found in it, and nothing changed."""
    read = settled(capture)
    assert read.findings == findings
    np.testing.assert_array_equal(read.positions, capture.positions)


def gaps(rng) -> np.ndarray:
    """Gaps of some frames each (T, N)."""
    hidden = np.zeros((FRAMES, MARKERS), dtype=bool)
    for column in range(MARKERS):
        for begin in rng.choice(np.arange(5, FRAMES - 20), size=2, replace=False):
            hidden[begin : begin + rng.integers(1, 15), column] = True
    return hidden


def filled(positions: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Positions whose gaps hold the last position, and those at the beginning the first."""
    positions = positions.copy()
    for column in range(positions.shape[1]):
        seen = np.flatnonzero(~hidden[:, column])
        last = np.maximum(np.searchsorted(seen, np.arange(len(positions)), side="right") - 1, 0)
        positions[:, column] = positions[seen[last], column]
    return positions


@pytest.mark.parametrize("suffix", WRITABLE)
def test_gaps_that_hold_the_last_position_are_missing(moving, rng, tmp_path, suffix):
    hidden = gaps(rng)
    hidden[80:83] = hidden[78:85, 0] = True  # frames without a point
    hidden[100:, 3] = True
    path = tmp_path / f"take{suffix}"
    write_capture(path, with_positions(moving, filled(moving.positions, hidden)))
    with pytest.warns(
        HandSimWarning, match=rf"{hidden.sum()} points repeat their position while others move"
    ):
        read = read_capture(path)
    assert read.findings == {"held": hidden.sum()}
    np.testing.assert_array_equal(np.isnan(read.positions[..., 0]), hidden)


@pytest.mark.parametrize("suffix", WRITABLE)
def test_gaps_that_were_interpolated_are_missing(moving, rng, tmp_path, suffix):
    hidden = gaps(rng)
    positions, frames = moving.positions.copy(), np.arange(FRAMES)
    for column in range(MARKERS):
        seen = np.flatnonzero(~hidden[:, column])
        for axis in range(3):
            positions[:, column, axis] = np.interp(frames, seen, positions[seen, column, axis])
    write_capture(tmp_path / f"take{suffix}", with_positions(moving, positions))
    with pytest.warns(HandSimWarning, match=r"points move by equal steps"):
        read = read_capture(tmp_path / f"take{suffix}")
    missing = np.isnan(read.positions[..., 0])
    assert not (missing & ~hidden).any() and missing.sum() > 0.8 * hidden.sum()  # of one or two frames: left


def test_what_is_simulated_without_noise_stays(moving):
    """It moves along a line, as a whole or beside a finger."""
    seconds = np.arange(FRAMES)[:, None, None] / 120.0
    positions = moving.positions[:1] + seconds * np.array([0.2, 0.1, 0.0])
    untouched(with_positions(moving, positions))
    positions[60:, :4] += 0.02 * (1.0 - np.cos(3.0 * seconds[:60]))
    untouched(with_positions(moving, positions))


def test_a_marker_that_was_not_there_at_first_is_missing(moving):
    hidden = np.zeros((FRAMES, MARKERS), dtype=bool)
    hidden[:30, 2] = True
    missing = np.isnan(settled(with_positions(moving, filled(moving.positions, hidden))).positions[..., 0])
    assert missing[:30, 2].all()
    assert missing.sum() <= 31  # the first real point is among equal ones


def test_what_is_still_stays(moving):
    still = np.repeat(moving.positions[:1], FRAMES, axis=0)
    untouched(with_positions(moving, still))
    steps = moving.positions[np.arange(FRAMES) // 10]
    # a simulated capture that shows each pose for a while
    untouched(with_positions(moving, steps), repeated_frames=FRAMES - FRAMES // 10)
    standing = moving.positions.copy()
    standing[:, 4:8] = standing[0, 4:8]  # a thing without noise
    untouched(with_positions(moving, standing))
    lifted = standing.copy()
    rise = 0.2 * np.clip((np.arange(FRAMES) - 40) / 60.0, 0.0, 1.0) ** 3
    lifted[:, 4:8, 2] += rise[:, None]
    lifted[100:, 4:8] += (np.arange(FRAMES - 100) * 1e-3)[:, None, None]
    untouched(with_positions(moving, lifted))
    there_and_back = moving.positions[np.r_[:60, 59:-1:-1]]
    untouched(with_positions(moving, there_and_back), repeated_frames=1)
    twice = moving.positions[np.arange(FRAMES) // 2]
    twice[8:10] = np.nan  # without points
    untouched(with_positions(moving, twice), repeated_frames=FRAMES // 2 - 1)
    told = findings_sentence({"repeated_frames": 59})
    assert told.startswith(
        "59 frames repeat the one before, as where frames were lost or the rate was raised"
    )


@pytest.mark.parametrize("millimeters", [0.1, 0.25, 1.0])
def test_few_digits_repeat_positions_of_what_rests(moving, millimeters):
    positions = moving.positions.copy()
    positions[:, 4:8] = positions[0, 4:8] + 2e-5 * np.random.default_rng(1).normal(size=(FRAMES, 4, 3))
    positions[60:, 6, 2] += np.linspace(0.0, 0.3, FRAMES - 60) ** 2  # and is lifted
    grid = millimeters * 1e-3
    untouched(with_positions(moving, np.round(positions / grid) * grid))


def test_gaps_are_found_among_few_digits(moving):
    hidden = np.zeros((FRAMES, MARKERS), dtype=bool)
    hidden[40:60, 2] = True
    rounded = np.round(filled(moving.positions, hidden) * 1e4) * 1e-4
    np.testing.assert_array_equal(
        np.isnan(settled(with_positions(moving, rounded)).positions[..., 0]), hidden
    )


@pytest.mark.parametrize("suffix", WRITABLE)
@pytest.mark.parametrize(("share", "apart"), [(1.0, 0.0), (0.5, 0.0), (1.0, 1e-4), (2.0, 1e-4)])
def test_markers_of_two_subjects_are_one(moving, rng, tmp_path, suffix, share, apart):
    """Also of three, and where the two differ a little."""
    positions = np.where(gaps(rng)[..., None], np.nan, moving.positions)
    again = np.arange(round(share * MARKERS)) % MARKERS
    names = [f"A:{name}" for name in moving.names] + [f"B:{moving.names[n]}" for n in again]
    others = positions[:, again] + rng.uniform(-apart, apart, size=(FRAMES, len(again), 3))
    twice = np.concatenate([positions, others], axis=1)
    path = tmp_path / f"take{suffix}"
    write_capture(path, Capture(tuple(names), twice, 120.0))
    with pytest.warns(HandSimWarning, match="repeat another within 1 mm"):
        read = read_capture(path)
    assert read.names == tuple(names[:MARKERS])
    assert read.findings == {"doubled": np.isfinite(positions[:, again, 0]).sum()}
    np.testing.assert_allclose(read.positions, positions, atol=1e-6)
    assert select_markers(read, moving.names).shape == positions.shape


@pytest.mark.parametrize("numbers", [9999.0, -1.0, -9999.99, 1e6, (0.0, 0.0, -1.0), (0.0, -9999.0, 0.0)])
@pytest.mark.parametrize("suffix", WRITABLE)
def test_numbers_that_stand_for_none_are_missing(moving, rng, tmp_path, suffix, numbers):
    hidden = gaps(rng)
    path = tmp_path / f"take{suffix}"
    positions = np.where(hidden[..., None], 1e-3 * np.array(numbers), moving.positions)
    write_capture(path, with_positions(moving, positions))
    with pytest.warns(HandSimWarning, match=rf"{hidden.sum()} points stand for none"):
        read = read_capture(path)
    np.testing.assert_array_equal(np.isnan(read.positions[..., 0]), hidden)


@pytest.mark.parametrize("count", [2, 3])
def test_a_place_that_markers_jump_to_thrice_stands_for_none(moving, count):
    positions = moving.positions.copy()
    for column in range(count):
        positions[20 + 9 * column : 40 + 9 * column, column] = 0.0, 0.0, -1e-3
    read = settled(with_positions(moving, positions))
    assert read.findings.get("stand_ins", 0) == (20 * count if count == 3 else 0)


def test_markers_that_are_exchanged_at_rest_stay(moving):
    """With few digits exchanged markers jump to where the other one was in other frames."""
    positions = np.repeat(moving.positions[:1], FRAMES, axis=0)
    positions += 1e-4 * np.random.default_rng(2).integers(-1, 2, size=positions.shape)
    positions[:60, 8:] = moving.positions[:60, 8:]
    positions[::7, [0, 1]] = positions[::7, [1, 0]]
    read = settled(with_positions(moving, np.round(positions / 1e-4) * 1e-4))
    assert "stand_ins" not in read.findings


def test_two_columns_of_a_marker_have_the_points_of_both(moving):
    first, second = moving.positions[:, :1].copy(), moving.positions[:, :1].copy()
    first[:40], second[80:] = np.nan, np.nan
    positions = np.concatenate([first, second, moving.positions[:, 1:]], axis=1)
    read = settled(Capture(("A:m0", "B:m0", *moving.names[1:]), positions, 120.0))
    assert read.names == ("A:m0", *moving.names[1:])
    assert read.findings == {"doubled": 40}
    np.testing.assert_array_equal(read.positions, moving.positions)


def test_a_point_of_two_columns_for_a_moment_is_one(moving):
    positions = moving.positions.copy()
    positions[50:53, 7] = positions[50:53, 2]
    read = settled(with_positions(moving, positions))
    assert (read.names, read.findings) == (moving.names, {"doubled": 3})
    assert np.isnan(read.positions[50:53, 7]).all() and np.isfinite(read.positions[50:53, 2]).all()


def with_outputs(path: Path, moving: Capture, groups: dict[str, list[str]], labels: list[str]) -> None:
    """A C3D with outputs of a model behind its markers, as Nexus writes it."""
    outputs = 40.0 * np.sin(
        np.arange(FRAMES)[:, None, None] / 9.0 + np.arange(3 * len(labels)).reshape(-1, 3)
    )
    file = ezc3d.c3d()
    points = np.concatenate([1e3 * moving.positions, outputs], axis=1).transpose(2, 1, 0)
    file["parameters"]["POINT"]["RATE"]["value"] = [120.0]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = [*moving.names, *labels]
    file["data"]["points"] = np.concatenate([points, np.ones_like(points[:1])])
    for group, names in groups.items():
        file.add_parameter("POINT", group, names)
    file.write(str(path))


@pytest.mark.parametrize("prefixes", [("Anna:", "Anna:"), ("", "Anna:"), ("Anna:", ""), ("", "")])
def test_outputs_of_models_are_no_markers(moving, tmp_path, prefixes):
    names = {
        "ANGLES": ["RWristOne"], "ANGLES2": ["RWristTwo"], "MOMENTS": ["M"], "FORCES": ["F"], "POWERS": ["P"],
        "SCALARS": ["Spread"], "MODELED_MARKERS": ["WristCenter"],
    }  # fmt: skip
    listed, shown = prefixes
    labels = [shown + name for group in names.values() for name in group]
    groups = {group: [listed + name for name in one] for group, one in names.items()}
    with_outputs(tmp_path / "nexus.c3d", moving, groups, labels)
    with pytest.warns(HandSimWarning, match="7 columns are outputs of models, such as angles and forces"):
        read = read_capture(tmp_path / "nexus.c3d")
    assert (read.names, read.findings) == (moving.names, {"model_outputs": 7})
    np.testing.assert_allclose(read.positions, moving.positions, atol=1e-6)


def test_outputs_show_by_their_names_and_units(moving, tmp_path):
    with_outputs(tmp_path / "bare.c3d", moving, {}, ["Anna:RThumbAngles", "LWristMoment", "R_WRIST_ANGLE"])
    assert settled(read_c3d((tmp_path / "bare.c3d").read_bytes())).names == moving.names
    text = nexus(names=("a", "b", "c")).replace("mm,mm,mm,mm,mm,mm,mm", "mm,mm,mm,deg,deg,deg,mm")
    (tmp_path / "nexus.csv").write_text(text)
    with pytest.warns(HandSimWarning, match="1 columns are outputs of models"):
        read = read_capture(tmp_path / "nexus.csv")
    assert read.names == ("a", "c")
    only = Capture(("LAngles", "RAngles"), moving.positions[:, :2], 120.0)
    with pytest.raises(CaptureError, match="no markers: all 2 columns are outputs of models"):
        settled(only)


def test_a_c3d_that_marks_all_points_as_missing_is_read() -> None:
    everywhere = tuple((frame, point) for frame in range(2) for point in range(2))
    read = read_c3d(c3d(missing=everywhere))
    np.testing.assert_allclose(read.positions, POINTS * 1e-3)
    assert "the 4 with coordinates are read" in findings_sentence(read.findings)
    holes = POINTS.copy()
    holes[0, 1] = 0.0
    read = read_c3d(c3d(holes, missing=everywhere))
    assert np.isnan(read.positions[0, 1]).all() and np.isfinite(read.positions[:, 0]).all()
    read = read_c3d(c3d(missing=everywhere[1:]))
    assert np.isnan(read.positions).any(axis=-1).sum() == 3
    assert "3 points have coordinates and are marked as missing" in findings_sentence(read.findings)


def test_one_sentence_tells_everything(moving, rng, tmp_path):
    hidden = gaps(rng)
    positions = filled(moving.positions, hidden)
    positions[20:25, 0] = 0.0
    twice = np.concatenate([positions, positions[:, 5:6]], axis=1)
    write_capture(tmp_path / "all.c3d", Capture((*moving.names, "again"), twice, 120.0))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        read = read_capture(tmp_path / "all.c3d")
    assert list(read.findings) == ["zeros", "doubled", "held"]
    (one,) = told
    for count in read.findings.values():
        assert f"{count} points" in str(one.message)
