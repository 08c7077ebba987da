"""Trains a labeler: makes steps and checkpoints, and at the end writes weights, card and page."""

from __future__ import annotations

import dataclasses
import io
import signal
import time
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Int
from lightning_fabric import Fabric
from numpy.typing import NDArray
from torch import nn

from gloves.layout import stored_layout
from handsim._checks import check_count, check_type
from handsim._process import torch_kept
from handsim._version import full_version
from handsim.app.workers import usable_cores
from handsim.callbacks import OnStep, Progress, no_progress, no_step
from handsim.errors import DatasetError, HandSimError, WeightsError
from handsim.files.arrays import check_members
from handsim.files.outputs import atomic_write, claim, written_together
from handsim.files.signals import InterruptFlag, Stopped, interrupt_flag, interrupts_bare
from train.data.batches import Batch, Part, check_corruption, draw_batch, paper_corruption, right_hands
from train.data.shards import Dataset, Manifest, MappedRows, load_dataset
from train.evaluation import CLEAN, SEEN, History, LabelingReport, evaluate_markers, paper_report, rig_report
from train.fabric import lost_peers_reported, start_fabric
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
from train.labelers.protocol import MOST_THREADS, Labeling, torch_threads
from train.labelers.storage import GLOVE, RUN_SETTINGS, save_network, untrained_labeler
from train.reports.run_page import UNKNOWN_LICENSE, write_model_card, write_run_page
from train.settings import CNNConfig, Kind, TrainSettings, batch_recipe, train_settings

CHECKPOINT: Final = "checkpoint.pt"
_HELD_OUT_SHARE: Final = 0.02  # share of the people, from the end of the set, that is held out from training
_FEWEST_HELD_OUT_PEOPLE: Final = 20  # least number of held-out people of a set of two hundred or more
_NUM_EVALUATIONS: Final = 10  # number of evaluations on held-out frames during a run
_CURVE_FRAMES: Final[dict[Kind, int]] = {"set": 512, "cnn": 160}  # held-out frames of each such evaluation
_CARD_FRAMES: Final[dict[Kind, int]] = {"set": 8192, "cnn": 1024}  # held-out frames of the model card
_FEWEST_EVALUATED, _SAMPLES_PER_EVALUATED_ROW = 64, 8  # least held-out frames; samples of a run for each
_CURVE_POINTS: Final = 200  # number of entries of the loss curve
_PRIOR_STRETCH: Final = 0.03  # anisotropy of the prior's hands: real people differ more
_COST_FRAMES: Final = 400  # held-out frames for choosing the costs of the paper's network
_TRIED_REJECTS: Final = (0.015, 0.02, 0.03, 0.04, 0.06, 0.08)  # [m] tried costs of a ghost
_TRIED_SPREADS: Final = (
    0.002,
    0.003,
    0.004,
    0.006,
    0.008,
    0.012,
)  # [m] confidence scales tried after training


class TrainingError(HandSimError):
    """A training run that does not converge."""


@torch_kept()
def train_labeler(
    dataset: Dataset | str | Path,
    out: str | Path,
    settings: TrainSettings | None = None,
    *,
    threads: int | None = None,
    progress: Progress = no_progress,
    on_step: OnStep = no_step,
    save_every: float = 60.0,
    **options: Any,
) -> dict[str, Any]:
    """Train a labeler and write weights, card, curves and a page to `out`; continues from a checkpoint there.

    `load_labeler(out)` reads the labeler.

    A run to be continued may have had fewer samples: the learning rate then continues as in a run of the new
    length. It may also have had another number of devices. In a process started by torchrun or srun this
    takes part in a run of all processes.

    Args:
        dataset: The training set, or its folder.
        out: Folder of the run.
        settings: Settings of the training; those of the shipped labelers if not given.
        threads: Threads of each process on a CPU. By default one for the set labeler, and all for the paper's
            network unless there are several processes. The number affects the last bits of the weights.
        progress: Called after every step with the numbers of samples done and in total.
        on_step: Called with the name of each step, such as "pose prior", and with the loss after every
            training step.
        save_every: Time between checkpoints [s].
        options: Settings of `TrainSettings` that differ from `settings`: `samples=300_000`; `labeler="cnn"`
            alone stands for the settings that the paper's network is trained with.

    Returns:
        The model card.

    Raises:
        DatasetError: The set is too small to train on.
        WeightsError: `out` holds a run with other settings.
        ArgumentError: A setting is refused, or there are fewer GPUs than processes.
        TrainingError: The loss is not finite.
        HandSimError: Another process of the run ended, and tells why.
        Stopped: A signal came; the last step is kept in the checkpoint.
    """
    check_type("out", out, (str, Path), "the path of a folder")
    settings, out = train_settings(settings, options), Path(out)
    if threads is not None:
        check_count("threads", threads, 1, MOST_THREADS)
    fabric = start_fabric(settings, out)
    if not fabric.is_global_zero:
        progress, on_step = no_progress, no_step
    if threads is None:
        alone_on_cpu = fabric.device.type == "cpu" and fabric.world_size == 1
        many = settings.labeler == "cnn" and alone_on_cpu
        threads = min(torch.get_num_threads(), usable_cores()) if many else 1
    with ExitStack() as stack, lost_peers_reported(), torch_threads(threads):
        # Close the writer of curves: its thread would report an error if the process ended before.
        stack.callback(fabric.logger.finalize, "")
        on_step("training set")
        flag = InterruptFlag()
        # Delay signals if there are other processes: they would wait for one that ends at once.
        with nullcontext() if fabric.world_size == 1 else interrupt_flag(flag, again=False):
            run = _prepare(load_dataset(dataset), settings, out, fabric)
            with run.checkpointed_if_interrupted():
                run.do_steps(flag, progress, on_step, save_every)
        with run.checkpointed_if_interrupted():
            return fabric.broadcast(run.finish(on_step) if fabric.is_global_zero else {})


