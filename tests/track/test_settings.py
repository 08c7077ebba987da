"""Settings of tracking are given whole or by name, and come back from a take."""

from __future__ import annotations

import json

import pytest

from gloves import load_layout
from gloves.fit import nominal_fit
from handsim.errors import ArgumentError
from track import TrackerConfig, TrackSettings
from track.config import BOTH


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


def test_fields_that_are_named_differ_from_the_settings():
    settings = TrackSettings(size="L", glove="dense19")
    assert TrackSettings.of(settings, {"size": "S"}).record() == {**settings.record(), "size": "S"}
    assert TrackSettings.of(None, {}).hands == BOTH
    with pytest.raises(ArgumentError, match=r"unknown setting of tracking 'glvoe' .* valid names: glove"):
        TrackSettings.of(None, {"glvoe": "dense19"})
    with pytest.raises(ArgumentError, match="settings is 'dense19', expected a TrackSettings"):
        TrackSettings.of("dense19", {})  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="unknown setting of tracker 'noise'"):
        TrackSettings.from_json({"tracker": {"noise": 1.0}})
