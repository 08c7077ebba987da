"""The people of a simulation: the shapes of their two hands, and the gloves as they wear them."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np

from gloves.attachment import wear
from gloves.fit import GloveFit
from gloves.layout import MarkerLayout
from handsim.errors import ArgumentError, PoseError
from handsim.hand.model import HandModel
from handsim.hand.shape import ADULTS, SIDES, Population, sample_shape
from poses.shapes.validity import resting_angles

NO_REST: Final = "person: fingers overlap at rest"
"""Reason for which a person is drawn again."""
_MAX_PEOPLE: Final = 1000


def sample_hands(
    population: Population, *, redrawn: Counter[str] | None = None, rng: np.random.Generator
) -> tuple[HandModel, ...]:
    """A random person's left and right hand, whose fingers do not overlap at rest.

    Those who were drawn again are counted in `redrawn`, by reason.
    """
    for _ in range(_MAX_PEOPLE):
        shape = sample_shape(population, side=SIDES[0], rng=rng)
        models = tuple(HandModel(dataclasses.replace(shape, side=side)) for side in SIDES)
        try:
            resting_angles(models[0])
        except PoseError:
            if redrawn is not None:
                redrawn[NO_REST] += 1
            continue
        return models
    raise ArgumentError(
        f"the fingers of all {_MAX_PEOPLE} people drawn from the population overlap at rest, expected a "
        f"population with smaller spreads than {population}"
    )


def sample_adult_hands(*, rng: np.random.Generator) -> tuple[HandModel, HandModel]:
    """Right and left hand of a random adult, for takes."""
    shape = sample_shape(ADULTS, side="right", rng=rng)
    return HandModel(shape), HandModel(dataclasses.replace(shape, side="left"))


def wear_gloves(
    layout: MarkerLayout,
    models: Sequence[HandModel],
    *,
    along: float,
    around: float,
    rng: np.random.Generator,
) -> tuple[GloveFit, ...]:
    """The same glove on each hand, its markers slipped a little.

    Args:
        along: Standard deviation of the slip along the bones [bone lengths].
        around: Standard deviation of the slip around the bones [rad].

    Raises:
        LayoutError: A marker misses the skin however it slips.
    """
    return tuple(
        GloveFit(model, wear(layout, model, along=along, around=around, rng=rng)) for model in models
    )
