"""The generation of training sets: in shards on all cores, resumable, reproducible to the byte."""

from __future__ import annotations

import dataclasses
import functools
import pickle
import sys
import warnings
from collections import Counter
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, Final

import numpy as np
from upath import UPath

from gloves.fit import attach_markers
from gloves.layout import MarkerLayout, load_layout
from handsim._checks import check_type, make_settings
from handsim._plugins import plugin_name
from handsim.app.output import Output, Place, open_output, place_of
from handsim.app.workers import check_workers, run_jobs
from handsim.callbacks import Progress, no_progress
from handsim.errors import DatasetError, HandSimWarning
from handsim.files.json_files import load_json, save_json
from handsim.files.outputs import check_free
from handsim.files.signals import Stopped, interrupts_bare
from handsim.hand.model import HandModel
from handsim.hand.shape import HAND_DTYPE, SIDES, pack_hand
from handsim.space.rig import ROOM_CENTER, CameraRig, as_rig, check_outside_volume, rig_setting
from poses.shapes import PoseSampler, load_sampler
from train.data.shards import (
    CONFIG,
    MANIFEST,
    Dataset,
    Manifest,
    array_bytes,
    hands_name,
    load_redrawn,
    redrawn_name,
    row_dtype,
    rows_name,
    save_array,
    save_manifest,
)
from train.simulation.scenes import sample_hands
from train.simulation.training_frames import DatasetConfig, simulate_frames

ROWS_PER_SHARD: Final = 8192
_SMALL: Final = 50_000_000  # bytes that no disk is asked for
"""Called with frames done and frames expected."""


def generate_dataset(
    out: str | Place,
    *,
    glove: MarkerLayout | str | Path = "dense19",
    sampler: PoseSampler | str | None = None,
    rig: CameraRig | str | Path = "figure5",
    num_frames: int = 170_330,
    seed: int = 0,
    workers: int | Executor | None = None,
    progress: Progress = no_progress,
    **settings: Any,
) -> Dataset:
    """Make a training set, finish a stopped one, or let one grow.

    The same arguments give the same bytes, with any number of workers.

    Args:
        out: Folder to make it in, or a folder of an object store, as s3://bucket/prefix. A set there may have
            fewer frames and must have the same settings else.
        glove: The marker layout, or its name or path.
        sampler: A pose sampler of your own for hands that are alone: a function like `poses.PoseSampler`,
            `module:name` of one, or its entry point. Whole poses (T, 27) say where the hands are; joint
            angles (T, 20) [rad], and wrists left at the origin, are put anywhere.
        rig: The cameras, or the name or path of a rig.
        num_frames: Frames; the default is the paper's number.
        seed: Seed of all randomness.
        workers: Processes, all cores when not given, or an executor; one process for a sampler that no other
            can import, such as a lambda.
        progress: Called after every shard with frames done and frames expected.
        settings: The other settings of `handsim generate`, as it prints them: `volume=0.5` [m],
            `scenes={"together": 0.0, "holding": 0.0}`, and so on.

    Returns:
        The set: `rows()` are its frames, positions in [m] and angles in [rad].

    Raises:
        ArgumentError: An argument is of another type or out of range, the rig stands in the hands' way, or no
            hand of the population can rest.
        DatasetError: `out` holds a set of other settings, its disk is too small, or a worker died.
        LayoutError, RigError: The glove or rig is unknown, or the glove does not fit.
    """
    check_type("out", out, (str, Path, UPath), "the path of a folder")
    given = {"glove": glove, "sampler": sampler, "rig": rig, "num_frames": num_frames, "seed": seed}
    config = make_settings(DatasetConfig, "setting of a training set", given | settings)
    make_dataset(config, out, workers=workers, progress=progress)
    return Dataset(out)


def make_dataset(
    config: DatasetConfig,
    out: str | Place,
    *,
    workers: int | Executor | None = None,
    progress: Progress = no_progress,
) -> Manifest:
    """As `generate_dataset`.

    Args:
        out: Folder to make it in; or a folder of an object store, as `s3://bucket/prefix` or a `UPath`. A set
            there may have fewer frames and must have the same settings else.
        workers: Number of processes, all cores when not given; or an executor, as Dask's
            `Client.get_executor()`.

    Returns:
        The manifest, which is also the file `manifest.json` beside the `.npy` shards; `Dataset(out)` reads
        them. Positions are in [m], angles in [rad].

    Raises:
        DatasetError: `out` holds a set of another config, its disk is too small, or a worker died.
        HandSimError: The object store does not answer or refuses.
        LayoutError: The glove is unknown or does not fit.
        ArgumentError: The rig is unknown or stands in the hands' way, or no hand of the population can rest.
    """
    workers = _allowed_workers(workers, config.sampler)
    place, workers = place_of(out), workers if isinstance(workers, Executor) else check_workers(workers)
    layout, rig = load_layout(config.glove), as_rig(config.rig)
    check_outside_volume(rig, np.array(ROOM_CENTER), config.volume)
    if config.min_cameras > len(rig.positions):
        raise DatasetError(
            f"min_cameras is {config.min_cameras}, but rig '{rig.name}' has {len(rig.positions)}"
        )
    attach_markers(layout, HandModel.named("M"))  # raises before anything is written
    if config.sampler is not None:
        load_sampler(config.sampler)
    if isinstance(place, Path):
        _check_space(config, place, layout.num_markers)
    with open_output(place) as output:
        output.claim(
            CONFIG,
            _settings(config, layout, rig),
            noun="training set",
            error=DatasetError,
            grows="num_frames",
            result=MANIFEST,
        )
        _make_shards(config, output, layout.num_markers, workers, progress)
        return _complete(config, output, layout)


