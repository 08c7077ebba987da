"""Places on the skin of fixed people in fixed poses: the columns that layouts are put together from."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.fit import Attachment, GloveFit, wear
from gloves.layout import FEWEST_MARKERS, MarkerLayout, MarkerPlace
from gloves.optics.visibility import visible_cameras
from handsim.hand.model import HandModel
from handsim.hand.shape import SIDES
from handsim.space.rig import CameraRig
from track.glove_advice.joint_spread import pose_spreads
from train.simulation.training_frames import GenerateSettings, sample_hands, sample_single_hand

_TABLES: Final = ("points", "normals", "bone_indices", "bone_weights")
_JOINT_POSES: Final = 6  # of a person, from which the joints' spread is taken


class Columns(NamedTuple):
    """Places, and where they are on everybody; a layout is some columns in order."""

    places: tuple[MarkerPlace, ...]
    positions: Float[np.ndarray, "T P 3"]
    """[m], around the mean of the wrist."""
    seen: Bool[np.ndarray, "T P"]
    """By two cameras or more."""
    worn: tuple[dict[str, NDArray[Any]], ...]
    """The tables of each person's `gloves.fit.Attachment`."""

    def chosen(self, columns: Sequence[int] | Int[np.ndarray, "Q"]) -> Columns:
        """Some columns in this order."""
        rows = np.asarray(columns)
        return Columns(
            tuple(self.places[column] for column in rows),
            self.positions[:, rows],
            self.seen[:, rows],
            tuple({name: table[rows] for name, table in one.items()} for one in self.worn),
        )

    def renamed(self, number: int, name: str) -> Columns:
        """The same columns, one with another name."""
        places = list(self.places)
        places[number] = dataclasses.replace(places[number], name=name)
        return self._replace(places=tuple(places))

    def layout(self, radius: float, name: str = "places") -> MarkerLayout:
        """The layout of these places, whose names must differ."""
        return MarkerLayout(name, self.places, radius)

    def joined(self, other: Columns) -> Columns:
        """These columns, then others of the same people."""
        return Columns(
            (*self.places, *other.places),
            np.concatenate([self.positions, other.positions], axis=1),
            np.concatenate([self.seen, other.seen], axis=1),
            tuple(
                {name: np.concatenate([one[name], two[name]]) for name in _TABLES}
                for one, two in zip(self.worn, other.worn, strict=True)
            ),
        )


class WornPlaces:
    """Right hands of random people in random poses before a rig.

    Args:
        poses_each: Poses of each.
    """

    def __init__(
        self, num_people: int, poses_each: int, radius: float, rig: CameraRig, *, rng: np.random.Generator
    ) -> None:
        config = GenerateSettings()
        self._radius, self._rig, self._rng = radius, rig, rng
        self._slip = config.slip_along, float(np.deg2rad(config.slip_around))
        self._people: list[tuple[HandModel, Float[np.ndarray, "T 27"], Float[np.ndarray, "T L 4 4"]]] = []
        for _ in range(num_people):
            model = sample_hands(config.population, rng=rng)[SIDES.index("right")]
            (qpos,) = sample_single_hand(model, poses_each, config, rng=rng).qpos
            self._people.append((model, qpos, model.forward_kinematics(qpos)))

    def put_on(self, places: Sequence[MarkerPlace]) -> Columns:
        """Put markers on everybody, each slipped a little.

        Raises:
            LayoutError: A place misses the skin of somebody.
        """
        copies = (*places, *[places[0]] * (FEWEST_MARKERS - len(places)))  # the fewest that a glove has
        named = [dataclasses.replace(place, name=str(number)) for number, place in enumerate(copies)]
        glove, (along, around) = MarkerLayout("places", tuple(named), self._radius), self._slip
        positions, seen, worn = [], [], []
        for model, qpos, bones in self._people:
            one = wear(glove, model, along=along, around=around, rng=self._rng)
            markers, normals = one.markers(model, bones)
            capsules = model.capsules
            visible = visible_cameras(markers, normals, self._rig, capsules.posed(bones), capsules.radii)
            seen.append(visible.sum(axis=-1) >= 2)
            positions.append(markers - qpos[:, None, :3])
            worn.append({name: getattr(one, name) for name in _TABLES})
        columns = Columns(copies, np.concatenate(positions), np.concatenate(seen), tuple(worn))
        return columns.chosen(range(len(places)))

    def joint_spreads(self, columns: Columns) -> Float[np.ndarray, "20"]:
        """Standard deviation that the markers of a layout leave of each joint [rad].

        Args:
            columns: The layout, of five places or more; see `track.glove_advice.joint_spread`.
        """
        poses_each = len(self._people[0][1])
        step = max(1, poses_each // _JOINT_POSES)
        parts = []
        layout = columns.layout(self._radius)
        for number, ((model, qpos, _), worn) in enumerate(zip(self._people, columns.worn, strict=True)):
            seen = columns.seen[number * poses_each : (number + 1) * poses_each : step]
            parts.append((GloveFit(model, Attachment(layout, **worn)), qpos[::step], seen))
        return pose_spreads(parts)
