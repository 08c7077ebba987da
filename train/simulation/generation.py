"""Generation of training sets: in shards on all cores, resumable, and reproducible to the byte."""

from __future__ import annotations

import dataclasses
import functools
import pickle
import re
import warnings
from collections import Counter
from collections.abc import Collection, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from gloves.fit import check_layout
from gloves.layout import load_layout
from handsim._plugins import plugin_name
from handsim._version import full_version
from handsim.app.output import (
    CHECKSUMS,
    Output,
    Place,
    changed_files,
    checksums_name,
    load_checksums,
    open_output,
    place_of,
    save_checksums,
)
from handsim.app.workers import check_workers, main_script, run_jobs
from handsim.callbacks import Progress, no_progress
from handsim.errors import DatasetError, HandSimWarning
from handsim.files.inputs import load_json
from handsim.files.outputs import check_free, json_text, save_json
from handsim.files.signals import Stopped, interrupts_bare
from handsim.hand.shape import SIDES, pack_hand
from handsim.space.rig import check_outside_volume, load_rig, rig_setting
from poses.shapes import PoseSampler, load_sampler
from train.data.shards import (
    CONFIG,
    MANIFEST,
    Dataset,
    Manifest,
    array_bytes,
    hands_name,
    load_manifest,
    load_redrawn,
    redrawn_name,
    row_dtype,
    rows_name,
    save_array,
    worn_dtype,
)
from train.simulation.training_frames import FrameSource, GenerateSettings, sample_hands, simulate_frames

ROWS_PER_SHARD: Final = 8192
_SMALL_BYTES: Final = 50_000_000  # [bytes] Free space is not checked for smaller sets.


def generate_dataset(
    out: str | Place,
    settings: GenerateSettings | None = None,
    *,
    workers: int | Executor | None = None,
    progress: Progress = no_progress,
    **options: Any,
) -> Dataset:
    """Generate a training set, continue a stopped one, or extend one.

    The same settings give the same bytes for any number of workers.

    Args:
        out: Folder of the set, also in an object store, as s3://bucket/prefix. An existing set there may have
            fewer frames, but must have the same other settings.
        settings: Settings of the set; the defaults when not given.
        workers: Number of processes, all cores when not given, or an executor; one process for a sampler that
            other processes cannot import, such as a lambda.
        progress: Called after every shard with the numbers of frames done and in total.
        options: Settings by name: `glove="sparse13"`, `num_frames=2000`, `scenes={"holding": 0.0}`, ...

    Returns:
        The set: `rows()` are its frames, positions in [m] and angles in [rad].

    Raises:
        ArgumentError: A setting is unknown or out of range, a camera of the rig is inside the hands' volume,
            or no hand of the population can rest.
        DatasetError: `out` holds a set with other settings, its disk is too small, or a worker died.
        LayoutError, RigError: The glove or rig is unknown, or the glove does not fit.
    """
    make_dataset(GenerateSettings.of(settings, options), out, workers=workers, progress=progress)
    return Dataset(out)


def make_dataset(
    settings: GenerateSettings,
    out: str | Place,
    *,
    workers: int | Executor | None = None,
    progress: Progress = no_progress,
) -> Manifest:
    """Generate a training set like `generate_dataset`, without reading it; return its manifest."""
    place, workers = place_of(out), _allowed_workers(workers, settings.sampler)
    source = _resolve_source(settings)
    if isinstance(place, Path):
        _check_space(source, place)
    with open_output(place) as output:
        whole = _whole_files(output)
        _restore_config(output)
        about = {"noun": "training set", "grows": "num_frames", "result": MANIFEST}
        output.claim(CONFIG, _record(source), error=DatasetError, **about)
        _make_shards(source, output, whole, workers, progress)
        return _write_manifest(source, output, whole)


def _resolve_source(settings: GenerateSettings) -> FrameSource:
    """Load the glove, rig and sampler named by the settings, and check them against each other."""
    layout, rig = load_layout(settings.glove), load_rig(settings.rig)
    check_outside_volume(rig, np.array(settings.center), settings.volume)
    if settings.min_cameras > len(rig.positions):
        raise DatasetError(
            f"min_cameras is {settings.min_cameras}, but rig '{rig.name}' has {len(rig.positions)}"
        )
    check_layout(layout)
    sampler = None if settings.sampler is None else load_sampler(settings.sampler)
    return FrameSource(settings, layout, rig, sampler)