def _allowed_workers(
    workers: int | Executor | None, sampler: PoseSampler | str | None
) -> int | Executor | None:
    """One process for a sampler that others cannot import; a number that was asked for is told about."""
    if workers == 1 or sampler is None or isinstance(sampler, str):
        return workers
    try:
        pickle.dumps(sampler)
        alone = getattr(sampler, "__module__", "") == "__main__" and not hasattr(
            sys.modules["__main__"], "__file__"
        )  # as in a notebook
    except Exception:  # whatever an object of a user's raises
        alone = True
    if alone and workers is not None:
        what = f"sampler {plugin_name(sampler)} cannot be imported by other processes"
        told = f"{what}, so that this one does all; a function at the top of a module can"
        warnings.warn(told, HandSimWarning, stacklevel=4)
    return 1 if alone else workers


def _settings(config: DatasetConfig, layout: MarkerLayout, rig: CameraRig) -> dict[str, Any]:
    """What decides the bytes of a set, as JSON."""
    named: dict[str, Any] = {
        "glove": config.glove.name if isinstance(config.glove, MarkerLayout) else str(config.glove),
        "rig": rig.name,
        "sampler": None if config.sampler is None else plugin_name(config.sampler),
    }
    known = dataclasses.replace(config, optics=config.optics.worn(layout.radius), **named)
    settings = {
        **dataclasses.asdict(known),
        "rig": rig_setting(rig),
        "rig_digest": rig.digest(),  # a shipped rig may be another one in another release
        "layout": dataclasses.asdict(layout),
    }
    if config.sampler is None:
        del settings["sampler"]
    return settings


def _make_shards(
    config: DatasetConfig,
    output: Output,
    num_markers: int,
    workers: int | Executor,
    progress: Progress,
) -> None:
    """Have the shards made that are not there."""
    there = output.sizes()
    todo = [shard for shard in _shards(config) if not _finished(config, there, shard, num_markers)]
    done = config.num_frames - sum(_shard_size(config, shard) for shard in todo)
    try:
        job = output.job(functools.partial(make_shard, config), last=["rows-*"])
        with interrupts_bare():
            for shard in run_jobs(job, todo, workers):
                done += _shard_size(config, shard)
                progress(done, config.num_frames)
    except KeyboardInterrupt as stop:
        kept = f"{done} of {config.num_frames} frames are in {output}"
        raise Stopped.again(stop, f"{kept}, and the same command goes on after them") from stop


def _complete(config: DatasetConfig, output: Output, layout: MarkerLayout) -> Manifest:
    """Write the manifest."""
    shards = _shards(config)
    output.fetch("redrawn-*.json")
    names = sorted(name(shard) for shard in shards for name in (rows_name, hands_name))
    manifest = Manifest(
        config=load_json(output.folder / CONFIG),
        marker_names=layout.names,
        num_frames=config.num_frames,
        min_cameras=config.min_cameras,
        files={name: output.checksum(name) for name in names},
        redrawn=load_redrawn(output.folder, len(shards)),
    )
    save_manifest(output.folder, manifest)
    output.publish(MANIFEST)
    return manifest


def _check_space(config: DatasetConfig, out: Path, num_markers: int) -> None:
    """Refuse a set that is larger than the disk."""
    people = config.num_frames // config.frames_per_hand + 1
    needed = config.num_frames * row_dtype(num_markers).itemsize + people * len(SIDES) * HAND_DTYPE.itemsize
    if needed > _SMALL:  # before anything counts shards
        there = sum(file.stat().st_size for file in out.glob("*.npy"))
        what = f"{config.num_frames} frames"
        check_free(out, needed - there, what, "ask for fewer frames", error=DatasetError)


def _shards(config: DatasetConfig) -> range:
    return range(-(-config.num_frames // ROWS_PER_SHARD))


def _finished(config: DatasetConfig, there: dict[str, int], shard: int, num_markers: int) -> bool:
    """Whether a shard is there with all its rows; the last one of a set that grows is made again."""
    expected = array_bytes(row_dtype(num_markers), _shard_size(config, shard))
    return hands_name(shard) in there and there.get(rows_name(shard)) == expected


def _shard_size(config: DatasetConfig, shard: int) -> int:
    return min(ROWS_PER_SHARD, config.num_frames - shard * ROWS_PER_SHARD)


def make_shard(config: DatasetConfig, out: Path, shard: int) -> int:
    """Write one shard's hands, counts of redraws and rows; they depend on its number and the seed alone."""
    rng = np.random.default_rng(np.random.SeedSequence(config.seed, spawn_key=(shard,)))
    layout, rig = load_layout(config.glove), as_rig(config.rig)
    size = _shard_size(config, shard)
    rows = np.zeros(size, dtype=row_dtype(layout.num_markers))
    people = -(-size // config.frames_per_hand)
    redrawn: Counter[str] = Counter()
    hands = np.zeros(len(SIDES) * people, dtype=HAND_DTYPE)
    for person in range(people):
        block = rows[person * config.frames_per_hand : (person + 1) * config.frames_per_hand]
        models = sample_hands(config.population, redrawn=redrawn, rng=rng)
        first = len(SIDES) * person
        hands[first : first + len(SIDES)] = [pack_hand(model.shape) for model in models]
        simulate_frames(block, models, layout, rig, config, redrawn=redrawn, rng=rng)
        block["hand"] += first
    save_array(out / hands_name(shard), hands)
    save_json(out / redrawn_name(shard), dict(sorted(redrawn.items())))
    save_array(out / rows_name(shard), rows)  # last: a shard with rows is finished
    return shard
