"""Cells are the product of the lists, and share the steps that are the same for them."""

from __future__ import annotations

import dataclasses

from gloves.layout import load_layout, save_layout
from track.evaluation.sweep.cells import cells_of, steps_of
from track.evaluation.sweep.sweep_file import Sweep

SWEEP = Sweep(
    gloves=("dense19", "sparse13"),
    rigs=("figure5", "eight"),
    people=(5, 6, 7),
    seeds=(0, 1),
    settings={"generate": {"num_frames": 100}, "train": {"samples": 256}, "simulate": {"num_frames": 10}},
    vary={"train.rig_share": (0, 0.5), "simulate.kind": ("single-hand", "hand-hand")},
)


def test_steps_are_shared():
    cells = cells_of(SWEEP)
    sets, trainings, measures = steps_of(cells)
    assert len(cells) == len(measures) == 2 * 2 * 3 * 2 * 2 * 2
    assert len(sets) == 2 * 2 * 2 and len(trainings) == 2 * len(sets)
    assert {step.set.name for step in trainings} == {step.name for step in sets}
    first = cells[0]
    assert first.varied == {
        "glove": "dense19",
        "rig": "figure5",
        "train.rig_share": 0,
        "simulate.kind": "single-hand",
        "seed": 0,
        "person": 5,
    }
    assert [cell.varied["person"] for cell in cells[:4]] == [5, 6, 7, 5]


def test_every_setting_reaches_its_step():
    for cell in cells_of(SWEEP):
        varied, capture, training = cell.varied, cell.measure.capture, cell.measure.labeler
        glove, rig, seed = varied["glove"], varied["rig"], varied["seed"]
        assert (capture.glove, capture.rig, capture.seed) == (glove, rig, varied["person"])
        assert (capture.kind, capture.num_frames) == (varied["simulate.kind"], 10)
        assert (training.config.rig_share, training.config.seed) == (varied["train.rig_share"], seed)
        dataset = training.set.config
        assert (dataset.glove, dataset.rig, dataset.seed) == (glove, rig, seed)
        assert (dataset.num_frames, training.config.samples) == (100, 256)


def test_a_table_may_name_another_rig_for_its_command():
    settings = {"generate": {"rig": "eight"}, "train": {}}
    (cell,) = cells_of(Sweep(settings=settings))
    assert cell.measure.labeler.set.config.rig == "eight" and cell.measure.capture.rig == "figure5"


def test_names_change_with_what_decides_a_result_and_with_nothing_else(tmp_path):
    def names(sweep: Sweep) -> list[set[str]]:
        return [{step.name for step in steps} for steps in steps_of(cells_of(sweep))]

    sets, trainings, measures = names(SWEEP)
    more = names(dataclasses.replace(SWEEP, people=(5, 6, 7, 8), seeds=(0, 1, 2)))
    assert sets < more[0] and trainings < more[1] and measures < more[2]
    longer = names(dataclasses.replace(SWEEP, settings=SWEEP.settings | {"train": {"samples": 512}}))
    assert longer[0] == sets and not longer[1] & trainings and not longer[2] & measures
    tracked = names(dataclasses.replace(SWEEP, settings=dict(SWEEP.settings) | {"track": {}}))
    assert tracked[:2] == [sets, trainings] and not tracked[2] & measures

    glove = tmp_path / "mine.toml"
    save_layout(glove, load_layout("dense19"))
    one = Sweep(gloves=(str(glove),), settings=SWEEP.settings)
    before = names(one)
    assert names(one) == before
    layout = load_layout(str(glove))
    moved = dataclasses.replace(layout.markers[0], along=0.4)
    save_layout(glove, dataclasses.replace(layout, markers=(moved, *layout.markers[1:])))
    assert all(not old & new for old, new in zip(before, names(one), strict=True))


def test_without_training_the_seed_is_no_column():
    (cell,) = cells_of(Sweep())
    assert cell.varied == {"glove": "dense19", "rig": "figure5", "person": 0} and cell.measure.labeler is None
