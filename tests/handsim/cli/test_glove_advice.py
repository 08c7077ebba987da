"""`handsim glove score` and `handsim glove improve`, as they are typed."""

from __future__ import annotations

import pytest

from gloves.layout import load_layout, starter_layout
from handsim.cli.main import main


@pytest.fixture
def mine(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(starter_layout(), "utf-8")
    return path


@pytest.mark.slow
def test_a_score_is_printed_and_drawn(mine, capsys):
    assert main(["glove", "score", str(mine), "--frames", "120", "--rig", "six", "--captures", "1"]) == 0
    told = capsys.readouterr().out
    assert "% of the slots right as the rig sees them" in told
    assert all(f"{work} " in told for work in ("one hand", "two apart", "two touching"))
    page = mine.with_suffix(".html").read_text("utf-8")
    assert page.count("data:image/svg+xml") == 2 and "What to do" in page and "ThumbTip" in page


def test_an_improved_layout_is_written(mine, tmp_path, capsys):
    out = tmp_path / "better.toml"
    command = [
        "glove",
        "improve",
        str(mine),
        "--out",
        str(out),
        "--minutes",
        "0",
        "--markers",
        "7",
        "--captures",
        "0",
    ]
    assert main(command) == 0
    assert load_layout(out).num_markers == 7
    told = capsys.readouterr().out
    assert "before: 8 markers" in told and "after:  7 markers" in told and "drop " in told


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["score", "GLOVE", "--motion", "dance"], "motion is 'dance', expected poses, twins or a take"),
        (["score", "GLOVE", "--captures", "-1"], "captures is -1, expected 0 or more"),
        (["score", "GLOVE", "--frames", "1"], "frames is 1, expected at least 100"),
        (
            ["score", "GLOVE", "--out", "page.pdf"],
            "--out is page.pdf, expected a file name that ends in .html",
        ),
        (["improve", "GLOVE", "--out", "GLOVE"], "is the input"),
        (["improve", "GLOVE", "--out", "new.toml", "--markers", "3"], "markers is 3, expected 5 to 60"),
        (["improve", "GLOVE", "--out", "new.toml", "--keep", "Tail"], "to be kept are Tail"),
    ],
)
def test_mistakes_are_told(mine, options, sentence, capsys):
    assert main(["glove", *(str(mine) if one == "GLOVE" else one for one in options)]) == 1
    assert sentence in capsys.readouterr().err
