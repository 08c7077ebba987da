"""Training sets and takes of gloves, samplers and rigs that are objects."""

from __future__ import annotations

import json

import numpy as np
import pytest

from gloves import MarkerLayout, MarkerPlace
from handsim import HandSimWarning, load_rig
from handsim.errors import ArgumentError, DatasetError
from poses import sample_poses
from train import generate_dataset, simulate_take

DIGITS = ("thumb", "index", "middle", "ring", "little")
LAYOUT = MarkerLayout(
    "mine",
    (
        *(MarkerPlace(f"{digit}_tip", f"{digit}_distal", 0.5, 0.0) for digit in DIGITS),
        MarkerPlace("back", "palm", 0.5, 0, 0.2),
    ),
    radius=0.004,
)
ALONE = {"alone": 1.0}


def fists(model, num_poses, *, rng):
    low, high = model.skeleton.ranges.T
    return low + (high - low) * rng.beta(4, 2, (num_poses, 20))


def above(model, num_poses, *, rng):
    qpos = sample_poses(model, num_poses, rng=rng)
    qpos[:, :3] = 0.1, 0.2, 1.1
    return qpos


def degrees(model, num_poses, *, rng):
    return np.full((num_poses, 20), 45.0)


class Flat:
    def __call__(self, model, num_poses, *, rng):
        return np.zeros((num_poses, 20))


def make(out, **options):
    return generate_dataset(
        out, **{"glove": LAYOUT, "num_frames": 60, "scenes": ALONE, "workers": 1, **options}
    )


def test_a_set_of_objects_is_what_they_say(tmp_path):
    dataset = make(tmp_path / "set", sampler=fists, rig=load_rig("six"))
    assert len(dataset) == 60 and dataset.layout == LAYOUT and dataset.marker_names == LAYOUT.names
    settings = json.loads((tmp_path / "set" / "config.json").read_text())
    assert settings["sampler"] == f"{__name__}:fists" and settings["glove"] == "mine"
    assert settings["rig"] == "six", "a rig that comes with the package is its name"
    again = make(tmp_path / "other", sampler=fists, rig="six")
    assert again.rows().tobytes() == dataset.rows().tobytes()
    assert len(make(tmp_path / "set", sampler=fists, rig="six", num_frames=90)) == 90, "it grows"
    with pytest.raises(DatasetError, match=r"begun with other settings \(sampler: "):
        make(tmp_path / "set", sampler=Flat(), rig="six", num_frames=90)


def test_whole_poses_say_where_the_hands_are(tmp_path):
    wrists = make(tmp_path / "placed", sampler=above).rows()["qpos"][:, :7]
    np.testing.assert_allclose(wrists, np.tile([0.1, 0.2, 1.1, 1, 0, 0, 0], (60, 1)), atol=1e-6)
    spread = make(tmp_path / "anywhere", sampler=sample_poses_at_the_origin).rows()["qpos"][:, :3]
    assert np.ptp(spread, axis=0).min() > 0.3 and np.abs(spread.mean(axis=0) - [0, 0, 1.1]).max() < 0.2


def sample_poses_at_the_origin(model, num_poses, *, rng):
    return sample_poses(model, num_poses, rng=rng)


def test_a_sampler_that_no_process_can_import_is_told_when_several_were_asked_for(tmp_path):
    with pytest.warns(HandSimWarning, match="cannot be imported by other processes, so that this one does"):
        dataset = make(
            tmp_path / "set", sampler=lambda model, count, *, rng: np.zeros((count, 20)), workers=2
        )
    assert len(dataset) == 60


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"sampler": 5}, "sampler is 5, expected a function (model, num_poses, *, rng)"),
        ({"sampler": degrees}, "holds an angle of 45 rad; are these degrees?"),
        ({"scenes": {"togeter": 1}}, "unknown setting of scenes 'togeter' (did you mean 'together'?)"),
        ({"scenes": 3}, "scenes is 3, expected a SceneMix"),
        ({"volum": 1.0}, "unknown setting of a training set 'volum' (did you mean 'volume'?)"),
        ({"num_frames": "many"}, "num_frames is 'many', expected a whole number"),
    ],
)  # fmt: skip
def test_mistakes_are_told_before_anything_is_written(tmp_path, options, sentence):
    with pytest.raises(ArgumentError) as error:
        make(tmp_path / "set", **options)
    assert sentence in str(error.value) and not (tmp_path / "set").exists()


def test_a_take_of_objects():
    take = simulate_take("free", glove=LAYOUT, rig=load_rig("eight"), num_frames=4, hands="right", seed=1)
    assert take.num_frames == 4 and take.hands[0].layout.names == LAYOUT.names
    named = simulate_take("free", glove=LAYOUT, rig="eight", num_frames=4, hands=("right",), seed=1)
    np.testing.assert_array_equal(named.points, take.points)
    blind = simulate_take("free", glove=LAYOUT, num_frames=4, optics={"blob_loss": 0.9})
    assert blind.markers_present().mean() < 0.7
