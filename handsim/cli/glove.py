"""The commands `handsim glove list | show | new | learn | check | score | improve`."""

from __future__ import annotations

import warnings
from datetime import date
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.text import Text

from gloves.layout import (
    MarkerLayout,
    MarkerPlace,
    list_layouts,
    load_layout,
    shipped_layout,
    starter_layout,
)
from handsim.app.messages import named_steps, print_line, print_table
from handsim.errors import CaptureError, HandSimWarning, LayoutError
from handsim.files.inputs import check_there
from handsim.files.outputs import as_text, check_outputs, write_starter
from handsim.hand.shape import SIZES, Size
from track.gloves.settings import LearnSettings
from train.forecast.settings import ImproveGloveSettings, ScoreGloveSettings


def list_glove(out: Path | None = None) -> None:
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
        rows.append([name, _count(shipped.layout), labeler, text])
    print_table(rows, left=4, wraps=True)
    print_line(
        "The labeler for any layout needs no training. One of its own for NAME: handsim generate --glove "
        "NAME --out SET && handsim train SET --out RUN, which says whether to use it (--labeler RUN)."
    )
    if out is not None:
        from gloves.fit import nominal_fit
        from render.captions import write_png
        from render.illustrations import draw_gloves

        layouts = map(load_layout, list_layouts())
        write_png(out, draw_gloves([nominal_fit(layout, "M", layout.sides[-1]) for layout in layouts]))
        print_line(f"{out}: the gloves on hands of size M")


def _count(layout: MarkerLayout) -> str:
    """The number of markers, those on the forearm counted apart."""
    return f"{layout.num_markers}{f' + {len(layout.forearm)}' if layout.forearm else ''}"


def show_glove(glove: Annotated[str, tyro.conf.Positional]) -> None:
    """Show a layout's markers.

    Args:
        glove: A shipped name or the path of a .toml file.
    """
    layout = load_layout(glove)
    rows = [["", "name", "bone", "along", "around [deg]", "across", "stalk [mm]"]]
    for number, marker in enumerate((*layout.markers, *layout.forearm)):
        across = f"{marker.across:.2f}" if marker.bone == "palm" else ""
        around = f"{np.rad2deg(marker.around):.0f}"
        height = f"{1e3 * marker.height:.1f}" if marker.height else ""
        rows.append([str(number), marker.name, marker.bone, f"{marker.along:.2f}", around, across, height])
    print_line(f"{layout.name}: {_count(layout)} markers")
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


def learn_glove(
    captures: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    settings: Annotated[LearnSettings, tyro.conf.arg(name="")],
    users: Path | None = None,
    prove: bool = True,
) -> None:
    """Learn a layout from labeled captures: where each marker sits, whatever its column is called.

    Each column must be one marker all the time. Which one is found, in about a minute; columns of arms and
    objects are left out. Best is a minute in which all fingers bend and spread.

    Args:
        captures: Labeled .c3d, .trc, .csv (Motive, Vicon) or .tsv (Qualisys) files, of one or more people.
        out: The layout, a .toml file; its page (.html) lies beside it.
        settings: What is known of the glove.
        users: A folder for a user's file of each capture, NAME.json: its hands, with their own places.
        prove: Whether the last third of each capture, which is not learned from, is labeled at the end.
    """
    page, names = out.with_suffix(".html"), [as_text(one.name) for one in captures]
    files = [] if users is None else [users / f"{one.stem}.json" for one in captures]
    check_outputs([*captures, settings.start], [out, page, *files], ".toml")
    if not captures:
        raise CaptureError("no capture was given, expected one labeled marker file or more")
    for capture in captures:
        check_there(capture, error=CaptureError)
    from track.gloves import learned_glove
    from track.gloves.learned_page import hand_rows, marker_rows, origin, write_learned_page
    from track.gloves.proof import prove_glove
    from train.evaluation import percent, percent_between

    with named_steps("") as step:
        learned = learned_glove.learn_glove(captures, settings, name=as_text(out.stem), on_step=step)
    layout, used = learned.layout, sorted({one.capture for one in learned.hands})
    source = f"handsim glove learn, {date.today()}, from {', '.join(names[number] for number in used)}"
    layout.save(out, description=origin(learned), source=source)
    print_table(marker_rows(learned), left=2, title=f"{layout.name}: {layout.num_markers} markers")
    for name, side, count, length, breadth in hand_rows(learned, names)[1:]:
        print_line(f"{name}: a {side} hand of {length} x {breadth} mm with {count} markers")
    print_line(*learned.left_out, *learned.doubt)
    write_learned_page(page, learned, names)
    print_line(f"{page}: the markers on the hand")
    if users is not None:
        for number, user in zip(used, learned.users(), strict=True):
            user.save(files[number])
            print_line(f"{files[number]}: the hands of {names[number]}, for --shape")
    if prove and settings.start is None:
        with named_steps("labeling what was not learned from"):
            proof = prove_glove(learned, captures, rng=np.random.default_rng(0))
        share, worst = percent_between(proof.frames, proof.interval), percent(min(proof.by_capture))
        what = "(95 % interval, one frame a second counts) of the frames of the captures' last thirds"
        print_line(
            f"{share} % {what} are labeled right in every marker; {worst} % in the worst capture, "
            f"{percent(proof.slots)} % of the markers"
        )
    print_line(f"{out}: run `handsim label NEXT.c3d --glove {out} --out labeled.c3d` on the next capture")


