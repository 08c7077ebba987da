"""Marker layouts: the place of each marker on the skin over a bone, read from a TOML file.

A layout does not depend on the size of a hand: places are fractions of bones, so that a glove fits every
hand. The file has angles in degrees and lengths in millimeters; in memory they are radians and meters.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from jaxtyping import Float

from handsim._checks import check_choice, check_type
from handsim.cards import card, map_drawing
from handsim.errors import HandSimError, LayoutError, choices, errors_of
from handsim.files.inputs import (
    check_keys,
    checksum,
    number_of,
    read_toml,
    tables_of,
    text_of,
    toml_number,
    toml_string,
)
from handsim.files.outputs import write_text, writing
from handsim.hand.shape import BONE_NAMES, BONES, PALM, SIDES, Side
from handsim.settings import Expected

MIN_MARKERS: Final = 5
MAX_MARKERS: Final = 60
_RADIUS_RANGE: Final = (0.0005, 0.015)  # [m]
ALONG_RANGE: Final = (-0.3, 1.3)
"""Range of `MarkerPlace.along`."""
_AROUND_RANGE: Final = (-180.0, 180.0)  # [deg]
ACROSS_RANGE: Final = (-1.0, 1.0)
"""Range of `MarkerPlace.across`."""
HEIGHT_RANGE: Final = (0.0, 0.05)
"""Range of `MarkerPlace.height` [m]."""
FOREARM: Final = "forearm"
"""Bone of markers beyond the wrist's joint, which are not on the hand but on a rigid body beside it."""
_FEWEST_ON_FOREARM: Final = 3
_ARM_HINTS: Final = {
    "wrist": "for a marker that moves with the hand write palm, along from -0.15 to 0; for others forearm"
}
_ALIASES: Final = {name.replace("little", "pinky"): name for name in BONE_NAMES if name.startswith("little")}
"""Other names of bones."""
_LAYOUTS_FOLDER: Final = Path(__file__).parent / "layouts"
_LAYOUT_KEYS: Final = ("name", "description", "source", "sides", "radius_mm", "marker")
_MARKER_KEYS: Final = ("name", "bone", "along", "around", "across", "height_mm")
_OPTIONAL_KEYS: Final = ("across", "height_mm")
_STARTER_FILE: Final = Path(__file__).parent / "data" / "starter_layout.toml"
_TABLE_LINE: Final = re.compile(r"\s*\[\[\s*marker\s*\]\]\s*(?:#.*)?$")
_ENTRY_LINE: Final = re.compile(r"(\s*(\w+)\s*=\s*)(\"[^\"\\]*\"|'[^']*'|[^\s#\"']+)(\s*(?:#.*)?)$")


@dataclass(frozen=True, slots=True)
class MarkerPlace:
    """One marker on the skin over one bone.

    Raises:
        LayoutError: The bone is unknown, or a number is NaN or far off the bone.
    """

    name: str
    bone: str
    """One of `handsim.hand.shape.BONE_NAMES`, or forearm; pinky_distal is another name of little_distal, and
    so on."""
    along: float
    """Position along the bone: 0 at its near end, 1 at its far end, and up to 0.3 beyond either."""
    around: float
    """Angle about the bone [rad]: 0 back, pi/2 thumb side, -pi/2 little-finger side, pi palm side."""
    across: float = 0.0
    """For the palm alone: sideways from its middle, in hand breadths, positive towards the thumb."""
    height: float = 0.0
    """Length of the marker's stalk [m]."""

    def __post_init__(self) -> None:
        check_type("name of a marker", self.name, str, "text")
        bones = (*BONE_NAMES, FOREARM)
        check_type(f"bone of marker '{self.name}'", self.bone, str, "the name of one", bones)
        object.__setattr__(self, "bone", _ALIASES.get(self.bone, self.bone))
        for key in ("along", "around", "across", "height"):
            kinds = (int, float, np.number)
            check_type(f"{key} of marker '{self.name}'", getattr(self, key), kinds, "a number")
        if not self.name or self.name != self.name.strip() or not self.name.isprintable():
            raise LayoutError(
                f"marker name {self.name!r}: expected printable characters without outer blanks"
            )
        if self.bone in _ARM_HINTS:
            raise LayoutError(
                f"marker '{self.name}': {self.bone} is not a bone of the hand; {_ARM_HINTS[self.bone]}"
            )
        if self.bone not in bones:
            raise LayoutError(f"marker '{self.name}': {choices(self.bone, bones, noun='bone')}")
        degrees, millimeters = round(math.degrees(self.around), 9), round(1e3 * self.height, 9)
        heights = (0.0, 1e3 * HEIGHT_RANGE[1])
        for key, value, (low, high), unit, given in (
            ("along", self.along, ALONG_RANGE, "", ""),
            ("around", degrees, _AROUND_RANGE, " degrees", f" ({self.around:g} rad)"),
            ("across", self.across, ACROSS_RANGE, "", ""),
            ("height", millimeters, heights, " mm", f" ({self.height:g} m)"),
        ):
            if not low <= value <= high:
                raise LayoutError(
                    f"marker '{self.name}': {key} is {value:g}{unit}{given}, "
                    f"expected {low:g} to {high:g}{unit}"
                )
        if self.across != 0.0 and self.bone != BONES[PALM].name:
            raise LayoutError(
                f"marker '{self.name}': across is for the palm only, and this marker sits on {self.bone}"
            )


