"""Folders that a settings file claims: differences are named, one setting may grow."""

from __future__ import annotations

import json

import pytest

from handsim.errors import DatasetError
from handsim.files.json_files import claim, load_json, save_json

SETTINGS = {"train": {"samples": 100, "seed": 3, "network": {"width": 64}}, "names": ["a", "b"]}


def claim_again(folder, *, grows="train.samples", **train):
    settings = {**SETTINGS, "train": {**SETTINGS["train"], **train}}
    result = folder / "manifest.json"
    claim(folder / "config.json", settings, noun="run", error=DatasetError, grows=grows, result=result)


def test_equal_settings_go_on_and_leftovers_go(tmp_path):
    claim_again(tmp_path)
    (tmp_path / "png").mkdir()
    for name in (".rows.tmp-1.npy", "png/.a.tmp-77.png"):
        (tmp_path / name).write_text("half")
    claim_again(tmp_path)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["config.json", "png"]


def test_a_difference_is_named_with_both_values(tmp_path):
    claim_again(tmp_path)
    sentence = (
        r"holds a run begun with other settings \(train.network.depth: nothing there, 5 here; "
        r"train.network.width: 64 there, nothing here\)"
    )
    with pytest.raises(DatasetError, match=sentence):
        claim_again(tmp_path, network={"depth": 5})
    with pytest.raises(DatasetError, match=r"\(train.seed: 3 there, 4 here\); use them or another folder$"):
        claim_again(tmp_path, seed=4)


def test_one_setting_may_grow(tmp_path):
    claim_again(tmp_path)
    (tmp_path / "manifest.json").write_text("{}")
    claim_again(tmp_path)
    assert (tmp_path / "manifest.json").exists()
    claim_again(tmp_path, samples=200)
    assert load_json(tmp_path / "config.json")["train"]["samples"] == 200
    assert not (tmp_path / "manifest.json").exists(), "it was true for the old settings"
    with pytest.raises(
        DatasetError, match=r"train.samples: 200 there, 100 here.*train.samples may only grow"
    ):
        claim_again(tmp_path, samples=100)
    with pytest.raises(
        DatasetError, match=r"train.samples: 200 there, 300 here; train.seed: 3 there, 4 here"
    ):
        claim_again(tmp_path, samples=300, seed=4)


def test_a_run_killed_at_its_first_file_goes_on(tmp_path):
    (tmp_path / ".config.tmp-77.json").write_text("{")
    claim_again(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    (tmp_path / "config.json").unlink()
    (tmp_path / "mine.txt").write_text("")
    with pytest.raises(DatasetError, match="is not empty and holds no run"):
        claim_again(tmp_path)


def test_json_nested_without_end_is_damage(tmp_path):
    (tmp_path / "config.json").write_text("[" * 200_000)
    with pytest.raises(DatasetError, match=r"config.json is damaged: it does not hold JSON"):
        load_json(tmp_path / "config.json")


def test_what_is_not_finite_becomes_null(tmp_path):
    path = tmp_path / "figures.json"
    save_json(path, {"recall": float("nan"), "curve": [1.0, float("inf")], "runs": {"a": (2, 0.5)}})
    assert json.loads(path.read_text(), parse_constant=pytest.fail) == {
        "recall": None, "curve": [1.0, None], "runs": {"a": [2, 0.5]}
    }  # fmt: skip
