"""A simulated capture in shards: hands, gloves, poses and a rig, on all cores, resumable, reproducible."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.attachment import attach_markers, wear
from gloves.layout import MarkerLayout, load_layout
from gloves.optics.ghosts import GhostConfig
from gloves.optics.reconstruction import OpticsConfig
from handsim.app.workers import in_processes
from handsim.errors import DatasetError, PoseError
from handsim.files.json_files import claim, load_json
from handsim.hand.model import HandModel
from handsim.hand.records import HAND_DTYPE, pack_hand
from handsim.hand.shape import Population, sample_shape
from handsim.hand.topology import SIDES
from handsim.space.cameras import ROOM_CENTER, CameraRig, check_outside_volume, list_rigs, load_rig
from poses.shapes.samplers import PoseMix
from poses.shapes.validity import resting_angles
from train.data.shards import (
    CONFIG,
    Manifest,
    checksum,
    hands_name,
    row_dtype,
    rows_name,
    save_array,
    save_manifest,
)
from train.simulation.scenes import Scene, SceneMix, alone, holding, together, watch

if TYPE_CHECKING:
    from numpy.typing import NDArray

ROWS_PER_SHARD: Final = 8192
MOST_LOST: Final = 6
"""Cameras that lose their pictures together, at most."""
Progress = Callable[[int, int], None]
"""Called with frames done and frames wanted."""


@dataclass(frozen=True, slots=True)
class DatasetConfig:
    """Everything that decides the bytes of a training set."""

    glove: str = "dense19"
    """Marker layout: a shipped name or the path of a .toml file."""
    num_frames: int = 170_330
    """Frames; the default is the paper's number."""
    seed: int = 0
    rig: str = "figure5"
    """Camera rig: a shipped name or the path of a .toml file."""
    min_cameras: int = 2
    """Cameras that must see a marker before it exists."""
    frames_per_hand: int = 128
    """Poses of one hand before the next person puts on the glove."""
    slip_along: float = 0.1
    """How far markers sit from their places along the bones, standard deviation [bone lengths]."""
    slip_around: float = 10.0
    """The same around the bones [deg]."""
    volume: float = 0.3
    """Half side of the cube the wrist moves in [m], around 1.1 m above the floor."""
    population: Population = dataclasses.field(default_factory=lambda: Population(children=0.2))
    poses: PoseMix = dataclasses.field(default_factory=PoseMix)
    scenes: SceneMix = dataclasses.field(default_factory=SceneMix)
    ghosts: GhostConfig = dataclasses.field(default_factory=GhostConfig)
    optics: OpticsConfig = dataclasses.field(default_factory=OpticsConfig)
    blob_loss: tuple[float, float] = (0.0, 0.15)
    """Least and greatest chance that a camera misses a blob; every person draws another."""
    dropout: tuple[float, float] = (0.0, 0.4)
    """The same for the chance a frame that some cameras lose their pictures."""

    def __post_init__(self) -> None:
        for name in ("num_frames", "min_cameras", "frames_per_hand"):
            if getattr(self, name) < 1:
                raise DatasetError(f"{name} is {getattr(self, name)}, expected at least 1")
        if self.seed < 0:
            raise DatasetError(f"seed is {self.seed}, expected 0 or more")


