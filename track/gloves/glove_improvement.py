"""A search for a better layout near a given one: markers are moved, added and dropped one at a time.

Layouts are compared by labels of the same hands with the same occlusions (`judge`). At the end the old and
the new one are tried in captures that the search did not use.
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.fit import Attachment, GloveFit, attach_markers, wear
from gloves.layout import ACROSS_RANGE, ALONG_RANGE, MIN_MARKERS, MarkerLayout, MarkerPlace, load_layout
from gloves.optics.visibility import visible_cameras
from handsim.callbacks import OnStep, no_step
from handsim.errors import LayoutError
from handsim.hand.model import HandModel
from handsim.hand.shape import BONE_NAMES, PALM, SIDES
from handsim.space.objects import MARKER_RADIUS
from handsim.space.rig import CameraRig, load_rig
from track.gloves.glove_score import Trial, digit_of, layout_at, layout_spreads, palm_spread, try_layout
from track.user import ATTACHMENT_ARRAYS, AnyGlove
from train.data.batches import Corruption, corrupt
from train.evaluation import cloud_frames, evaluate_frames
from train.forecast.settings import ImproveGloveSettings
from train.labelers.layout_labeler import LayoutLabeler, learned_labeler, mean_features, shipped_network
from train.simulation.training_frames import GenerateSettings, sample_hands, sample_single_hand

_PEOPLE, _POSES_EACH = 40, 40
_JOINT_POSES: Final = 6  # poses per person for the spread of the joints
_CANDIDATES: Final = 10  # places tried at once
_NEARBY: Final = 6  # number of these that are near the marker's own place
_TRIED_PLACES: Final = 24  # number of tried places of a new marker
_STEP: Final = (0.15, float(np.deg2rad(20.0)), 0.1)  # standard deviations: along, around, across
_GRID: Final = (0.05, float(np.deg2rad(15.0)), 0.05)  # rounding of places: along, around, across
_LEAST_GAP: Final = 0.006  # [m] least gap between two markers' surfaces on the flat hand
_CREASE_MARGIN: Final = 0.005  # [m] distance from a joint within which the skin folds and stretches
_MOST_ALONG_TIP: Final = 0.9  # [bone lengths] farthest place on a last bone, where the nail's edge begins
_FEWEST_ON_PALM: Final = 3  # The palm's bone keeps this many markers, which determine its pose.
_SURE_PALM_SPREAD: Final = float(np.deg2rad(2.0))  # [rad] spread of the palm's pose that suffices
_PALM_ALONG, _PALM_ACROSS = (-0.1, 0.95), 0.36  # [bone lengths] along and across the palm
_FINGER_ALONG, _TIP_ALONG = (0.1, 1.05), (0.1, 0.9)  # [bone lengths] along a bone, a last bone
_PALM_SHARE: Final = 5.0  # random places on the palm for each one on a finger's bone
_SPREAD_DEG: Final = 35.0  # [deg] standard deviation about a finger's bone
_MOST_DEG: Final = 100.0  # [deg] largest angle about a finger's bone
_LEAST_DISTANCE: Final = 0.0025  # [m] least distance between two random places
_MOST_MISSES: Final = 500  # draws in a row without a free place, after which sampling ends
_PADS: Final = float(np.deg2rad(80.0))  # [rad] Farther around a finger a marker touches held objects.
_LEAST_GAIN: Final = 0.05  # A better layout costs less by at least this much.
_MOST_DRAWS: Final = 20  # attempts to draw a place
_TESTED_FRAMES: Final = 240  # frames whose labels are counted
_GHOSTS: Final = 2  # largest number of ghosts in a frame
_JOINT_COST: Final = 3.0  # cost of one degree of joint spread, in percent of slots
_MOST_DROPPED: Final = 3  # Layouts with up to this many markers less are compared, too.
_CHANCE: Final = 0.002  # difference in share of right slots that may be chance


class Worth(NamedTuple):
    """Figures of merit of a layout."""

    slots: float
    """Share of right slots, as a rig sees them and with ghosts."""
    joints: float
    """Root mean square spread of the joints [rad]."""
    by_marker: Float[np.ndarray, "M"]
    """Share of right slots of each marker."""

    @property
    def cost(self) -> float:
        """Cost to be minimized: wrong slots [%] and, weighted, the spread of the joints [deg]."""
        return 100.0 * (1.0 - self.slots) + _JOINT_COST * float(np.rad2deg(self.joints))

    def __str__(self) -> str:
        """Share of right slots and spread of the joints in words."""
        return (
            f"{100.0 * self.slots:.1f} % of the slots right with losses and ghosts, joints to "
            f"{np.rad2deg(self.joints):.1f} deg"
        )


@dataclass(frozen=True, slots=True, eq=False)
class ImprovedGlove:
    """A layout before and after a search."""

    start: MarkerLayout
    layout: MarkerLayout
    """The improved layout."""
    before: Worth
    after: Worth
    fewer: Sequence[tuple[int, Worth]]
    """Number of markers and worth of the glove, each time that the least useful marker was dropped."""
    trials: Mapping[str, Mapping[str, Trial]]
    """Results on captures by kind of work, under `before` and `after`; empty if none was tried."""

    @property
    def verdict(self) -> str | None:
        """One sentence on whether captures went better; None if none was tried."""
        return verdict(self.trials["before"], self.trials["after"]) if self.trials else None


def improve_glove(
    glove: AnyGlove,
    settings: ImproveGloveSettings | None = None,
    *,
    name: str = "improved",
    on_step: OnStep = no_step,
    **options: Any,
) -> ImprovedGlove:
    """Look for a better layout near a given one, as `handsim glove improve` does.

    Args:
        glove: Marker layout to start from, or its shipped name or the path of its .toml file.
        settings: Settings of the search.
        name: Name of the new layout.
        on_step: Called with the name of each step.
        options: Fields of `settings`, by name: `keep=("ThumbTip",)`, `minutes=10` [min].

    Raises:
        ArgumentError: A setting is unknown or refused.
        LayoutError, RigError: The glove or the rig is unknown, a marker is off the skin of a hand, or a name
            to keep is not in the layout.
    """
    chosen = ImproveGloveSettings.of(settings, options)
    layout, rig = load_layout(glove), load_rig(chosen.rig)
    count = layout.num_markers if chosen.markers is None else chosen.markers
    on_step("putting the glove on")
    search = Improvement(layout, rig, chosen.keep, rng=np.random.default_rng(chosen.seed))
    before = search.worth
    search.resize(count)
    search.search(60.0 * chosen.minutes, lambda worth: on_step(str(worth)))
    on_step("dropping one marker at a time, to compare")
    fewer = search.smaller(max(MIN_MARKERS, len(chosen.keep), count - _MOST_DROPPED))
    found = dataclasses.replace(search.layout, name=name)

    def trials_of(when: str, tried: MarkerLayout) -> dict[str, Trial]:
        on_step(f"learning the layout {when}, about a minute")
        labeler, told = learned_labeler(tried, rig), lambda words: on_step(f"trying captures {when}: {words}")
        return try_layout(tried, rig, labeler, count=chosen.captures, told=told)

    pairs = (("before", layout), ("after", found)) if chosen.captures else ()
    trials = {when: trials_of(when, tried) for when, tried in pairs}
    return ImprovedGlove(layout, found, before, search.worth, fewer, trials)


def verdict(before: Mapping[str, Trial], after: Mapping[str, Trial]) -> str:
    """One sentence on whether a layout did better in captures than another one."""
    tried = [list(trials.values()) for trials in (before, after)]
    slots = [float(np.mean([float(one.right.mean()) for one in trials])) for trials in tried]
    joints = [float(np.mean([one.joint_error for one in trials])) for trials in tried]
    told = (
        f"{100 * slots[0]:.2f} % of the slots were right before and {100 * slots[1]:.2f} % after, joints "
        f"{joints[0]:.1f} and {joints[1]:.1f} deg off"
    )
    if slots[1] < slots[0] - _CHANCE or (slots[1] < slots[0] + _CHANCE and not joints[1] < joints[0]):
        return f"Not better in captures: {told}. Keep the layout that you have, or search longer."
    return f"Better in captures: {told}."


class Columns(NamedTuple):
    """Places and their positions on all simulated hands; a layout is a sequence of columns."""

    places: tuple[MarkerPlace, ...]
    positions: Float[np.ndarray, "T P 3"]
    """[m], relative to the mean of the wrist."""
    seen: Bool[np.ndarray, "T P"]
    """Whether two or more cameras see each place."""
    worn: tuple[dict[str, NDArray[Any]], ...]
    """Tables of each person's `gloves.fit.Attachment`."""

    def chosen(self, columns: Sequence[int] | Int[np.ndarray, "Q"]) -> Columns:
        """Select columns in this order."""
        rows = np.asarray(columns)
        places = tuple(self.places[column] for column in rows)
        worn = tuple({name: table[rows] for name, table in one.items()} for one in self.worn)
        return Columns(places, self.positions[:, rows], self.seen[:, rows], worn)

    def renamed(self, number: int, name: str) -> Columns:
        """Return these columns with another name of the one at `number`."""
        places = list(self.places)
        places[number] = dataclasses.replace(places[number], name=name)
        return self._replace(places=tuple(places))

    def joined(self, other: Columns) -> Columns:
        """Append other columns of the same people."""
        return Columns(
            (*self.places, *other.places),
            np.concatenate([self.positions, other.positions], axis=1),
            np.concatenate([self.seen, other.seen], axis=1),
            tuple(
                {name: np.concatenate([one[name], two[name]]) for name in ATTACHMENT_ARRAYS}
                for one, two in zip(self.worn, other.worn, strict=True)
            ),
        )


