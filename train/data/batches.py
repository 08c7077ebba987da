"""Draws batches for training: random rows, stretched, and corrupted by the paper's or a user's corruption."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from handsim._checks import as_numbers, check_callable, check_rng, check_type, shown_value
from handsim._plugins import call_plugin, load_plugin, plugin_name
from handsim.errors import ArgumentError
from handsim.hand.shape import SIDES
from handsim.settings import Limits, Settings

if TYPE_CHECKING:
    from train.data.shards import MappedRows

MAX_CHANGED: Final = 100
"""Largest number of points to add to a cloud or to drop from it."""

CORRUPTIONS: Final = "handsim.corruptions"
"""Group of entry points for corruptions."""
_NOUN: Final = "corruption"
_MAX_COORDINATE: Final = 10.0  # [m] largest coordinate of a point relative to the markers' center
_MAX_POINTS: Final = 512  # largest number of points in a cloud


@dataclass(frozen=True, slots=True)
class Corruption(Settings):
    """The paper's corruption, for training and for tests."""

    occlude: Annotated[int, Limits(0, MAX_CHANGED)] = 5
    """Largest number of draws of a marker to drop, with replacement, as the paper's ratio implies."""
    ghosts: Annotated[int, Limits(0, MAX_CHANGED)] = 2
    """Largest number of added ghosts, uniform in the sample's box grown by `margin`."""
    jitter: Annotated[float, Limits(0.0, 0.1)] = 0.0
    """Half width of the uniform noise on each coordinate [m]."""
    margin: Annotated[float, Limits(0.0, 10.0)] = 0.1
    """Growth of the box, as share of its sides."""


class Cloud(NamedTuple):
    """Clouds of points, padded to one length, in random order."""

    points: Float[np.ndarray, "B N 3"]
    """[m]; 0 in padding."""
    present: Bool[np.ndarray, "B N"]
    """False in padding."""
    truth: Int[np.ndarray, "B N"]
    """Marker of each point, -1 for a ghost."""


def corrupt(
    markers: Float[np.ndarray, "B M 3"],
    corruption: Corruption,
    *,
    ghosts: Float[np.ndarray, "B G 3"] | None = None,
    rng: np.random.Generator,
) -> Cloud:
    """Corrupt and shuffle clean markers (B, M) to clouds (B, N).

    Args:
        markers: Marker positions (B, M, 3) [m]; NaN where a marker is missing already.
        corruption: Additional random corruption.
        ghosts: Ghosts that the rig sees (B, G, 3) [m], NaN where there is none.
        rng: Source of all randomness.

    Returns:
        Points (B, N, 3) [m], which of them are present (B, N), and the marker of each (B, N), -1 for a ghost.

    Raises:
        ArgumentError: An argument is of another type or shape.
    """
    check_type("corruption", corruption, Corruption, "a Corruption")
    check_rng(rng)
    markers = as_numbers("markers", markers)
    if markers.ndim != 3 or markers.shape[2] != 3:
        raise ArgumentError(f"markers is {shown_value(markers)}, expected an array (B, M, 3) [m]")
    batch, count = markers.shape[:2]
    known = np.isfinite(markers).all(-1)
    positions = markers + rng.uniform(-corruption.jitter, corruption.jitter, markers.shape)
    dropped = np.zeros((batch, count), dtype=bool)
    if corruption.occlude:  # zero to `occlude` draws with replacement per row
        num_draws = rng.integers(0, corruption.occlude + 1, size=(batch,))
        draws = rng.integers(0, count, size=(batch, corruption.occlude))
        row, draw = np.nonzero(np.arange(corruption.occlude) < num_draws[:, None])
        dropped[row, draws[row, draw]] = True
    present = known & ~dropped
    drawn = _draw_ghosts(positions, known, corruption, rng)
    parts = [positions, drawn] if ghosts is None else [positions, drawn, ghosts]
    points = np.concatenate(parts, axis=1)
    present = np.concatenate([present, *(np.isfinite(part).all(-1) for part in parts[1:])], axis=1)
    truth = np.full(present.shape, -1)
    truth[:, :count] = np.arange(count)
    return shuffled(points, present, truth, rng=rng)


def shuffled(
    points: Float[np.ndarray, "B N 3"],
    present: Bool[np.ndarray, "B N"],
    truth: Int[np.ndarray, "B N"],
    *,
    rng: np.random.Generator,
) -> Cloud:
    """Shuffle the present points [m] into clouds, padded to the length of the fullest cloud."""
    order = rng.random(present.shape).argsort(axis=1)
    order = np.take_along_axis(
        order, np.take_along_axis(~present, order, 1).argsort(axis=1, kind="stable"), 1
    )
    width = max(1, int(present.sum(1).max()))
    order = order[:, :width]
    present = np.take_along_axis(present, order, 1)
    points = np.where(present[..., None], np.take_along_axis(points, order[..., None], 1), 0.0)
    return Cloud(points, present, np.take_along_axis(truth, order, 1))