def _prepare(dataset: Dataset, settings: TrainSettings, out: Path, fabric: Fabric) -> _Run:
    """Claim the run's folder, or check that its run has the same settings, and restore the checkpoint."""
    rows, people = dataset.mapped_rows(), dataset.people()
    settings = settings.for_set(len(dataset.marker_names), len(rows))
    held_out = len(rows) - _first_held_out(people)
    if len(rows) - held_out < settings.batch:
        raise DatasetError(
            f"{dataset.path} has {len(rows)} frames, expected at least {settings.batch + held_out + 1}"
        )
    if fabric.is_global_zero:
        record = settings.record()
        if settings.corruption is None:
            del record["corruption"]
        else:
            check_corruption(settings.corruption, len(dataset.marker_names))
        # Older runs record their devices.
        claim(
            out / RUN_SETTINGS, {"train": record, "dataset": dataset.manifest.config}, noun="training run",
            error=WeightsError, grows="train.samples", free=("train.devices",),
        )  # fmt: skip
    seen = rows.span(0, len(rows) - held_out)
    torch.manual_seed(settings.seed)
    state = TrainingState(settings, fabric, seen)
    state.restore(out / CHECKPOINT)
    unseen = people[len(seen) :] if people[len(seen)] != people[len(seen) - 1] else people[:0]
    return _Run(state, dataset.manifest, seen, rows.span(len(seen), len(rows)), unseen, out)


def untrained_report(dataset: Dataset | str | Path, settings: TrainSettings) -> LabelingReport:
    """Evaluate the labeler that a glove has without training on the held-out frames of a run.

    The frames are those of the run's model card, as the rig saw them. The labeler for any layout learns a
    new layout in about a minute.
    """
    dataset = load_dataset(dataset)
    rows = dataset.mapped_rows()
    settings = settings.for_set(len(dataset.marker_names), len(rows))
    held_out = rows.span(_first_held_out(dataset.people()), len(rows))
    shown = held_out[_evaluation_rows(held_out, settings.samples, _CARD_FRAMES[settings.labeler])]
    return rig_report(untrained_labeler(dataset.layout), shown, rng=np.random.default_rng(0))


