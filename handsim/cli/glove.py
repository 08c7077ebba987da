"""The commands `handsim glove list | show | new | check | score | improve`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from gloves.layout import (
    MarkerLayout,
    MarkerPlace,
    list_layouts,
    load_layout,
    shipped_layout,
    starter_layout,
)
from handsim.app.messages import print_line
from handsim.app.progress import named_steps
from handsim.errors import LayoutError
from handsim.files.outputs import as_text, check_ending, check_outputs, write_starter
from handsim.hand.shape import SIZES

if TYPE_CHECKING:
    from gloves.fit import GloveFit
    from track.glove_advice.layout_score import LayoutScore
    from track.glove_advice.trials import Trial


def list_gloves(out: Path | None = None) -> None:
    """List the marker layouts that come with handsim: markers, labeler and source of each.

    Args:
        out: A picture of all of them, a .png file.
    """
    from train.labelers.storage import shipped_labelers

    labeled = shipped_labelers()
    table = Table("name", "markers", "labeler", "description and source", box=None, pad_edge=False)
    for name in list_layouts():
        shipped = shipped_layout(name)
        labeler = "comes with it" if name in labeled else "for any layout"
        text = Text(shipped.description).append(f"\n{shipped.source}", "dim")
        table.add_row(name, str(shipped.layout.num_markers), labeler, text)
    Console().print(table)
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
    table = Table(box=None, pad_edge=False)
    for column in ("", "name", "bone"):
        table.add_column(column, no_wrap=True)
    for column in ("along", "around [deg]", "across", "stalk [mm]"):
        table.add_column(Text(column), justify="right")
    for number, marker in enumerate(layout.markers):
        across = f"{marker.across:.2f}" if marker.bone == "palm" else ""
        around = f"{np.rad2deg(marker.around):.0f}"
        height = f"{1e3 * marker.height:.1f}" if marker.height else ""
        along = f"{marker.along:.2f}"
        table.add_row(str(number), Text(marker.name), marker.bone, along, around, across, height)
    print_line(f"{layout.name}: {layout.num_markers} markers")
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
    table = Table("size", "nearest two markers", title=Text(f"{layout.name}: {layout.num_markers} markers"))
    table.add_column(Text("centers apart [mm]"), justify="right")
    overlaps = []
    for name in SIZES:
        first, second, distance = nearest_markers(_fitted(layout, name))
        pair = f"{first} and {second}"
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


def score_glove(
    glove: Annotated[str, tyro.conf.Positional],
    rig: str = "figure5",
    motion: str = "poses",
    out: Path | None = None,
    num_frames: Annotated[int, tyro.conf.arg(aliases=["--frames"])] = 1500,
    labeler: str | None = None,
    captures: int = 3,
    seed: int = 0,
) -> None:
    """Say how well a layout can be labeled and what it tells of each joint; nothing is trained.

    Short captures of one hand, two apart and two that touch are simulated, and labeled and tracked as
    `handsim label` and `handsim track` do with nothing calibrated: they are what to expect.

    Args:
        glove: A .toml file or a shipped name.
        rig: Camera rig: a shipped name or the path of a .toml file.
        motion: What hands do: poses (random people and poses), twins (simulated motion of one hand and of
            two) or a take (.npz) of `handsim track` or `handsim simulate`.
        out: The page, an .html file; named after the glove when not given.
        num_frames: Frames of hands, of a take those of each hand.
        labeler: Folder of a labeler trained on the layout, or an exported .onnx file; the network for any
            layout when not given.
        captures: Captures of each kind of work that are tried, of different people; 0 for none.
        seed: Seed of people, poses and cameras' losses; captures have their own.
    """
    page = Path(glove).with_suffix(".html") if out is None else out
    check_ending(page, ".html")
    check_outputs([glove, rig, motion], [page])
    from track.glove_advice import scoring
    from track.glove_advice.score_page import write_score_page

    with named_steps("getting ready") as step:
        score = scoring.score_glove(
            glove,
            rig,
            motion=motion,
            labeler=labeler,
            num_frames=num_frames,
            captures=captures,
            seed=seed,
            on_step=step,
        )
    _tell(score)
    for number, sentence in enumerate(score.advice, 1):
        print_line(f"{number}. {sentence}")
    write_score_page(page, score)
    print_line(f"{page}: the hand with its confusions, markers and joints")


def _tell(score: LayoutScore) -> None:
    """Print the figures of a score."""
    from train.evaluation import percent

    joints = np.rad2deg(score.joints)
    for title, report in (
        ("as the rig sees them", score.observed),
        ("where every marker is seen", score.clean),
        ("with the paper's drops and ghosts", score.corrupted),
    ):
        print_line(f"{percent(report.figures['slot_accuracy'])} % of the slots right {title}")
    print_line(f"{percent(score.seen.mean())} % of the markers seen; {percent(score.sides_right)} % of the "
               "hands told left from right")  # fmt: skip
    print_line(
        "joints of calibrated hands, frame by frame: standard deviation "
        f"{np.sqrt((joints**2).mean()):.1f} deg, the worst {joints.max():.1f} deg; {_palm_line(score.layout)}"
    )
    _tell_trials(score.trials, score.layout)


def _tell_trials(trials: Mapping[str, Trial], layout: MarkerLayout) -> None:
    """Print what became of simulated captures, nothing calibrated."""
    from track.glove_advice.score_page import trial_rows

    if not trials:
        return
    print_line("captures, hands not calibrated; slots and whole frames that are right:")
    header, *rows = trial_rows(trials, layout)
    table = Table(box=None, pad_edge=False)
    for column in header:
        table.add_column(Text(column))
    for row in rows:
        table.add_row(*map(Text, row))
    Console().print(table)


def improve_glove(
    glove: Annotated[str, tyro.conf.Positional],
    out: Path,
    markers: int | None = None,
    keep: tuple[str, ...] = (),
    rig: str = "figure5",
    minutes: float = 3.0,
    captures: int = 3,
    seed: int = 0,
) -> None:
    """Look for a better layout near a given one: move, add or drop markers.

    At the end both are tried as `handsim glove score` tries one.

    Args:
        glove: A .toml file or a shipped name to begin with.
        out: The new layout, a .toml file.
        markers: Number of markers of the new layout; as many as before when not given.
        keep: Names of markers that stay where they are.
        rig: Camera rig: a shipped name or the path of a .toml file.
        minutes: How long to move markers.
        captures: Captures of each kind of work on which both layouts are tried at the end; 0 for none.
        seed: Seed of people, poses and tries.
    """
    check_ending(out, ".toml")
    check_outputs([glove, rig], [out])
    from track.glove_advice import improving

    with named_steps("getting ready") as step:
        improved = improving.improve_glove(
            glove,
            rig,
            markers=markers,
            keep=keep,
            minutes=minutes,
            captures=captures,
            name=as_text(out.stem),
            seed=seed,
            on_step=step,
        )
    layout, found = improved.start, improved.layout
    found.save(out)
    print_line(f"before: {layout.num_markers} markers, {improved.before}, {_palm_line(layout)}")
    print_line(f"after:  {found.num_markers} markers, {improved.after}, {_palm_line(found)}")
    for name, trials in improved.trials.items():
        print_line(f"{name}, on people that the search did not see:")
        _tell_trials(trials, layout if name == "before" else found)
    if improved.verdict is not None:
        print_line(improved.verdict)
    for fewer_count, worth in improved.fewer:
        print_line(f"        {fewer_count} markers, {worth}")
    old = {marker.name: marker for marker in layout.markers}
    for marker in found.markers:
        if old.get(marker.name) != marker:
            verb = "move" if marker.name in old else "add"
            print_line(f"{verb} {marker.name}: {_place_line(marker)}")
    for name in sorted(set(old) - set(found.names)):
        print_line(f"drop {name}")
    print_line(f"{out}: run `handsim glove check {out}` and `handsim glove score {out}`")


def _palm_line(layout: MarkerLayout) -> str:
    from handsim.hand.model import HandModel
    from track.glove_advice.joint_spread import palm_spread

    spread = np.rad2deg(palm_spread(layout.markers, HandModel.named("M")))
    if not np.isfinite(spread):
        return "the palm has not three markers in a triangle, so that they alone do not tell its rotation"
    return f"the palm's own markers tell its rotation to {spread:.1f} deg"


def _place_line(marker: MarkerPlace) -> str:
    place = f"{marker.bone}, along {marker.along:.2f}"
    if marker.across:
        return f"{place}, across {marker.across:.2f}"
    return f"{place}, around {np.rad2deg(marker.around):.0f} deg"


GLOVE: Final[dict[str, Callable[..., Any]]] = {
    "list": list_gloves,
    "show": show_glove,
    "new": new_glove,
    "check": check_glove,
    "score": score_glove,
    "improve": improve_glove,
}