def _draw_ghosts(
    positions: NDArray[np.float64], known: NDArray[np.bool_], corruption: Corruption, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Draw zero to `ghosts` points [m], uniformly in each cloud's box; NaN for those that are not drawn."""
    batch, max_ghosts = len(positions), corruption.ghosts
    low = np.where(known[..., None], positions, np.inf).min(1)
    high = np.where(known[..., None], positions, -np.inf).max(1)
    side = np.where(np.isfinite(high - low), high - low, np.nan)
    uniform = rng.uniform(-corruption.margin / 2, 1 + corruption.margin / 2, size=(batch, max_ghosts, 3))
    ghosts: NDArray[np.float64] = low[:, None] + uniform * side[:, None]
    num_ghosts = rng.integers(0, max_ghosts + 1, size=batch)
    ghosts[np.arange(max_ghosts) >= num_ghosts[:, None]] = np.nan
    return ghosts


class OwnCorruption(Protocol):
    """A user's own corruption: any function with this signature."""

    def __call__(
        self, markers: Float[np.ndarray, "B M 3"], *, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "B N 3"], Int[np.ndarray, "B N"]]:
        """Corrupt a batch.

        Args:
            markers: All markers of right hands [m], relative to each hand's center; left hands are mirrored.
            rng: Source of all randomness.

        Returns:
            Points [m] in any order, NaN in places without a point; and the marker of each, -1 for a ghost.
        """


def draw_cloud(
    corruption: Corruption | OwnCorruption | str,
    markers: Float[np.ndarray, "B M 3"],
    *,
    rng: np.random.Generator,
) -> Cloud:
    """Draw shuffled clouds (B, N) of clean markers [m], by the paper's or a user's corruption."""
    if isinstance(corruption, Corruption):
        return corrupt(markers, corruption, rng=rng)
    if isinstance(corruption, str):
        function = load_plugin(corruption, group=CORRUPTIONS, noun=_NOUN)
    else:
        check_callable(_NOUN, corruption, "a Corruption, a function (markers, *, rng), or its module:name")
        function = corruption
    name = plugin_name(corruption)
    returned = call_plugin(function, name, _NOUN, markers.copy(), rng=rng)
    owner = f"{_NOUN} '{name}'"
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise ArgumentError(f"{owner} returns {type(returned).__name__}, expected the pair points, labels")
    points = as_numbers(f"points of {owner}", returned[0])
    labels = as_numbers(f"labels of {owner}", returned[1], None)
    _check_result(owner, points, labels, *markers.shape[:2])
    present = np.asarray(np.isfinite(points).all(axis=-1))
    return shuffled(points, present, labels.astype(np.int64), rng=rng)


def check_corruption(corruption: OwnCorruption | str, num_markers: int) -> None:
    """Load a corruption and test it on two clouds."""
    rng = np.random.default_rng(0)
    draw_cloud(corruption, rng.uniform(-0.1, 0.1, (2, num_markers, 3)), rng=rng)


