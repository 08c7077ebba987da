"""A layout's TOML text with some markers moved: comments, order and all other lines stay."""

from __future__ import annotations

import math
import re
import tomllib
from typing import Final

from gloves.layout import MarkerLayout, MarkerPlace, layout_lines, parse_layout
from handsim.errors import HandSimError
from handsim.files.inputs import quoted, written

_TABLE: Final = re.compile(r"\s*\[\[\s*marker\s*\]\]\s*(?:#.*)?$")
_ENTRY: Final = re.compile(r"(\s*(\w+)\s*=\s*)(\"[^\"\\]*\"|'[^']*'|[^\s#\"']+)(\s*(?:#.*)?)$")
_DECIMALS: Final = 1e-8


def moved_text(text: str, layout: MarkerLayout) -> tuple[str, bool]:
    """The text of a layout file with the same markers in the same order where `layout` has them.

    Returns:
        The text, and whether it is the given one with changed places. Where that one is written in a way
        that cannot be changed line by line, the text is a new one without comments.
    """
    lines = text.splitlines()
    starts = [number for number, line in enumerate(lines) if _TABLE.match(line)]
    if len(starts) == layout.num_markers:
        ends = [*starts[1:], len(lines)]
        for start, end, marker in reversed(list(zip(starts, ends, layout.markers, strict=True))):
            lines[start + 1 : end] = _moved_table(lines[start + 1 : end], marker)
        changed = "\n".join(lines) + "\n"
        if _says(changed, layout):
            return changed, True
    return "\n".join(layout_lines(layout)) + "\n", False


def _moved_table(lines: list[str], marker: MarkerPlace) -> list[str]:
    """The lines of one table with the values of a marker; a value that is the same stays as it is written."""
    numbers = {"along": marker.along, "around": math.degrees(marker.around)}
    optional = {"across": marker.across, "height_mm": 1e3 * marker.height}
    numbers |= optional
    result, met, last = [], set(), 0
    for line in lines:
        match = _ENTRY.match(line)
        if match is None or match[2] not in (*numbers, "bone"):
            result.append(line)
            last = len(result) if match is not None else last
            continue
        key = match[2]
        met.add(key)
        if key in optional and not optional[key]:
            continue
        value = quoted(marker.bone) if key == "bone" else written(numbers[key])
        same = key != "bone" and _is_number(match[3], numbers[key])
        result.append(line if same else f"{match[1]}{value}{match[4]}")
        last = len(result)
    new = [f"{key} = {written(value)}" for key, value in optional.items() if value and key not in met]
    result[last:last] = new
    return result


def _is_number(text: str, value: float) -> bool:
    try:
        return abs(float(text) - value) < _DECIMALS
    except ValueError:
        return False


def _says(text: str, layout: MarkerLayout) -> bool:
    """Whether a text is this layout's, as far as a file's decimals go."""
    try:
        read = parse_layout(tomllib.loads(text))
    except (HandSimError, ValueError):
        return False
    return (
        read.sides == layout.sides
        and len(read.markers) == layout.num_markers
        and all(
            (ours.name, ours.bone) == (theirs.name, theirs.bone)
            and abs(ours.along - theirs.along) < _DECIMALS
            and abs(ours.around - theirs.around) < _DECIMALS
            and abs(ours.across - theirs.across) < _DECIMALS
            and abs(ours.height - theirs.height) < _DECIMALS
            for ours, theirs in zip(read.markers, layout.markers, strict=True)
        )
    )