def generate_dataset(
    config: DatasetConfig, out: Path, *, workers: int | None = None, progress: Progress | None = None
) -> Manifest:
    """Make a training set, or finish one that was stopped; the bytes depend on the config alone.

    Args:
        config: What to make.
        out: Folder to make it in.
        workers: Processes; all cores when not given.
        progress: Told after every shard.

    Raises:
        DatasetError: `out` holds a set of another config, or a worker died.
        LayoutError: The glove is unknown or does not fit.
    """
    layout, rig = load_layout(config.glove), load_rig(config.rig)
    check_outside_volume(rig, np.array(ROOM_CENTER), config.volume)
    if config.min_cameras > len(rig.positions):
        raise DatasetError(
            f"min_cameras is {config.min_cameras}, but rig '{rig.name}' has {len(rig.positions)}"
        )
    attach_markers(
        layout, HandModel.named("M")
    )  # a glove that does not fit is told before anything is written
    settings = {**dataclasses.asdict(config), "layout": dataclasses.asdict(layout)}
    if config.rig not in list_rigs():  # a file may change
        settings["cameras"] = {
            "T_world_camera": rig.T_world_camera.tolist(),
            "field_of_view": rig.field_of_view,
        }
    claim(out / CONFIG, settings, noun="training set", error=DatasetError)
    shards = range(-(-config.num_frames // ROWS_PER_SHARD))
    todo = [shard for shard in shards if not _finished(out, shard)]
    done = config.num_frames - sum(_shard_size(config, shard) for shard in todo)
    for shard in in_processes(
        functools.partial(make_shard, config, out), todo, workers or os.cpu_count() or 1
    ):
        done += _shard_size(config, shard)
        if progress is not None:
            progress(done, config.num_frames)
    names = [name(shard) for shard in shards for name in (rows_name, hands_name)]
    manifest = Manifest(
        config=load_json(out / CONFIG),
        marker_names=layout.names,
        num_frames=config.num_frames,
        min_cameras=config.min_cameras,
        files={name: checksum(out / name) for name in sorted(names)},
    )
    save_manifest(out, manifest)
    return manifest


def _finished(out: Path, shard: int) -> bool:
    return (out / rows_name(shard)).is_file() and (out / hands_name(shard)).is_file()


def _shard_size(config: DatasetConfig, shard: int) -> int:
    return min(ROWS_PER_SHARD, config.num_frames - shard * ROWS_PER_SHARD)


def make_shard(config: DatasetConfig, out: Path, shard: int) -> int:
    """Write one shard's hands and rows; its number is all that its randomness hangs on besides the seed."""
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(shard,)))
    layout, rig = load_layout(config.glove), load_rig(config.rig)
    size = _shard_size(config, shard)
    rows = np.zeros(size, dtype=row_dtype(layout.num_markers))
    people = -(-size // config.frames_per_hand)
    hands = np.zeros(len(SIDES) * people, dtype=HAND_DTYPE)
    for person in range(people):
        block = rows[person * config.frames_per_hand : (person + 1) * config.frames_per_hand]
        models = sample_hands(config.population, rng=rng)
        first = len(SIDES) * person
        hands[first : first + len(SIDES)] = [pack_hand(model.shape) for model in models]
        simulate_frames(block, models, layout, rig, config, rng=rng)
        block["hand"] += first
    save_array(out / hands_name(shard), hands)
    save_array(out / rows_name(shard), rows)
    return shard


def sample_hands(population: Population, *, rng: np.random.Generator) -> tuple[HandModel, ...]:
    """A random person's left and right hand, whose fingers have room beside each other."""
    while True:
        shape = sample_shape(population, side=SIDES[0], rng=rng)
        models = tuple(HandModel(dataclasses.replace(shape, side=side)) for side in SIDES)
        try:
            resting_angles(models[0])
        except PoseError:
            continue
        return models


def simulate_frames(
    block: NDArray[np.void],
    models: tuple[HandModel, ...],
    layout: MarkerLayout,
    rig: CameraRig,
    config: DatasetConfig,
    *,
    rng: np.random.Generator,
) -> None:
    """Fill rows with random poses of one person's gloved hands and what rig and system make of them.

    Two hands share the rows, one after the other.
    """
    scene = draw_scene(models, len(block), config, rng=rng)
    around = np.deg2rad(config.slip_around)
    gloves = tuple(
        wear(layout, hand, along=config.slip_along, around=around, rng=rng) for hand in scene.hands
    )
    optics = dataclasses.replace(
        config.optics,
        blob_loss=rng.uniform(*config.blob_loss),
        dropout=rng.uniform(*config.dropout),
        dropout_length=1.0,
        dropout_cameras=int(rng.integers(1, MOST_LOST + 1)),
        min_rays=config.min_cameras,
        min_rays_to_start=config.min_cameras,
    )
    begin = 0
    for hand, qpos, sight in zip(
        scene.hands, scene.qpos, watch(scene, gloves, rig, optics, config.ghosts, rng=rng), strict=True
    ):
        part = block[begin : begin + len(qpos)]
        part["hand"] = SIDES.index(hand.shape.side)
        part["qpos"] = qpos[: len(part)]
        for name in ("markers", "cameras", "observed", "ghosts"):
            part[name] = getattr(sight, name)[: len(part)]
        begin += len(qpos)


def draw_scene(
    models: tuple[HandModel, ...], count: int, config: DatasetConfig, *, rng: np.random.Generator
) -> Scene:
    """A scene that fills `count` rows, of a kind that the mix decides."""
    shares = np.array(dataclasses.astuple(config.scenes))
    kind = int(rng.choice(len(shares), p=shares / shares.sum()))
    hand = models[int(rng.integers(len(models)))]
    try:
        if kind == 1:
            left, right = models
            return together(right, left, -(-count // 2), rng=rng)
        if kind == 2:
            return holding(hand, count, config.volume, rng=rng)
    except PoseError:
        pass  # not everybody's hands get hold of everything
    return alone(hand, count, config.poses, config.volume, rng=rng)
