"""`Subject`, what pictures show: the poses of a take or a user's own, and who strikes them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Int
from numpy.typing import ArrayLike

from gloves.fit import GloveFit, attach
from gloves.layout import MarkerLayout, load_layout
from gloves.takes.take import Take, load_take
from handsim._checks import check_choice, check_count, check_type
from handsim.errors import ArgumentError, CaptureError
from handsim.files.inputs import checksum
from handsim.hand.model import HandModel, load_model
from handsim.hand.shape import HAND_DTYPE, SIDES, HandShape, Side, pack_hand, sample_shape
from render.config import SpawnKey
from render.pose_file import CSV, MOST_PEOPLE, OwnPoses, check_poses, read_pose_file

_SECOND: Final = 1.0  # [s] between frames without times, which are poses without a motion

Model = HandModel | HandShape | str
"""A hand, or its shape, or the name of its size: XS, S, M, L or XL."""


@dataclass(frozen=True, slots=True, eq=False)
class Cast:
    """Who is in each frame, where poses are struck by others than those whose hands a take has."""

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
        return SpawnKey.PERSON.rng(self.seed, person, 1)

    def hands(self, person: int, worn: Sequence[GloveFit]) -> tuple[GloveFit, ...]:
        """A person's hands in the gloves of others.

        Raises:
            LayoutError: A glove does not fit these hands.
        """
        if self.shapes is not None:
            shape = self.shapes[person if len(self.shapes) > 1 else 0]
        else:
            shape = sample_shape(rng=SpawnKey.PERSON.rng(self.seed, person, 0))
        model = HandModel(shape.with_side("right"))
        return tuple(attach(fit.layout, model).with_side(fit.side) for fit in worn)


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """What pictures show."""

    take: Take
    """Poses, NaN where a hand is not there; rigid bodies; points of the optical system."""
    name: str
    """What a rendering's settings call it: its file, or the digest of what is in memory."""
    cast: Cast | None = None
    """Who is in each frame; None: those whose hands these are."""
    is_motion: bool = True
    """Whether frames follow one another; else they are poses of their own."""
    poses: dict[str, Any] | None = None
    """What else decides the pictures of poses, as JSON; None for a take."""

    def __post_init__(self) -> None:
        if not np.isfinite(self.take.qpos[..., 0]).any():
            raise ArgumentError("there is no hand in any frame, expected one to draw")


@dataclass(frozen=True, slots=True)
class PoseFile:
    """A file of poses (.npz or .csv), and what the file does not say of them.

    Raises:
        ArgumentError: A side is unknown or comes twice, or `people` is less than 1.
    """

    path: Path
    sides: tuple[Side, ...] | None = None
    """Which hands the poses of an .npz are of, in the file's order, a right one when None; or which of a
    .csv, which names them, all when None."""
    people: int | None = None
    """People whom the frames are distributed over at random; one for each shard when not given. Not for files
    that say who is in each frame."""
    glove: str = "dense19"
    """Marker layout on the hands, where they wear gloves."""

    def __post_init__(self) -> None:
        sides = ("right",) if self.sides is None else self.sides
        for side in sides:
            check_choice(side, SIDES, noun="hand")
        if not 1 <= len(set(sides)) == len(sides):
            raise ArgumentError(f"hands are {' '.join(sides) or 'none'}, expected right, left or both")
        _check_people(self.people)


Source = Path | PoseFile | Subject
"""Where a subject comes from; files are read again by every process that draws."""


def source_of(
    source: Take | str | Path | PoseFile | ArrayLike,
    *,
    model: Model | tuple[Model, Model] | None = None,
    times: ArrayLike | None = None,
    people: int | Sequence[Model] | None = None,
    person: ArrayLike | None = None,
    glove: MarkerLayout | str | None = None,
    seed: int = 0,
) -> Source:
    """What a public function was given, as a source; see `subject_of_poses` for what belongs to poses."""
    given = {"model": model, "times": times, "people": people, "person": person, "glove": glove}
    if isinstance(source, Take | str | Path | PoseFile):
        for name, value in given.items():
            if value is not None:
                raise ArgumentError(f"{name} belongs to poses of your own; a take and a file have their own")
        if isinstance(source, Take):
            return subject_of_take(source)
        return _of_file(Path(source)) if isinstance(source, str | Path) else source
    return subject_of_poses(
        source,
        model=model,
        times=times,
        people=people,
        person=person,
        glove="dense19" if glove is None else glove,
        seed=seed,
    )


def _of_file(path: Path) -> Path | PoseFile:
    """A take's file, or a table of poses."""
    return PoseFile(path) if path.suffix.lower() == CSV else path


def load_subject(source: Source, *, seed: int) -> Subject:
    """Read what is drawn.

    Args:
        source: A tracked take or the truth of a simulated one, a file of poses, or what is in memory already.
        seed: Seed of the people who are not in a file.

    Raises:
        CaptureError: The file is missing, of another kind or schema, damaged, or without any pose.
        LayoutError: The glove is unknown or does not fit.
    """
    if isinstance(source, Subject):
        return source
    if isinstance(source, PoseFile):
        return _load_poses(source, seed)
    take = load_take(source)
    try:
        return Subject(take, source.name)
    except ArgumentError as error:
        raise CaptureError(f"{source}: {error}") from error


def subject_of_take(take: Take) -> Subject:
    """A take in memory.

    Raises:
        ArgumentError: There is no hand in any frame.
    """
    hands = np.array([pack_hand(hand.model.shape) for hand in take.hands], dtype=HAND_DTYPE)
    return Subject(take, _digest(take.times, take.qpos, hands))


