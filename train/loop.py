"""The training loop, top to bottom: rows, corruption, network, resume, weights, and a page about the run."""

from __future__ import annotations

import dataclasses
import logging
import pickle
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from lightning_fabric import Fabric
from lightning_fabric.loggers.tensorboard import TensorBoardLogger
from torch import nn

from handsim._version import __version__
from handsim.errors import DatasetError, WeightsError
from handsim.io import atomic_write
from train.augmentation import Corruption
from train.batches import Batch, draw_batch, paper_corruption
from train.config import TrainConfig
from train.evaluation import Report, evaluate_labeler
from train.history import History
from train.kinds import batch_loss, labeler_of, new_network
from train.labeler import save_network
from train.labeling import Labeler
from train.run_page import write_run_page
from train.shards import Dataset, claim

if TYPE_CHECKING:
    from numpy.typing import NDArray

CHECKPOINT: Final = "checkpoint.pt"
_CONFIG: Final = "train.json"
_HELD_OUT: Final = 0.02  # share of rows, from the end, that training never sees
_MOST_HELD_OUT: Final = 8192
_CURVE: Final = 200  # points of the loss curve
_LOOKS: Final = 10  # at held-out frames in the course of a run
_MOST_LOOKED_AT: Final = 512

Progress = Callable[[int, int, float], None]
"""Called with samples done, samples wanted, and the loss."""


