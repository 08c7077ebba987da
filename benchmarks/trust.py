"""Writes docs/trust.md from the figures in benchmarks/figures: `make results`.

The rows stand in trust_rows.toml, with figures as in results_template.md. The best row comes first: outputs
are ordered by how many kinds of evidence they have, in the file's order where these are equal.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Final

from benchmarks.record import load_figures

PAGE: Final = Path(__file__).resolve().parents[1] / "docs" / "trust.md"
ROWS: Final = Path(__file__).with_name("trust_rows.toml")
_COLUMNS: Final = {
    "output": "output",
    "real": "judged on real data",
    "others": "judged by others",
    "simulated": "judged on simulated data",
    "deviation": "deviation it states, and how often that held",
    "never": "never judged",
}
_EVIDENCE: Final = ("real", "others", "simulated", "deviation")
_LEAD: Final = """# What was judged, and by what

`make results` writes this page. A row is an output of handsim; those with the most kinds of evidence stand
first, and "-" means that there is none. Real data are those of two people in the public Mocap_SIG18_Data,
unless a row says otherwise, and say little about a third person. [Results](results.md) and
`benchmarks/figures/quoted.json` have the commands.
"""


_METHODS: Final = {
    "method": "method",
    "benchmark": "frames with every label right, public benchmark: easy, medium, hard [%]",
    "real": "slots right, single frames of real hands: as captured; drops and ghosts [%]",
}
_BESIDE: Final = """
## Other methods

Methods on the same data, with hands whose size was measured (`benchmarks/public/README.md` has more). The
loop of the paper runs with our labeler there, and its network was counted on every tenth real frame.

"""


def trust_rows() -> list[dict[str, str]]:
    """The rows with their figures, the one with the most kinds of evidence first."""
    return sorted(_filled("row", _COLUMNS), key=lambda row: sum(row[key] == "-" for key in _EVIDENCE))


def _filled(table: str, columns: dict[str, str]) -> list[dict[str, str]]:
    """The rows of a table of the file with their figures."""
    figures = load_figures()
    rows = tomllib.loads(ROWS.read_text("utf-8"))[table]
    return [{key: row.get(key, "-").format(**figures) for key in columns} for row in rows]


def _table(columns: dict[str, str], rows: list[dict[str, str]]) -> str:
    """A table of Markdown."""
    lines = [list(columns.values()), ["---"] * len(columns), *(list(row.values()) for row in rows)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def trust_page() -> str:
    """The page."""
    outputs, methods = _table(_COLUMNS, trust_rows()), _table(_METHODS, _filled("method", _METHODS))
    return f"{_LEAD}\n{outputs}{_BESIDE}{methods}"


def readme_rows() -> list[str]:
    """The three best and the three worst rows, as README.md has them."""
    rows = trust_rows()
    return [f"| {row['output']} | {row['real']} | {row['never']} |" for row in (*rows[:3], *rows[-3:])]
