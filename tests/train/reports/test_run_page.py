"""The page of a run: what it says, that a stopped run's is the whole run's, and that any glove has one."""

from __future__ import annotations

import dataclasses
import json
import shutil
from importlib import resources
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from gloves import MarkerLayout, MarkerPlace, load_layout
from gloves.layout import MAX_MARKERS, MIN_MARKERS
from handsim.hand.shape import BONES
from handsim.pages import picture
from tests.renames import fails_at
from tests.train.reports.conftest import pictures
from train import (
    LabelingReport,
    SetLabelerConfig,
    TrainSettings,
    evaluate_labeler,
    load_labeler,
    train_labeler,
)
from train.evaluation import (
    History,
    error_without,
    expected_calibration_error,
    macro_f1,
    percent,
    reliability,
)
from train.labelers.storage import CARD, WEIGHTS
from train.loop import CHECKPOINT, TrainingState, _first_held_out
from train.reports.hand_plot import MAX_LETTERS, short
from train.reports.run_page import (
    MODEL_CARD,
    PAGE,
    confusion_size,
    draw_confusion,
    draw_curves,
    draw_reliability,
    model_card,
    write_model_card,
    write_run_page,
)

pytestmark = pytest.mark.filterwarnings("error")  # matplotlib's, for a figure that does not fit
SMALL = TrainSettings(samples=2560, batch=128, network=SetLabelerConfig(width=16, gates=4, depth=1))
SHIPPED = json.loads(resources.files("train").joinpath("weights/dense19.json").read_text())


@pytest.fixture(scope="module")
def run(dataset, tmp_path_factory):
    """A whole run and its model card."""
    out = tmp_path_factory.mktemp("whole") / "run"
    return out, train_labeler(dataset, out, SMALL)


def test_what_takes_long_beside_the_samples_is_named(dataset, tmp_path, without_pictures):
    told = []
    train_labeler(dataset, tmp_path / "run", dataclasses.replace(SMALL, samples=256), on_step=told.append)
    told = [step for step in told if not step.startswith("loss ")]
    assert told[0] == "training set"
    assert told[-4:] == ["checkpoint", "pose prior", "held-out frames", "weights and report"]


def test_the_page_says_what_the_card_says(run):
    out, card = run
    text = (out / PAGE).read_text("utf-8")
    assert "<title>Labeler run</title>" in text
    assert "A set labeler for glove dense19 (19 markers), trained on 2,560 clouds of a set of 400" in text
    for figures in card["held_out_simulated"].values():
        for figure in ("slot_accuracy", "macro_f1", "calibration_error", "error_without_least_sure"):
            assert f"<td>{percent(figures[figure])}</td>" in text
    drawn = pictures(out / PAGE)
    assert len(drawn) == 4
    for one in drawn:
        assert len(list(ElementTree.fromstring(one).iter())) > 100
    assert load_labeler(out).marker_names == tuple(card["marker_names"])
    accuracies = torch.load(out / CHECKPOINT, weights_only=True)["history"]["accuracies"]
    assert accuracies[-1][-1] == card["held_out_simulated"]["occlude 5, ghosts 2"]["slot_accuracy"]


