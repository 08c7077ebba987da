"""A search for a better layout near a given one: markers are moved, added and dropped, one at a time.

Layouts are compared by labels of the same hands with the same losses (`judge`).
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from gloves.fit import attach_markers
from gloves.layout import ACROSS_RANGE, ALONG_RANGE, MarkerLayout, MarkerPlace
from handsim.errors import LayoutError
from handsim.hand.model import HandModel
from handsim.hand.shape import BONE_NAMES, BONES, PALM
from handsim.space.rig import CameraRig
from track.glove_advice.joint_spread import palm_spread
from track.glove_advice.worn_places import Columns, WornPlaces
from train.data.batches import Corruption, corrupt
from train.evaluation import LabelCounts
from train.labelers.layout_labeler import mean_features, shipped_network
from train.labelers.layout_training import sample_places
from train.labelers.matching import match_probabilities, pair_probabilities
from train.labelers.protocol import labeling_threads

_PEOPLE, _POSES_EACH = 40, 40
_CANDIDATES: Final = 10  # places that are tried at once
_LOCAL: Final = 6  # of them near the marker's own
_ADDED: Final = 24  # places that are tried for a new marker
_STEP: Final = (0.15, float(np.deg2rad(20.0)), 0.1)  # standard deviations: along, around, across
_GRID: Final = (0.05, float(np.deg2rad(15.0)), 0.05)  # of places that a person finds with a ruler
_CLEAR: Final = 0.006  # between two markers' surfaces on the flat hand [m]
_CREASE: Final = 0.005  # from a joint, within which the skin folds and stretches [m]
_TIP: Final = 0.9  # of the last bone: beyond it is the nail's edge
_ON_BACK: Final = 3  # markers on the palm's bone, from which its pose is known
_PALM_SURE: Final = float(np.deg2rad(2.0))  # spread of the palm's pose that is enough [rad]
_PALM_ALONG, _PALM_ACROSS = (-0.1, 0.95), 0.36
_PADS: Final = float(np.deg2rad(80.0))  # beyond this angle a finger's marker touches what is held
_GAIN: Final = 0.05  # of a better layout, at least [points]
_TRIES: Final = 20  # draws of a place
_TESTED: Final = 240  # frames whose labels are counted
_GHOSTS: Final = 2  # at most
_OF_JOINTS: Final = 3.0  # percent of the slots that a degree of the joints counts for


class Improvement:
    """A layout that gets better step by step.

    Args:
        layout: Where to begin.
        keep: Names of markers that stay where they are.

    Raises:
        LayoutError: A marker misses the skin of somebody, or a name to keep is none of the layout's.
    """

    def __init__(
        self, layout: MarkerLayout, rig: CameraRig, keep: Collection[str], *, rng: np.random.Generator
    ) -> None:
        unknown = sorted(set(keep) - set(layout.names))
        if unknown:
            raise LayoutError(
                f"to be kept are {', '.join(unknown)}, expected markers of the layout: "
                f"{', '.join(layout.names)}"
            )
        self._start, self._keep, self._rng = layout, frozenset(keep), rng
        self._model = HandModel.named("M")
        self._people = WornPlaces(_PEOPLE, _POSES_EACH, layout.radius, rig, rng=rng)
        self._seed = int(rng.integers(2**31))
        self._columns = self._people.put_on(layout.markers)
        self.worth = self._judge(self._columns)
        """How good the layout so far is."""

    @property
    def layout(self) -> MarkerLayout:
        """The layout so far."""
        return dataclasses.replace(self._start, markers=self._columns.places)

    def resize(self, num_markers: int) -> None:
        """Add the best of some places, or drop the least useful marker, until there are so many.

        Raises:
            LayoutError: More markers than that are to be kept.
        """
        while len(self._columns.places) < num_markers:
            self._take(self._grown())
        while len(self._columns.places) > num_markers:
            self._take(self._shrunk())

    def search(self, seconds: float, told: Callable[[Worth], None]) -> None:
        """Move markers while time lasts."""
        places, until = self._columns.places, time.monotonic() + seconds
        free = [number for number, place in enumerate(places) if place.name not in self._keep]
        while free and time.monotonic() < until:
            wrong = 1.02 - self.worth.by_marker[free]
            worth, columns = self._best(self._moved(int(self._rng.choice(free, p=wrong / wrong.sum()))))
            if columns is not None and worth.cost < self.worth.cost - _GAIN:
                self.worth, self._columns = worth, columns
            told(self.worth)

    def smaller(self, fewest: int) -> list[tuple[int, Worth]]:
        """How good the layout is without its least useful markers, one after the other; it stays as it is."""
        kept, found = (self.worth, self._columns), []
        while len(self._columns.places) > fewest:
            self._take(self._shrunk())
            found.append((len(self._columns.places), self.worth))
        self.worth, self._columns = kept
        return found

    def _judge(self, columns: Columns) -> Worth:
        return judge(self._people, columns, seed=self._seed)

    def _take(self, layouts: Sequence[Columns]) -> None:
        """Go on with the best of some layouts."""
        worth, columns = self._best(layouts)
        if columns is None:
            raise LayoutError("no place for another marker was found, expected a hand with free skin")
        self.worth, self._columns = worth, columns

    def _best(self, layouts: Sequence[Columns]) -> tuple[Worth, Columns | None]:
        judged = [(self._judge(layout), layout) for layout in layouts]
        return min(judged, key=lambda one: one[0].cost) if judged else (self.worth, None)

    def _wearable(self, layouts: Sequence[Columns]) -> list[Columns]:
        """Layouts in which every digit that has a marker keeps one, no bone a crowd, the palm enough."""
        return [layout for layout in layouts if self._is_wearable(layout.places)]

    def _is_wearable(self, places: Sequence[MarkerPlace]) -> bool:
        """Whether markers may replace those of the layout so far."""
        now, palm = self._columns.places, BONE_NAMES[PALM]
        bones, before = (Counter(place.bone for place in some) for some in (places, now))
        crowded = any(count > max(1, before[bone]) for bone, count in bones.items() if bone != palm)
        if crowded or not set(map(_digit, now)) <= set(map(_digit, places)):
            return False
        least = max(palm_spread(now, self._model), _PALM_SURE)
        return bones[palm] >= min(_ON_BACK, before[palm]) and palm_spread(places, self._model) <= least

    def _shrunk(self) -> list[Columns]:
        """The layout without each of its markers."""
        places = self._columns.places
        free = [number for number, place in enumerate(places) if place.name not in self._keep]
        if not free:
            raise LayoutError(f"all {len(places)} markers are to be kept, expected fewer than are left")
        everything = range(len(places))
        fewer = [self._columns.chosen([one for one in everything if one != number]) for number in free]
        return self._wearable(fewer) or fewer  # where there are too few for all digits and the palm

    def _grown(self) -> list[Columns]:
        """The layout with another marker at some places."""
        count = len(self._columns.places)
        fresh = self._put_on(self._anywhere(_ADDED, self._columns.places))
        if fresh is None:
            return []
        both = self._columns.joined(fresh)
        added = [both.chosen([*range(count), count + one]) for one in range(len(fresh.places))]
        named = [one.renamed(count, self._new_name(one.places[count].bone)) for one in added]
        return self._wearable(named) or named

    def _moved(self, number: int) -> list[Columns]:
        """The layout with one marker at some other places."""
        places = self._columns.places
        others = places[:number] + places[number + 1 :]
        near = [place for _ in range(_LOCAL) for place in self._near(places[number], others)]
        fresh = self._put_on([*near, *self._anywhere(_CANDIDATES - _LOCAL, others)])
        if fresh is None:
            return []
        both, count = self._columns.joined(fresh), len(places)
        moved = [
            both.chosen([*range(number), count + one, *range(number + 1, count)])
            for one in range(len(fresh.places))
        ]
        named = [one.renamed(number, self._name_after(places[number], one.places[number])) for one in moved]
        return self._wearable(named)

    def _put_on(self, places: Sequence[MarkerPlace]) -> Columns | None:
        try:
            return self._people.put_on(places) if places else None
        except LayoutError:  # it misses the skin of somebody's hand
            return None

    def _near(self, place: MarkerPlace, others: Sequence[MarkerPlace]) -> Iterator[MarkerPlace]:
        """A place near another one, if one is found."""
        for _ in range(_TRIES):
            along, around, across = self._rng.standard_normal(3) * _STEP
            palm = place.bone == BONE_NAMES[PALM]
            moved = self._on_grid(
                dataclasses.replace(
                    place,
                    along=float(np.clip(place.along + along, *ALONG_RANGE)),
                    around=place.around if palm else float(np.clip(place.around + around, -_PADS, _PADS)),
                    across=float(np.clip(place.across + across, *ACROSS_RANGE)) if palm else 0.0,
                )
            )
            if moved is not None and self._is_clear(moved, others):
                yield moved
                return

    def _on_grid(self, place: MarkerPlace) -> MarkerPlace | None:
        """The nearest place that a ruler finds, on the back or a side and off the creases; None without."""
        bone = BONE_NAMES.index(place.bone)
        low, high = _PALM_ALONG
        if bone != PALM:
            margin = _CREASE / float(self._model.skeleton.lengths[bone])
            low, high = margin, _TIP if place.bone.endswith("distal") else 1.0 - margin
        along, around, across = (
            round(step * round(value / step), 6)
            for value, step in zip((place.along, place.around, place.across), _GRID, strict=True)
        )
        fits = low <= along <= high and abs(around) <= _PADS and abs(across) <= _PALM_ACROSS
        return dataclasses.replace(place, along=along, around=around, across=across) if fits else None

    def _anywhere(self, count: int, others: Sequence[MarkerPlace]) -> list[MarkerPlace]:
        """Places anywhere on the back and the sides of the hand, clear of the creases and other markers."""
        found: list[MarkerPlace] = []
        for place in map(self._on_grid, sample_places(_TRIES + 4 * count, rng=self._rng)):
            if place is not None and len(found) < count and self._is_clear(place, others):
                found.append(place)
        return found

    def _is_clear(self, place: MarkerPlace, others: Sequence[MarkerPlace]) -> bool:
        """Whether a place is on the skin and not too near to the other markers of the flat hand."""
        names = [str(number) for number in range(len(others) + 1)]
        markers = [
            dataclasses.replace(one, name=name) for one, name in zip((*others, place), names, strict=True)
        ]
        try:
            points = attach_markers(
                dataclasses.replace(self._start, markers=tuple(markers)), self._model
            ).points
        except LayoutError:
            return False
        apart = np.linalg.norm(points[:-1] - points[-1], axis=1).min()
        return bool(apart > 2.0 * self._start.radius + _CLEAR)

    def _name_after(self, old: MarkerPlace, new: MarkerPlace) -> str:
        """The name of a marker that was moved: a new one if it went to another bone."""
        return old.name if old.bone == new.bone else self._new_name(new.bone)

    def _new_name(self, bone: str) -> str:
        """A name for a marker on a bone, as IndexMiddle2."""
        stem = "".join(word.capitalize() for word in bone.split("_"))
        taken = {place.name for place in self._columns.places}
        return next(name for number in range(1, 100) if (name := f"{stem}{number}") not in taken)


def _digit(place: MarkerPlace) -> int:
    return BONES[BONE_NAMES.index(place.bone)].digit


class Worth(NamedTuple):
    """How good a layout is."""

    slots: float
    """Share of slots that are right, as a rig sees them and with ghosts."""
    joints: float
    """Root mean square spread of the joints [rad]."""
    by_marker: Float[np.ndarray, "M"]
    """Share of each marker's slots that are right."""

    @property
    def cost(self) -> float:
        """What a better layout has less of: wrong slots [%] and, weighted, the spread of the joints [deg]."""
        return 100.0 * (1.0 - self.slots) + _OF_JOINTS * float(np.rad2deg(self.joints))

    def __str__(self) -> str:
        """Both shares in words."""
        return (
            f"{100.0 * self.slots:.1f} % of the slots right with losses and ghosts, joints to "
            f"{np.rad2deg(self.joints):.1f} deg"
        )


