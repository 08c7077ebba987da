"""`ShownTake`, the content of a simulated or tracked take that pictures need."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from gloves.fit import GlovedHand, attach
from gloves.takes.take import Take, load_take
from handsim.errors import CaptureError
from handsim.hand.model import HandModel
from handsim.hand.shape import HandShape, sample_shape
from handsim.space.objects import RigidObject
from handsim.space.transforms import pose_matrices


@dataclass(frozen=True, slots=True, eq=False)
class ShownBody:
    """One rigid body of a take."""

    name: str
    obj: RigidObject | None
    """Its shape; None for a body of the user's own, of which only the markers are known."""
    markers: Float[np.ndarray, "Q 3"]
    """Markers in the body's frame [m]."""
    T_world_body: Float[np.ndarray, "T 4 4"]
    """Poses of the body; NaN where it is lost."""


_PEOPLE: Final = 4  # spawn key of what a person draws; `render.session` and `render.own_poses` have others


@dataclass(frozen=True, slots=True, eq=False)
class Cast:
    """Who is in each frame, where poses are of several people."""

    seed: int
    """Of what the people draw: their hands, where there are no `shapes`, and their skins."""
    person: Int[np.ndarray, "T"] | None = None
    """Number of the person in each frame; None: another person in every shard."""
    shapes: tuple[HandShape, ...] | None = None
    """Hands of the people; None: adults who are drawn."""

    def person_in(self, frame: int, shard: int) -> int:
        """Number of the person in a frame of a shard."""
        return shard if self.person is None else int(self.person[frame])

    def rng(self, person: int) -> np.random.Generator:
        """The source of a person's skin, the same wherever the person appears."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(_PEOPLE, person, 1)))

    def shape(self, person: int) -> HandShape:
        """A person's hand."""
        if self.shapes is not None:
            return self.shapes[0 if self.person is None else person]
        sequence = np.random.SeedSequence(self.seed, spawn_key=(_PEOPLE, person, 0))
        return sample_shape(rng=np.random.default_rng(sequence))


@dataclass(frozen=True, slots=True, eq=False)
class ShownTake:
    """Motion of hands and rigid bodies, and the points that the optical system saw of them."""

    rate: float
    """Frames per second [Hz]."""
    times: Float[np.ndarray, "T"]
    """Time of each frame [s]."""
    hands: tuple[GlovedHand, ...]
    bodies: tuple[ShownBody, ...]
    points: Float[np.ndarray, "T N 3"]
    """World [m], NaN where a column has no point."""
    labels: Int[np.ndarray, "T N"]
    """Indices of `label_names`, -1 for a ghost."""
    label_names: tuple[str, ...]
    cast: Cast | None = None
    """Who is in each frame; None: those whose hands these are."""
    is_motion: bool = True
    """Whether frames follow one another; else they are poses of their own."""

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.times)

    def wrists(self) -> Float[np.ndarray, "T H 27"]:
        """Qpos of all H hands."""
        return np.stack([hand.qpos for hand in self.hands], axis=1)

    def of_person(self, person: int) -> ShownTake:
        """The same poses, of the hands of one of the cast.

        Raises:
            LayoutError: The glove does not fit these hands.
        """
        assert self.cast is not None
        model = HandModel(self.cast.shape(person).with_side("right"))
        hands = tuple(
            GlovedHand(attach(hand.layout, model).with_side(hand.side), hand.qpos) for hand in self.hands
        )
        return dataclasses.replace(self, hands=hands)


def load_shown_take(path: Path) -> ShownTake:
    """Read a take.

    Raises:
        CaptureError: The file is missing, of another kind or schema, damaged, or without any pose.
    """
    shown = show_take(load_take(path))
    if not np.isfinite(shown.wrists()[..., 0]).any():
        raise CaptureError(f"{path}: there is no hand in any frame, expected one to draw")
    return shown


def show_take(take: Take) -> ShownTake:
    """What pictures need of a take."""
    bodies = []
    for number, body in enumerate(take.bodies):
        obj, poses = body.shape, pose_matrices(take.body_poses[:, number])
        bodies.append(ShownBody(body.name, obj, body.positions if obj is None else obj.markers, poses))
    labels = take.labels.astype(np.int64)
    hands, names = take.moving_hands(), take.label_names
    return ShownTake(take.rate, take.times, hands, tuple(bodies), take.points, labels, names)
