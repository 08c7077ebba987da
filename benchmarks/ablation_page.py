"""Writes docs/ablation.md from benchmarks/figures/ablation.json: `make results`."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any, Final, NamedTuple

from benchmarks.record import FOLDER

PAGE: Final = Path(__file__).resolve().parents[1] / "docs" / "ablation.md"
_LEAD: Final = """# What the numbers of the tracker are worth

`python -m benchmarks.ablation GROUND --save ablation` halves and doubles the numeric constants of the tracker
and the labeler, one at a time, and labels and tracks short captures; `make results` writes this page from
`benchmarks/figures/ablation.json`, which has every variant. A number is *read* if a line that ran reads it.
It *moves* something if some label or pose is another one, in any of its variants. A number that moves nothing
on these captures may count on others: of hands that touch, of gloves with few markers, of a calibration.
The same command goes on with the numbers that were not tried.
The last columns have the number with the largest change of the frames that are right, in the mean of the
captures and in the worst one [percentage points].

"""
_HEAD: Final = ("module", "numbers", "read", "tried", "move something", "largest change", "mean", "worst")


class _Tried(NamedTuple):
    """A variant of a number."""

    name: str
    change: str  # such as "half"
    found: list[float]  # see `ablation.COLUMNS`


def ablation_page(folder: Path = FOLDER) -> str:
    """The page: a row for each module."""
    figures = json.loads((folder / "ablation.json").read_text("utf-8"))["figures"]
    by_module: dict[str, dict[str, Any]] = defaultdict(dict)
    for key, figure in figures.items():
        module, name = key.split(":")
        by_module[module][name] = figure["value"]
    rows = [_HEAD, ("---",) * len(_HEAD), *(_row(module, by_module[module]) for module in sorted(by_module))]
    return _LEAD + "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def _row(module: str, values: dict[str, Any]) -> tuple[str, ...]:
    """Cells of a module, from what was found of its numbers and their variants."""
    tried = [_Tried(*key.split(), found) for key, found in values.items() if isinstance(found, list)]
    names = {key.split()[0] for key in values}
    unread = sum(found == "not read" for found in values.values())
    moving = [one for one in tried if one.found[3] > 0]
    counts = (
        len(names),
        len(names) - unread,
        len({one.name for one in tried}),
        len({one.name for one in moving}),
    )
    most = max(moving, key=lambda one: abs(one.found[0]), default=None)
    last = ("-",) * 3
    if most is not None:
        last = (f"`{most.name}` {most.change}", f"{most.found[0]:+.2f}", f"{most.found[1]:+.2f}")
    return (f"`{module}`", *map(str, counts), *last)