def check_glove(
    glove: Annotated[str, tyro.conf.Positional],
    out: Path | None = None,
    size: Size = "M",
) -> None:
    """Check a layout on hands of all five sizes, and draw it from all sides with its slips on 100 people.

    A layout must fit a hand of size M. What does not fit another size is reported; there markers give way.

    Args:
        glove: A .toml file or a shipped name.
        out: The picture, a .png file; named after the glove when not given.
        size: Size of the hand in the picture.
    """
    from gloves.fit import nearest_markers, nominal_fit

    layout = load_layout(glove)
    side = layout.sides[-1]
    picture = Path(glove).with_suffix(".png") if out is None else out
    check_outputs([glove], [picture])
    rows, overlaps = [["size", "nearest two markers", "centers apart [mm]"]], dict[str, str]()
    for name in SIZES:
        worn = nominal_fit(layout, name, side)
        first, second, distance = nearest_markers(worn)
        pair = f"{first} and {second}"
        rows.append([name, pair, f"{1e3 * distance:.1f}"])
        if distance < 2 * layout.radius:
            overlaps[name] = f"{pair} on size {name}"
        moved = [
            one.name for one, place in zip(layout.markers, worn.layout.markers, strict=True) if one != place
        ]
        if moved:
            where = f"off its digit on size {name}, where it is worn nearer to the middle of its bone's back"
            warnings.warn(f"{glove}: {', '.join(moved)} would be {where}", HandSimWarning, stacklevel=2)
    print_table(rows, left=2, title=f"{layout.name}: {_count(layout)} markers")
    if overlaps:
        overlap = f"{glove}: markers of {2e3 * layout.radius:.1f} mm overlap: {', '.join(overlaps.values())}"
        if "M" in overlaps:
            raise LayoutError(f"{overlap}; move them apart")
        warnings.warn(overlap, HandSimWarning, stacklevel=2)
    from render.captions import write_png
    from render.illustrations import draw_glove
    from train.simulation.training_frames import GenerateSettings, slipped_gloves

    fit, rng = nominal_fit(layout, size, side), np.random.default_rng(0)
    slips = slipped_gloves(layout, fit.model, GenerateSettings(), rng=rng)
    write_png(picture, draw_glove(fit, slips=slips))
    print_line(
        f"{picture}: the glove on a hand of size {size}; below, where the slips of `handsim generate` put "
        f"each marker on {len(slips)} people"
    )


