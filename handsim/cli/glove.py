"""The commands `handsim glove list | show | new | check`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from rich.text import Text

from gloves.fit import GloveFit, nominal_fit
from gloves.layout import MarkerLayout, list_layouts, load_layout, shipped_layout, starter_layout
from handsim.app.messages import print_line
from handsim.errors import LayoutError
from handsim.files.atomic import atomic_write
from handsim.files.outputs import check_outputs
from handsim.hand.shape import SIZES

LABELED_GLOVES: Final = ("dense19", "sparse13")
"""Gloves whose trained labeler comes with handsim."""


def list_gloves(out: Path | None = None) -> None:
    """List the marker layouts that come with handsim: markers, labeler and source of each.

    Args:
        out: A picture of all of them, a .png file.
    """
    table = Table("name", "markers", "labeler", "description and source", box=None, pad_edge=False)
    for name in list_layouts():
        shipped = shipped_layout(name)
        labeler = "comes with it" if name in LABELED_GLOVES else "for any layout"
        text = Text(shipped.description).append(f"\n{shipped.source}", "dim")
        table.add_row(name, str(shipped.layout.num_markers), labeler, text)
    Console().print(table)
    print_line(
        "A labeler of its own for NAME: handsim generate --glove NAME --out SET && handsim train SET "
        "--out RUN, then give --labeler RUN."
    )
    if out is not None:
        from render.illustrations.captions import write_png
        from render.illustrations.hands import draw_gloves

        write_png(out, draw_gloves([_fitted(load_layout(name), "M") for name in list_layouts()]))
        print_line(f"{out}: the gloves on hands of size M")


def show_glove(glove: Annotated[str, tyro.conf.Positional]) -> None:
    """Show a layout's markers.

    Args:
        glove: A shipped name or the path of a .toml file.
    """
    layout = load_layout(glove)
    table = Table(
        "", "name", "bone", title=Text(f"{layout.name}: {layout.num_markers} markers"), title_justify="left"
    )
    for column in ("along", "around [deg]", "across", "stalk [mm]"):
        table.add_column(Text(column), justify="right")
    for number, marker in enumerate(layout.markers):
        across = f"{marker.across:.2f}" if marker.bone == "palm" else ""
        around = f"{np.rad2deg(marker.around):.0f}"
        height = f"{1e3 * marker.height:.1f}" if marker.height else ""
        along = f"{marker.along:.2f}"
        table.add_row(str(number), Text(marker.name), marker.bone, along, around, across, height)
    console = Console()
    console.print(table)
    console.print(
        f"Radius {1e3 * layout.radius:.1f} mm. Along: 0 at the bone's near end, 1 at its far end. Around: 0 "
        "on the back, 90 on the thumb's side. Across: hand breadths from the palm's middle towards the thumb."
    )
    if len(layout.sides) == 1:
        console.print(f"For a {layout.sides[0]} hand only.")
    if glove in list_layouts():
        console.print(Text(f"Source: {shipped_layout(glove).source}"))


def new_glove(file: Annotated[Path, tyro.conf.Positional]) -> None:
    """Write a commented layout file as a start for a glove of your own.

    Args:
        file: A new .toml file.
    """
    if file.suffix.lower() != ".toml":
        raise LayoutError(f"{file}: expected a file name that ends in .toml")
    if file.exists():
        raise LayoutError(f"{file} exists already and is left as it is; name a new file")
    with atomic_write(file) as temporary:
        temporary.write_text(starter_layout(), "utf-8")
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
    layout = load_layout(glove)
    picture = Path(glove).with_suffix(".png") if out is None else out
    check_outputs([glove], [picture])
    table = Table("size", "nearest two markers", title=Text(f"{layout.name}: {layout.num_markers} markers"))
    table.add_column(Text("centers apart [mm]"), justify="right")
    overlaps = []
    for name in SIZES:
        first, second, distance = nearest_pair(_fitted(layout, name).attachment.points)
        pair = f"{layout.names[first]} and {layout.names[second]}"
        table.add_row(name, Text(pair), f"{1e3 * distance:.1f}")
        if distance < 2 * layout.radius:
            overlaps.append(f"{pair} on size {name}")
    console = Console()
    console.print(table)
    if overlaps:
        raise LayoutError(
            f"{glove}: markers of {2e3 * layout.radius:.1f} mm overlap: {', '.join(overlaps)}; "
            "move them apart"
        )
    from render.illustrations.captions import write_png
    from render.illustrations.hands import draw_glove

    write_png(picture, draw_glove(nominal_fit(layout, size, layout.sides[-1])))
    print_line(f"{picture}: the glove on a hand of size {size}")


def nearest_pair(points: NDArray[np.float64]) -> tuple[int, int, float]:
    """The two nearest of some points (N, 3), and their distance."""
    distances = np.linalg.norm(points[:, None] - points, axis=-1)
    np.fill_diagonal(distances, np.inf)
    first, second = divmod(int(distances.argmin()), len(points))
    return first, second, float(distances[first, second])


def _fitted(layout: MarkerLayout, size: str) -> GloveFit:
    try:
        return nominal_fit(layout, size, layout.sides[-1])
    except LayoutError as error:
        raise LayoutError(f"on a hand of size {size}: {error}") from error


GLOVE: Final[dict[str, Callable[..., Any]]] = {
    "list": list_gloves,
    "show": show_glove,
    "new": new_glove,
    "check": check_glove,
}