def _flat_position(marker: MarkerPlace) -> tuple[float, float]:
    """Position of a marker in a drawing: across the digits from the thumb, and along palm and three bones."""
    bone = BONE_NAMES.index(marker.bone)
    if bone == PALM:
        return 2.5 + 3.0 * marker.across, marker.along
    digit, part = divmod(bone - 1, 3)
    return digit + 0.25 * math.sin(marker.around), 1.0 + part + marker.along


@dataclass(frozen=True, slots=True)
class MarkerLayout:
    """A marker glove: 5 to 60 markers of one radius, in the order of their labels.

    Raises:
        LayoutError: Too few or too many markers, two of one name, or a radius outside 0.5 to 15 mm.
    """

    name: str
    markers: tuple[MarkerPlace, ...]
    """Markers of the hand. Those given with the bone forearm become those of `forearm`."""
    radius: float
    """Radius of every marker [m]."""
    sides: tuple[Side, ...] = SIDES
    """The hands that the glove fits: both, or one."""
    forearm: tuple[MarkerPlace, ...] = ()
    """Markers of the forearm, none or three and more: a rigid body beside the hand."""

    def __post_init__(self) -> None:
        check_type("name of a layout", self.name, str, "text")
        check_type("markers of a layout", self.markers, (tuple, list), "MarkerPlaces")
        for marker in self.markers:
            check_type("marker of a layout", marker, MarkerPlace, "a MarkerPlace")
        check_type("radius of a layout", self.radius, (int, float, np.number), "a number [m]")
        check_type("sides of a layout", self.sides, (tuple, list), "the sides that it fits", SIDES)
        given = *self.markers, *self.forearm
        for key, is_beyond in (("markers", False), ("forearm", True)):
            object.__setattr__(self, key, tuple(one for one in given if (one.bone == FOREARM) == is_beyond))
        if not self.name or not self.name.isprintable():
            raise LayoutError(f"layout name {self.name!r}: expected printable characters")
        if not MIN_MARKERS <= self.num_markers <= MAX_MARKERS:
            raise LayoutError(
                f"a layout needs {MIN_MARKERS} to {MAX_MARKERS} markers, got {self.num_markers}"
            )
        if 0 < len(self.forearm) < _FEWEST_ON_FOREARM:
            raise LayoutError(
                f"the forearm has too few markers ({len(self.forearm)}), expected none, or "
                f"{_FEWEST_ON_FOREARM} or more, which determine its pose"
            )
        names = tuple(one.name for one in (*self.markers, *self.forearm))
        for index, name in enumerate(names):
            if name in names[:index]:
                raise LayoutError(f"two markers are named '{name}'; every marker needs a name of its own")
        low, high = _RADIUS_RANGE
        if not low <= self.radius <= high:
            raise LayoutError(
                f"radius is {self.radius * 1e3:g} mm ({self.radius:g} m), expected {low * 1e3:g} to "
                f"{high * 1e3:g} mm"
            )
        for side in self.sides:
            if side not in SIDES:
                raise LayoutError(f"sides: {choices(side, SIDES, noun='side')}")
        if not self.sides or len(set(self.sides)) < len(self.sides):
            raise LayoutError('sides: expected "right", "left" or both, each once')
        object.__setattr__(self, "sides", tuple(sorted(self.sides)))

    @property
    def names(self) -> tuple[str, ...]:
        """Marker names in label order."""
        return tuple(marker.name for marker in self.markers)

    @property
    def heights(self) -> Float[np.ndarray, "M"]:
        """Heights of the marker centers above the skin [m]: the radius, and the stalk where there is one."""
        return self.radius + np.array([marker.height for marker in self.markers])

    def _repr_html_(self) -> str:
        """The card that notebooks show: the markers on the bones of a hand that is laid out flat."""
        points = [_flat_position(marker) for marker in self.markers]
        digits = [np.array([[2.0, 0.0], [digit, 1.0], [digit, 4.0]]) for digit in range(5)]
        facts = {
            "markers": f"{self.num_markers}, radius {self.radius * 1e3:g} mm",
            "hands": ", ".join(self.sides),
        }
        return card(f"Layout {self.name}", facts, map_drawing(np.array(points), self.names, digits))

    def check_side(self, side: Side) -> None:
        """Raise a `LayoutError` if the glove does not fit hands of this side."""
        if side not in self.sides:
            raise LayoutError(
                f"glove '{self.name}' is for a {self.sides[0]} hand only (its file's `sides`), and a {side} "
                f"hand was asked for"
            )

    @property
    def num_markers(self) -> int:
        """Number of markers, M."""
        return len(self.markers)

    def record(self) -> dict[str, Any]:
        """The layout as JSON, for `stored_layout`; one without a forearm has no entry of it."""
        stored = dataclasses.asdict(self)
        if not self.forearm:
            del stored["forearm"]
        return stored

    def save(self, path: str | Path, *, description: str = "", source: str = "") -> None:
        """Write the layout as TOML, numbers to nine decimals; `load_layout` gives the same layout again.

        Args:
            path: The .toml file; it has lengths in [mm] and angles in [deg].
            description: A sentence on the layout for the file's readers.
            source: Where its places come from.

        Raises:
            LayoutError: The file cannot be written.
        """
        texts = [
            f"{key} = {toml_string(text)}"
            for key, text in (("description", description), ("source", source))
            if text
        ]
        name, *others = layout_lines(self)
        with writing(path, LayoutError):
            write_text(path, "\n".join([name, *texts, *others]) + "\n")


