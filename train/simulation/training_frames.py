"""Training frames: a person's gloved hands in random poses, seen by a rig and its optical system."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Annotated, ClassVar, Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from gloves.fit import GlovedHand, GloveFit, settle_glove, wear
from gloves.layout import AnyLayout, MarkerLayout
from gloves.optics.ghosts import GHOST_REACH, GhostConfig, keep_some, sample_ghosts
from gloves.optics.reconstruction import FrameOptics, OpticsConfig, reconstruct
from gloves.optics.visibility import MeshTree, clear_of_body, pack_cameras, visible_cameras
from handsim.errors import ArgumentError, PoseError
from handsim.hand.model import HandModel, join_qpos
from handsim.hand.shape import ADULTS, BONES, NUM_JOINTS, NUM_QPOS, SIDES, Population, sample_shape
from handsim.settings import Limits, Mixture, Settings
from handsim.space.objects import RigidObject, named_object, object_names
from handsim.space.rig import ROOM_CENTER, AnyRig, CameraRig, Center
from handsim.space.transforms import pose_matrices, quaternion_matrix, random_quaternions
from poses.grasps import sample_held_poses, settle_hold
from poses.shapes import SAMPLER, PoseMix, PoseSampler, make_valid, rests_easily, sample_valid_angles
from poses.two_hands import sample_two_hand_poses

NO_REST: Final = "person: fingers overlap at rest"
"""Reason to draw another person."""
# Fitted to the published captures of Han et al. 2018, like the speed of real-like takes (docs/room.md).
NOISE: Final = 0.00125
"""Standard deviation of the markers' independent noise per axis [m]."""
FLESH: Final = 0.0008
"""RMS displacement per axis that depends on the angles of the marker's digit [m]."""
_MAX_PEOPLE: Final = 1000
_SHOWN_PEOPLE: Final = 100  # number of people whose slips are drawn
NO_TOUCH: Final = "two hands: no valid pose, one hand instead"
"""Reason to replace a scene of two hands by one of a single hand."""
NO_GRASP: Final = "held object: not grasped, empty hand instead"
"""Reason to replace a scene with an object by one of an empty hand."""
_MAX_LOST_CAMERAS: Final = 6  # largest number of cameras that lose pictures together


@dataclass(frozen=True, slots=True)
class SceneMix(Mixture):
    """How often a person's hands are alone, together or hold something; shares are normalized."""

    alone: float = 0.6
    together: float = 0.25
    """Two hands that touch."""
    holding: float = 0.15
    """A hand with one of the objects of `handsim.space.objects`."""


@dataclass(frozen=True, slots=True)
class GenerateSettings(Settings):
    """Everything that determines the bytes of a training set: people, poses, scenes, cameras and losses.

    A group of settings may be given as a mapping with those that differ from the default, such as
    `ghosts={"stray_rate": 0.0}` or, for hands that are all alone, `scenes={"together": 0, "holding": 0}`.
    """

    noun: ClassVar[str] = "setting of a training set"
    glove: AnyLayout = "dense19"
    """Marker layout: a shipped name or the path of a .toml file."""
    num_frames: Annotated[int, Limits(1)] = 170_330
    """Number of frames; the default is the paper's."""
    seed: Annotated[int, Limits(0)] = 0
    rig: AnyRig = "figure5"
    """Camera rig: a shipped name or the path of a .toml file."""
    min_cameras: Annotated[int, Limits(1)] = 2
    """Number of cameras that must see a marker."""
    frames_per_hand: Annotated[int, Limits(1)] = 128
    """Poses of one person before the next one puts on the glove."""
    slip_along: Annotated[float, Limits(0.0, 1.0)] = 0.1
    """Standard deviation of the markers' slip along bones [bone lengths]."""
    slip_around: Annotated[float, Limits(0.0, 90.0)] = 10.0
    """Standard deviation of the markers' slip around bones [deg]."""
    center: Center = ROOM_CENTER
    """Center of the cube in which wrists move, in the rig's room [m]."""
    volume: Annotated[float, Limits(0.0, 10.0)] = 0.3
    """Half side of that cube [m]."""
    population: Population = field(default_factory=lambda: Population(children=0.2))
    poses: PoseMix = field(default_factory=PoseMix)
    sampler: Annotated[PoseSampler | str, SAMPLER] | None = None
    """A pose sampler of your own for hands that are alone, instead of `poses`: module:name, or the name of an
    entry point. Whole poses (T, 27) place the hands; joint angles (T, 20) [rad], and wrists that are all at
    the origin, are placed at random."""
    scenes: SceneMix = field(default_factory=SceneMix)
    flesh: bool = False
    """Whether markers move with the skin, as in real-like takes of `simulate`: by 0.8 mm per axis that depend
    on the digit's angles, and by 1.25 mm of noise."""
    ghosts: GhostConfig = field(default_factory=GhostConfig)
    optics: FrameOptics = field(default_factory=FrameOptics)
    blob_loss: Annotated[tuple[float, float], Limits(0.0, 1.0, ascends=True)] = (0.0, 0.15)
    """Range of the probability that a camera misses a blob, drawn for every person."""
    dropout: Annotated[tuple[float, float], Limits(0.0, 1.0, ascends=True)] = (0.0, 0.4)
    """Range of the probability per frame that some cameras lose their pictures, drawn for every person."""

    @property
    def slips(self) -> dict[str, float]:
        """The slips as `wear_gloves` takes them, in [bone lengths] and [rad]."""
        return {"along": self.slip_along, "around": float(np.deg2rad(self.slip_around))}

    def check(self) -> None:
        """Refuse optics over time, as their losses are drawn for each person."""
        if isinstance(self.optics, OpticsConfig):
            raise ArgumentError(
                "optics is an OpticsConfig, expected FrameOptics; each person draws the losses of blobs and "
                "pictures, as blob_loss and dropout of a training set say"
            )


