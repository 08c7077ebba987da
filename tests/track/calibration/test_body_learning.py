"""A body's markers out of a capture of it: right to hundredths of a millimeter, or a sentence."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

from gloves.captures.capture import Capture
from gloves.takes.take import Take
from handsim.errors import ArgumentError
from handsim.space.objects import named_object
from handsim.space.transforms import rigid_fit
from track.calibration.body_learning import learn_body
from track.calibration.frames import CalibrationError
from train.simulation.takes import simulate_take

FRAMES = 240


@functools.cache
def twin() -> Take:
    return simulate_take(kind="hand-controller", num_frames=FRAMES)


def capture_of(points: np.ndarray) -> Capture:
    points = points[:, np.isfinite(points[..., 0]).any(axis=0)]
    return Capture(tuple(f"*{number}" for number in range(points.shape[1])), points, 120.0)


def controller(rng, ghosts: float = 0.0) -> Capture:
    """The controller alone, as the room saw it in a hand: columns end where markers are hidden."""
    take = twin()
    body = np.where((take.labels >= take.hand_labels[-1].stop)[..., None], take.points, np.nan)
    false = rng.uniform(-0.2, 0.2, (FRAMES, 2, 3)) + np.nanmean(body, axis=(0, 1))
    false[rng.random((FRAMES, 2)) >= ghosts] = np.nan
    return capture_of(np.concatenate([body, false], axis=1))


def off(found: np.ndarray, true: np.ndarray) -> float:
    """Largest distance from the true markers [m], in the order and place that suit best."""
    errors = []
    for order in itertools.permutations(range(len(true))):
        rotation, moved = rigid_fit(found, true[list(order)])
        errors.append(np.linalg.norm(found @ rotation.T + moved - true[list(order)], axis=1).max())
    return min(errors)


@pytest.mark.parametrize("ghosts", [0.0, 0.1])
def test_all_markers_are_where_they_are(ghosts, rng):
    capture = controller(rng, ghosts)
    body = learn_body(capture, "wand")
    assert body.name == "wand" and body.marker_names == tuple(f"Marker{n}" for n in range(1, 7))
    assert off(body.positions, named_object("controller").markers) < 0.00005
    np.testing.assert_allclose(body.positions.mean(axis=0), 0.0, atol=1e-12)


def test_one_frame_is_not_enough_to_be_so_right(rng):
    """What averaging over the frames is for."""
    capture = controller(rng)
    whole = capture.positions[np.isfinite(capture.positions[..., 0]).sum(axis=1) == 6][0]
    assert off(whole[np.isfinite(whole[:, 0])], named_object("controller").markers) > 0.0001


def test_captures_of_anything_else_are_told(rng):
    take = twin()
    hands = np.where(((take.labels >= 0) & (take.labels < 38))[..., None], take.points, np.nan)
    with pytest.raises(
        CalibrationError, match="points per frame, expected 3 to 20: one body and nothing else"
    ):
        learn_body(capture_of(hands), "wand")
    fingers = np.where(np.isin(take.labels, (3, 6, 9, 12, 15))[..., None], take.points, np.nan)
    with pytest.raises(
        CalibrationError, match="% of the points keep their positions on one rigid body, expected"
    ):
        learn_body(capture_of(fingers), "wand")
    with pytest.raises(CalibrationError, match="a capture of 0 points per frame"):
        learn_body(Capture(("a",), np.full((5, 1, 3), np.nan), 120.0), "wand")
    line = np.linspace(0, 0.1, 4)[:, None] * np.array([1.0, 0.0, 0.0]) + rng.normal(0, 1e-5, (9, 4, 3))
    with pytest.raises(CalibrationError, match="wand: its markers lie on one line"):
        learn_body(capture_of(line), "wand")
    with pytest.raises(ArgumentError, match="millimeters"):
        learn_body(capture_of(1e3 * controller(rng).positions), "wand")