def test_figures_are_of_people_whom_training_did_not_see(dataset, run):
    out, card = run
    people = dataset.people()
    np.testing.assert_array_equal(people, np.arange(400) // 50)
    first = _first_held_out(people)
    assert set(people[:first]).isdisjoint(people[first:]) and card["held_out_people"] == 1
    assert "frames of 1 person whom training did not see" in (out / PAGE).read_text("utf-8")
    many = np.repeat(np.arange(400), 3)
    assert len(set(many[_first_held_out(many) :])) == 20
    assert _first_held_out(np.zeros(100, dtype=int)) == 98


def test_a_set_is_evaluated_as_its_rig_saw_it(dataset):
    seen, rows = evaluate_labeler("dense19", dataset), dataset.rows()
    missing = np.isnan(rows["observed"][..., 0]).mean()
    assert seen.figures["occlusion_ratio"] == pytest.approx(missing) and missing > 0.0
    ghosts = np.isfinite(rows["ghosts"][..., 0]).sum()
    assert seen.numbers["ghosts"] == ghosts > 0
    clean = evaluate_labeler("dense19", rows["markers"].astype(np.float64))
    assert clean.figures["slot_accuracy"] > seen.figures["slot_accuracy"] > 0.8
    assert (seen.grouped_by, seen.num_groups) == ("people", len(np.unique(dataset.people())))
    for name, (low, high) in seen.intervals().items():
        assert low < seen.figures[name] < high
    hard = evaluate_labeler("dense19", dataset, occlude=5, ghosts=2, every=2)
    assert hard.num_groups == seen.num_groups and hard.interval() is not None
    assert clean.interval() is None


def test_a_run_has_a_model_card_of_what_was_trained(run):
    out, _ = run
    text = (out / MODEL_CARD).read_text("utf-8")
    assert text.startswith("---\nlicense: unknown\n")
    assert "--glove THIS_FOLDER/glove.toml --labeler THIS_FOLDER" in text
    assert load_layout(out / "glove.toml").names == load_labeler(out).marker_names
    assert "400 of them, from `handsim generate` with\nseed 3, of which training saw 2,560 clouds" in text


def test_weights_card_and_page_are_all_new_or_all_old(dataset, tmp_path, monkeypatch, without_pictures):
    config = dataclasses.replace(SMALL, samples=256)
    train_labeler(dataset, tmp_path, config)
    names = [WEIGHTS, CARD, PAGE]
    for name in names:
        (tmp_path / name).write_text(f"older {name}")
    with monkeypatch.context() as patch:
        renamed = fails_at(patch, 3)
        with pytest.raises(OSError, match=PAGE):
            train_labeler(dataset, tmp_path, config)
    assert [file.name for file in renamed] == [CHECKPOINT, *names]
    assert [(tmp_path / name).read_text() for name in names] == [f"older {name}" for name in names]


def test_a_stopped_runs_page_is_the_whole_runs(dataset, run, tmp_path):
    class Stopped(Exception):
        pass

    def stop(done, total):
        if done in (896, 1792):
            raise Stopped

    out = tmp_path / "run"
    for _ in range(2):
        with pytest.raises(Stopped):
            train_labeler(dataset, out, SMALL, progress=stop, save_every=0.0)
    train_labeler(dataset, out, SMALL, save_every=0.0)
    whole, resumed = (torch.load(path / CHECKPOINT, weights_only=True)["history"] for path in (run[0], out))
    assert resumed["losses"] == whole["losses"]
    for history in (resumed, whole):
        done, minutes, _ = zip(*history["accuracies"], strict=True)
        assert list(minutes) == sorted(minutes) and minutes[-1] == history["minutes"] > 0.0
    assert [done for done, _, _ in whole["losses"]] == list(range(128, 2561, 128))
    assert done[-1] == 2560 and min(np.diff(done)) >= 128 and len(done) >= 7
    accuracies = [[accuracy for _, _, accuracy in history["accuracies"]] for history in (whole, resumed)]
    assert accuracies[0] == accuracies[1]
    assert (out / PAGE).read_bytes() == (run[0] / PAGE).read_bytes()


def test_looking_at_held_out_frames_leaves_the_training_alone(
    dataset, run, tmp_path, monkeypatch, without_pictures
):
    monkeypatch.setattr(TrainingState, "evaluate", lambda state, rows, names: None)
    train_labeler(dataset, tmp_path / "blind", SMALL)
    one, other = (torch.load(path / CHECKPOINT, weights_only=True) for path in (run[0], tmp_path / "blind"))
    for name, values in one["network"].items():
        assert torch.equal(values, other["network"][name])


def test_checkpoints_without_a_history_go_on(dataset, run, tmp_path, without_pictures):
    path = shutil.copytree(run[0], tmp_path / "run") / CHECKPOINT
    content = torch.load(path, weights_only=True)
    del content["history"]
    torch.save(content, path)
    train_labeler(dataset, tmp_path / "run", SMALL)
    assert len(pictures(tmp_path / "run" / PAGE)) == 4


def made_up(count: int, rng: np.random.Generator, *, perfect: bool = False) -> tuple[dict, LabelingReport]:
    """A card and a report of a glove with names that pages and formulas take for their own."""
    places = []
    for number in range(count):
        bone = BONES[number % len(BONES)].name
        across = 0.2 if bone == "palm" else 0.0
        along = 0.2 + 0.2 * (number // len(BONES))
        places.append(MarkerPlace(f"<b>${number}$&_{number}" + "^" * number, bone, along, 0.0, across))
    layout = MarkerLayout("<i>odd</i>", tuple(places), 0.003)
    confusion = rng.poisson(0.3, (count + 1, count + 1)) * (not perfect) + 500 * np.eye(count + 1, dtype=int)
    wrong = int(confusion.sum() - confusion.trace())
    right = np.arange(confusion.sum()) >= wrong
    confidences = rng.uniform(size=right.size)
    figures = {
        "slot_accuracy": 0.9, "point_accuracy": float(right.mean()), "occlusion_ratio": 0.1,
        "occlusion_recall": float("nan"), "ghost_ratio": 0.05, "macro_f1": macro_f1(confusion),
        "calibration_error": expected_calibration_error(confidences, right),
        "error_without_least_sure": error_without(confidences, right),
    }  # fmt: skip
    card = {
        "dataset": {"layout": dataclasses.asdict(layout), "num_frames": 1000},
        "train": dataclasses.asdict(TrainSettings(labeler="cnn", average=0.0)),
        "held_out_simulated": {"clean": figures, "occlude 1, ghosts 2": figures},
    }
    accuracy = confusion.diagonal()[:-1] / confusion[:-1].sum(axis=1)
    return card, LabelingReport(figures, accuracy, 500, confusion, confidences, right)


@pytest.mark.parametrize("count", [MIN_MARKERS, MAX_MARKERS])
def test_any_glove_and_either_network_have_a_page(tmp_path, rng, count):
    card, report = made_up(count, rng)
    history = History([(256, 3.0, 0.6), (512, 2.0, 0.6)], [(512, 0.1, 0.4)])
    page = write_run_page(tmp_path, card, history, report)
    text = page.read_text("utf-8")
    assert "The network of Han et al. 2018 for glove &lt;i&gt;odd" in text
    assert "<b>" not in text and "<i>" not in text
    assert len([ElementTree.fromstring(picture) for picture in pictures(page)]) == 4
    assert text.count("<td>&lt;b&gt;$") > 0
    if count == MIN_MARKERS:
        first = page.read_bytes()
        assert write_run_page(tmp_path, card, history, report).read_bytes() == first


def test_a_labeler_without_mistakes_has_a_page(tmp_path, rng, without_pictures):
    card, report = made_up(19, rng, perfect=True)
    page = write_run_page(tmp_path, card, History([(256, 0.1, 0.6)], [(256, 0.1, 1.0)]), report)
    assert "No marker was taken for another" in page.read_text("utf-8")


@pytest.mark.parametrize(
    "history",
    [
        History(),
        History([(256, 3.0, 0.1)], [(256, 0.1, 0.5)]),
        History([(256, 3.0, 0.1), (512, 0.02, 0.1), (768, 1e-4, 0.0)], [(512, 0.1, 1.0), (768, 0.2, 1.0)]),
    ],
)
def test_curves_of_any_length_are_drawn(history):
    assert picture((6.0, 4.0), draw_curves, history=history).startswith("data:image/svg")


@pytest.mark.parametrize(
    "confusion",
    [np.zeros((6, 6), int), 7 * np.eye(6, dtype=int), np.ones((6, 6), int), np.diag([0, 5, 0, 0, 9, 0])],
)
def test_any_confusion_is_drawn(confusion):
    names = ("a$b$", "<i>&amp;", "x" * 60, "\\frac", "e")
    assert picture(confusion_size(6), draw_confusion, names, confusion).startswith("data:image/svg")


@pytest.mark.parametrize("count", [0, 1, 5000])
def test_reliability_of_few_and_many_points(rng, count):
    confidence = rng.uniform(size=count)
    bins = reliability(confidence, confidence > 0.4)
    assert picture((6.0, 6.0), draw_reliability, bins, 0.1).startswith("data:image/svg")


def test_long_names_are_cut():
    assert short("IndexTip") == "IndexTip"
    assert len(short("x" * 60)) == MAX_LETTERS and short("x" * 60).endswith("…")


def head(text: str) -> dict[str, str | list[str]]:
    """The YAML between the first two rules: plain keys with a word or a list of words."""
    before, lines, _ = text.split("---\n", maxsplit=2)
    assert before == ""
    found: dict[str, str | list[str]] = {}
    for line in lines.splitlines():
        if line.startswith("- "):
            entries = found[key]
            assert isinstance(entries, list)
            entries.append(line[2:])
        else:
            key, _, value = line.partition(":")
            found[key] = value.strip() or []
    return found


@pytest.mark.parametrize("license", ["unknown", "apache-2.0"])
def test_the_head_is_what_hubs_read(license: str) -> None:
    found = head(model_card(SHIPPED | {"license": license}))
    assert found["license"] == license
    assert found["library_name"] == "handsim"
    assert found["pipeline_tag"] == "other"
    assert "motion-capture" in found["tags"]


def test_the_shipped_weights_have_the_same_head() -> None:
    text = resources.files("train").joinpath("weights/README.md").read_text()
    assert head(text) == head(model_card(SHIPPED))


def test_the_words_say_what_the_card_says() -> None:
    text = model_card(SHIPPED)
    assert "# Labeler of hand markers: dense19" in text
    assert "Trained on simulated frames only: 1,200,000 of them" in text
    assert "clouds" in text
    for column in SHIPPED["held_out_simulated"].values():
        assert f"{100 * column['slot_accuracy']:.2f}" in text
    for name in SHIPPED["marker_names"]:
        assert name in text


def test_a_card_in_which_a_license_was_named_is_its_authors(tmp_path: Path) -> None:
    card = SHIPPED | {"license": "unknown"}
    path = write_model_card(tmp_path, card)
    assert path == tmp_path / MODEL_CARD
    write_model_card(tmp_path, card | {"handsim": "9.9.9"})
    assert "9.9.9" in path.read_text()
    mine = path.read_text().replace("license: unknown", "license: cc-by-4.0")
    path.write_text(mine)
    write_model_card(tmp_path, card)
    assert path.read_text() == mine
