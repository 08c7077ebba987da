"""Pages on takes, training sets, gloves and rigs."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any, Final

from handsim._checks import check_type, shown_value
from handsim.errors import ArgumentError

# By names, because the packages that make pages lie above this one.
_WRITERS: Final = {
    "gloves.takes.take.Take": "track.reports.take_page:write_take_page",
    "train.data.shards.Dataset": "train.reports.dataset_page:write_dataset_page",
    "track.glove_advice.layout_score.LayoutScore": "track.glove_advice.score_page:write_score_page",
    "train.rig_advice.rig_score.RigScore": "train.rig_advice.rig_page:write_rig_page",
}


def write_page(path: str | Path, thing: Any) -> None:
    """Write the page on a thing: one HTML file with its pictures inside, complete or not at all.

    Args:
        path: The page, an .html file; the tables of a take (.csv) lie beside it.
        thing: A take, a training set, or what `score_glove` or `score_rig` returned; pages show angles in
            [deg] and distances in [mm].

    Raises:
        ArgumentError: It is something else, or the page's name does not end in .html.
        OSError: A file cannot be written.
    """
    check_type("path", path, (str, os.PathLike), "the path of an .html file")
    if Path(path).suffix.lower() != ".html":
        raise ArgumentError(f"path is {path}, expected a file name that ends in .html")
    kinds = (f"{kind.__module__}.{kind.__qualname__}" for kind in type(thing).__mro__)
    target = next((_WRITERS[kind] for kind in kinds if kind in _WRITERS), None)
    if target is None:
        raise ArgumentError(
            f"thing is {shown_value(thing)}, expected a Take, a Dataset, or a score of a glove or a rig"
        )
    module, _, name = target.partition(":")
    getattr(importlib.import_module(module), name)(Path(path), thing)
