"""Settings of tracking are given whole or by name, and come back from a take."""

from __future__ import annotations

import dataclasses
import json
import warnings

import numpy as np
import pytest

from gloves import load_layout
from gloves.fit import nominal_fit
from handsim.errors import ArgumentError
from track import TrackerConfig, TrackSettings
from track.settings import TrackerSetup


def test_settings_come_back_from_json():
    settings = TrackSettings(
        glove="sparse13", hands=("left",), size="L", bodies=("mug",), tracker=TrackerConfig(fewest_labels=5)
    )
    again = TrackSettings.from_json(json.loads(json.dumps({**settings.record(), "capture": "take.c3d"})))
    assert again.record() == settings.record()
    assert again.tracker == settings.tracker and again.glove == "sparse13"


def test_objects_are_recorded_by_name():
    layout = load_layout("dense19")
    hands = [nominal_fit(layout, "M", "right")]
    record = TrackSettings(glove=layout, hands=hands).record()
    assert (record["glove"], record["hands"], record["labeler"]) == ("dense19", ["right"], None)


def test_hands_in_a_named_glove_get_the_labeler_of_its_design():
    worn = dataclasses.replace(load_layout("dense19"), name="worn")
    settings = TrackSettings(glove="dense19", hands=[nominal_fit(worn, "M", "right")])
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of a labeler that is learned anew
        assert TrackerSetup.of(settings).user.layout == worn


def test_hands_that_are_not_named_are_those_of_the_glove():
    glove = load_layout("dense19")
    for sides in (("right",), ("left", "right")):
        worn = dataclasses.replace(glove, sides=sides)
        setup = TrackerSetup.of(TrackSettings(glove=worn, labeler="dense19"))
        assert setup.user.sides == sides[::-1] and setup.settings["hands"] == list(sides[::-1])


def test_fields_that_are_named_differ_from_the_settings():
    settings = TrackSettings(size="L", glove="dense19")
    assert TrackSettings.of(settings, {"size": "S"}).record() == {**settings.record(), "size": "S"}
    assert TrackSettings.of(None, {}).hands is None
    with pytest.raises(ArgumentError, match=r"unknown setting of tracking 'glvoe' .* valid names: glove"):
        TrackSettings.of(None, {"glvoe": "dense19"})
    with pytest.raises(ArgumentError, match="settings is 'dense19', expected a TrackSettings"):
        TrackSettings.of("dense19", {})  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="unknown setting of tracker 'noise'"):
        TrackSettings.from_json({"tracker": {"noise": 1.0}})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"known": {"index_PIP": 60.0}}, "index_PIP_flexion"),
        ({"known": {"both:index_PIP_flexion": 60.0}}, "side of a known angle"),
        ({"known": {"index_PIP_flexion": 600.0}}, "from -180 to 180"),
        ({"known": {"index_PIP_flexion": "60"}}, "known: index_PIP_flexion is '60', expected a number"),
        ({"known": "index_PIP_flexion=60"}, "expected names with their values"),
        ({"known": {"index_PIP_flexion": 60.0}, "smooth": False}, "smooth=False"),
    ],
)
def test_known_angles_are_of_joints_and_need_poses_over_time(options, message):
    with pytest.raises(ArgumentError, match=message):
        TrackSettings(**options)


def test_known_angles_may_be_numbers_of_numpy():
    angles = {"index_PIP_flexion": np.float32(30.0), "left:ring_PIP_flexion": np.int64(45)}
    record = TrackSettings(known=angles).record()
    assert record["known"] == {"index_PIP_flexion": 30.0, "left:ring_PIP_flexion": 45}