class FrameSource(NamedTuple):
    """Settings of training frames, and the objects that they name."""

    settings: GenerateSettings
    layout: MarkerLayout
    rig: CameraRig
    sampler: PoseSampler | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MovingObject:
    """An object, and where it is in each frame."""

    rigid_object: RigidObject
    T_world_body: Float[np.ndarray, "T 4 4"]
    """Poses [m]."""


class FrameScene(NamedTuple):
    """Unrelated frames of one or two hands, and perhaps an object."""

    hands: tuple[HandModel, ...]
    qpos: tuple[Float[np.ndarray, "T 27"], ...]
    held: MovingObject | None = None


class HandFrames(NamedTuple):
    """Markers of one hand of a scene: true ones, and as captured by a rig and its optical system."""

    markers: Float[np.ndarray, "T M 3"]
    """True centers [m]."""
    cameras: Int[np.ndarray, "T M"]
    """Cameras with a free view, as bits."""
    observed: Float[np.ndarray, "T M 3"]
    """Captured positions [m], NaN for lost markers."""
    ghosts: Float[np.ndarray, "T 4 3"]
    """Ghosts near the hand [m]; NaN where there is none."""


def sample_hands(
    population: Population, *, redrawn: Counter[str] | None = None, rng: np.random.Generator
) -> tuple[HandModel, ...]:
    """Left and right hand of a random person, whose fingers do not overlap at rest.

    Redraws are counted in `redrawn`, by reason.
    """
    for _ in range(_MAX_PEOPLE):
        shape = sample_shape(population, side=SIDES[0], rng=rng)
        models = HandModel(shape), HandModel(shape.with_side(SIDES[1]))
        if rests_easily(models[0]):
            return models
        if redrawn is not None:
            redrawn[NO_REST] += 1
    raise ArgumentError(
        f"the fingers of all {_MAX_PEOPLE} people drawn from the population overlap at rest, expected a "
        f"population with smaller spreads than {population}"
    )


def sample_adult_hands(*, rng: np.random.Generator) -> tuple[HandModel, HandModel]:
    """Right and left hand of a random adult."""
    shape = sample_shape(ADULTS, side="right", rng=rng)
    return HandModel(shape), HandModel(shape.with_side("left"))


def wear_gloves(
    layout: MarkerLayout,
    models: Sequence[HandModel],
    *,
    along: float,
    around: float,
    rng: np.random.Generator,
) -> tuple[GloveFit, ...]:
    """Put the same glove on each hand, with random slips along [bone lengths] and around [rad] bones."""
    return tuple(
        GloveFit(model, wear(layout, model, along=along, around=around, rng=rng)) for model in models
    )


def slipped_gloves(
    layout: MarkerLayout, model: HandModel, settings: GenerateSettings, *, rng: np.random.Generator
) -> tuple[GloveFit, ...]:
    """Gloves of a hundred people, with slips as in a training set, whose places are put on one hand."""
    people = [sample_shape(settings.population, side=model.shape.side, rng=rng) for _ in range(_SHOWN_PEOPLE)]
    worn = (wear_gloves(layout, [HandModel(one)], **settings.slips, rng=rng) for one in people)
    return tuple(settle_glove(fit.layout, model) for (fit,) in worn)


