"""Writes docs/trust.md from the figures in benchmarks/figures: `make results`.

The rows stand in trust_rows.toml, with figures as in results_template.md. The best row comes first: outputs
are ordered by how many kinds of evidence they have, in the file's order where these are equal.
"""

from __future__ import annotations

import textwrap
import tomllib
from pathlib import Path
from typing import Final

from benchmarks.record import load_figures

PAGE: Final = Path(__file__).resolve().parents[1] / "docs" / "trust.md"
ROWS: Final = Path(__file__).with_name("trust_rows.toml")
_EVIDENCE: Final = {
    "real": "Real data",
    "others": "Others",
    "simulated": "Simulated data",
    "deviation": "Stated deviation",
}
_LEAD: Final = """# What was judged, and by what

For those who must decide what to rely on: what judged each output of handsim, those with the most kinds of
evidence first. Real data are those of two people in the public Mocap_SIG18_Data, unless an output says
otherwise, and say little about a third person. `make results` writes this page; [results](results.md) and
`benchmarks/figures/quoted.json` have the commands, `benchmarks/public/README.md` has other methods.
"""


def trust_rows() -> list[dict[str, str]]:
    """The rows with their figures, the one with the most kinds of evidence first."""
    figures = load_figures()
    keys = ("output", *_EVIDENCE, "never")
    rows = tomllib.loads(ROWS.read_text("utf-8"))["row"]
    filled = [{key: row.get(key, "-").format(**figures) for key in keys} for row in rows]
    return sorted(filled, key=lambda row: sum(row[key] == "-" for key in _EVIDENCE))


def trust_page() -> str:
    """The page."""
    lines = [_LEAD]
    for row in trust_rows():
        names = {**_EVIDENCE, "never": "Never judged"}
        parts = [f"{name}: {row[key]}." for key, name in names.items() if row[key] != "-"]
        text = f"- **{row['output'].capitalize()}.** {' '.join(parts)}"
        lines.append(textwrap.fill(text, 140, subsequent_indent="  ", break_on_hyphens=False))
    return "\n".join([*lines, ""])


def readme_rows() -> list[str]:
    """The three best and the three worst rows, as README.md has them."""
    rows = trust_rows()
    return [f"| {row['output']} | {row['real']} | {row['never']} |" for row in (*rows[:3], *rows[-3:])]
