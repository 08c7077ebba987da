"""The training loop: rows, corruption, network, checkpoints, weights, and a page about the run."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from lightning_fabric import Fabric

from handsim._checks import check_type, make_settings
from handsim.callbacks import OnStep, Progress, no_progress, no_step
from handsim.errors import ArgumentError, DatasetError, WeightsError
from handsim.files.json_files import claim
from handsim.files.signals import Stopped, interrupt_flag, interrupts_bare
from train.config import KINDS, Kind, TrainConfig, batch_recipe, default_config
from train.data.batches import Batch, check_corruption, draw_batch
from train.data.shards import Dataset, MappedRows, load_dataset
from train.devices.agreement import Agreement, PeerError
from train.devices.fabric_start import check_devices, start_fabric
from train.devices.local_processes import LossProgress, Tell, in_local_processes
from train.devices.world import world_of
from train.run_result import MOST_HELD_OUT, few, finish_run
from train.threads import TrainingThreads, check_threads
from train.training_state import TrainingState, passed

CHECKPOINT: Final = "checkpoint.pt"
_CONFIG: Final = "train.json"
_HELD_OUT: Final = 0.02  # share of rows, from the end, that training never sees
_NUM_EVALUATIONS: Final = 10  # on held-out frames in the course of a run
_CURVE_FRAMES: Final[dict[Kind, int]] = {"set": 512, "cnn": 160}  # of each of these evaluations


def train_labeler(
    dataset: Dataset | str | Path,
    out: str | Path,
    config: TrainConfig | None = None,
    *,
    threads: int | None = None,
    progress: Progress = no_progress,
    on_step: OnStep = no_step,
    save_every: float = 60.0,
    **settings: Any,
) -> dict[str, Any]:
    """Train a labeler and write weights, card, curves and a page to `out`; continues from a checkpoint there.

    `load_labeler(out)` is the labeler.

    A run there may have had fewer samples. The learning rate then goes on as in a run of the new length. It
    may have had another number of devices.

    With `config.devices` above one this starts a process for each, so a script must call it below
    `if __name__ == "__main__"`. In a process that torchrun or srun started it takes its part in their run.

    Args:
        dataset: The training set, or its folder.
        out: Folder of the run.
        config: How to train; as the shipped labelers when not given.
        threads: Threads of each process on a CPU; one or all when not given, whichever a few steps show to be
            faster, and one on several devices. Weights differ in their last bits with it.
        progress: Called after every step with samples done and samples expected.
        on_step: Called with what is done, such as "pose prior", when it begins; and after every step of
            training with the loss.
        save_every: Time between checkpoints [s].
        settings: Settings of `TrainConfig` that differ from `config`: `samples=300_000`; `labeler="cnn"`
            stands for the settings that the paper's network is trained with.

    Returns:
        The model card.

    Raises:
        DatasetError: The set is too small to train on.
        WeightsError: `out` holds a run of other settings.
        ArgumentError: There are fewer devices than `config.devices`, or than processes.
        TrainingError: The loss is not finite.
        PeerError: Another process of the run failed, and tells why.
        Stopped: A signal came; the last step is kept in the checkpoint.
    """
    check_type("out", out, (str, Path), "the path of a folder")
    config, out = _chosen_config(config, settings), Path(out)

    def report(done: int, total: int, loss: float) -> None:
        on_step(f"loss {loss:.3f}")
        progress(done, total)

    if config.devices == 1 or world_of().size > 1:
        return _train(
            dataset, config, out, threads=threads, progress=report, told=on_step, save_every=save_every
        )
    check_threads(threads)
    check_devices(config, config.devices, config.devices)
    checked = load_dataset(dataset)
    job = functools.partial(_train, checked, config, out, threads=threads, save_every=save_every)
    card: dict[str, Any] = in_local_processes(job, config.devices, progress=report, told=on_step)
    return card


def _chosen_config(config: TrainConfig | None, settings: dict[str, Any]) -> TrainConfig:
    """The settings, with those that were given by name."""
    if config is None:
        labeler = settings.get("labeler", "set")
        config = default_config(labeler) if labeler in KINDS else TrainConfig(labeler=labeler)
    check_type("config", config, TrainConfig, "a TrainConfig")
    return make_settings(TrainConfig, "setting of a training", settings, default=config)


def _train(
    dataset: Dataset | str | Path,
    config: TrainConfig,
    out: Path,
    *,
    threads: int | None,
    progress: LossProgress | None,
    told: Tell | None,
    save_every: float,
) -> dict[str, Any]:
    """Train on the device of this process, together with those of the others."""
    fabric = _started(config, out, threads)
    tell = told if told is not None and fabric.is_global_zero else _say_nothing
    ranks = Agreement(fabric)
    with _curves_closed(fabric), ranks.losses_told():
        with ranks.signals_noted():
            tell("training set")
            run = _prepare(dataset, config, out, fabric, ranks)
            chosen = TrainingThreads(_threads(threads, fabric), run.try_step)
            with chosen.in_use(), run.kept(out / CHECKPOINT):
                _do_steps(run, chosen, out / CHECKPOINT, progress, tell, save_every)
        with chosen.in_use(), run.kept(out / CHECKPOINT):
            card: dict[str, Any] = {}
            if fabric.is_global_zero:
                card = finish_run(run.state, run.rows, run.held_out, run.dataset.manifest, out, tell)
            return fabric.broadcast(card)


def _say_nothing(step: str) -> None:
    """What is told to where nobody listens."""


def _do_steps(
    run: _Run,
    chosen: TrainingThreads,
    checkpoint: Path,
    progress: LossProgress | None,
    tell: Tell,
    save_every: float,
) -> None:
    """Do what steps there are to do, and keep the state now and then."""
    state, config = run.state, run.state.config
    saved = time.monotonic()
    while run.is_unfinished(tell):
        with chosen.timed_step():
            loss = run.step()
        if progress is not None and state.fabric.is_global_zero:
            progress(min(state.done, config.samples), config.samples, loss)
        if time.monotonic() - saved > save_every:
            tell("checkpoint")
            state.save(checkpoint)
            saved = time.monotonic()
    run.ranks.agree(lambda: None)  # a signal since the last step ends the run here
    tell("checkpoint")
    state.save(checkpoint)


def _started(config: TrainConfig, out: Path, threads: int | None) -> Fabric:
    """The devices; of the processes on this machine the first tells mistakes, which all have."""
    try:
        check_threads(threads)
        return start_fabric(config, out)
    except ArgumentError as error:
        if world_of().local_rank == 0:
            raise
        raise PeerError(str(error)) from error


@contextmanager
def _curves_closed(fabric: Fabric) -> Iterator[None]:
    """Close the writer of the curves after the block; its thread complains in a process that ends before."""
    try:
        yield
    finally:
        fabric.logger.finalize("")


def _prepare(
    dataset: Dataset | str | Path, config: TrainConfig, out: Path, fabric: Fabric, ranks: Agreement
) -> _Run:
    """Open the set, claim the folder of the run and go on from its checkpoint."""

    def claimed() -> tuple[Dataset, TrainConfig, MappedRows, MappedRows]:
        opened = load_dataset(dataset)
        whole = _for_set(config, len(opened.marker_names), fabric.world_size)
        rows = opened.mapped_rows()
        held_out = min(MOST_HELD_OUT, max(1, int(_HELD_OUT * len(rows))))
        if len(rows) - held_out < config.batch:
            raise DatasetError(
                f"{opened.path} has {len(rows)} frames, expected at least {config.batch + held_out + 1}"
            )
        parts = rows.span(0, len(rows) - held_out), rows.span(len(rows) - held_out, len(rows))
        if fabric.is_global_zero:
            _claim(out, whole, opened)
        return opened, whole, *parts

    opened, whole, rows, held_out = ranks.agree(claimed)
    torch.manual_seed(config.seed)
    run = _Run(TrainingState(whole, fabric, rows), ranks, opened, rows, held_out)
    with ranks.told_once():
        run.state.restore(out / CHECKPOINT)
    return run


def _for_set(config: TrainConfig, num_labels: int, devices: int) -> TrainConfig:
    """The same settings for a layout of this many markers, on this many devices."""
    return dataclasses.replace(
        config,
        devices=devices,
        network=dataclasses.replace(config.network, num_labels=num_labels),
        cnn=dataclasses.replace(config.cnn, num_labels=num_labels),
    )


def _claim(out: Path, config: TrainConfig, dataset: Dataset) -> None:
    """Claim the folder of the run, or check that the run there is this one."""
    settings: dict[str, Any] = {"train": config.record(), "dataset": dataset.manifest.config}
    del settings["train"]["devices"]
    if config.corruption is None:
        del settings["train"]["corruption"]
    else:
        check_corruption(config.corruption, len(dataset.marker_names))
    # Older runs name their devices.
    claim(
        out / _CONFIG, settings, noun="training run", error=WeightsError,
        grows="train.samples", free=("train.devices",),
    )  # fmt: skip


def _threads(given: int | None, fabric: Fabric) -> int | None:
    """The threads of this process, None where they shall be measured, which processes cannot do alone."""
    if fabric.device.type != "cpu":
        return given or torch.get_num_threads()
    return given if fabric.world_size == 1 else given or 1


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """The state of a run and what it learns from."""

    state: TrainingState
    ranks: Agreement
    dataset: Dataset
    rows: MappedRows
    held_out: MappedRows

    def is_unfinished(self, tell: Tell) -> bool:
        """Whether there are steps to do; an evaluation that is due is done first."""
        state, config = self.state, self.state.config
        evaluated = state.history.accuracies[-1][0] if state.history.accuracies else 0
        due = state.done > evaluated and passed(state.done, config, _NUM_EVALUATIONS)
        if due and state.fabric.is_global_zero:
            tell("held-out frames")
            state.evaluate(few(self.held_out, _CURVE_FRAMES[config.labeler]), self.dataset.marker_names)
        return state.done < config.samples

    def step(self) -> float:
        """Make a step, whole or not at all, and return its loss."""
        if not self.ranks.alone:
            batch, rng = self.ranks.agree(self._draw)
            with self.ranks.told_once():
                return self.state.step(batch, rng=rng)
        with interrupt_flag() as interrupted:
            batch, rng = self._draw()
            loss = self.state.step(batch, rng=rng)
        if interrupted():
            raise Stopped(interrupted.number)
        return loss

    def try_step(self) -> None:
        """Do the work of the next step; the state stays as it is."""
        batch, rng = self._draw()
        self.state.try_step(batch, rng=rng)

    def _draw(self) -> tuple[Batch, np.random.Generator]:
        """The batch of the next step, and the generator that the step goes on with."""
        # One generator per step, so that a resumed run makes the same draws; the same one on each device.
        rng = np.random.default_rng((self.state.config.seed, self.state.done, 0))
        recipe = batch_recipe(self.state.config, len(self.dataset.marker_names))
        return draw_batch(self.rows, recipe, rng=rng), rng

    @contextmanager
    def kept(self, checkpoint: Path) -> Iterator[None]:
        """Write a checkpoint when a signal ends the block, and say so."""
        try:
            with interrupts_bare():
                yield
        except KeyboardInterrupt as stop:
            self.state.save(checkpoint)
            done, expected = self.state.done, self.state.config.samples
            raise Stopped.again(
                stop,
                f"{min(done, expected)} of {expected} samples are kept in {checkpoint}, and the same command "
                "goes on after them",
            ) from stop