def subject_of_poses(
    qpos: ArrayLike,
    *,
    model: Model | tuple[Model, Model] | None = None,
    times: ArrayLike | None = None,
    people: int | Sequence[Model] | None = None,
    person: ArrayLike | None = None,
    glove: MarkerLayout | str = "dense19",
    seed: int = 0,
) -> Subject:
    """A user's own poses.

    Args:
        qpos: (T, 27), or joint angles (T, 20) with the wrist at the origin, of one hand; (T, 2, 27) of two
            [m, rad]. NaN is a hand that is not there.
        model: The hand, or both of them in the order of the poses; right hands of drawn people when not
            given.
        times: Time of each frame (T,), increasing [s]; poses are no motion without them.
        people: Who strikes the poses, instead of the model: a number of drawn people, or their hands.
        person: Which of the people is in each frame (T,); when not given, a number of people is distributed
            at random, and of hands there is one, or one for each frame.
        glove: Marker layout on the hands, where they wear gloves.

    Raises:
        ArgumentError: An array has another shape or impossible numbers, or the arguments do not fit together.
        LayoutError: The glove is unknown or does not fit.
    """
    array = np.asarray(qpos)
    models = models_of(model, 2 if array.ndim == 3 else 1)
    if model is not None and person is not None and people is None:
        raise ArgumentError("person says who strikes each pose, and the model is one hand; give people")
    if people is not None:
        check_type("people", people, (int, list, tuple), "a number of people, or their hands")
    count = people if isinstance(people, int) else None
    _check_people(count)
    known = () if people is None or isinstance(people, int) else people
    shapes = tuple(load_model(one).shape for one in known) or None
    poses = check_poses(
        array,
        len(models),
        times=None if times is None else np.asarray(times),
        person=None if person is None else np.asarray(person),
        shapes=shapes,
    )
    cast = None
    if model is None or people is not None:
        cast = _cast(poses, count, seed)
    hands = [pack_hand(shape) for shape in (*(one.shape for one in models), *(shapes or ()))]
    told = (array for array in (poses.qpos, poses.times, poses.person) if array is not None)
    name = _digest(*told, np.array(hands, dtype=HAND_DTYPE))
    layout = load_layout(glove)
    record = {"people": count, "glove": layout.name}
    return _posed(name, poses, models, layout, cast, record)


def _load_poses(file: PoseFile, seed: int) -> Subject:
    poses, sides = read_pose_file(file.path, file.sides)
    if poses.person is not None and file.people is not None:
        whose = "the hand of one person" if len(poses.shapes or ()) == 1 else "who is in each frame"
        raise CaptureError(f"{file.path}: the file has {whose}; leave out --people")
    record = {
        "sha256": checksum(file.path),
        "sides": list(sides),
        "people": file.people,
        "glove": file.glove,
    }
    models = tuple(HandModel.named("M", side=side) for side in sides)
    return _posed(
        file.path.name, poses, models, load_layout(file.glove), _cast(poses, file.people, seed), record
    )


def _cast(poses: OwnPoses, people: int | None, seed: int) -> Cast:
    """The people of poses: as told, distributed over the frames at random, or another in every shard."""
    if people is None or poses.person is not None:
        return Cast(seed, poses.person, poses.shapes)
    return Cast(seed, SpawnKey.PEOPLE_OF_FRAMES.rng(seed).integers(people, size=len(poses.qpos)))


def _posed(
    name: str,
    poses: OwnPoses,
    models: Sequence[HandModel],
    layout: MarkerLayout,
    cast: Cast | None,
    record: dict[str, Any],
) -> Subject:
    hands = tuple(attach(layout, HandModel(model.shape.with_side("right"))) for model in models)
    hands = tuple(fit.with_side(model.shape.side) for fit, model in zip(hands, models, strict=True))
    times = _SECOND * np.arange(len(poses.qpos)) if poses.times is None else poses.times
    rate = _SECOND if poses.times is None else 1.0 / max(float(np.median(np.diff(times))), 1e-6)
    take = Take.of_poses(hands, poses.qpos, rate=rate, times=times)
    return Subject(take, name, cast, poses.times is not None, record)


def models_of(model: Model | tuple[Model, Model] | None, num_hands: int) -> tuple[HandModel, ...]:
    """The hands of poses: those given, or a right one, or both."""
    if model is None:
        return tuple(HandModel.named("M", side=side) for side in SIDES[::-1][:num_hands])
    models = tuple(load_model(one) for one in (model if isinstance(model, tuple | list) else (model,)))
    if len(models) == 1 and num_hands == 2:
        other: Side = "left" if models[0].shape.side == "right" else "right"
        models = (models[0], HandModel(models[0].shape.with_side(other)))
    if len(models) != num_hands or len({one.shape.side for one in models}) < len(models):
        sides = " and ".join(one.shape.side for one in models)
        raise ArgumentError(
            f"the models are of {len(models)} hands ({sides}) and the poses of {num_hands}, expected a model "
            "for each, and one hand of each side"
        )
    return models


def _check_people(people: int | None) -> None:
    if people is not None:
        check_count("people", people, 1, MOST_PEOPLE)


def _digest(*arrays: np.ndarray) -> str:
    """What tells these arrays from others."""
    content = hashlib.sha256()
    for array in arrays:
        content.update(np.ascontiguousarray(array).tobytes())
    return f"sha256:{content.hexdigest()}"
