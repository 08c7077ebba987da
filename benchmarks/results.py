"""Writes docs/results.md and docs/trust.md from benchmarks/figures: `python -m benchmarks.results`.

The page's text is results_template.md; `{table5.right_size[1]:.2f}` in it is a number of table5.json, and
`{speed_rows}` are tables of all of speed.json.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from benchmarks.record import FOLDER, load_figures
from benchmarks.trust import PAGE as TRUST
from benchmarks.trust import trust_page

PAGE: Final = Path(__file__).resolve().parents[1] / "docs" / "results.md"
TEMPLATE: Final = Path(__file__).with_name("results_template.md")
README: Final = (
    "{label_clean.row[0]:.2f} {label_both.row[0]:.2f}",
    "{real_motion.mean[1]:.2f} {real_motion.worst[1]:.2f}",
    "{table5.right_size[1]:.2f} {table5_seed1.right_size[1]:.2f}",
    "{speed.hand_hand_true[0]:.2f} {speed.hand_hand_true[1]:.2f}",
    "{calibration.after[0][0]:.2f} {calibration.after[0][1]:.2f}",
    "{calibration.people_after[0]:.2f} {calibration.people_after[1]:.2f}",
    "{judge.clean[0]:.1f} {judge.mixed[0]:.1f}",
    "{keypoint_network.ours[2]:.1f} {keypoint_photographs.ours[2]:.1f}",
)
"""The numbers of each row of the table of results in README.md, which is written by hand and tested."""


def filled(text: str) -> str:
    """A text with the figures in place of its fields.

    Raises:
        KeyError: A field names a file that is not there.
        AttributeError: A field names a figure that its file lacks.
    """
    return text.format(**load_figures(), speed_rows=_speed_rows())


def _speed_rows() -> str:
    """The tables of speed.json: one of times, one of rates, each without the figures in units."""
    figures = json.loads((FOLDER / "speed.json").read_text("utf-8"))["figures"]
    times = ["| what | median [ms] | 99th percentile [ms] | longest [ms] |", "|---|---|---|---|"]
    rates = ["| what | in a second |", "|---|---|"]
    for key, figure in figures.items():
        if key == "unit":
            continue
        *shown, _ = figure["value"]
        row = f"| {' | '.join([figure['what'].rsplit(': ', 1)[0], *map(_shown, shown)])} |"
        (times if len(shown) == 3 else rates).append(row)
    return "\n\n".join("\n".join(table) for table in (times, rates) if len(table) > 2)


def _shown(value: float) -> str:
    """A number to three digits."""
    return f"{float(f'{value:.3g}'):,g}"


if __name__ == "__main__":
    PAGE.write_text(filled(TEMPLATE.read_text("utf-8")), "utf-8")
    TRUST.write_text(trust_page(), "utf-8")
    print(PAGE, TRUST)