def score_glove(
    glove: Annotated[str, tyro.conf.Positional],
    settings: Annotated[ScoreGloveSettings, tyro.conf.arg(name="")],
    out: Path | None = None,
) -> None:
    """Say how well a layout can be labeled and what it tells of each joint; nothing is trained.

    Short captures of hands apart, hands that touch and real-like motion are simulated, and labeled and
    tracked as `handsim label` and `handsim track` do with nothing calibrated: they are what to expect.

    Args:
        glove: A .toml file or a shipped name.
        settings: What hands do, before which rig.
        out: The page, an .html file; named after the glove when not given.
    """
    page = Path(glove).with_suffix(".html") if out is None else out
    check_outputs([glove, settings.rig, settings.motion], [page], ".html")
    from track.gloves import glove_score
    from track.gloves.glove_page import trial_rows, write_glove_page, wrong_line
    from train.evaluation import percent, percent_between

    with named_steps("") as step:
        score = glove_score.score_glove(glove, settings, on_step=step)
    if score.trials:
        print_line(wrong_line(score))
        print_line("captures, hands not calibrated; slots and whole frames that are right:")
        print_table(trial_rows(score.trials, score.layout), left=6, wraps=True)
    print_line("single frames, without tracking:")
    for title, report in (
        ("as the rig sees them", score.observed),
        ("with the paper's drops and ghosts", score.corrupted),
        ("where every marker is seen", score.clean),
    ):
        share = percent_between(report.figures["slot_accuracy"], report.interval())
        print_line(f"{share} % of the slots right {title}")
    print_line(f"{percent(score.seen.mean())} % of the markers seen")
    joints = np.rad2deg(score.joints)
    print_line(
        "joints of calibrated hands, frame by frame: standard deviation "
        f"{np.sqrt((joints**2).mean()):.1f} deg, the worst {joints.max():.1f} deg; {_palm_line(score.layout)}"
    )
    print_line(*(f"{number}. {sentence}" for number, sentence in enumerate(score.advice, 1)))
    write_glove_page(page, score)
    print_line(f"{page}: the hand with its confusions, markers and joints")


def improve_glove(
    glove: Annotated[str, tyro.conf.Positional],
    out: Path,
    settings: Annotated[ImproveGloveSettings, tyro.conf.arg(name="")],
) -> None:
    """Look for a better layout near a given one: move, add or drop markers.

    At the end both are tried as `handsim glove score` tries one.

    Args:
        glove: A .toml file or a shipped name to begin with.
        out: The new layout, a .toml file.
        settings: How to search.
    """
    check_outputs([glove, settings.rig], [out], ".toml")
    from track.gloves import glove_improvement
    from track.gloves.glove_page import trial_rows

    with named_steps("") as step:
        improved = glove_improvement.improve_glove(glove, settings, name=as_text(out.stem), on_step=step)
    layout, found = improved.start, improved.layout
    found.save(out)
    print_line(f"before: {layout.num_markers} markers, {improved.before}, {_palm_line(layout)}")
    print_line(f"after:  {found.num_markers} markers, {improved.after}, {_palm_line(found)}")
    for name, trials in improved.trials.items():
        print_line(f"{name}, captures of people that the search did not see, hands not calibrated:")
        print_table(trial_rows(trials, layout if name == "before" else found), left=6, wraps=True)
    if improved.verdict is not None:
        print_line(improved.verdict)
    print_line(*(f"        {fewer} markers, {worth}" for fewer, worth in improved.fewer))
    old = {marker.name: marker for marker in layout.markers}
    for marker in found.markers:
        if old.get(marker.name) != marker:
            verb = "move" if marker.name in old else "add"
            print_line(f"{verb} {marker.name}: {_place_line(marker)}")
    print_line(*(f"drop {name}" for name in sorted(set(old) - set(found.names))))
    print_line(f"{out}: run `handsim glove check {out}` and `handsim glove score {out}`")


def _palm_line(layout: MarkerLayout) -> str:
    from handsim.hand.model import HandModel
    from track.gloves.glove_score import palm_spread

    spread = np.rad2deg(palm_spread(layout.markers, HandModel.named("M")))
    if not np.isfinite(spread):
        return "the palm has not three markers in a triangle, so that they alone do not tell its rotation"
    return f"the palm's own markers tell its rotation to {spread:.1f} deg"


def _place_line(marker: MarkerPlace) -> str:
    place = f"{marker.bone}, along {marker.along:.2f}"
    if marker.across:
        return f"{place}, across {marker.across:.2f}"
    return f"{place}, around {np.rad2deg(marker.around):.0f} deg"
