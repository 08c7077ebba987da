"""Writes docs/results.md and docs/trust.md from benchmarks/figures: `python -m benchmarks.results`.

The page's text is results_template.md; `{table5.right_size[1]:.2f}` in it is a number of table5.json.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from benchmarks.record import load_figures
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
    return text.format(**load_figures())


if __name__ == "__main__":
    PAGE.write_text(filled(TEMPLATE.read_text("utf-8")), "utf-8")
    TRUST.write_text(trust_page(), "utf-8")
    print(PAGE, TRUST)
