"""Training of a labeler: its state, its steps and checkpoints, and the weights, card and page of its end."""

from __future__ import annotations

import dataclasses
import functools
import io
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from lightning_fabric import Fabric
from numpy.typing import NDArray
from torch import nn

from handsim import __version__
from handsim._checks import check_type, make_settings
from handsim.callbacks import OnStep, Progress, no_progress, no_step
from handsim.errors import ArgumentError, DatasetError, HandSimError, WeightsError
from handsim.files.arrays import check_members
from handsim.files.json_files import claim
from handsim.files.outputs import atomic_write, written_together
from handsim.files.signals import Stopped, interrupt_flag, interrupts_bare
from train.data.batches import (
    Batch,
    Corruption,
    Part,
    check_corruption,
    draw_batch,
    paper_corruption,
    right_hands,
)
from train.data.shards import Dataset, Manifest, MappedRows, load_dataset
from train.devices.agreement import Agreement, PeerError
from train.devices.fabric_start import check_devices, start_fabric
from train.devices.local_processes import LossProgress, Tell, in_local_processes
from train.devices.world import world_of
from train.evaluation import History, LabelingReport, evaluate_markers, paper_report
from train.labelers.cnn_labeler import label_by_distance
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.networks import (
    SetLabeler,
    batch_loss,
    cnn_labeler,
    labeler_of,
    new_network,
    prepare_network,
)
from train.labelers.pose_prior import learn_pose_prior
from train.labelers.protocol import Labeling
from train.labelers.storage import save_network
from train.reports.model_card import UNKNOWN_LICENSE, write_model_card
from train.reports.run_page import write_run_page
from train.settings import KINDS, CNNConfig, Kind, TrainSettings, batch_recipe, default_config
from train.threads import TrainingThreads, check_threads

_CURVE: Final = 200  # points of the loss curve


class TrainingError(HandSimError):
    """A training run that does not converge."""


