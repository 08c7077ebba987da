"""`handsim train`: a preset replaces the defaults, and options given beside it hold."""

from __future__ import annotations

import dataclasses

import pytest

import train.loop
from handsim.cli.main import main
from train import CNNConfig, Corruption, GenerateSettings, SceneMix, TrainSettings, evaluate_labeler
from train.data.batches import paper_corruption
from train.evaluation import SEEN
from train.loop import _scheduled_rate
from train.settings import EPOCHS, usual_settings
from train.simulation.generation import make_dataset

FRAMES = 16


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    out = tmp_path_factory.mktemp("sets") / "small"
    make_dataset(GenerateSettings(num_frames=FRAMES, scenes=SceneMix(1.0, 0.0, 0.0)), out, workers=1)
    return out


@pytest.fixture
def accuracy():
    """Share of right slots of the trained labeler."""
    return [1.0]


@pytest.fixture
def config_of(dataset, tmp_path, monkeypatch, accuracy):
    """The settings that `handsim train` hands to the training loop."""

    def config_of(*options: str) -> TrainSettings:
        configs = []

        def keep(rows, out, settings, *, threads, progress, on_step):
            configs.append(settings.for_set(19, FRAMES))
            return {"held_out_simulated": {SEEN: {"slot_accuracy": accuracy[0]}}, "held_out_intervals": {}}

        monkeypatch.setattr(train.loop, "train_labeler", keep)
        assert main(["train", str(dataset), "--out", str(tmp_path / "run"), *options]) == 0
        return configs[0]

    return config_of


@pytest.mark.parametrize(("added", "better"), [(-0.3, False), (-1e-3, False), (0.0, True), (1e-3, True)])
def test_the_better_of_trained_and_untrained_is_named(config_of, dataset, accuracy, capsys, added, better):
    """The figure of the labeler without training is that on the same held-out frames."""
    usual = evaluate_labeler("dense19", dataset).right_slots  # of all frames, the last of which are held out
    held_out = max(1, int(0.02 * FRAMES))
    without = float(usual[-held_out:].mean())
    accuracy[0] = without + added
    config_of("--samples", "64")
    told = " ".join(capsys.readouterr().out.split())
    assert f"{100 * accuracy[0]:.2f} % of the slots are right as the rig sees them with this labeler" in told
    assert f"{100 * without:.2f} % with the one that the glove has without training" in told
    assert ("use it, with --labeler" in told) == better == ("use that one, without" not in told)


def test_a_preset_replaces_the_defaults(config_of):
    assert config_of() == TrainSettings()
    config = config_of("--preset", "han2018")
    assert config == config_of("--preset=han2018") == usual_settings(preset="han2018").for_set(19, FRAMES)
    assert config.optimizer == "sgd" and config.samples == EPOCHS * FRAMES


def test_the_preset_is_section_3_3_of_the_paper(config_of):
    """Each number of Han et al. 2018, section 3.3, and those of 3.1 and 3.2 that training needs."""
    config = config_of("--preset", "han2018")
    assert config.labeler == "cnn" and config.cnn.views == "random"
    assert config.optimizer == "sgd" and config.learning_rate == 0.6 and config.weight_decay == 0.0
    assert config.batch == 256
    assert config.samples == 75 * FRAMES
    rates = [_scheduled_rate(config, epoch / 75) for epoch in (0, 49, 51, 69, 71, 74)]
    assert rates == pytest.approx([1, 1, 0.1, 0.1, 0.01, 0.01])
    assert config.occlude is None and paper_corruption(19).occlude == 5 and paper_corruption(13).occlude == 3
    assert config.ghosts == 2 and Corruption().margin == 0.1
    assert config.rig_share == config.anisotropy == config.average == 0.0
    assert config.knee == 1.0
    assert config.cnn.reject == 0.015
    assert config_of("--preset", "han2018", "--cnn.reject", "0.04").cnn.reject == 0.04


def test_each_kind_has_defaults_of_its_own(config_of):
    assert config_of("--labeler", "set") == config_of() == TrainSettings()
    assert config_of("--labeler", "cnn") == config_of("--labeler=cnn") == usual_settings("cnn")
    config = config_of("--labeler", "cnn", "--batch", "256", "--cnn.views", "random")
    assert config == dataclasses.replace(usual_settings("cnn"), batch=256, cnn=CNNConfig(views="random"))


@pytest.mark.parametrize("option", ["--cnn.reject", "--cnn.spread"])
def test_distances_of_matching_are_positive(dataset, tmp_path, capsys, option):
    assert main(["train", str(dataset), "--out", str(tmp_path), "--labeler", "cnn", option, "0"]) != 0
    assert f"{option[6:]} is 0, expected a number above 0" in capsys.readouterr().err


def test_every_usual_default_holds_when_given_before_or_behind_a_preset(config_of):
    usual, preset = TrainSettings(), ["--preset", "han2018"]
    options = [
        f"--{name.replace('_', '-')}={getattr(usual, name)}"
        for name in (
            "labeler",
            "samples",
            "learning_rate",
            "schedule",
            "weight_decay",
            "average",
            "optimizer",
        )
    ]
    config = config_of(*preset, *options)
    assert config == config_of(*options, *preset) and config.optimizer == usual.optimizer
    assert config.samples == usual.samples and config.average == usual.average and config.labeler == "set"
    assert config.jitter == usual_settings(preset="han2018").jitter


def test_unknown_presets_and_missing_sets_are_told(tmp_path, capsys):
    with pytest.raises(SystemExit) as caught:
        main(["train", str(tmp_path), "--out", str(tmp_path / "run"), "--preset", "han2081"])
    assert caught.value.code == 2
    assert "han2018" in capsys.readouterr().err
    assert main(["train", str(tmp_path), "--out", str(tmp_path / "run"), "--preset", "han2018"]) == 1
    assert "expected a training set with a manifest.json" in capsys.readouterr().err


def test_help_shows_the_preset(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["train", "--preset", "han2018", "--help"])
    assert caught.value.code == 0
    out = capsys.readouterr().out
    assert "default: sgd" in out and "75 epochs" in out and "handsim train" in out