@dataclass(frozen=True, slots=True)
class ShippedLayout:
    """A layout that comes with the package, its description and its source."""

    layout: MarkerLayout
    description: str
    """One sentence."""
    source: str
    """The publication or page that describes the markers."""


def list_layouts() -> tuple[str, ...]:
    """Names of the layouts that come with the package."""
    return tuple(sorted(path.stem for path in _LAYOUTS_FOLDER.glob("*.toml")))


AnyLayout = Annotated[
    MarkerLayout | str | Path, Expected("a MarkerLayout, or the name or path of one", list_layouts)
]
"""Type of a setting that is a marker layout, or the name or path of one."""


def load_layout(glove: MarkerLayout | str | Path) -> MarkerLayout:
    """A shipped layout by its name, or your own by the path of its `.toml` file.

    The file has the marker radius in [mm] and angles in [deg]; the layout has them in [m] and [rad].
    `handsim glove new FILE` writes a commented file to begin with.

    Args:
        glove: `dense19`, `sparse13` or another shipped name; a path; or a layout, which is returned as it is.

    Raises:
        ArgumentError: `glove` has another type.
        LayoutError: No such layout or file, or the file does not describe one; the message names the file.
    """
    if isinstance(glove, MarkerLayout):
        return glove
    check_type("glove", glove, (str, Path), "a MarkerLayout, or the name or path of one", list_layouts())
    path = _layout_path(glove)
    if path.suffix.lower() != ".toml":
        beside = Path(f"{glove}.toml")
        if beside.is_file():
            raise LayoutError(f"unknown glove '{glove}'; give the name of its file, {beside}")
        unknown = choices(str(glove), list_layouts(), noun="glove")
        raise LayoutError(f"{unknown}, or the path of a .toml file")
    table = read_toml(path, error=LayoutError)
    with errors_of(path, LayoutError):
        return parse_layout(table)


def _layout_path(glove: str | Path) -> Path:
    """The file of a layout that is given by its shipped name or by its path."""
    return _LAYOUTS_FOLDER / f"{glove}.toml" if str(glove) in list_layouts() else Path(glove)


def layout_checksum(glove: str | Path) -> str:
    """SHA-256 of the file of a layout, which a shipped name or a path names; empty without a file."""
    path = _layout_path(glove)
    return checksum(path) if path.is_file() else ""


def shipped_layout(name: str) -> ShippedLayout:
    """A shipped layout with its description and its source; a `LayoutError` if there is none of this name."""
    check_choice(name, list_layouts(), noun="glove", error=LayoutError)
    table = read_toml(_LAYOUTS_FOLDER / f"{name}.toml", error=LayoutError)
    return ShippedLayout(
        parse_layout(table), text_of(table, "description", default=""), text_of(table, "source", default="")
    )


def stored_layout(stored: Mapping[str, Any]) -> MarkerLayout:
    """A layout from its `MarkerLayout.record` in takes and training sets."""
    markers, forearm = (
        tuple(MarkerPlace(**one) for one in stored.get(key, ())) for key in ("markers", FOREARM)
    )
    return MarkerLayout(**{**stored, "markers": markers, "forearm": forearm})


def starter_layout() -> str:
    """A commented layout file to start your own glove from; it loads as it is."""
    return _STARTER_FILE.read_text("utf-8")


