"""Touches are found where the thumb holds still at a fingertip, and their points lie between the pads."""

from __future__ import annotations

import numpy as np
import pytest

from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import DIGITS
from poses.shapes import resting_angles
from poses.touch import touching_angles
from track.calibration.contacts import (
    PAD_COMPRESSION,
    ContactGeometry,
    contact_geometry,
    contact_weights,
    find_touches,
    initialize_contacts,
)
from track.calibration.skin_coordinates import SkinPatch

RATE = 60.0


@pytest.fixture(scope="module")
def model():
    return HandModel.named("M")


def visits(model, fingers, hold):
    """From rest to each finger's touch and back, holding there for some frames; where the holds are."""
    rest, parts, holds = resting_angles(model), [], []
    for finger in fingers:
        touch = touching_angles(model, finger)
        share = (0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 30)))[:, None]
        parts += [rest + share * (touch - rest), np.tile(touch, (hold, 1)), touch + share * (rest - touch)]
        end = sum(len(part) for part in parts) - 30
        holds.append((end - hold, end))
    return np.concatenate(parts), holds


def geometry_of(model, touches, angles):
    bones = model.forward_kinematics(join_qpos(angles[[frame for frame, _ in touches]]))
    contacts = initialize_contacts(model, touches, bones)
    faces = np.concatenate([contacts.thumb_coordinates.faces, contacts.finger_coordinates.faces])
    return contacts, contact_geometry(
        contacts, SkinPatch(faces).corners(model.surface.vertices), model, bones
    )


def test_every_touch_is_found_once(model):
    fingers = ("index", "ring", "index")
    angles, holds = visits(model, fingers, hold=20)
    touches = find_touches(model, angles, np.ones((len(angles), 5), dtype=bool), RATE)
    held = [touch for touch in touches if any(a - 3 <= touch[0] <= b + 3 for a, b in holds)]
    assert [finger for _, finger in held] == list(fingers)


def test_a_digit_that_lacks_markers_touches_nothing(model):
    angles, _ = visits(model, ("index",), hold=20)
    trusted = np.ones((len(angles), 5), dtype=bool)
    trusted[:, DIGITS.index("index")] = False
    assert all(finger != "index" for _, finger in find_touches(model, angles, trusted, RATE))


def test_a_wave_past_the_finger_is_no_touch(model):
    angles, _ = visits(model, ("middle",), hold=1)
    touches = find_touches(model, angles, np.ones((len(angles), 5), dtype=bool), 240.0)
    assert not [touch for touch in touches if touch[1] == "middle" and 20 < touch[0] < 45]


@pytest.mark.parametrize("finger", ["index", "middle", "ring", "little"])
def test_pads_of_a_touch_press_as_much_as_is_held(finger, model):
    angles = touching_angles(model, finger)[None]
    contacts, geometry = geometry_of(model, [(0, finger)], angles)
    assert geometry.facing.all()
    assert abs(geometry.gaps[0]) < 0.0015
    assert DIGITS[contacts.fingers[0]] == finger


def test_gaps_grow_as_the_thumb_leaves(model):
    touch, rest = touching_angles(model, "index"), resting_angles(model)
    angles = touch + np.array([[0.0], [0.1], [0.2], [0.3]]) * (rest - touch)
    _, geometry = geometry_of(model, [(number, "index") for number in range(4)], angles)
    assert (np.diff(geometry.gaps) > 0.0005).all()
    assert PAD_COMPRESSION == 0.001  # what gaps count from, told in the document


def test_an_odd_touch_is_not_trusted():
    gaps = np.array([0.003, 0.0032, 0.0029, 0.009, 0.02])
    fingers = np.array([1, 1, 1, 1, 2])
    geometry = ContactGeometry(np.zeros((5, 3)), gaps, np.array([True, True, True, True, False]))
    weights = contact_weights(geometry, fingers)
    assert weights[:3].min() > 0.9
    assert weights[3] < 0.05
    assert weights[4] == 0.0