def move_skin(hand: GlovedHand, *, rng: np.random.Generator) -> Float[np.ndarray, "T M 3"]:
    """Displacement of a hand's markers in the world [m]: a part that depends on the pose, and noise."""
    turns, layout = quaternion_matrix(hand.qpos[:, 3:7]), hand.layout
    moved = NOISE * rng.standard_normal((len(hand.qpos), layout.num_markers, 3))
    for marker, bone in enumerate(hand.fit.attachment.main_bones):
        digit = BONES[bone].digit
        angles = hand.qpos[:, 7 + 4 * digit : 11 + 4 * digit] if digit >= 0 else hand.qpos[:, 12::4]
        way = (angles - angles.mean(axis=0)) @ rng.standard_normal((4, 3))
        way *= FLESH / max(np.sqrt((way**2).mean()), 1e-9)
        moved[:, marker] += np.einsum("tij,tj->ti", turns, way)
    return moved


def simulate_frames(
    block: NDArray[np.void],
    models: tuple[HandModel, ...],
    source: FrameSource,
    *,
    redrawn: Counter[str] | None = None,
    rng: np.random.Generator,
) -> tuple[GloveFit, ...]:
    """Fill rows with random poses of a person's gloved hands, as captured by a rig and its optical system.

    In a scene of two hands, the first half of the rows is the right hand's. Impossible scenes are counted in
    `redrawn`, by reason. Returns the hands with their gloves as worn.
    """
    settings, layout, rig, sampler = source
    scene = sample_frame_scene(models, len(block), settings, sampler=sampler, redrawn=redrawn, rng=rng)
    fits = wear_gloves(layout, scene.hands, **settings.slips, rng=rng)
    optics = OpticsConfig(  # Every person has another optical system.
        **dataclasses.asdict(settings.optics),
        blob_loss=rng.uniform(*settings.blob_loss),
        dropout=rng.uniform(*settings.dropout),
        dropout_length=1.0,
        dropout_cameras=int(rng.integers(1, _MAX_LOST_CAMERAS + 1)),
        min_rays=settings.min_cameras,
        min_rays_to_start=settings.min_cameras,
    )
    observed = observe_scene(scene, fits, rig, optics, settings.ghosts, flesh=settings.flesh, rng=rng)
    begin = 0
    for model, qpos, frames in zip(scene.hands, scene.qpos, observed, strict=True):
        part = block[begin : begin + len(qpos)]
        part["hand"] = SIDES.index(model.shape.side)
        part["qpos"] = qpos[: len(part)]
        for name in HandFrames._fields:
            part[name] = getattr(frames, name)[: len(part)]
        begin += len(qpos)
    return fits