class WornPlaces:
    """Places on the skin of the right hands of random people in random poses, seen by a rig."""

    def __init__(
        self, num_people: int, poses_each: int, radius: float, rig: CameraRig, *, rng: np.random.Generator
    ) -> None:
        config = GenerateSettings()
        self.radius, self._rig, self._rng = radius, rig, rng
        self._slip = config.slip_along, float(np.deg2rad(config.slip_around))
        self._people: list[tuple[HandModel, Float[np.ndarray, "T 27"], Float[np.ndarray, "T L 4 4"]]] = []
        for _ in range(num_people):
            model = sample_hands(config.population, rng=rng)[SIDES.index("right")]
            (qpos,) = sample_single_hand(model, poses_each, config, rng=rng).qpos
            self._people.append((model, qpos, model.forward_kinematics(qpos)))

    def put_on(self, places: Sequence[MarkerPlace]) -> Columns:
        """Attach slightly slipped markers to all hands; raise a `LayoutError` if one is off a hand's skin."""
        glove, (along, around) = layout_at(places, self.radius), self._slip
        positions, seen, worn = [], [], []
        for model, qpos, bones in self._people:
            one = wear(glove, model, along=along, around=around, rng=self._rng)
            markers, normals = one.markers(model, bones)
            capsules = model.capsules
            visible = visible_cameras(markers, normals, self._rig, capsules.posed(bones), capsules.radii)
            seen.append(visible.sum(axis=-1) >= 2)
            positions.append(markers - qpos[:, None, :3])
            worn.append({name: getattr(one, name) for name in ATTACHMENT_ARRAYS})
        copies = (*places, *[places[0]] * (glove.num_markers - len(places)))
        columns = Columns(copies, np.concatenate(positions), np.concatenate(seen), tuple(worn))
        return columns.chosen(range(len(places)))

    def joint_spreads(self, columns: Columns) -> Float[np.ndarray, "20"]:
        """`layout_spreads` of a layout of at least five places [rad]."""
        poses_each = len(self._people[0][1])
        step = max(1, poses_each // _JOINT_POSES)
        parts = []
        layout = MarkerLayout("places", columns.places, self.radius)
        for number, ((model, qpos, _), worn) in enumerate(zip(self._people, columns.worn, strict=True)):
            seen = columns.seen[number * poses_each : (number + 1) * poses_each : step]
            parts.append((GloveFit(model, Attachment(layout, **worn)), qpos[::step], seen))
        return layout_spreads(parts)


def judge(people: WornPlaces, layout: Columns, *, seed: int) -> Worth:
    """Label a layout with the network for any layout, without verification by a pose, and count errors.

    Layouts can be compared only with the same seed of occlusions and ghosts.
    """
    network = shipped_network()
    features = mean_features(layout.positions, network.config)[None]
    rng = np.random.default_rng(seed)
    step = max(1, len(layout.positions) // _TESTED_FRAMES)
    points = layout.positions[::step] - layout.positions[::step].mean(axis=1, keepdims=True)
    observed = np.where(layout.seen[::step, :, None], points, np.nan)
    half = len(layout.places) // 8  # half of the paper's occlusions, because the rig loses few markers
    cloud = corrupt(observed, Corruption(occlude=half, ghosts=_GHOSTS), rng=rng)
    worn = MarkerLayout("places", layout.places, people.radius)
    report = evaluate_frames(LayoutLabeler(worn, network, features, None), [cloud_frames(cloud)])
    by_marker = report.slot_accuracy_by_marker
    spreads = people.joint_spreads(layout)
    return Worth(float(by_marker.mean()), float(np.sqrt((spreads**2).mean())), by_marker)


class Improvement:
    """A layout that is improved step by step; markers named in `keep` do not move."""

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
        """Worth of the current layout."""

    @property
    def layout(self) -> MarkerLayout:
        """The current layout."""
        return dataclasses.replace(self._start, markers=self._columns.places)

    def resize(self, num_markers: int) -> None:
        """Add the best of some places, or drop the least useful marker, until the number is right."""
        while len(self._columns.places) < num_markers:
            self._adopt_best(self._grown_layouts())
        while len(self._columns.places) > num_markers:
            self._adopt_best(self._shrunk_layouts())

    def search(self, seconds: float, told: Callable[[Worth], None]) -> None:
        """Move one marker at a time until the time is over."""
        places, until = self._columns.places, time.monotonic() + seconds
        free = [number for number, place in enumerate(places) if place.name not in self._keep]
        while free and time.monotonic() < until:
            wrong = 1.02 - self.worth.by_marker[free]
            worth, columns = self._best(self._moves(int(self._rng.choice(free, p=wrong / wrong.sum()))))
            if columns is not None and worth.cost < self.worth.cost - _LEAST_GAIN:
                self.worth, self._columns = worth, columns
            told(self.worth)

    def smaller(self, fewest: int) -> list[tuple[int, Worth]]:
        """Worth without the least useful markers, dropped one by one; the layout itself is unchanged."""
        kept, found = (self.worth, self._columns), []
        while len(self._columns.places) > fewest:
            self._adopt_best(self._shrunk_layouts())
            found.append((len(self._columns.places), self.worth))
        self.worth, self._columns = kept
        return found

    def _judge(self, columns: Columns) -> Worth:
        return judge(self._people, columns, seed=self._seed)

    def _adopt_best(self, layouts: Sequence[Columns]) -> None:
        """Continue with the best of some layouts."""
        worth, columns = self._best(layouts)
        if columns is None:
            raise LayoutError("no place for another marker was found, expected a hand with free skin")
        self.worth, self._columns = worth, columns

    def _best(self, layouts: Sequence[Columns]) -> tuple[Worth, Columns | None]:
        judged = [(self._judge(layout), layout) for layout in layouts]
        return min(judged, key=lambda one: one[0].cost) if judged else (self.worth, None)

    def _wearable(self, layouts: Sequence[Columns]) -> list[Columns]:
        return [layout for layout in layouts if self.is_wearable(layout.places)]

    def is_wearable(self, places: Sequence[MarkerPlace]) -> bool:
        """Whether places keep all digits, crowd no bone and determine the palm, so that they may be used."""
        now, palm = self._columns.places, BONE_NAMES[PALM]
        bones, before = (Counter(place.bone for place in some) for some in (places, now))
        crowded = any(count > max(1, before[bone]) for bone, count in bones.items() if bone != palm)
        if crowded or not set(map(digit_of, now)) <= set(map(digit_of, places)):
            return False
        least = max(palm_spread(now, self._model), _SURE_PALM_SPREAD)
        return bones[palm] >= min(_FEWEST_ON_PALM, before[palm]) and palm_spread(places, self._model) <= least

    def _shrunk_layouts(self) -> list[Columns]:
        """The layout with one marker dropped, for each marker."""
        places = self._columns.places
        free = [number for number, place in enumerate(places) if place.name not in self._keep]
        if not free:
            raise LayoutError(f"all {len(places)} markers are to be kept, expected fewer than are left")
        everything = range(len(places))
        fewer = [self._columns.chosen([one for one in everything if one != number]) for number in free]
        return self._wearable(fewer) or fewer  # with too few markers no layout is wearable

    def _grown_layouts(self) -> list[Columns]:
        """The layout with a marker added, for some places."""
        count = len(self._columns.places)
        added = self._with_marker_at(count, self._sampled(_TRIED_PLACES, self._columns.places))
        return self._wearable(added) or added

    def _moves(self, number: int) -> list[Columns]:
        """The layout with one marker moved to some other places."""
        places = self._columns.places
        others = places[:number] + places[number + 1 :]
        near = (self._near_place(places[number], others) for _ in range(_NEARBY))
        found = [place for place in near if place is not None]
        found += self._sampled(_CANDIDATES - _NEARBY, others)
        return self._wearable(self._with_marker_at(number, found))

    def _with_marker_at(self, number: int, places: Sequence[MarkerPlace]) -> list[Columns]:
        """The layout with marker `number`, perhaps a new one, at each of some places."""
        try:
            fresh = self._people.put_on(places) if places else None
        except LayoutError:  # off the skin of some hand
            fresh = None
        if fresh is None:
            return []
        now = self._columns.places
        both, count, changed = self._columns.joined(fresh), len(now), []
        for one, place in enumerate(fresh.places, count):
            stays = number < count and now[number].bone == place.bone
            columns = both.chosen([*range(number), one, *range(number + 1, count)])
            changed.append(columns.renamed(number, now[number].name if stays else self._new_name(place.bone)))
        return changed

    def _near_place(self, place: MarkerPlace, others: Sequence[MarkerPlace]) -> MarkerPlace | None:
        """A free place near another one, or None."""
        for _ in range(_MOST_DRAWS):
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
                return moved
        return None

    def _on_grid(self, place: MarkerPlace) -> MarkerPlace | None:
        """The nearest place on the grid; None if it is on a crease, on the inside or off the bone."""
        bone = BONE_NAMES.index(place.bone)
        low, high = _PALM_ALONG
        if bone != PALM:
            margin = _CREASE_MARGIN / float(self._model.skeleton.lengths[bone])
            low, high = margin, _MOST_ALONG_TIP if place.bone.endswith("distal") else 1.0 - margin
        numbers = zip((place.along, place.around, place.across), _GRID, strict=True)
        along, around, across = (round(step * round(value / step), 6) for value, step in numbers)
        fits = low <= along <= high and abs(around) <= _PADS and abs(across) <= _PALM_ACROSS
        return dataclasses.replace(place, along=along, around=around, across=across) if fits else None

    def _sampled(self, count: int, others: Sequence[MarkerPlace]) -> list[MarkerPlace]:
        """Random places on the back and sides of the hand, away from creases and other markers."""
        found: list[MarkerPlace] = []
        for place in map(self._on_grid, sample_places(_MOST_DRAWS + 4 * count, rng=self._rng)):
            if place is not None and len(found) < count and self._is_clear(place, others):
                found.append(place)
        return found

    def _is_clear(self, place: MarkerPlace, others: Sequence[MarkerPlace]) -> bool:
        """Whether a place is on the skin and away from the other markers of the flat hand."""
        try:
            points = attach_markers(layout_at((*others, place), self._start.radius), self._model).points
        except LayoutError:
            return False
        apart = np.linalg.norm(points[:-1] - points[-1], axis=1).min()
        return bool(apart > 2.0 * self._start.radius + _LEAST_GAP)

    def _new_name(self, bone: str) -> str:
        """A new name for a marker on a bone, such as IndexMiddle2."""
        stem = "".join(word.capitalize() for word in bone.split("_"))
        taken = {place.name for place in self._columns.places}
        return next(name for number in range(1, 100) if (name := f"{stem}{number}") not in taken)


def sample_places(
    num_places: int, *, rng: np.random.Generator, apart: float = _LEAST_DISTANCE
) -> tuple[MarkerPlace, ...]:
    """Random places on the back and sides of the flat hand; fewer if no more fit."""
    model = HandModel.named("M")
    share = np.where(np.arange(len(BONE_NAMES)) == PALM, _PALM_SHARE, 1.0)
    places: list[MarkerPlace] = []
    points: list[Float[np.ndarray, "3"]] = []
    missed = 0
    while len(places) < num_places and missed < _MOST_MISSES:
        bone = int(rng.choice(len(BONE_NAMES), p=share / share.sum()))
        name = BONE_NAMES[bone]
        if bone == PALM:
            along, around = rng.uniform(*_PALM_ALONG), 0.0
            across = rng.uniform(-_PALM_ACROSS, _PALM_ACROSS)
        else:
            along = rng.uniform(*(_TIP_ALONG if name.endswith("distal") else _FINGER_ALONG))
            around, across = (np.clip(_SPREAD_DEG * rng.standard_normal(), -_MOST_DEG, _MOST_DEG), 0.0)
        place = MarkerPlace(f"place{len(places)}", name, along, float(np.deg2rad(around)), across)
        missed += 1
        try:
            point = np.asarray(attach_markers(layout_at([place], MARKER_RADIUS), model).points[0])
        except LayoutError:
            continue  # the place is off the skin
        if all(np.linalg.norm(point - other) > apart for other in points):
            places.append(place)
            points.append(point)
            missed = 0
    return tuple(places)
