"""The README of a run: its head by hubs' rules, its words by the run's card."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import pytest

from train.reports.model_card import MODEL_CARD, model_card, write_model_card

CARD = json.loads(resources.files("train").joinpath("weights/dense19.json").read_text())


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
    found = head(model_card(CARD | {"license": license}))
    assert found["license"] == license
    assert found["library_name"] == "handsim"
    assert found["pipeline_tag"] == "other"
    assert "motion-capture" in found["tags"]


def test_the_shipped_weights_have_the_same_head() -> None:
    text = resources.files("train").joinpath("weights/README.md").read_text()
    assert head(text) == head(model_card(CARD))


def test_the_words_say_what_the_card_says() -> None:
    text = model_card(CARD)
    assert "# Labeler of hand markers: dense19" in text
    assert "Trained on simulated frames only: 1,200,000 of them" in text
    assert "clouds" in text
    for column in CARD["held_out_simulated"].values():
        assert f"{100 * column['slot_accuracy']:.2f}" in text
    for name in CARD["marker_names"]:
        assert name in text


def test_a_card_in_which_a_license_was_named_is_its_authors(tmp_path: Path) -> None:
    card = CARD | {"license": "unknown"}
    path = write_model_card(tmp_path, card)
    assert path == tmp_path / MODEL_CARD
    write_model_card(tmp_path, card | {"handsim": "9.9.9"})
    assert "9.9.9" in path.read_text()
    mine = path.read_text().replace("license: unknown", "license: cc-by-4.0")
    path.write_text(mine)
    write_model_card(tmp_path, card)
    assert path.read_text() == mine
