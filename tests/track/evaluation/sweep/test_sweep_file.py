"""The file of a sweep: what it may say, and what is told of mistakes."""

from __future__ import annotations

import pytest

from handsim.errors import HandSimError
from track.evaluation.sweep.cells import cells_of
from track.evaluation.sweep.sweep_file import Sweep, SweepError, load_sweep


def test_an_empty_file_is_the_paper_s_glove_and_rig(tmp_path):
    path = tmp_path / "sweep.toml"
    path.write_text("")
    assert load_sweep(path) == Sweep()


def test_files_are_looked_for_beside_it_and_names_stay(tmp_path):
    path = tmp_path / "sweep.toml"
    path.write_text(
        'gloves = ["dense19", "mine.toml"]\nrigs = ["eight"]\n[vary]\n"simulate.kind" = ["free"]\n'
    )
    sweep = load_sweep(path)
    assert sweep.gloves == ("dense19", str(tmp_path / "mine.toml"))
    assert (sweep.rigs, sweep.vary) == (("eight",), {"simulate.kind": ("free",)})


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("gloves = [", "not a TOML file"),
        (
            'glove = "dense19"',
            "unknown key 'glove' (did you mean 'gloves'?); valid names: gloves, rigs, people",
        ),
        ('gloves = "dense19"', 'gloves is "dense19", expected a list of one value or more'),
        ("gloves = [1]", "gloves has 1, expected names in quotes"),
        ("people = [0, 1, 0]", "people has 0 twice"),
        ("people = [-1]", "people has -1, expected whole numbers, 0 or more"),
        ("seeds = [true]", "seeds has true, expected whole numbers, 0 or more"),
        ("seeds = []", "seeds is [], expected a list of one value or more"),
        ("seeds = [0, 1]", "seeds are of trainings, and there is no [train]; people varies captures"),
        ("train = 3", "train is 3, expected a table [train]"),
        ("[generate]\nnum_frames = 100", "[generate] has no use without [train]"),
        ("[simulate]\nseed = 3", "[simulate] seed is given, expected the list seeds and people at the top"),
        ("[vary]\nrig_share = [0, 1]", "[vary] has the key 'rig_share', expected a setting's name after its"),
        (
            '[vary]\n"train.rig_share" = [0]',
            "[vary] has the key 'train.rig_share', but there is no table [train]",
        ),
        ('[vary]\n"simulate.glove" = ["a"]', "expected the list gloves at the top"),
        ('[vary]\n"simulate.kind" = "free"', 'simulate.kind is "free", expected a list'),
    ],
)
def test_mistakes_are_told_with_the_file(tmp_path, text, sentence):
    path = tmp_path / "sweep.toml"
    path.write_text(text)
    with pytest.raises(SweepError) as error:
        load_sweep(path)
    assert str(error.value).startswith(f"{path}: ") and sentence in str(error.value)


@pytest.mark.parametrize(
    ("settings", "vary", "sentence"),
    [
        ({"train": {"sample": 3}}, {}, "train has an unknown key 'sample' (did you mean 'samples'?)"),
        ({"train": {}}, {"train.samples": ("x",)}, 'train.samples is "x": expected int, got str'),
        (
            {},
            {"simulate.kind": ("hand",)},
            "unknown simulate.kind 'hand' (did you mean 'hand-pen'?); valid names: single-hand",
        ),
        ({"track": {"users": "me"}}, {}, "unknown track.users 'me'; valid names: uncalibrated, calibrated"),
        ({"track": {"tracker": {"search": {"x": 1}}}}, {}, "track.tracker has an unknown key 'search'"),
        ({"generate": {"num_frames": 0}, "train": {}}, {}, "num_frames is 0, expected at least 1"),
    ],
)
def test_settings_are_checked_before_anything_is_made(settings, vary, sentence):
    with pytest.raises(HandSimError) as error:
        cells_of(Sweep(settings=settings, vary=vary))
    assert sentence in str(error.value)


def test_too_many_cells_are_refused_at_once():
    seeds = tuple(range(1000))
    with pytest.raises(HandSimError, match="the sweep has 1000000 cells, expected at most 10000"):
        cells_of(Sweep(people=seeds, seeds=seeds, settings={"train": {}}))