def judge(people: WornPlaces, layout: Columns, *, seed: int) -> Worth:
    """Label a layout with the network for any layout, without verification by a pose, and count.

    Args:
        seed: Of losses and ghosts: the same for layouts that are compared.
    """
    network = shipped_network()
    features = mean_features(layout.positions, network.config)[None]
    rng = np.random.default_rng(seed)
    step = max(1, len(layout.positions) // _TESTED)
    points = layout.positions[::step] - layout.positions[::step].mean(axis=1, keepdims=True)
    observed = np.where(layout.seen[::step, :, None], points, np.nan)
    half = len(layout.places) // 8  # the rig loses few; half of the paper's recipe on top
    cloud = corrupt(observed, Corruption(occlude=half, ghosts=_GHOSTS), rng=rng)
    with torch.inference_mode(), labeling_threads():
        scores = network(
            torch.from_numpy(cloud.points.astype(np.float32)), torch.from_numpy(cloud.present), features
        )[-1]
    count, right = len(layout.places), np.zeros(len(layout.places))
    counts = LabelCounts(confusion=np.zeros((count + 1, count + 1), dtype=np.int64))
    for by_point, by_label, here, truth in zip(
        scores.points.numpy(), scores.labels.numpy(), cloud.present, cloud.truth, strict=True
    ):
        of_points = np.concatenate([by_label[:, :-1][:, here], by_label[:, -1:]], axis=1)
        labels = match_probabilities(pair_probabilities(by_point[here], of_points))
        right += counts.add(labels, truth[here], count)
    by_marker = right / len(cloud.truth)
    spreads = people.joint_spreads(layout)
    return Worth(float(by_marker.mean()), float(np.sqrt((spreads**2).mean())), by_marker)