def _allowed_workers(workers: int | Executor | None, sampler: PoseSampler | str | None) -> int | Executor:
    """The workers; one process, with a warning if needed, for a sampler that others cannot import."""
    allowed = workers if isinstance(workers, Executor) else check_workers(workers)
    if allowed == 1 or sampler is None or isinstance(sampler, str):
        return allowed
    try:
        pickle.dumps(sampler)
        alone = getattr(sampler, "__module__", "") == "__main__" and main_script() is None
    except Exception:  # A user's object may raise anything.
        alone = True
    if alone and workers is not None:
        what = f"sampler {plugin_name(sampler)} cannot be imported by other processes"
        message = f"{what}, so that this one does all; a function at the top of a module can"
        warnings.warn(message, HandSimWarning, stacklevel=4)
    return 1 if alone else allowed


def _record(source: FrameSource) -> dict[str, Any]:
    """Everything that determines the bytes of a set, as JSON."""
    settings, layout, rig, _ = source
    record = dataclasses.replace(settings, optics=settings.optics.worn(layout.radius)).record()
    newer = "sampler", "center", "flesh"  # Without them, sets of versions without these settings go on.
    left_out = set(newer) - set(settings.changed(*newer))
    return {name: value for name, value in record.items() if name not in left_out} | {
        "rig": rig_setting(rig),
        "rig_digest": rig.digest(),  # releases may change a shipped rig
        "layout": layout.record(),
    }