def sample_frame_scene(
    models: tuple[HandModel, ...],
    num_rows: int,
    settings: GenerateSettings,
    *,
    sampler: PoseSampler | None = None,
    redrawn: Counter[str] | None = None,
    rng: np.random.Generator,
) -> FrameScene:
    """A random scene of a person's left and right hand, with `num_rows` rows shared by the hands.

    A scene that the hands cannot do is replaced by one of a single hand, and counted in `redrawn`.
    """
    shares = settings.scenes.shares
    kind = int(rng.choice(len(shares), p=shares))
    model = models[int(rng.integers(len(models)))]
    try:
        if kind == 1:
            left, right = models
            both = sample_two_hand_poses(right, left, -(-num_rows // 2), rng=rng)
            for qpos in both:
                qpos[:, :3] += np.subtract(settings.center, ROOM_CENTER)
            return FrameScene((right, left), both)
        if kind == 2:
            return sample_holding_hand(model, num_rows, settings, rng=rng)
    except PoseError:
        if redrawn is not None:
            redrawn[NO_TOUCH if kind == 1 else NO_GRASP] += 1
    return sample_single_hand(model, num_rows, settings, sampler=sampler, rng=rng)


def sample_single_hand(
    model: HandModel,
    num_frames: int,
    settings: GenerateSettings,
    *,
    sampler: PoseSampler | None = None,
    rng: np.random.Generator,
) -> FrameScene:
    """Poses of one hand in any orientation and anywhere in the volume.

    A sampler of whole poses also places the wrists, unless all of them are at the origin.
    """
    position = settings.center + rng.uniform(-settings.volume, settings.volume, size=(num_frames, 3))
    if sampler is None:
        angles = sample_valid_angles(model, num_frames, settings.poses, rng=rng)
    else:
        drawn = sampler(model, num_frames, rng=rng)
        angles = make_valid(model, drawn[:, -NUM_JOINTS:])
        if drawn.shape[1] == NUM_QPOS and drawn[:, :3].any():
            qpos = np.concatenate([drawn[:, :-NUM_JOINTS], angles], axis=1)
            return FrameScene((model,), (qpos,))
    quaternion = random_quaternions(num_frames, rng=rng)
    return FrameScene((model,), (join_qpos(angles, position=position, quaternion=quaternion),))


def sample_holding_hand(
    model: HandModel, num_frames: int, settings: GenerateSettings, *, rng: np.random.Generator
) -> FrameScene:
    """Poses of a hand that holds a random object, anywhere in the volume."""
    names = object_names()
    rigid_object = named_object(names[rng.integers(len(names))])
    hold = settle_hold(model, rigid_object, rng=rng)
    angles, T_wrist_object = sample_held_poses(model, rigid_object, hold, num_frames, rng=rng)
    position = settings.center + rng.uniform(-settings.volume, settings.volume, size=(num_frames, 3))
    quaternion = random_quaternions(num_frames, rng=rng)
    qpos = join_qpos(angles, position=position, quaternion=quaternion)
    held = MovingObject(rigid_object, pose_matrices(qpos[:, :7]) @ T_wrist_object)
    return FrameScene((model,), (qpos,), held)


def observe_scene(
    scene: FrameScene,
    fits: tuple[GloveFit, ...],
    rig: CameraRig,
    optics: OpticsConfig,
    ghosts: GhostConfig,
    *,
    flesh: bool = False,
    rng: np.random.Generator,
) -> tuple[HandFrames, ...]:
    """Markers of every hand as captured by a rig; hands, as capsules, and the object hide markers.

    With `flesh`, markers move with the skin.
    """
    bones = [fit.model.forward_kinematics(qpos) for fit, qpos in zip(fits, scene.qpos, strict=True)]
    worn = [fit.attachment.markers(fit.model, frames) for fit, frames in zip(fits, bones, strict=True)]
    if flesh:
        for fit, qpos, part in zip(fits, scene.qpos, worn, strict=True):
            part[0][:] += move_skin(GlovedHand(fit, qpos), rng=rng)
    markers, normals = (np.concatenate(parts, axis=1) for parts in zip(*worn, strict=True))
    posed = [fit.model.capsules.posed(frames) for fit, frames in zip(fits, bones, strict=True)]
    segments = np.concatenate(posed, axis=1)
    radii = np.concatenate([fit.model.capsules.radii for fit in fits])
    visible = visible_cameras(markers, normals, rig, segments, radii)
    if scene.held is not None:
        tree = _mesh_tree(scene.held.rigid_object.name)
        visible = clear_of_body(tree, scene.held.T_world_body, markers, rig.positions, visible)
    radii_worn = np.array([optics.radius_of(fit.layout.radius) for fit in fits])
    sizes = np.repeat(radii_worn, [centers.shape[1] for centers, _ in worn])
    found = reconstruct(markers, visible, rig, optics, radii=sizes, continuous=False, rng=rng)
    cameras, hands = pack_cameras(visible), []
    for number, (centers, _) in enumerate(worn):
        columns = slice(number * centers.shape[1], (number + 1) * centers.shape[1])
        strays = sample_ghosts(centers, rig, segments, radii, ghosts, min_cameras=optics.min_rays, rng=rng)
        near = np.where(_near_markers(found.false_points, centers)[..., None], found.false_points, np.nan)
        kept = keep_some(np.concatenate([strays, near], axis=1), rng=rng)
        hands.append(HandFrames(centers, cameras[:, columns], found.positions[:, columns], kept))
    return tuple(hands)


def _near_markers(
    points: Float[np.ndarray, "T P 3"], centers: Float[np.ndarray, "T M 3"]
) -> Bool[np.ndarray, "T P"]:
    """Which points, most of them NaN, are within `GHOST_REACH` of a marker center of their frame."""
    near: NDArray[np.bool_] = np.isfinite(points[..., 0])
    distance = np.linalg.norm(points[near][:, None] - centers[near.nonzero()[0]], axis=-1)
    near[near] = distance.min(axis=1) < GHOST_REACH
    return near


@cache
def _mesh_tree(name: str) -> MeshTree:
    """Search tree of a named object's mesh."""
    rigid_object = named_object(name)
    return MeshTree(rigid_object.vertices, rigid_object.faces)
