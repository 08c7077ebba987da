"""The state of a training run: network, optimizer, mean weights, history; one step; checkpoints."""

from __future__ import annotations

import dataclasses
import io
import time
import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from lightning_fabric import Fabric
from numpy.typing import NDArray
from torch import nn

from handsim.errors import HandSimError, WeightsError
from handsim.files.arrays import check_members
from handsim.files.outputs import atomic_write
from train.config import TrainConfig
from train.data.batches import Batch, Part
from train.data.shards import MappedRows
from train.history import History
from train.labeler_evaluation import paper_report
from train.labelers.kinds import batch_loss, labeler_of, new_network, prepare_network

_CURVE: Final = 200  # points of the loss curve


class TrainingError(HandSimError):
    """A training run that does not converge."""


class TrainingState:
    """The state that a run carries from step to step and a checkpoint keeps."""

    def __init__(self, config: TrainConfig, fabric: Fabric, rows: NDArray[np.void] | MappedRows) -> None:
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


def _optimizer(config: TrainConfig, network: nn.Module) -> torch.optim.Optimizer:
    if config.optimizer == "sgd":
        return torch.optim.SGD(
            network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
    return torch.optim.AdamW(
        network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, fused=True
    )


def _rate(config: TrainConfig, progress: float) -> float:
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


def passed(done: int, config: TrainConfig, parts: int) -> bool:
    """Whether the last step ended one of this many parts of the run, each at least one step long."""
    part = max(config.batch, config.samples // parts)
    return (done - config.batch) // part != done // part