def _check_result(
    owner: str, points: NDArray[np.float64], labels: NDArray[np.generic], batch: int, count: int
) -> None:
    """Refuse an invalid result of a user's corruption for `count` markers."""
    if points.ndim != 3 or points.shape[0] != batch or points.shape[2] != 3 or points.shape[1] > _MAX_POINTS:
        raise ArgumentError(
            f"{owner} returns points of shape {points.shape}, expected ({batch}, N, 3) with N up to "
            f"{_MAX_POINTS}"
        )
    if labels.shape != points.shape[:2] or labels.dtype.kind not in "iu":
        raise ArgumentError(
            f"{owner} returns labels of type {labels.dtype} and shape {labels.shape}, expected whole numbers "
            f"{points.shape[:2]}"
        )
    missing = np.isnan(points)
    if (missing.any(axis=-1) != missing.all(axis=-1)).any() or (np.abs(points) > _MAX_COORDINATE).any():
        raise ArgumentError(
            f"{owner} returns points of which some coordinates are NaN or beyond {_MAX_COORDINATE:g} m, "
            "expected meters, and NaN for whole points that are missing"
        )
    known = np.where(missing.any(axis=-1), -1, labels).astype(np.int64)
    if known.min(initial=-1) < -1 or known.max(initial=-1) >= count:
        raise ArgumentError(
            f"{owner} returns labels from {known.min()} to {known.max()}, expected -1 to {count - 1}"
        )
    ordered = np.sort(known, axis=1)
    if ((ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any():
        raise ArgumentError(f"{owner} returns a marker twice in a cloud, expected each at most once")


class Weights(NamedTuple):
    """Factors for the losses of a part of a batch, so that their mean over all parts is the batch's loss."""

    points: float = 1.0
    """Factor of a mean over points."""
    clouds: float = 1.0
    """Factor of a mean over clouds."""


WHOLE: Final = Weights()
"""Factors for the whole batch."""


class Batch(NamedTuple):
    """Clouds and their true markers."""

    cloud: Cloud
    markers: Float[np.ndarray, "B M 3"]
    """True positions of all markers, centered like the clouds [m]."""
    weights: Weights = WHOLE


@dataclass(frozen=True, slots=True)
class Part:
    """The clouds of a batch for one of several processes: every `count`-th, starting from `first`."""

    first: int = 0
    count: int = 1

    def of(self, batch: Batch) -> Batch:
        """This part of a batch."""
        if self.count == 1:
            return batch
        chosen = slice(self.first, None, self.count)
        cloud, total = batch.cloud, batch.cloud.present.sum()
        width = max(1, int(cloud.present[chosen].sum(axis=1).max()))  # points come before padding
        part = Cloud(*(entry[chosen, :width] for entry in cloud))
        share = len(part.present) / len(cloud.present)
        weights = Weights(self.count * float(part.present.sum() / total), self.count * share)
        return Batch(part, batch.markers[chosen], weights)


def paper_corruption(num_markers: int) -> Corruption:
    """The paper's corruption of a layout: up to 5 draws of 19 markers, or 3 of 13, and up to 2 ghosts."""
    return Corruption(occlude=round(num_markers / 4), ghosts=2)


@dataclass(frozen=True, slots=True)
class BatchRecipe:
    """Parameters of the drawing of batches."""

    batch: int
    """Number of clouds."""
    corruption: Corruption | OwnCorruption | str
    """Corruption of clean markers: the paper's, a user's function, or its name."""
    jitter: float = 0.0
    """Largest half width of the uniform noise on each coordinate [m]; every batch draws its own."""
    rig_share: float = 0.0
    """Share of batches with the points that the simulated rig sees."""
    anisotropy: float = 0.0
    """Log standard deviation of the stretch of each hand along three random directions."""


def draw_batch(
    rows: NDArray[np.void] | MappedRows, recipe: BatchRecipe, *, rng: np.random.Generator
) -> Batch:
    """Draw corrupted, centered clouds of random rows [m]; left hands are mirrored to right ones."""
    chosen = rows[rng.integers(len(rows), size=recipe.batch)]
    markers = chosen["markers"].astype(np.float64)
    center = markers.mean(axis=1, keepdims=True)
    stretch = _mirrors(chosen["hand"]) @ _stretches(len(markers), recipe.anisotropy, rng)
    markers = (markers - center) @ stretch
    jitter = recipe.jitter * rng.uniform()
    if rng.random() < recipe.rig_share:
        observed = (chosen["observed"].astype(np.float64) - center) @ stretch
        ghosts = (chosen["ghosts"].astype(np.float64) - center) @ stretch
        corruption = Corruption(occlude=0, ghosts=0, jitter=jitter)
        return Batch(corrupt(observed, corruption, ghosts=ghosts, rng=rng), markers)
    own = recipe.corruption
    if isinstance(own, Corruption):
        own = dataclasses.replace(own, jitter=own.jitter + jitter)
    return Batch(draw_cloud(own, markers, rng=rng), markers)


def right_hands(
    rows: NDArray[np.void] | MappedRows, anisotropy: float, *, rng: np.random.Generator
) -> Float[np.ndarray, "B M 3"]:
    """Center the markers of all rows [m], mirror left hands, and stretch each hand at random."""
    markers = rows["markers"]
    centered = markers - markers.mean(axis=1, keepdims=True)
    return stretched(centered @ _mirrors(rows["hand"]), anisotropy, rng=rng)


def stretched(
    markers: Float[np.ndarray, "B M 3"], anisotropy: float, *, rng: np.random.Generator
) -> Float[np.ndarray, "B M 3"]:
    """Stretch hands [m] at random around the origin; anisotropy is the log standard deviation."""
    return markers @ _stretches(len(markers), anisotropy, rng)


def _stretches(count: int, anisotropy: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Symmetric matrices (B, 3, 3) that stretch along random orthogonal directions."""
    axes, _ = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    factors = np.exp(anisotropy * rng.standard_normal((count, 1, 3)))
    return np.asarray((axes * factors) @ axes.transpose(0, 2, 1))


def _mirrors(hand: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Matrices (B, 3, 3) that mirror left hands; hands of a person are stored in the order of `SIDES`."""
    mirrors = np.tile(np.eye(3), (len(hand), 1, 1))
    mirrors[hand % len(SIDES) == SIDES.index("left"), 0, 0] = -1.0
    return mirrors
