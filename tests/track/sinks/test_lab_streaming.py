"""A stream of the Lab Streaming Layer, as pylsl's inlet sees it."""

from __future__ import annotations

import numpy as np

from track.sinks import channels_of, sample_of


def test_every_channel_has_a_name_and_a_unit(message):
    one = message(5)
    channels = list(channels_of(one.header))
    sample = dict(zip([channel.label for channel in channels], sample_of(one), strict=True))
    assert len(sample) == len(channels), "no name twice"
    assert (sample["frame"], sample["time"]) == (5, one.time)
    assert sample["left_wrist_position_y"] == one.hands[1].position[1]
    assert (
        sample["right_index_PIP_flexion"] == one.hands[0].angles[one.header.angles.index("index_PIP_flexion")]
    )
    assert sample["right_ring_tip_z"] == one.hands[0].positions[one.header.positions.index("ring_tip"), 2]
    units = {channel.label: channel.unit for channel in channels}
    assert units["right_index_PIP_flexion"] == "radians" and units["mug_position_x"] == "meters"


def test_a_lost_hand_is_nan(message):
    one = message(lost=True)
    labels = [channel.label for channel in channels_of(one.header)]
    sample = sample_of(one)
    assert sample[labels.index("left_status")] == 3.0
    left = [label.startswith(("left_", "mug_", "lag")) and not label.endswith("status") for label in labels]
    assert np.isnan(sample[left]).all(), "and it did not come live"
    assert np.isfinite(sample[~np.array(left)]).all()


def test_an_inlet_gets_samples_and_the_description(message, tmp_path):
    """In a process of its own: the library reads its configuration once; this one stays on the machine."""
    import json
    import os
    import subprocess
    import sys
    from pathlib import Path

    settings = tmp_path / "lsl_api.cfg"
    settings.write_text(
        "[multicast]\nResolveScope = machine\n[lab]\nKnownPeers = {127.0.0.1}\n[log]\nlevel = -3\n"
    )
    root = Path(__file__).resolve().parents[3]
    code = """
import json, sys, time
sys.path.insert(0, "tests/track/sinks")
import pylsl
from conftest import make_message
from track.sinks import open_sink
sink = open_sink("lsl:hands")
sink.send(make_message(0))
(info,) = pylsl.resolve_byprop("name", "hands", timeout=120.0)
inlet = pylsl.StreamInlet(info)
inlet.open_stream(timeout=120.0)
for number in range(1, 6):
    sink.send(make_message(number))
samples = [inlet.pull_sample(timeout=120.0)[0] for _ in range(5)]
described = inlet.info(timeout=120.0)
labels, units = described.get_channel_labels(), described.get_channel_units()
print(json.dumps([samples, labels, units, described.type(), described.desc().child_value("schema")]))
sink.close()
"""
    environment = {**os.environ, "LSLAPICFG": str(settings), "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    samples, labels, units, kind, schema = json.loads(done.stdout.splitlines()[-1])
    assert [sample[0] for sample in samples] == [1, 2, 3, 4, 5] and (kind, schema) == ("MoCap", "1")
    channels = list(channels_of(message().header))
    assert labels == [channel.label for channel in channels]
    assert [unit or "" for unit in units] == [channel.unit for channel in channels]
    np.testing.assert_array_equal(samples[-1], sample_of(message(5)))