class TrainingState:
    """The state that a run carries from step to step and a checkpoint keeps."""

    def __init__(self, config: TrainSettings, fabric: Fabric, rows: NDArray[np.void] | MappedRows) -> None:
        self.config = config
        self.fabric = fabric
        self.part = Part(fabric.global_rank, fabric.world_size)
        network = new_network(config.chosen)
        prepare_network(network, rows)
        self.network, self.optimizer = fabric.setup(network, _optimizer(config, network))
        self.mean = {name: tensor.detach().clone() for name, tensor in self.network.state_dict().items()}
        self.done = 0
        self.history = History()
        self.began = time.monotonic(), 0

    def step(self, batch: Batch, *, rng: np.random.Generator) -> float:
        """Make one gradient step together with the other devices and return the loss before it.

        Each device learns from its part of the batch; the rng is the same on each.

        Raises:
            TrainingError: The loss is not finite; the state is of no use then.
        """
        began = time.perf_counter()
        rate = self.config.learning_rate * _rate(self.config, self.done / self.config.samples)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        loss = self._loss(batch, rng)
        self.optimizer.zero_grad()
        self.fabric.backward(loss)
        if self.config.optimizer == "adamw":
            self.fabric.clip_gradients(self.network, self.optimizer, max_norm=1.0)
        self.optimizer.step()
        self.done += self.config.batch
        self._average()
        value = float(self.fabric.all_reduce(loss.detach(), reduce_op="mean"))  # type: ignore[arg-type]
        if not np.isfinite(value):
            raise TrainingError(
                f"the loss is {value} after {self.done} samples; begin again with a learning rate below "
                f"{self.config.learning_rate:g}"
            )
        self.history.add(value)
        self.history.minutes += (time.perf_counter() - began) / 60.0
        if passed(self.done, self.config, _CURVE) or self.done >= self.config.samples:
            self._log(rate)
        return value

    def _loss(self, batch: Batch, rng: np.random.Generator) -> torch.Tensor:
        return batch_loss(self.config, self.network, batch, self.fabric.device, rng=rng, part=self.part)

    def _average(self) -> None:
        every = self.config.batch * self.config.average_every
        if self.done % every and self.done < self.config.samples:
            return
        decay = min(self.config.average, self.done / (self.done + 20.0 * every))
        with torch.no_grad():
            for name, tensor in self.network.state_dict().items():
                if tensor.is_floating_point():
                    self.mean[name].lerp_(tensor, 1.0 - decay)
                else:
                    self.mean[name].copy_(tensor)

    def _log(self, rate: float) -> None:
        loss = self.history.close(self.done, rate)
        since, done = self.began
        now = time.monotonic()
        speed = (self.done - done) / (now - since)
        self.began = now, self.done
        self.fabric.log_dict(
            {"loss": loss, "learning_rate": rate, "samples_per_second": speed}, step=self.done
        )

    def evaluate(self, rows: NDArray[np.void], names: tuple[str, ...]) -> None:
        """Record the slot accuracy of the mean weights on a few held-out rows, the same each time."""
        report = paper_report(labeler_of(self.averaged(), names), rows)
        accuracy = report.figures["slot_accuracy"]
        self.history.accuracies.append((self.done, self.history.minutes, accuracy))
        self.fabric.log_dict({"held_out_slot_accuracy": accuracy}, step=self.done)

    def averaged(self) -> nn.Module:
        """The network with the mean weights."""
        with torch.random.fork_rng(devices=[]):  # the initial weights are replaced at once
            network = new_network(self.config.chosen)
        network.load_state_dict({name: tensor.cpu() for name, tensor in self.mean.items()})
        return network.eval()

    def save(self, path: Path) -> None:
        """Write a checkpoint; the first process does."""
        if not self.fabric.is_global_zero:
            return
        content = {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "mean": self.mean,
            "done": self.done,
            "history": dataclasses.asdict(self.history),
        }
        # Through memory: torch puts the temporary name into a file that it opens itself, and does not say
        # that the disk is full.
        buffer = io.BytesIO()
        torch.save(content, buffer)
        with atomic_write(path) as temporary:
            temporary.write_bytes(buffer.getbuffer())

    def restore(self, path: Path) -> None:
        """Continue from a checkpoint, if there is one; the first process reads it for all."""
        found = path.read_bytes() if self.fabric.is_global_zero and path.is_file() else None
        found = self.fabric.broadcast(found)
        if found is None:
            return
        stored = io.BytesIO(found)  # torch calls some damage an OSError
        try:
            with zipfile.ZipFile(stored) as archive:
                check_members(archive, len(found))
            stored.seek(0)
            content = torch.load(stored, weights_only=True, map_location=self.fabric.device)
            self._check(content)
            self.network.load_state_dict(content["network"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.mean, self.done = content["mean"], content["done"]
            self.history = History(**content.get("history", {}))  # older checkpoints have none
        except MemoryError:
            raise
        except Exception as error:  # a file can be damaged in more ways than torch names
            raise WeightsError(f"{path} is damaged; delete it to begin this run again") from error
        self.began = time.monotonic(), self.done

    def _check(self, content: dict[str, Any]) -> None:
        """Raise a ValueError unless a checkpoint's tensors are this run's, finite, and its count is one."""
        check_stored(content)
        done, mean, network = content["done"], content["mean"], content["network"]
        if type(done) is not int or done < 0 or done % self.config.batch:
            raise ValueError("the number of samples is none of this run's")
        for name, tensor in self.mean.items():
            for stored in (mean[name], network[name]):
                if stored.shape != tensor.shape or stored.dtype != tensor.dtype:
                    raise ValueError(f"{name} has another shape")
                if not torch.isfinite(stored).all():
                    raise ValueError(f"{name} is not finite")

    def try_step(self, batch: Batch, *, rng: np.random.Generator) -> None:
        """Do the work of a step, to time it; the state stays as it is."""
        kept = {name: tensor.detach().clone() for name, tensor in self.network.state_dict().items()}
        try:
            self.fabric.backward(self._loss(batch, rng))
        finally:
            self.optimizer.zero_grad()
            self.network.load_state_dict(kept)  # means of batch normalization move in a forward pass


def _optimizer(config: TrainSettings, network: nn.Module) -> torch.optim.Optimizer:
    if config.optimizer == "sgd":
        return torch.optim.SGD(
            network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
    return torch.optim.AdamW(
        network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, fused=True
    )


def _rate(config: TrainSettings, progress: float) -> float:
    """Share of the peak learning rate at a share of the run."""
    if config.schedule == "steps":
        return float(0.1 ** ((progress >= 50 / 75) + (progress >= 70 / 75)))
    return float(min(1.0, progress / 0.01 + 1e-3) * 0.5 * (1.0 + np.cos(np.pi * min(1.0, progress))))


def check_stored(content: object, seen: set[int] | None = None) -> None:
    """Raise a ValueError for a tensor in nested tables that has more entries than are stored of it."""
    seen = set() if seen is None else seen
    if id(content) in seen:
        return
    seen.add(id(content))
    if isinstance(content, torch.Tensor):
        if content.numel() * content.element_size() > content.untyped_storage().nbytes():
            raise ValueError("a tensor of more entries than are stored")
    elif isinstance(content, dict | list | tuple):
        for entry in content.values() if isinstance(content, dict) else content:
            check_stored(entry, seen)


def passed(done: int, config: TrainSettings, parts: int) -> bool:
    """Whether the last step ended one of this many parts of the run, each at least one step long."""
    part = max(config.batch, config.samples // parts)
    return (done - config.batch) // part != done // part


MOST_HELD_OUT: Final = 8192
_CARD_FRAMES: Final[dict[Kind, int]] = {"set": MOST_HELD_OUT, "cnn": 1024}  # of the evaluation
_PRIOR_STRETCH: Final = 0.03  # anisotropy of the hands of the pose prior: people differ more than simulated
_COST_FRAMES: Final = 400  # for the costs of the paper's network
_REJECTS: Final = (0.015, 0.02, 0.03, 0.04, 0.06, 0.08)  # [m]
_SPREADS: Final = (0.002, 0.003, 0.004, 0.006, 0.008, 0.012)  # [m]


def finish_run(
    state: TrainingState,
    rows: MappedRows,
    held_out: MappedRows,
    manifest: Manifest,
    out: Path,
    tell: Callable[[str], None],
) -> dict[str, Any]:
    """Evaluate the network, write weights, card and page, and return the card.

    Args:
        rows: What it was trained on.
        held_out: What it has not seen.
        out: Folder of the run.
        tell: Called with the name of each step.
    """
    config, names = state.config, manifest.marker_names
    network = state.averaged()
    if isinstance(network, DeepLabelCNN):
        tell("costs of the paper's labeler")
        choose_costs(network, names, few(held_out, _COST_FRAMES))
    else:
        assert isinstance(network, SetLabeler)
        tell("pose prior")
        rng = np.random.default_rng(config.seed)
        network.prior = learn_pose_prior(right_hands(rows, _PRIOR_STRETCH, rng=rng), rng=rng)
    tell("held-out frames")
    card, report = _card(network, few(held_out, _CARD_FRAMES[config.labeler]), config, manifest)
    card["curve"] = state.history.accuracies
    tell("weights and report")
    with written_together():
        save_network(out, network, card)
        write_run_page(out, card, state.history, report)
        write_model_card(out, card)
    return card


def few(rows: MappedRows, count: int) -> NDArray[np.void]:
    """Every nth of these rows, at most `count`."""
    return rows[np.arange(0, len(rows), -(-len(rows) // count))]


def _card(
    network: nn.Module, rows: NDArray[np.void], config: TrainSettings, manifest: Manifest
) -> tuple[dict[str, Any], LabelingReport]:
    """Model card with figures on held-out simulated frames; the evaluation with the paper's corruption."""
    labeler = labeler_of(network, manifest.marker_names)
    markers = rows["markers"].astype(np.float64)
    clean = evaluate_markers(labeler, markers, Corruption(0, 0), rng=np.random.default_rng(0))
    paper, report = paper_corruption(markers.shape[1]), paper_report(labeler, rows)
    card = {
        "marker_names": list(manifest.marker_names),
        "trained_on": "simulated frames only",
        "handsim": __version__,
        "license": UNKNOWN_LICENSE,
        "dataset": manifest.config,
        "train": config.record(),
        "held_out_simulated": {
            "clean": clean.figures,
            f"occlude {paper.occlude}, ghosts {paper.ghosts}": report.figures,
        },
    }
    return card, report


def choose_costs(network: DeepLabelCNN, marker_names: tuple[str, ...], rows: NDArray[np.void]) -> CNNConfig:
    """The network's settings with the reject that labels most slots right, and the best calibrated spread.

    Settings that the network has already are kept.

    Args:
        rows: A few hundred held-out rows of a training set; they get the paper's corruption.
    """
    labeler = _Recalling(network, marker_names)

    def report(reject: float, spread: float) -> LabelingReport:
        labeler.reject, labeler.spread = reject, spread
        return paper_report(labeler, rows)

    config = network.config
    reject = config.reject or max(
        _REJECTS, key=lambda tried: report(tried, _SPREADS[0]).figures["slot_accuracy"]
    )
    spread = config.spread or min(
        _SPREADS, key=lambda tried: report(reject, tried).figures["calibration_error"]
    )
    network.config = dataclasses.replace(config, reject=reject, spread=spread)
    return network.config


class _Recalling:
    """A labeler that runs its network once: later calls label the same frames with other costs."""

    def __init__(self, network: DeepLabelCNN, marker_names: tuple[str, ...]) -> None:
        self.marker_names = marker_names
        self.reject = self.spread = 0.0
        self._labeler = cnn_labeler(network, marker_names)
        self._distances: list[NDArray[np.float64]] = []

    def label_frames(self, frames: Sequence[NDArray[np.float64]]) -> list[Labeling]:
        """Label the frames that were given first."""
        self._distances = self._distances or self._labeler.distances(list(frames))
        return [label_by_distance(distances, self.reject, self.spread) for distances in self._distances]


CHECKPOINT: Final = "checkpoint.pt"
_CONFIG: Final = "train.json"
_HELD_OUT: Final = 0.02  # share of rows, from the end, that training never sees
_NUM_EVALUATIONS: Final = 10  # on held-out frames in the course of a run
_CURVE_FRAMES: Final[dict[Kind, int]] = {"set": 512, "cnn": 160}  # of each of these evaluations


def train_labeler(
    dataset: Dataset | str | Path,
    out: str | Path,
    config: TrainSettings | None = None,
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
        settings: Settings of `TrainSettings` that differ from `config`: `samples=300_000`; `labeler="cnn"`
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


def _chosen_config(config: TrainSettings | None, settings: dict[str, Any]) -> TrainSettings:
    """The settings, with those that were given by name."""
    if config is None:
        labeler = settings.get("labeler", "set")
        config = default_config(labeler) if labeler in KINDS else TrainSettings(labeler=labeler)
    check_type("config", config, TrainSettings, "a TrainSettings")
    return make_settings(TrainSettings, "setting of a training", settings, default=config)


def _train(
    dataset: Dataset | str | Path,
    config: TrainSettings,
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


def _started(config: TrainSettings, out: Path, threads: int | None) -> Fabric:
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
    dataset: Dataset | str | Path, config: TrainSettings, out: Path, fabric: Fabric, ranks: Agreement
) -> _Run:
    """Open the set, claim the folder of the run and go on from its checkpoint."""

    def claimed() -> tuple[Dataset, TrainSettings, MappedRows, MappedRows]:
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


def _for_set(config: TrainSettings, num_labels: int, devices: int) -> TrainSettings:
    """The same settings for a layout of this many markers, on this many devices."""
    return dataclasses.replace(
        config,
        devices=devices,
        network=dataclasses.replace(config.network, num_labels=num_labels),
        cnn=dataclasses.replace(config.cnn, num_labels=num_labels),
    )


def _claim(out: Path, config: TrainSettings, dataset: Dataset) -> None:
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