def layout_lines(layout: MarkerLayout) -> list[str]:
    """The lines of a layout's file."""
    lines = [f"name = {toml_string(layout.name)}", f"radius_mm = {toml_number(layout.radius * 1e3)}"]
    if set(layout.sides) != set(SIDES):
        lines.append(f"sides = [{', '.join(map(toml_string, layout.sides))}]")
    for marker in (*layout.markers, *layout.forearm):
        lines += ["", "[[marker]]", *(f"{key} = {text}" for key, text in _marker_texts(marker).items())]
    return lines


def _marker_texts(marker: MarkerPlace) -> dict[str, str]:
    """The values of a marker's table as TOML, without optional ones that are zero."""
    texts = {
        "name": toml_string(marker.name),
        "bone": toml_string(marker.bone),
        "along": toml_number(marker.along),
    }
    texts |= {"around": toml_number(math.degrees(marker.around)), "across": toml_number(marker.across)}
    texts |= {"height_mm": toml_number(1e3 * marker.height)}
    return {key: text for key, text in texts.items() if key not in _OPTIONAL_KEYS or text != "0.0"}


def parse_layout(table: Mapping[str, object]) -> MarkerLayout:
    """The layout of a file's table."""
    check_keys(table, "the file", _LAYOUT_KEYS, optional=("description", "source", "sides", "marker"))
    text_of(table, "description", default="")
    text_of(table, "source", default="")
    markers = tuple(
        _parse_marker(entry, number) for number, entry in enumerate(tables_of(table, "marker"), 1)
    )
    radius = number_of(table, "radius_mm") * 1e-3
    sides = table.get("sides", list(SIDES))
    if not isinstance(sides, list) or not all(isinstance(side, str) for side in sides):
        raise LayoutError(f'sides is {sides!r}, expected a list of "right" and "left"')
    return MarkerLayout(text_of(table, "name"), markers, radius, tuple(sides))


def _parse_marker(table: Mapping[str, object], number: int) -> MarkerPlace:
    name = table.get("name")
    owner = f"marker '{name}'" if isinstance(name, str) else f"marker number {number}"
    check_keys(table, owner, _MARKER_KEYS, optional=_OPTIONAL_KEYS)
    return MarkerPlace(
        text_of(table, "name", f"{owner}: "),
        text_of(table, "bone", f"{owner}: "),
        along=number_of(table, "along", f"{owner}: "),
        around=math.radians(number_of(table, "around", f"{owner}: ")),
        across=number_of(table, "across", f"{owner}: ", default=0.0),
        height=number_of(table, "height_mm", f"{owner}: ", default=0.0) * 1e-3,
    )


def moved_text(text: str, layout: MarkerLayout) -> tuple[str, bool]:
    """Move the markers in the text of a layout file as in `layout`; also returns whether comments are kept.

    A text that cannot be edited line by line is rewritten without comments.
    """
    lines = text.splitlines()
    starts = [number for number, line in enumerate(lines) if _TABLE_LINE.match(line)]
    markers = *layout.markers, *layout.forearm
    if len(starts) == len(markers):
        ends = [*starts[1:], len(lines)]
        for start, end, marker in reversed(list(zip(starts, ends, markers, strict=True))):
            lines[start + 1 : end] = _moved_table(lines[start + 1 : end], marker)
        changed = "\n".join(lines) + "\n"
        if _is_text_of(changed, layout):
            return changed, True
    return "\n".join(layout_lines(layout)) + "\n", False


def _moved_table(lines: list[str], marker: MarkerPlace) -> list[str]:
    """Replace the values in the lines of a marker's table; equal values keep their text."""
    texts = _marker_texts(marker)
    result, present, last = [], set(), 0
    for line in lines:
        match = _ENTRY_LINE.match(line)
        if match is None or match[2] not in _MARKER_KEYS[1:]:
            result.append(line)
            last = len(result) if match is not None else last
            continue
        key = match[2]
        present.add(key)
        if key not in texts:
            continue
        same = False
        with contextlib.suppress(ValueError):  # the bone is no number
            same = toml_number(float(match[3])) == texts[key]
        result.append(line if same else f"{match[1]}{texts[key]}{match[4]}")
        last = len(result)
    missing = [key for key in _OPTIONAL_KEYS if key in texts and key not in present]
    result[last:last] = [f"{key} = {texts[key]}" for key in missing]
    return result


def _is_text_of(text: str, layout: MarkerLayout) -> bool:
    """Whether a text describes this layout, to the precision of a file."""
    try:
        read = parse_layout(tomllib.loads(text))
    except (HandSimError, ValueError):
        return False
    same = dataclasses.replace(layout, name=read.name, radius=read.radius)
    return layout_lines(read) == layout_lines(same)
