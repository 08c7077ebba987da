"""The commands `handsim glove list | show | new | check`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro
from rich.text import Text

from gloves.layout import (
    MarkerLayout,
    list_layouts,
    load_layout,
    shipped_layout,
    starter_layout,
)
from handsim.app.messages import print_line, print_table
from handsim.errors import LayoutError
from handsim.files.outputs import check_outputs, write_starter
from handsim.hand.shape import SIZES

if TYPE_CHECKING:
    from gloves.fit import GloveFit


def list_gloves(out: Path | None = None) -> None:
    """List the marker layouts that come with handsim: markers, labeler and source of each.

    Args:
        out: A picture of all of them, a .png file.
    """
    from train.labelers.storage import shipped_labelers

    labeled = shipped_labelers()
    rows: list[list[str | Text]] = [["name", "markers", "labeler", "description and source"]]
    for name in list_layouts():
        shipped = shipped_layout(name)
        labeler = "comes with it" if name in labeled else "for any layout"
        text = Text(shipped.description).append(f"\n{shipped.source}", "dim")
        rows.append([name, str(shipped.layout.num_markers), labeler, text])
    print_table(rows, left=4, wraps=True)
    print_line(
        "The labeler for any layout needs no training. A better one of its own for NAME: handsim generate "
        "--glove NAME --out SET && handsim train SET --out RUN, then give --labeler RUN."
    )
    if out is not None:
        from render.captions import write_png
        from render.illustrations import draw_gloves

        write_png(out, draw_gloves([_fitted(load_layout(name), "M") for name in list_layouts()]))
        print_line(f"{out}: the gloves on hands of size M")


def show_glove(glove: Annotated[str, tyro.conf.Positional]) -> None:
    """Show a layout's markers.

    Args:
        glove: A shipped name or the path of a .toml file.
    """
    layout = load_layout(glove)
    rows = [["", "name", "bone", "along", "around [deg]", "across", "stalk [mm]"]]
    for number, marker in enumerate(layout.markers):
        across = f"{marker.across:.2f}" if marker.bone == "palm" else ""
        around = f"{np.rad2deg(marker.around):.0f}"
        height = f"{1e3 * marker.height:.1f}" if marker.height else ""
        rows.append([str(number), marker.name, marker.bone, f"{marker.along:.2f}", around, across, height])
    print_line(f"{layout.name}: {layout.num_markers} markers")
    print_table(rows, left=3)
    print_line(
        f"Radius {1e3 * layout.radius:.1f} mm. Along: 0 at the bone's near end, 1 at its far end. Around: 0 "
        "on the back, 90 on the thumb's side. Across: hand breadths from the palm's middle towards the thumb."
    )
    if len(layout.sides) == 1:
        print_line(f"For a {layout.sides[0]} hand only.")
    if glove in list_layouts():
        print_line(f"Source: {shipped_layout(glove).source}")


def new_glove(file: Annotated[Path, tyro.conf.Positional]) -> None:
    """Write a commented layout file as a start for a glove of your own.

    Args:
        file: A new .toml file.
    """
    write_starter(file, starter_layout(), error=LayoutError)
    print_line(f"{file}: edit it, then run `handsim glove check {file}`")


def check_glove(
    glove: Annotated[str, tyro.conf.Positional],
    out: Path | None = None,
    size: Literal["XS", "S", "M", "L", "XL"] = "M",
) -> None:
    """Check a layout on hands of all five sizes, and draw it from the back, the palm and the thumb's side.

    Args:
        glove: A .toml file or a shipped name.
        out: The picture, a .png file; named after the glove when not given.
        size: Size of the hand in the picture.
    """
    from gloves.fit import nearest_markers, nominal_fit

    layout = load_layout(glove)
    picture = Path(glove).with_suffix(".png") if out is None else out
    check_outputs([glove], [picture])
    rows, overlaps = [["size", "nearest two markers", "centers apart [mm]"]], []
    for name in SIZES:
        first, second, distance = nearest_markers(_fitted(layout, name))
        pair = f"{first} and {second}"
        rows.append([name, pair, f"{1e3 * distance:.1f}"])
        if distance < 2 * layout.radius:
            overlaps.append(f"{pair} on size {name}")
    print_table(rows, left=2, title=f"{layout.name}: {layout.num_markers} markers")
    if overlaps:
        raise LayoutError(
            f"{glove}: markers of {2e3 * layout.radius:.1f} mm overlap: {', '.join(overlaps)}; "
            "move them apart"
        )
    from render.captions import write_png
    from render.illustrations import draw_glove

    write_png(picture, draw_glove(nominal_fit(layout, size, layout.sides[-1])))
    print_line(f"{picture}: the glove on a hand of size {size}")


def _fitted(layout: MarkerLayout, size: str) -> GloveFit:
    from gloves.fit import nominal_fit

    try:
        return nominal_fit(layout, size, layout.sides[-1])
    except LayoutError as error:
        raise LayoutError(f"on a hand of size {size}: {error}") from error
