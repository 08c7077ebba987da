"""One door to every labeler: of a glove, for any layout, trained by you, exported, or your own object."""

from __future__ import annotations

import functools
import warnings
from pathlib import Path
from typing import Any, Final

from gloves.layout import MarkerLayout, list_layouts, load_layout
from handsim._checks import check_type
from handsim.errors import ArgumentError, HandSimWarning, WeightsError
from train.labelers.protocol import Labeler, OwnLabeler
from train.labelers.storage import load_stored_labeler, shipped_labelers

ANY_LAYOUT: Final = "any-layout"
"""Name of the labeler that needs no training."""
_FEW_POSES: Final = 6000  # from which a layout is known that nobody asked for
_EXPECTED: Final = (
    "a MarkerLayout, the name or path of one, a Labeler, the folder of a trained one, an .onnx file, or "
    "module:name"
)


def load_labeler(
    glove: MarkerLayout | Labeler | str | Path, labeler: Labeler | str | Path | None = None
) -> Labeler:
    """The labeler of a glove, or a labeler by its name, path or object.

    A glove without a labeler of its own gets the one for any layout, which learns the layout within a minute.
    Only shipped labelers, folders and the one for any layout need torch.

    Args:
        glove: A marker layout, or its name or path, whose labeler is wanted. Or, where `labeler` is not
            given, a labeler: a folder that `handsim train` wrote, an .onnx file, `module:name` of a `Labeler`
            or of a class of them, an entry point of the group `handsim.labelers`, or a `Labeler`.
        labeler: A labeler like these, or `any-layout`, to be used with this glove; it is checked against the
            glove's markers.

    Returns:
        A labeler; `label_frames` gives labels (N,) and confidences (N,) of points (N, 3) [m].

    Raises:
        ArgumentError: An argument is none of these, or `any-layout` is given without a glove.
        LayoutError: The glove is unknown.
        WeightsError: The labeler is unknown, damaged, or knows other markers.

    Warns:
        HandSimWarning: No labeler was trained on the glove, so that it is the one for any layout; or such a
            glove is nearly its own mirror image.
    """
    if labeler is None:
        return _of_layout(load_layout(glove), glove) if _is_layout(glove) else _of(glove)  # type: ignore[arg-type]
    layout = load_layout(glove)  # type: ignore[arg-type]
    if labeler == ANY_LAYOUT:
        from train.any_layout.learned_gloves import learned_labeler  # torch

        return learned_labeler(layout)
    found = _of(labeler)
    if found.marker_names != layout.names:
        raise WeightsError(
            f"the labeler knows markers {', '.join(found.marker_names)}, but glove '{layout.name}' has "
            f"{', '.join(layout.names)}; name the glove that it was trained on (--glove)"
        )
    return found


@functools.lru_cache(maxsize=32)
def labeler_at_once(layout: MarkerLayout) -> Labeler:
    """A labeler of a glove without a minute of learning: good enough to tell which glove is worn.

    Raises:
        LayoutError: A marker misses the skin.
    """
    for name in shipped_labelers():
        if load_layout(name) == layout:
            return load_stored_labeler(name)
    from train.any_layout.layout_labeler import LayoutLabeler  # torch
    from train.any_layout.learned_gloves import is_learned, learned_labeler

    return (
        learned_labeler(layout) if is_learned(layout) else LayoutLabeler.at_once(layout, num_poses=_FEW_POSES)
    )


def _is_layout(glove: Any) -> bool:
    return (
        isinstance(glove, MarkerLayout)
        or str(glove) in list_layouts()
        or (isinstance(glove, str | Path) and Path(glove).suffix.lower() == ".toml")
    )


def _of_layout(layout: MarkerLayout, glove: MarkerLayout | str | Path) -> Labeler:
    """The labeler that was trained on a layout, or the one for any."""
    for name in shipped_labelers():
        if load_layout(name) == layout:
            return load_stored_labeler(name)
    from train.any_layout.learned_gloves import is_learned, learned_labeler  # torch
    from train.labelers.side import is_mirror_like  # kernels

    own = isinstance(glove, MarkerLayout) and layout not in map(load_layout, list_layouts())
    name = layout.name if isinstance(glove, MarkerLayout) else str(glove)
    how = "has learned it before" if is_learned(layout) else "learns it within a minute, once"
    warnings.warn(
        f"no labeler was trained on glove '{name}', so that the one for any layout labels it, which {how}; a "
        f"better one takes handsim generate --glove {'GLOVE.toml' if own else name} --out SET && handsim "
        "train SET --out RUN, and --labeler RUN",
        HandSimWarning,
        stacklevel=3,
    )
    if is_mirror_like(layout):
        warnings.warn(
            f"glove '{name}' is nearly its own mirror image, so that right and left may be exchanged for a "
            "whole capture; put a marker on the thumb, or move those on the back away from any symmetry",
            HandSimWarning,
            stacklevel=3,
        )
    return learned_labeler(layout)


def _of(labeler: Any) -> Labeler:
    """A labeler by its name, path or object."""
    if labeler == ANY_LAYOUT:
        raise ArgumentError(
            f"labeler '{ANY_LAYOUT}' needs a glove, expected load_labeler(GLOVE, '{ANY_LAYOUT}') with a "
            "MarkerLayout, or the name or path of one"
        )
    if hasattr(labeler, "label_frames") and not isinstance(labeler, type):
        ours = type(labeler).__module__.startswith("train.")
        return labeler if ours else OwnLabeler(labeler)
    check_type("labeler", labeler, (str, Path), _EXPECTED, list_layouts())
    return load_stored_labeler(labeler)