def _evaluation_rows(held_out: MappedRows, samples: int, count: int) -> Int[np.ndarray, "R"]:
    """Indices of at most `count` held-out rows, evenly spread; fewer if evaluation would outlast training."""
    count = min(count, max(_FEWEST_EVALUATED, samples // _SAMPLES_PER_EVALUATED_ROW))
    return np.arange(0, len(held_out), -(-len(held_out) // count))


def _first_held_out(people: Int[np.ndarray, "T"]) -> int:
    """The first row of a set's last people, who are held out from training.

    They are 2 % of the people, at least twenty, but at most a tenth in a small set. In a set of one person
    the last 2 % of the rows are held out.
    """
    firsts = np.flatnonzero(np.diff(people, prepend=-1))
    if len(firsts) == 1:
        return len(people) - max(1, int(_HELD_OUT_SHARE * len(people)))
    count = max(int(_HELD_OUT_SHARE * len(firsts)), min(_FEWEST_HELD_OUT_PEOPLE, len(firsts) // 10), 1)
    return int(firsts[-count])


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """A training run: its state, its training set and its folder."""

    state: TrainingState
    manifest: Manifest
    rows: MappedRows
    held_out: MappedRows
    people: Int[np.ndarray, "T"]
    """Person of each held-out row; empty in a set of one person, who is also trained on."""
    out: Path

    def do_steps(self, flag: InterruptFlag, progress: Progress, on_step: OnStep, save_every: float) -> None:
        """Make the remaining steps, and save the state every `save_every` seconds.

        A signal ends the run between two steps; several processes all end after the same one.
        """
        state, settings, alone = self.state, self.state.settings, self.state.fabric.world_size == 1
        recipe, names = batch_recipe(settings, len(self.manifest.marker_names)), self.manifest.marker_names
        shown, saved = self.held_out[self._evaluation_rows(_CURVE_FRAMES[settings.labeler])], time.monotonic()
        evaluated = state.history.accuracies[-1][0] if state.history.accuracies else 0
        while True:
            if state.done > evaluated and _ends_interval(
                state.done, settings, _NUM_EVALUATIONS, _SAMPLES_PER_EVALUATED_ROW * len(shown)
            ):
                evaluated = state.done
                if state.fabric.is_global_zero:
                    on_step("held-out frames")
                    state.evaluate(shown, names)
            if state.done >= settings.samples:
                break
            with interrupt_flag(flag, again=alone):
                # A generator per step makes the draws of a resumed run the same; all devices share it.
                rng = np.random.default_rng((settings.seed, state.done, 0))
                loss = state.step(draw_batch(self.rows, recipe, rng=rng), rng=rng)
            ended = torch.tensor(float(flag()), device=state.fabric.device)
            if state.fabric.all_reduce(ended, reduce_op="sum"):
                raise Stopped(flag.number or signal.SIGTERM)
            on_step(f"loss {loss:.3f}")
            progress(min(state.done, settings.samples), settings.samples)
            if time.monotonic() - saved > save_every:
                on_step("checkpoint")
                state.save(self.out / CHECKPOINT)
                saved = time.monotonic()
        on_step("checkpoint")
        state.save(self.out / CHECKPOINT)

    def _evaluation_rows(self, count: int) -> Int[np.ndarray, "R"]:
        """At most `count` of the held-out rows, as indices."""
        return _evaluation_rows(self.held_out, self.state.settings.samples, count)

    @contextmanager
    def checkpointed_if_interrupted(self) -> Iterator[None]:
        """Write a checkpoint if a signal ends the block."""
        try:
            with interrupts_bare():
                yield
        except KeyboardInterrupt as stop:
            path = self.out / CHECKPOINT
            self.state.save(path)
            done, expected = self.state.done, self.state.settings.samples
            raise Stopped.again(
                stop,
                f"{min(done, expected)} of {expected} samples are kept in {path}, and the same command goes "
                "on after them",
            ) from stop

    def finish(self, on_step: OnStep) -> dict[str, Any]:
        """Evaluate the network, write weights, card and page, and return the card."""
        settings, names = self.state.settings, self.manifest.marker_names
        network = self.state.averaged()
        if isinstance(network, DeepLabelCNN):
            on_step("costs of the paper's labeler")
            choose_costs(network, names, self.held_out[self._evaluation_rows(_COST_FRAMES)])
        else:
            assert isinstance(network, SetLabeler)
            on_step("pose prior")
            rng = np.random.default_rng(settings.seed)
            network.prior = learn_pose_prior(right_hands(self.rows, _PRIOR_STRETCH, rng=rng), rng=rng)
        on_step("held-out frames")
        card, report = self._card(network, self._evaluation_rows(_CARD_FRAMES[settings.labeler]))
        on_step("weights and report")
        with written_together():
            save_network(self.out, network, card)
            write_run_page(self.out, card, self.state.history, report)
            write_model_card(self.out, card)
            stored_layout(card["dataset"]["layout"]).save(self.out / GLOVE)
        return card

    def _card(self, network: nn.Module, shown: Int[np.ndarray, "R"]) -> tuple[dict[str, Any], LabelingReport]:
        """The model card, and the evaluation on held-out frames with the paper's corruption."""
        settings, names = self.state.settings, self.manifest.marker_names
        labeler, paper = labeler_of(network, names), paper_corruption(len(names))
        rows, people = self.held_out[shown], self.people[shown] if len(self.people) else self.people
        corrupted = f"occlude {paper.occlude}, ghosts {paper.ghosts}"
        markers, rng = rows["markers"].astype(np.float64), np.random.default_rng
        reports = {
            SEEN: rig_report(labeler, rows, rng=rng(0)),
            corrupted: paper_report(labeler, rows),
            "clean": evaluate_markers(labeler, markers, CLEAN, rng=rng(0)),
        }
        if len(people):
            reports = {name: dataclasses.replace(one, groups=people) for name, one in reports.items()}
        card = {
            "marker_names": list(names),
            "trained_on": "simulated frames only",
            "handsim": full_version(),
            "license": UNKNOWN_LICENSE,
            "dataset": self.manifest.config,
            "train": settings.record() | {"devices": self.state.fabric.world_size},
            "held_out_simulated": {name: one.figures for name, one in reports.items()},
            "held_out_people": reports[SEEN].num_groups,
            "held_out_intervals": {name: one.intervals() for name, one in reports.items()},
            "curve": self.state.history.accuracies,
        }
        return card, reports[corrupted]


class TrainingState:
    """State of a run, which is updated in every step and stored in checkpoints."""

    def __init__(self, settings: TrainSettings, fabric: Fabric, rows: NDArray[np.void] | MappedRows) -> None:
        self.settings = settings
        self.fabric = fabric
        self.part = Part(fabric.global_rank, fabric.world_size)
        network = new_network(settings.chosen)
        prepare_network(network, rows)
        optimizer: torch.optim.Optimizer
        weights, rate, decay = network.parameters(), settings.learning_rate, settings.weight_decay
        if settings.optimizer == "sgd":
            optimizer = torch.optim.SGD(weights, lr=rate, weight_decay=decay)
        else:
            optimizer = torch.optim.AdamW(weights, lr=rate, weight_decay=decay, fused=True)
        self.network, self.optimizer = fabric.setup(network, optimizer)
        self.mean = {name: tensor.detach().clone() for name, tensor in self.network.state_dict().items()}
        self.done = 0
        self.history = History()
        self.began = time.monotonic(), 0

    def step(self, batch: Batch, *, rng: np.random.Generator) -> float:
        """Make one gradient step together with the other devices; return the loss before it.

        Each device learns from its part of the batch; `rng` is the same on all.
        """
        began = time.perf_counter()
        rate = self.settings.learning_rate * _scheduled_rate(self.settings, self.done / self.settings.samples)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        loss = batch_loss(self.settings, self.network, batch, self.fabric.device, rng=rng, part=self.part)
        self.optimizer.zero_grad()
        self.fabric.backward(loss)
        if self.settings.optimizer == "adamw":
            self.fabric.clip_gradients(self.network, self.optimizer, max_norm=1.0)
        self.optimizer.step()
        self.done += self.settings.batch
        self._average()
        value = float(self.fabric.all_reduce(loss.detach(), reduce_op="mean"))  # type: ignore[arg-type]
        if not np.isfinite(value):
            raise TrainingError(
                f"the loss is {value} after {self.done} samples; begin again with a learning rate below "
                f"{self.settings.learning_rate:g}"
            )
        self.history.add(value)
        self.history.minutes += (time.perf_counter() - began) / 60.0
        if _ends_interval(self.done, self.settings, _CURVE_POINTS):
            (since, done), self.began = self.began, (time.monotonic(), self.done)
            speed = (self.done - done) / (self.began[0] - since)
            mean = self.history.close(self.done, rate)
            figures = {"loss": mean, "learning_rate": rate, "samples_per_second": speed}
            self.fabric.log_dict(figures, step=self.done)
        return value

    def _average(self) -> None:
        """Update the running mean of the weights."""
        every = self.settings.batch * self.settings.average_every
        if self.done % every and self.done < self.settings.samples:
            return
        decay = min(self.settings.average, self.done / (self.done + 20.0 * every))
        with torch.no_grad():
            for name, tensor in self.network.state_dict().items():
                if tensor.is_floating_point():
                    self.mean[name].lerp_(tensor, 1.0 - decay)
                else:
                    self.mean[name].copy_(tensor)

    def evaluate(self, rows: NDArray[np.void], names: tuple[str, ...]) -> None:
        """Record the slot accuracy of the mean weights on a few held-out rows, which are always the same."""
        report = paper_report(labeler_of(self.averaged(), names), rows)
        accuracy = report.figures["slot_accuracy"]
        self.history.accuracies.append((self.done, self.history.minutes, accuracy))
        self.fabric.log_dict({"held_out_slot_accuracy": accuracy}, step=self.done)

    def averaged(self) -> nn.Module:
        """The network with the mean weights."""
        with torch.random.fork_rng(devices=[]):  # Initial weights are drawn, and then replaced.
            network = new_network(self.settings.chosen)
        network.load_state_dict({name: tensor.cpu() for name, tensor in self.mean.items()})
        return network.eval()

    def save(self, path: Path) -> None:
        """Write a checkpoint in the first process."""
        if not self.fabric.is_global_zero:
            return
        content = {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "mean": self.mean,
            "done": self.done,
            "history": dataclasses.asdict(self.history),
        }
        # Write through memory: torch stores the temporary name in a file that it opens itself, and it does
        # not report a full disk.
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
        stored = io.BytesIO(found)  # in memory, because torch reports some damage as an OSError
        try:
            with zipfile.ZipFile(stored) as archive:
                check_members(archive, len(found))
                if archive.testzip() is not None:
                    raise ValueError("a checksum is another one")
            stored.seek(0)
            content = torch.load(stored, weights_only=True, map_location=self.fabric.device)
            self._check(content)
            self.network.load_state_dict(content["network"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.mean, self.done = content["mean"], content["done"]
            self.history = History(**content.get("history", {}))  # Older checkpoints have none.
        except MemoryError:
            raise
        except Exception as error:  # A file can be damaged in more ways than torch has errors for.
            raise WeightsError(f"{path} is damaged; delete it to begin this run again") from error
        self.began = time.monotonic(), self.done

    def _check(self, content: dict[str, Any]) -> None:
        """Raise a ValueError unless a checkpoint's tensors are finite and fit this network."""
        _check_stored(content)
        done, mean, network = content["done"], content["mean"], content["network"]
        if type(done) is not int or done < 0 or done % self.settings.batch:
            raise ValueError(f"{done} samples cannot be done in this run")
        for name, tensor in self.mean.items():
            for stored in (mean[name], network[name]):
                if stored.shape != tensor.shape or stored.dtype != tensor.dtype:
                    raise ValueError(f"{name} has another shape")
                if not torch.isfinite(stored).all():
                    raise ValueError(f"{name} is not finite")


def _scheduled_rate(settings: TrainSettings, progress: float) -> float:
    """Learning rate at a share of the run, as a share of the peak rate."""
    if settings.schedule == "steps":
        return float(0.1 ** ((progress >= 50 / 75) + (progress >= 70 / 75)))
    return float(min(1.0, progress / 0.01 + 1e-3) * 0.5 * (1.0 + np.cos(np.pi * min(1.0, progress))))


def _check_stored(content: object, seen: set[int] | None = None) -> None:
    """Raise a ValueError if a tensor in nested tables has more entries than its storage."""
    seen = set() if seen is None else seen
    if id(content) in seen:
        return
    seen.add(id(content))
    if isinstance(content, torch.Tensor):
        if content.numel() * content.element_size() > content.untyped_storage().nbytes():
            raise ValueError("a tensor has more entries than its storage")
    elif isinstance(content, dict | list | tuple):
        for entry in content.values() if isinstance(content, dict) else content:
            _check_stored(entry, seen)


def _ends_interval(done: int, settings: TrainSettings, parts: int, least: int = 1) -> bool:
    """Whether the last step ended the run or one of `parts` equal intervals of at least `least` samples."""
    part = max(settings.batch, settings.samples // parts, least)
    return (done - settings.batch) // part != done // part or done >= settings.samples


def choose_costs(network: DeepLabelCNN, marker_names: tuple[str, ...], rows: NDArray[np.void]) -> CNNConfig:
    """Choose the reject with the best slot accuracy on held-out rows, and the best calibrated spread.

    A given reject or spread is kept.
    """
    labeler = _CachedLabeler(network, marker_names)

    def report(reject: float, spread: float) -> LabelingReport:
        labeler.reject, labeler.spread = reject, spread
        return paper_report(labeler, rows)

    def accuracy(tried: float) -> float:
        return report(tried, _TRIED_SPREADS[0]).figures["slot_accuracy"]

    config = network.config
    reject = config.reject or max(_TRIED_REJECTS, key=accuracy)
    spread = config.spread or min(
        _TRIED_SPREADS, key=lambda tried: report(reject, tried).figures["calibration_error"]
    )
    network.config = dataclasses.replace(config, reject=reject, spread=spread)
    return network.config


class _CachedLabeler:
    """Labeler that runs its network once, and then labels the same frames with other costs."""

    def __init__(self, network: DeepLabelCNN, marker_names: tuple[str, ...]) -> None:
        self.marker_names = marker_names
        self.reject = self.spread = 0.0
        self._labeler = cnn_labeler(network, marker_names)
        self._distances: list[NDArray[np.float64]] = []

    def label_frames(self, frames: Sequence[NDArray[np.float64]]) -> list[Labeling]:
        """Label the frames of the first call."""
        self._distances = self._distances or self._labeler.distances(list(frames))
        return [label_by_distance(distances, self.reject, self.spread) for distances in self._distances]