def train_labeler(
    dataset: Dataset,
    config: TrainConfig,
    out: Path,
    *,
    progress: Progress | None = None,
    save_every: float = 60.0,
) -> dict[str, Any]:
    """Train a labeler and leave weights, card, curves and a page in `out`; goes on from a checkpoint there.

    Raises:
        DatasetError: The set is too small to train on.
        WeightsError: `out` holds a run of other settings.
    """
    torch.set_flush_denormal(True)  # distance bumps underflow; denormals make a core many times slower
    names = dataset.marker_names
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, num_labels=len(names)))
    rows, held_out = _split(dataset, config.batch)
    fabric = _fabric(config, out)
    settings = {"train": dataclasses.asdict(config), "dataset": dataset.manifest.config}
    with fabric.rank_zero_first():
        claim(out / _CONFIG, settings, noun="training run", error=WeightsError)
    torch.manual_seed(config.seed)
    state = _State(config, fabric)
    state.restore(out / CHECKPOINT)
    saved = time.monotonic()
    while state.done < config.samples:
        # One generator a step, so that a resumed run draws what it would have.
        rng = np.random.default_rng((config.seed, state.done, fabric.global_rank))
        share = dataclasses.replace(config, batch=config.batch // fabric.world_size)
        loss = state.step(draw_batch(rows, share, rng=rng), rng=rng)
        if fabric.is_global_zero and _passed(state.done, config, _LOOKS):
            state.look(held_out[:: -(-len(held_out) // _MOST_LOOKED_AT)], names)
        if progress is not None and fabric.is_global_zero:
            progress(min(state.done, config.samples), config.samples, loss)
        if time.monotonic() - saved > save_every:
            state.save(out / CHECKPOINT)
            saved = time.monotonic()
    state.save(out / CHECKPOINT)
    network = state.averaged()
    card, report = _card(network, held_out, config, dataset)
    if fabric.is_global_zero:
        save_network(out, config.labeler, network, config.network, card)
        write_run_page(out, card, state.history, report)
    return card


def _split(dataset: Dataset, batch: int) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Rows to train on, and the held-out ones."""
    rows = dataset.rows()
    held_out = min(_MOST_HELD_OUT, max(1, int(_HELD_OUT * len(rows))))
    if len(rows) - held_out < batch:
        raise DatasetError(f"{dataset.path} has {len(rows)} frames, wanted at least {batch + held_out + 1}")
    return rows[:-held_out], rows[-held_out:]


def _passed(done: int, config: TrainConfig, parts: int) -> bool:
    """Whether the last step ended one of so many parts of the run, each at least a step long."""
    part = max(config.batch, config.samples // parts)
    return (done - config.batch) // part != done // part


def _fabric(config: TrainConfig, out: Path) -> Fabric:
    """Where the numbers are crunched: on GPUs where there are any, and what the curves are written with."""
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # its greetings are not about this run
    warnings.filterwarnings("ignore", module="lightning_fabric")
    fabric = Fabric(
        accelerator="cuda" if torch.cuda.is_available() else "cpu",
        devices=config.devices,
        precision="bf16-mixed" if config.precision == "bf16" else "32-true",
        loggers=TensorBoardLogger(out, name="tensorboard", version=""),
    )
    fabric.launch()
    return fabric


class _State:
    """What a run carries from step to step, and a checkpoint from run to run."""

    def __init__(self, config: TrainConfig, fabric: Fabric) -> None:
        self.config = config
        self.fabric = fabric
        network = new_network(config.labeler, config.network)
        self.network, self.optimizer = fabric.setup(network, _optimizer(config, network))
        self.mean = {name: tensor.detach().clone() for name, tensor in self.network.state_dict().items()}
        self.done = 0
        self.history = History()
        self.began = time.monotonic(), 0

    def step(self, batch: Batch, *, rng: np.random.Generator) -> float:
        """One gradient step; the loss before it."""
        rate = self.config.learning_rate * _rate(self.config, self.done / self.config.samples)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        loss = batch_loss(self.config.labeler, self.network, batch, self.fabric.device, rng=rng)
        self.optimizer.zero_grad()
        self.fabric.backward(loss)
        if self.config.optimizer == "adamw":
            self.fabric.clip_gradients(self.network, self.optimizer, max_norm=1.0)
        self.optimizer.step()
        self.done += self.config.batch
        self._average()
        value = float(loss.detach())
        self.history.add(value)
        if _passed(self.done, self.config, _CURVE) or self.done >= self.config.samples:
            self._log(rate)
        return value

    def _average(self) -> None:
        decay = min(self.config.average, self.done / (self.done + 20.0 * self.config.batch))
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

    def look(self, rows: NDArray[np.void], names: tuple[str, ...]) -> None:
        """Note how the mean weights do on a few held-out rows, the same each time."""
        report = _paper_report(labeler_of(self.averaged(), names), rows)
        accuracy = report.figures["slot_accuracy"]
        self.history.accuracies.append((self.done, accuracy))
        self.fabric.log_dict({"held_out_slot_accuracy": accuracy}, step=self.done)

    def averaged(self) -> nn.Module:
        """The network with the mean weights."""
        with torch.random.fork_rng(devices=[]):  # its first weights are drawn for nothing
            network = new_network(self.config.labeler, self.config.network)
        network.load_state_dict({name: tensor.cpu() for name, tensor in self.mean.items()})
        return network.eval()

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        content = {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "mean": self.mean,
            "done": self.done,
            "history": dataclasses.asdict(self.history),
        }
        if self.fabric.is_global_zero:
            with atomic_write(path) as temporary:
                torch.save(content, temporary)

    def restore(self, path: Path) -> None:
        """Go on from a checkpoint, if there is one."""
        if not path.is_file():
            return
        try:
            content = torch.load(path, weights_only=True, map_location=self.fabric.device)
            self.network.load_state_dict(content["network"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.mean, self.done = content["mean"], content["done"]
            self.history = History(**content.get("history", {}))  # older checkpoints have none
        except (RuntimeError, KeyError, TypeError, EOFError, ValueError, pickle.UnpicklingError) as error:
            raise WeightsError(f"{path} is damaged; delete it to begin this run again") from error
        self.began = time.monotonic(), self.done


def _optimizer(config: TrainConfig, network: nn.Module) -> torch.optim.Optimizer:
    if config.optimizer == "sgd":
        return torch.optim.SGD(
            network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
    return torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)


def _rate(config: TrainConfig, progress: float) -> float:
    """Share of the peak learning rate at a share of the run."""
    if config.schedule == "steps":
        return float(0.1 ** ((progress >= 50 / 75) + (progress >= 70 / 75)))
    return float(min(1.0, progress / 0.01 + 1e-3) * 0.5 * (1.0 + np.cos(np.pi * min(1.0, progress))))


def _card(
    network: nn.Module, rows: NDArray[np.void], config: TrainConfig, dataset: Dataset
) -> tuple[dict[str, Any], Report]:
    """Model card: where the weights come from and what they reach on held-out simulated frames.

    Returns:
        The card, and all that was found with the paper's corruption.
    """
    labeler = labeler_of(network, dataset.marker_names)
    markers = rows["markers"].astype(np.float64)
    clean = evaluate_labeler(labeler, markers, Corruption(0, 0), rng=np.random.default_rng(0))
    paper, report = paper_corruption(markers.shape[1]), _paper_report(labeler, rows)
    card = {
        "marker_names": list(dataset.marker_names),
        "trained_on": "simulated frames only",
        "handsim": __version__,
        "dataset": dataset.manifest.config,
        "train": dataclasses.asdict(config),
        "held_out_simulated": {
            "clean": clean.figures,
            f"occlude {paper.occlude}, ghosts {paper.ghosts}": report.figures,
        },
    }
    return card, report


def _paper_report(labeler: Labeler, rows: NDArray[np.void]) -> Report:
    """What a labeler reaches on these rows with the paper's corruption, the same each time."""
    markers = rows["markers"].astype(np.float64)
    corruption = paper_corruption(markers.shape[1])
    return evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(0))
