"""Points that are followed from frame to frame, by their places and by their labels."""

from __future__ import annotations

import numpy as np
import pytest

from track.finder.links import previous_points

FRAMES, MARKERS = 20, 6
STARTS = np.arange(FRAMES + 1) * MARKERS
SPACING = 0.02  # [m] between neighboring markers


def row_of_markers(step: float) -> np.ndarray:
    """A row of markers (T, M, 3) [m] that turns back every second frame."""
    points = np.zeros((FRAMES, MARKERS, 3))
    points[..., 0] = SPACING * np.arange(MARKERS)
    points[..., 0] += step * np.array([0.0, 1.0, 1.0, 0.0])[np.arange(FRAMES) % 4, None]
    return points


def followed(points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Marker of the frame before that each point (T, M) was, -1 for none."""
    previous = previous_points(points.reshape(-1, 3), STARTS, labels.ravel(), 0.03, 0.03).reshape(
        labels.shape
    )
    return np.where(previous >= 0, previous - STARTS[np.maximum(np.arange(FRAMES) - 1, 0), None], -1)


def test_slow_points_are_followed_through_wrong_labels():
    labels = np.tile(np.arange(MARKERS), (FRAMES, 1))
    labels[7, [2, 3]] = 3, 2
    links = followed(row_of_markers(0.002), labels)
    np.testing.assert_array_equal(links[1:], np.tile(np.arange(MARKERS), (FRAMES - 1, 1)))


def test_points_that_move_as_far_as_their_neighbors_are_apart_are_followed_by_their_labels():
    points, labels = row_of_markers(0.018), np.tile(np.arange(MARKERS), (FRAMES, 1))
    np.testing.assert_array_equal(followed(points, labels)[1:], np.tile(np.arange(MARKERS), (FRAMES - 1, 1)))
    without = followed(points, np.full_like(labels, -1))
    assert (without[1:] != np.arange(MARKERS)).any()


def test_an_ambiguous_step_leads_to_the_same_label():
    points, labels = row_of_markers(0.0), np.tile(np.arange(MARKERS), (FRAMES, 1))
    points[10:, :, 0] += 0.45 * SPACING
    labels[10:] = (labels[10:] + 1) % MARKERS
    np.testing.assert_array_equal(followed(points, labels)[10, 1:4], [2, 3, 4])


@pytest.mark.parametrize("step", [0.031, 0.1])
def test_nothing_is_followed_beyond_its_reach(step):
    labels = np.full((FRAMES, MARKERS), -1)
    points = row_of_markers(0.0)
    points[1::2, :, 1] += step
    assert (followed(points, labels) == -1).all()
