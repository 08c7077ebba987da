"""The labeler of a glove: a given one, the one that was trained on it, or the one for any layout."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Final

from gloves.layout import MarkerLayout, load_layout
from handsim.errors import HandSimWarning, WeightsError
from train.labelers.protocol import Labeler
from train.labelers.storage import load_labeler, shipped_labelers

ANY_LAYOUT: Final = "any-layout"
"""Name of the labeler that needs no training."""


def labeler_for_glove(glove: MarkerLayout | str, labeler: str | Path | None) -> Labeler:
    """The given labeler, or the glove's shipped one; checked against the glove's markers.

    Args:
        glove: Marker layout, or its shipped name or the path of its .toml file.
        labeler: Anything that `load_labeler` reads, or `any-layout`. When None the shipped one of the glove
            or, where none was trained on it, the one for any layout, with a warning.

    Raises:
        LayoutError: The glove is unknown.
        WeightsError: The labeler is unknown, damaged, or knows other markers.
    """
    layout = glove if isinstance(glove, MarkerLayout) else load_layout(glove)
    name = layout.name if isinstance(glove, MarkerLayout) else glove
    shipped = name in shipped_labelers() and load_layout(name) == layout
    if labeler is None and not shipped:
        warnings.warn(
            f"no labeler was trained on glove '{name}', so that the one for any layout learns it within a "
            f"minute; a better one takes handsim generate --glove {name} --out SET && handsim train SET "
            "--out RUN, and --labeler RUN",
            HandSimWarning,
            stacklevel=2,
        )
        labeler = ANY_LAYOUT
    if labeler == ANY_LAYOUT:
        from train.any_layout.fine_tuning import fine_tuned_labeler  # torch

        return fine_tuned_labeler(layout)
    found = load_labeler(name if labeler is None else labeler)
    if found.marker_names != layout.names:
        raise WeightsError(
            f"the labeler knows markers {', '.join(found.marker_names)}, but glove '{name}' has "
            f"{', '.join(layout.names)}"
        )
    return found
