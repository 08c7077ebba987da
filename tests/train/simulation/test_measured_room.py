"""What an optical system does, measured: as the truth of simulated captures and plain counts have it."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import numpy as np
import pytest

from gloves import Capture, Take, read_capture
from gloves.captures.capture import run_lengths
from handsim.errors import CaptureError
from train import MeasuredRoom, measure_room, simulate_take

REAL = Path(__file__).parents[4] / "shared" / "real"
SIG18 = Path(os.environ.get("HANDSIM_SIG18", Path(__file__).parents[4] / "shared" / "sig18"))
LOSSES = {"noise": 0.4, "dropout": 0.1, "dropout_length": 5.0, "dropout_cameras": 6, "min_distance": 0.012}
STRAYS = {"number": 8.0, "shown": 0.1, "hidden": 0.8}


@functools.cache
def take() -> Take:
    """Hands before a bad optical system."""
    return simulate_take("free", num_frames=1200, optics=LOSSES, strays=STRAYS)


@functools.cache
def unlabeled() -> MeasuredRoom:
    return measure_room(take().capture())


@functools.cache
def labeled() -> MeasuredRoom:
    return measure_room(take().labeled_capture())


def true_ghosts() -> np.ndarray:
    return np.isfinite(take().points[..., 0]) & (take().labels < 0)


@pytest.mark.parametrize("measured", [unlabeled, labeled])
def test_gaps_ghosts_and_merging_are_those_of_the_truth(measured):
    room, present = measured(), take().markers_present()
    gaps = run_lengths(~present, inside=True) / take().rate
    assert room.num_markers == 38 and room.rate == take().rate
    assert room.missing == pytest.approx(1.0 - present.mean(), rel=0.2)
    assert len(room.gaps) == pytest.approx(len(gaps), rel=0.2)
    assert room.gap_time == pytest.approx(gaps.mean(), rel=0.2)
    assert room.ghosts == pytest.approx(true_ghosts().sum(axis=1).mean(), rel=0.2)
    assert room.nearest == pytest.approx(LOSSES["min_distance"], rel=0.1)
    assert not any("ghosts" in one for one in room.untold)


def test_labels_tell_gaps_exactly_and_ids_that_last():
    present = take().markers_present()
    assert labeled().missing == pytest.approx(1.0 - present.mean(), abs=1e-12)
    assert sorted(labeled().gaps) == pytest.approx(sorted(run_lengths(~present, inside=True) / take().rate))
    assert labeled().lasting_ids is True and unlabeled().lasting_ids is False
    assert labeled().id_time == pytest.approx(run_lengths(present).mean() / take().rate)


@pytest.mark.parametrize("noise", [0.0003, 0.002])
def test_noise_is_told_from_motion(noise, rng):
    still = simulate_take(num_frames=600, optics={"noise": 0.0, "dropout": 0.0, "blob_loss": 0.0})
    capture = still.capture()
    noisy = capture.positions + noise * rng.standard_normal(capture.positions.shape)
    assert measure_room(Capture(capture.names, noisy, capture.rate)).noise == pytest.approx(noise, rel=0.1)


def test_points_in_another_order_in_each_frame_tell_the_same(rng):
    capture = simulate_take("free", num_frames=300, seed=2).capture()
    mixed = np.full((300, 2 * capture.positions.shape[1], 3), np.nan)
    for t, cloud in enumerate(capture.positions):
        order = rng.permutation(len(cloud))  # odd frames in other columns, as of fresh IDs
        mixed[t, t % 2 :: 2] = cloud[order]
    names = tuple(f"*{number}" for number in range(mixed.shape[1]))
    usual, fresh = measure_room(capture), measure_room(Capture(names, mixed, capture.rate))
    assert fresh.num_markers == usual.num_markers == 38
    assert fresh.missing == pytest.approx(usual.missing, abs=0.005)
    assert fresh.id_time == pytest.approx(1.0 / capture.rate)


def test_several_captures_count_together():
    both = measure_room([take().labeled_capture(), take()])
    assert both.num_frames == labeled().num_frames + unlabeled().num_frames
    assert both.gaps == labeled().gaps + unlabeled().gaps


def test_a_recording_that_was_cut_off_is_a_capture(tmp_path):
    part = tmp_path / "live.npz.part"
    take().save(tmp_path / "live.npz")
    (tmp_path / "live.npz").rename(part)
    assert repr(measure_room(part)) == repr(unlabeled())


def test_what_a_short_labeled_capture_does_not_tell_is_said():
    source = take().labeled_capture()
    markers = Capture(source.names[:5], source.positions[:30, :5], source.rate)
    room = measure_room(markers)
    assert room.ghosts is None and room.ghost_time is None and room.gap_time is None
    told = "\n".join(room.untold)
    assert "every point is a marker's" in told and "how long gaps last" in told and "are short" in told


def test_a_capture_without_a_hand_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="no marker stays for half of the frames"):
        measure_room(Capture(("a", "b"), np.full((50, 2, 3), np.nan), 100.0))
    one = np.full((50, 2, 3), np.nan)
    one[:, 0] = [0.1, 0.2, 1.0]
    with pytest.raises(CaptureError, match="only one marker stays for half of the frames"):
        measure_room(Capture(("a", "b"), one, 100.0))
    with pytest.raises(CaptureError, match="no capture was given"):
        measure_room([])


@pytest.mark.skipif(not REAL.exists(), reason="needs the recordings of other labs")
@pytest.mark.parametrize("name", ["arm-h", "grasp-c007", "grasp-c009", "grasp-d015"])
def test_gaps_of_real_recordings_are_those_of_a_count(name):
    file = np.load(REAL / f"{name}.npz")
    points, rate = file["places"].astype(float), float(file["rate"])
    room = measure_room(Capture(tuple(map(str, file["names"])), points, rate))
    missing = np.isnan(points[..., 0])
    assert room.missing == pytest.approx(missing.mean(), abs=1e-12)
    assert sorted(room.gaps) == pytest.approx(sorted(run_lengths(missing, inside=True) / rate))
    assert room.num_markers == points.shape[1] and room.ghosts is None


@pytest.mark.skipif(not SIG18.exists(), reason="needs Mocap_SIG18_Data")
def test_the_noise_of_published_markers_is_found():
    found = sorted((SIG18 / "User1" / "capture2").glob("*_right.trc"))[:3]
    room = measure_room([read_capture(one) for one in found])
    assert room.num_markers == 19 and 0.001 < room.noise < 0.002
