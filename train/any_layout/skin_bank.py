"""Many places on the skin in many poses of many people: any layout of markers is a choice among them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Float16, Int

from gloves.fit import attach_markers, wear
from gloves.layout import MOST_MARKERS, MarkerLayout, MarkerPlace
from handsim.errors import LayoutError
from handsim.hand.model import HandModel
from handsim.hand.topology import BONE_NAMES, PALM, SIDES
from handsim.space.transforms import MIRROR
from train.simulation.scenes import sample_hands
from train.simulation.training_frames import GenerateSettings, sample_frame_scene

_MOST_MISSED: Final = 500  # draws in a row without a free place
_APART: Final = 0.0025  # [m] between two places of a bank, at least
_PALM_SHARE: Final = 5.0  # of places, against a finger's bone
_PALM_ALONG, _PALM_ACROSS = (-0.1, 0.95), 0.36
_FINGER_ALONG, _TIP_ALONG = (0.1, 1.05), (0.1, 0.9)
_AROUND: Final = 35.0  # standard deviation of the angle about a finger's bone [deg]
_MOST_AROUND: Final = 100.0  # [deg]
_RADIUS: Final = 0.0032  # of the markers [m]
_POSES_EACH: Final = 64  # of a person


@dataclass(frozen=True, slots=True, eq=False)
class SkinBank:
    """Places on the back and the sides of right hands, and where they are in poses."""

    places: tuple[MarkerPlace, ...]
    positions: Float16[np.ndarray, "T C 3"]
    """[m], around their mean; left hands are mirrored."""

    @property
    def bones(self) -> Int[np.ndarray, "C"]:
        """Index of each place's bone."""
        return np.array([BONE_NAMES.index(place.bone) for place in self.places])

    def mean_distances(self, num_poses: int = 1000) -> Float[np.ndarray, "C C"]:
        """Mean distance between every two places [m], over some poses."""
        some = self.positions[:: max(1, len(self.positions) // num_poses)].astype(np.float32)
        total = np.zeros((len(self.places), len(self.places)), dtype=np.float32)
        for points in some:
            total += np.linalg.norm(points[:, None] - points, axis=-1)
        return total / len(some)


def sample_skin_bank(num_places: int, num_people: int, *, rng: np.random.Generator) -> SkinBank:
    """Poses of random people as training sets have them, alone, together and holding something.

    Args:
        num_places: Places on the skin.
        num_people: People, of whom each strikes up to 64 poses with one slip of every marker.
    """
    places = sample_places(num_places, rng=rng)
    gloves = [
        MarkerLayout("places", places[first : first + MOST_MARKERS], _RADIUS)
        for first in range(0, len(places), MOST_MARKERS)
    ]
    parts: list[Float16[np.ndarray, "T C 3"]] = []
    while len(parts) < num_people:
        positions = _positions(gloves, rng)
        if positions is not None:
            parts.append(positions)
    return SkinBank(places, np.concatenate(parts))


def sample_places(
    num_places: int, *, rng: np.random.Generator, apart: float = _APART
) -> tuple[MarkerPlace, ...]:
    """Random places on the skin of the back and the sides of the hand.

    Args:
        num_places: Number of places; there are fewer where no more fit.
        apart: Least distance between two of them on the flat hand [m].
    """
    model = HandModel.named("M")
    share = np.where(np.arange(len(BONE_NAMES)) == PALM, _PALM_SHARE, 1.0)
    places: list[MarkerPlace] = []
    points: list[Float[np.ndarray, "3"]] = []
    missed = 0
    while len(places) < num_places and missed < _MOST_MISSED:
        bone = int(rng.choice(len(BONE_NAMES), p=share / share.sum()))
        name = BONE_NAMES[bone]
        if bone == PALM:
            along, around = rng.uniform(*_PALM_ALONG), 0.0
            across = rng.uniform(-_PALM_ACROSS, _PALM_ACROSS)
        else:
            along = rng.uniform(*(_TIP_ALONG if name.endswith("distal") else _FINGER_ALONG))
            around, across = np.clip(_AROUND * rng.standard_normal(), -_MOST_AROUND, _MOST_AROUND), 0.0
        place = MarkerPlace(f"place{len(places)}", name, along, float(np.deg2rad(around)), across)
        point = _point_of(place, model)
        if point is not None and all(np.linalg.norm(point - other) > apart for other in points):
            places.append(place)
            points.append(point)
            missed = 0
        else:
            missed += 1
    return tuple(places)


def _point_of(place: MarkerPlace, model: HandModel) -> Float[np.ndarray, "3"] | None:
    """Where a place is on the flat hand [m]; None where it meets no skin."""
    copies = tuple(dataclasses.replace(place, name=str(number)) for number in range(5))
    try:
        point: Float[np.ndarray, "3"] = attach_markers(MarkerLayout("place", copies, _RADIUS), model).points[
            0
        ]
    except LayoutError:
        return None
    return point


def _positions(gloves: list[MarkerLayout], rng: np.random.Generator) -> Float16[np.ndarray, "T C 3"] | None:
    """Places of one person in some poses; None where a place misses the skin of the hand."""
    config = GenerateSettings()
    models = sample_hands(config.population, rng=rng)
    scene = sample_frame_scene(models, _POSES_EACH, config, rng=rng)
    model = scene.hands[0]
    bones = model.forward_kinematics(scene.qpos[0])
    slip, roll = config.slip_along, np.deg2rad(config.slip_around)
    try:
        worn = [wear(glove, model, along=slip, around=roll, rng=rng) for glove in gloves]
    except LayoutError:
        return None
    points = np.concatenate([one.centers(model, bones) for one in worn], axis=1)
    if model.shape.side == SIDES[0]:
        points = points @ MIRROR
    centered: Float16[np.ndarray, "T C 3"] = (points - points.mean(axis=1, keepdims=True)).astype(np.float16)
    return centered
