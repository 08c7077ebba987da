"""The commands `handsim glove score | improve`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from gloves.layout import MarkerLayout, MarkerPlace
from handsim.app.messages import named_steps, print_line, print_table
from handsim.files.outputs import as_text, check_ending, check_outputs
from train.forecast.settings import ImproveGloveSettings, ScoreGloveSettings


def score_glove(
    glove: Annotated[str, tyro.conf.Positional],
    settings: Annotated[ScoreGloveSettings, tyro.conf.arg(name="")],
    out: Path | None = None,
) -> None:
    """Say how well a layout can be labeled and what it tells of each joint; nothing is trained.

    Short captures of one hand, two apart and two that touch are simulated, and labeled and tracked as
    `handsim label` and `handsim track` do with nothing calibrated: they are what to expect.

    Args:
        glove: A .toml file or a shipped name.
        settings: What hands do, before which rig.
        out: The page, an .html file; named after the glove when not given.
    """
    page = Path(glove).with_suffix(".html") if out is None else out
    check_ending(page, ".html")
    check_outputs([glove, settings.rig, settings.motion], [page])
    from track import glove_score
    from track.glove_page import trial_rows, write_glove_page
    from train.evaluation import percent

    with named_steps("getting ready") as step:
        score = glove_score.score_glove(glove, settings, on_step=step)
    for title, report in (
        ("as the rig sees them", score.observed),
        ("where every marker is seen", score.clean),
        ("with the paper's drops and ghosts", score.corrupted),
    ):
        print_line(f"{percent(report.figures['slot_accuracy'])} % of the slots right {title}")
    sides = f"{percent(score.sides_right)} % of the hands told left from right"
    print_line(f"{percent(score.seen.mean())} % of the markers seen; {sides}")
    joints = np.rad2deg(score.joints)
    print_line(
        "joints of calibrated hands, frame by frame: standard deviation "
        f"{np.sqrt((joints**2).mean()):.1f} deg, the worst {joints.max():.1f} deg; {_palm_line(score.layout)}"
    )
    if score.trials:
        print_line("captures, hands not calibrated; slots and whole frames that are right:")
        print_table(trial_rows(score.trials, score.layout), left=6, wraps=True)
    for number, sentence in enumerate(score.advice, 1):
        print_line(f"{number}. {sentence}")
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
    check_ending(out, ".toml")
    check_outputs([glove, settings.rig], [out])
    from track import glove_improvement
    from track.glove_page import trial_rows

    with named_steps("getting ready") as step:
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
    from track.glove_score import palm_spread

    spread = np.rad2deg(palm_spread(layout.markers, HandModel.named("M")))
    if not np.isfinite(spread):
        return "the palm has not three markers in a triangle, so that they alone do not tell its rotation"
    return f"the palm's own markers tell its rotation to {spread:.1f} deg"


def _place_line(marker: MarkerPlace) -> str:
    place = f"{marker.bone}, along {marker.along:.2f}"
    if marker.across:
        return f"{place}, across {marker.across:.2f}"
    return f"{place}, around {np.rad2deg(marker.around):.0f} deg"
