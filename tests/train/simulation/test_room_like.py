"""Simulated captures and training sets like a lab's: what was put in comes out again."""

from __future__ import annotations

import numpy as np
import pytest

from gloves.captures.capture import run_lengths
from train import GenerateSettings, RoomLike, SimulateSettings, measure_room, room_like, simulate_take
from train.simulation.measured_room import measure_simulated

OPTICS = {"noise": 0.4, "dropout": 0.1, "dropout_length": 5.0, "dropout_cameras": 6, "min_distance": 0.012}
TRIAL = simulate_take(
    "free", num_frames=1200, optics=OPTICS, strays={"number": 8.0, "shown": 0.1, "hidden": 0.8}
)


@pytest.fixture(scope="module")
def like() -> RoomLike[SimulateSettings]:
    return room_like(TRIAL.labeled_capture(), SimulateSettings("free", num_frames=1200))


def test_a_capture_has_the_noise_gaps_ghosts_and_merging_of_the_trial(like):
    found, made = (
        measure_room(TRIAL.labeled_capture()),
        measure_simulated(simulate_take(settings=like.settings)),
    )
    assert made.noise == pytest.approx(found.noise, rel=0.2)
    assert made.missing == pytest.approx(found.missing, rel=0.2)
    assert made.gap_time == pytest.approx(found.gap_time, rel=0.2)
    assert made.ghosts == pytest.approx(found.ghosts, rel=0.35)  # the number of spots is drawn
    assert made.nearest == pytest.approx(found.nearest, rel=0.1)
    assert like.settings.optics.noise == pytest.approx(OPTICS["noise"], rel=0.1)
    assert [row[0] for row in like.table][:2] == ["noise per axis [mm]", "markers missing [%]"]


def test_other_people_and_motions_have_the_losses_too(like):
    missing = [
        1.0 - simulate_take(settings=like.settings, seed=seed).markers_present().mean() for seed in (5, 6, 7)
    ]
    assert 0.02 < np.mean(missing) < 0.08, missing


def test_settings_that_are_given_hold():
    given = SimulateSettings("free", optics={"noise": 0.05}, strays={"number": 0.0})
    chosen = room_like(TRIAL, given)
    assert chosen.settings.optics.noise == 0.05 and chosen.settings.strays.number == 0.0
    assert "optics.noise" not in chosen.values and "strays.number" not in chosen.values
    (first, *_) = chosen.sentences(chosen.settings)
    assert first.startswith("from the trial: optics.blob_loss 0, ") and "optics.noise" not in first


def test_a_labeled_trial_without_gaps_leaves_losses_and_ghosts_as_they_are():
    clean = simulate_take("single-hand", num_frames=300, optics={"dropout": 0.0, "blob_loss": 0.0})
    chosen = room_like(clean.labeled_capture(), SimulateSettings("hand-hand"))
    assert set(chosen.values) <= {"optics.noise", "optics.min_distance"}, "gaps may have been filled"
    assert chosen.settings.strays == SimulateSettings().strays
    told = "\n".join(chosen.untold)
    assert "ghosts: every point is a marker's" in told and "whether they were filled" in told


def test_a_training_set_has_the_losses_and_ghosts_of_the_trial():
    chosen = room_like(TRIAL.labeled_capture(), GenerateSettings(seed=3))
    figures = {name: (float(found), float(made)) for name, found, made in chosen.table}
    present = TRIAL.markers_present()
    assert run_lengths(~present).size
    assert figures["markers missing [%]"][0] == pytest.approx(100 * (1 - present.mean()), rel=0.01)
    for name, (found, made) in figures.items():
        assert made == pytest.approx(found, rel=0.2), name
    assert chosen.settings.seed == 3 and chosen.settings.ghosts.stray_rate != 0.8
