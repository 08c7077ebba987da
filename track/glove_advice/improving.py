"""A better layout near a given one, tried beside it in captures that the search did not see."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from gloves.layout import FEWEST_MARKERS, MOST_MARKERS, MarkerLayout, load_layout
from handsim._checks import check_count, check_number
from handsim.callbacks import OnStep, no_step
from handsim.space.rig import CameraRig, as_rig
from track.glove_advice.improvement import Improvement, Worth
from track.glove_advice.trials import CAPTURES, Trial, try_layout, verdict
from track.user import AnyGlove
from train.labelers.layout_labeler import learned_labeler

_FEWER: Final = 3  # markers by which smaller layouts are compared with an improved one


@dataclass(frozen=True, slots=True, eq=False)
class ImprovedGlove:
    """A layout before and after a search."""

    start: MarkerLayout
    layout: MarkerLayout
    """The better one."""
    before: Worth
    after: Worth
    fewer: Sequence[tuple[int, Worth]]
    """How good it is without its least useful markers: how many are left, and its worth."""
    trials: Mapping[str, Mapping[str, Trial]]
    """What became of captures `before` and `after`, by kind of work; empty where none was tried."""

    @property
    def verdict(self) -> str | None:
        """Whether it did better in captures, in a sentence; None where none was tried."""
        return verdict(self.trials["before"], self.trials["after"]) if self.trials else None


def improve_glove(
    glove: AnyGlove,
    rig: CameraRig | str | Path = "figure5",
    *,
    markers: int | None = None,
    keep: str | Collection[str] = (),
    minutes: float = 3.0,
    captures: int = CAPTURES,
    name: str = "improved",
    seed: int = 0,
    on_step: OnStep = no_step,
) -> ImprovedGlove:
    """Look for a better layout near a given one, as `handsim glove improve` does.

    Args:
        glove: Marker layout to begin with, or its shipped name or the path of its .toml file.
        rig: The cameras, or the name or path of a rig.
        markers: Number of markers of the new layout; as many as before when not given.
        keep: Names of markers that stay where they are.
        minutes: How long to move markers [min].
        captures: Simulated captures of each kind of work on which both layouts are tried at the end, as
            `score_glove` tries one; 0 for none.
        name: Name of the new layout.
        seed: Seed of people, poses and tries.
        on_step: Called with the name of each step.

    Raises:
        ArgumentError: A number is out of range.
        LayoutError, RigError: The glove or the rig is unknown, a marker misses the skin of somebody, or a
            name to keep is none of the layout's.
    """
    layout, cameras = load_layout(glove), as_rig(rig)
    kept = (keep,) if isinstance(keep, str) else tuple(keep)
    count = layout.num_markers if markers is None else markers
    check_count("markers", count, FEWEST_MARKERS, MOST_MARKERS)
    check_count("captures", captures, 0)
    check_number("minutes", minutes, 0.0)
    check_count("seed", seed, 0)
    on_step("putting the glove on")
    search = Improvement(layout, cameras, kept, rng=np.random.default_rng(seed))
    before = search.worth
    search.resize(count)
    search.search(60.0 * minutes, lambda worth: on_step(str(worth)))
    on_step("dropping one marker at a time, to compare")
    fewer = search.smaller(max(FEWEST_MARKERS, len(kept), count - _FEWER))
    found = dataclasses.replace(search.layout, name=name)
    trials = {
        when: _tried(tried, cameras, captures, when, on_step)
        for when, tried in (("before", layout), ("after", found))
        if captures
    }
    return ImprovedGlove(layout, found, before, search.worth, fewer, trials)


def _tried(layout: MarkerLayout, rig: CameraRig, count: int, when: str, on_step: OnStep) -> dict[str, Trial]:
    on_step(f"learning the layout {when}, about a minute")
    labeler = learned_labeler(layout, rig)
    return try_layout(
        layout, rig, labeler, count=count, told=lambda words: on_step(f"trying captures {when}: {words}")
    )
