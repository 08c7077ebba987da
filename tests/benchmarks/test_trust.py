"""The page of what judged each output has the kept figures, and quotes what other pages say."""

from __future__ import annotations

import json
import re

import pytest

from benchmarks.record import FOLDER
from benchmarks.trust import PAGE, readme_rows, trust_page, trust_rows
from tests.programs import ROOT

QUOTED = json.loads((FOLDER / "quoted.json").read_text("utf-8"))["figures"]


def test_the_page_is_what_the_script_writes():
    assert PAGE.read_text("utf-8") == trust_page(), "`make results` puts it right"


def test_the_readme_has_the_three_best_and_the_three_worst_rows():
    section = (ROOT / "README.md").read_text("utf-8").split("\n## Trust\n")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("| ")][1:]
    assert rows == readme_rows()


def test_rows_with_more_evidence_stand_first():
    counts = [
        sum(row[key] != "-" for key in ("real", "others", "simulated", "deviation")) for row in trust_rows()
    ]
    assert counts == sorted(counts, reverse=True) and counts[0] > counts[-1]
    assert all(row["never"] != "-" for row in trust_rows())


@pytest.mark.parametrize("name", QUOTED)
def test_a_quoted_figure_stands_in_its_page_and_names_its_command(name):
    page, _, rest = QUOTED[name]["what"].partition(": ")
    text = " ".join((ROOT / "docs" / page).read_text("utf-8").split())
    assert all(value in text for value in QUOTED[name]["value"])
    if re.search(r"benchmarks/\w+ at commit [0-9a-f]{7}\b", rest) is None:
        module = re.search(r"python -m benchmarks\.(\w+)", rest)
        assert module is not None and (ROOT / "benchmarks" / f"{module[1]}.py").exists()