def _recorded_files(output: Output, own: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """Checksums of files of finished shards: from the shards' own lists, or else from the manifest."""
    try:
        recorded = load_manifest(output.folder).files
    except DatasetError:  # unfinished, damaged, or of another version
        recorded = {}
    numbers = set(map(_shard_of_file, own))
    recorded = {name: one for name, one in recorded.items() if _shard_of_file(name) not in numbers}
    return recorded | {name: one for table in own.values() for name, one in table.items()}


def _shard_records(output: Output) -> dict[str, dict[str, str]]:
    """Checksums of each shard's files, by the name of the list's file; a damaged list is empty."""
    output.fetch(CHECKSUMS)
    records = {path.name: load_checksums(path) for path in output.folder.glob(CHECKSUMS)}
    return {
        name: table if table.keys() == set(_files_of_shard(_shard_of_file(name))) else {}
        for name, table in records.items()
    }


def _whole_files(output: Output) -> dict[str, str]:
    """Checksums of the files of undamaged shards; warns of files that changed since they were written."""
    if not output.is_here and MANIFEST in output.sizes():
        (output.folder / MANIFEST).write_bytes((output.place / MANIFEST).read_bytes())
    own, there = _shard_records(output), output.sizes()
    recorded = _recorded_files(output, own)
    damaged = changed_files({name: recorded[name] for name in recorded if name in there}, output.checksum)
    lists = MANIFEST if (output.folder / MANIFEST).is_file() else CHECKSUMS
    output.warn_of(damaged, f"are not what {lists} lists (other checksums), and are made again")
    output.warn_of([name for name in own if not own[name]], "are damaged, and are made again")
    numbers = {_shard_of_file(name) for name in damaged}
    return {name: one for name, one in recorded.items() if _shard_of_file(name) not in numbers}


def _restore_config(output: Output) -> None:
    """Write the settings of a finished set again if their file is missing; the manifest has them too."""
    if CONFIG not in output.sizes():
        with suppress(DatasetError):  # no finished set
            save_json(output.folder / CONFIG, load_manifest(output.folder).config)
            output.publish(CONFIG)
            output.warn_of([CONFIG], f"is missing, and is made again from {MANIFEST}")


def _shard_of_file(name: str) -> int:
    """Number of a shard from the name of one of its files; -1 for other names."""
    number = Path(name).stem.rpartition("-")[2]
    return int(number) if number.isdecimal() else -1


def _files_of_shard(shard: int) -> tuple[str, str, str]:
    """Names of the files of a shard."""
    return hands_name(shard), redrawn_name(shard), rows_name(shard)


def _make_shards(
    source: FrameSource, output: Output, whole: Collection[str], workers: int | Executor, progress: Progress
) -> None:
    """Make the shards that are missing or damaged."""
    total = source.settings.num_frames
    there = {name: size for name, size in output.sizes().items() if name in whole}
    todo = [shard for shard in _shard_numbers(total) if not _is_finished(source, there, shard)]
    for shard in todo:
        (output.folder / checksums_name(shard)).unlink(missing_ok=True)
    done = total - sum(_shard_size(total, shard) for shard in todo)
    try:
        job = output.job(functools.partial(make_shard, source), last=[CHECKSUMS])
        with interrupts_bare():
            for shard in run_jobs(job, todo, workers):
                done += _shard_size(total, shard)
                progress(done, total)
    except KeyboardInterrupt as stop:
        kept = f"{done} of {total} frames are in {output}"
        raise Stopped.again(stop, f"{kept}, and the same command goes on after them") from stop


def _write_manifest(source: FrameSource, output: Output, whole: dict[str, str]) -> Manifest:
    """Write the manifest of a set with all shards."""
    shards = _shard_numbers(source.settings.num_frames)
    output.fetch("redrawn-*.json")
    recorded = whole | _recorded_files(output, _shard_records(output))
    names = sorted(name(shard) for shard in shards for name in (rows_name, hands_name))
    manifest = Manifest(
        config=load_json(output.folder / CONFIG),
        marker_names=source.layout.names,
        num_frames=source.settings.num_frames,
        min_cameras=source.settings.min_cameras,
        files={name: recorded[name] for name in names},
        redrawn=load_redrawn(output.folder, len(shards)),
    )
    path = output.folder / MANIFEST
    found = path.read_text("utf-8", "replace") if path.is_file() else ""
    stated = re.search(r'"handsim": "([^"]*)"', found)
    version = stated[1] if stated else full_version()  # another version changes nothing in a finished set
    manifest = dataclasses.replace(manifest, handsim=version)
    content = dataclasses.asdict(manifest)
    if found and found != json_text(content):
        message = f"{output}: {MANIFEST} is not what the shards give, and is written anew"
        warnings.warn(message, HandSimWarning, stacklevel=4)
    save_json(path, content)
    output.publish(MANIFEST)
    return manifest


def _check_space(source: FrameSource, out: Path) -> None:
    """Refuse a set that does not fit on the disk."""
    frames, row = source.settings.num_frames, row_dtype(source.layout.num_markers).itemsize
    people = frames // source.settings.frames_per_hand + 1
    needed = frames * row + people * len(SIDES) * worn_dtype(source.layout.num_markers).itemsize
    if needed > _SMALL_BYTES:  # checked before shards are counted
        there = sum(file.stat().st_size for file in out.glob("*.npy"))
        check_free(out, needed - there, f"{frames} frames", "ask for fewer frames", error=DatasetError)


def _shard_numbers(num_frames: int) -> range:
    """Numbers of the shards of a set."""
    return range(-(-num_frames // ROWS_PER_SHARD))


def _shard_size(num_frames: int, shard: int) -> int:
    """Rows of a shard."""
    return min(ROWS_PER_SHARD, num_frames - shard * ROWS_PER_SHARD)


def _is_finished(source: FrameSource, there: dict[str, int], shard: int) -> bool:
    """Whether a shard has all its rows; the last shard of a set to be extended has not."""
    size = _shard_size(source.settings.num_frames, shard)
    expected = array_bytes(row_dtype(source.layout.num_markers), size)
    return hands_name(shard) in there and there.get(rows_name(shard)) == expected


def make_shard(source: FrameSource, out: Path, shard: int) -> int:
    """Write one shard's hands, counts of redraws and rows, which depend only on its number and the seed."""
    settings = source.settings
    rng = np.random.default_rng(np.random.SeedSequence(settings.seed, spawn_key=(shard,)))
    rows = np.zeros(_shard_size(settings.num_frames, shard), dtype=row_dtype(source.layout.num_markers))
    people = -(-len(rows) // settings.frames_per_hand)
    before = shard * -(-ROWS_PER_SHARD // settings.frames_per_hand)  # people in earlier shards
    redrawn: Counter[str] = Counter()
    hands = np.zeros(len(SIDES) * people, dtype=worn_dtype(source.layout.num_markers))
    for person in range(people):
        block = rows[person * settings.frames_per_hand : (person + 1) * settings.frames_per_hand]
        models = sample_hands(settings.population, redrawn=redrawn, rng=rng)
        first = len(SIDES) * person
        fits = simulate_frames(block, models, source, redrawn=redrawn, rng=rng)
        worn = {fit.side: [(one.along, one.around, one.across) for one in fit.layout.markers] for fit in fits}
        nowhere = np.full((source.layout.num_markers, 3), np.nan)
        for number, shape in enumerate((model.shape for model in models), first):
            hands[number] = (*pack_hand(shape), worn.get(shape.side, nowhere), before + person)
        block["hand"] += first
    save_array(out / hands_name(shard), hands)
    save_json(out / redrawn_name(shard), dict(sorted(redrawn.items())))
    save_array(out / rows_name(shard), rows)
    save_checksums(out / checksums_name(shard), {name: out / name for name in _files_of_shard(shard)})
    return shard
