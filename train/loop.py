"""The training loop, top to bottom: rows, corruption, network, two cores, resume."""

from __future__ import annotations

import dataclasses
import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch

from handsim._version import __version__
from handsim.errors import DatasetError, WeightsError
from handsim.io import atomic_write
from train.augmentation import Cloud, Corruption, corrupt
from train.config import TrainConfig
from train.evaluation import evaluate_labeler
from train.labeler import TrainedSetLabeler, save_labeler
from train.set_labeler import SetLabeler, labeling_loss
from train.shards import Dataset, claim

if TYPE_CHECKING:
    from numpy.typing import NDArray

CHECKPOINT: Final = "checkpoint.pt"
_CONFIG: Final = "train.json"
_HELD_OUT: Final = 0.02  # share of rows, from the end, that training never sees
PAPER: Final = Corruption()


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
    """Train the set labeler and leave weights and model card in `out`; goes on from a checkpoint there.

    Raises:
        DatasetError: The set is too small to train on.
        WeightsError: `out` holds a run of other settings.
    """
    torch.set_flush_denormal(True)  # distance bumps underflow; denormals make a core many times slower
    names = dataset.marker_names
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, num_labels=len(names)))
    settings = {"train": dataclasses.asdict(config), "dataset": dataset.manifest.config}
    claim(out / _CONFIG, settings, noun="training run", error=WeightsError)
    rows = dataset.rows()
    held_out = max(1, int(_HELD_OUT * len(rows)))
    if len(rows) - held_out < config.batch:
        raise DatasetError(
            f"{dataset.path} has {len(rows)} frames, wanted at least {config.batch + held_out + 1}"
        )
    torch.manual_seed(config.seed)
    state = _State(config)
    state.restore(out / CHECKPOINT)
    saved = time.monotonic()
    while state.done < config.samples:
        # One generator a step, so that a resumed run draws what it would have.
        rng = np.random.default_rng((config.seed, state.done))
        cloud = draw_batch(rows[:-held_out], config, rng=rng)
        loss = state.step(cloud)
        if progress is not None:
            progress(min(state.done, config.samples), config.samples, loss)
        if time.monotonic() - saved > save_every:
            state.save(out / CHECKPOINT)
            saved = time.monotonic()
    state.save(out / CHECKPOINT)
    network = state.averaged()
    card = _card(network, rows[-held_out:], config, dataset)
    save_labeler(out, network, card)
    return card


class _State:
    """What a run carries from step to step, and a checkpoint from run to run."""

    def __init__(self, config: TrainConfig) -> None:
        self.config = config
        self.network = SetLabeler(config.network)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        self.mean = {name: tensor.detach().clone() for name, tensor in self.network.state_dict().items()}
        self.done = 0

    def step(self, cloud: Cloud) -> float:
        """One gradient step; the loss before it."""
        progress = self.done / self.config.samples
        rate = min(1.0, progress / 0.01 + 1e-3) * 0.5 * (1.0 + np.cos(np.pi * min(1.0, progress)))
        for group in self.optimizer.param_groups:
            group["lr"] = float(self.config.learning_rate * rate)
        points = torch.from_numpy(cloud.points.astype(np.float32))
        present, truth = torch.from_numpy(cloud.present), torch.from_numpy(cloud.truth)
        loss = labeling_loss(self.network(points, present), truth, present)
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        self.done += len(cloud.points)
        decay = min(self.config.average, self.done / (self.done + 20.0 * self.config.batch))
        with torch.no_grad():
            for name, tensor in self.network.state_dict().items():
                self.mean[name].lerp_(tensor, 1.0 - decay)
        return float(loss.detach())

    def averaged(self) -> SetLabeler:
        """The network with the mean weights."""
        network = SetLabeler(self.config.network)
        network.load_state_dict(self.mean)
        return network

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        content = {
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "mean": self.mean,
            "done": self.done,
        }
        with atomic_write(path) as temporary:
            torch.save(content, temporary)

    def restore(self, path: Path) -> None:
        """Go on from a checkpoint, if there is one."""
        if not path.is_file():
            return
        try:
            content = torch.load(path, weights_only=True)
            self.network.load_state_dict(content["network"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.mean, self.done = content["mean"], content["done"]
        except (RuntimeError, KeyError, EOFError, ValueError, pickle.UnpicklingError) as error:
            raise WeightsError(f"{path} is damaged; delete it to begin this run again") from error


def draw_batch(rows: NDArray[np.void], config: TrainConfig, *, rng: np.random.Generator) -> Cloud:
    """Random rows as corrupted clouds, centred."""
    chosen = rows[rng.integers(len(rows), size=config.batch)]
    markers = chosen["markers"].astype(np.float64)
    centre = markers.mean(axis=1, keepdims=True)
    stretch = _stretches(len(markers), config.anisotropy, rng)
    markers = (markers - centre) @ stretch
    jitter = config.jitter * rng.uniform()
    if rng.random() < config.rig_share:
        observed = (chosen["observed"].astype(np.float64) - centre) @ stretch
        ghosts = (chosen["ghosts"].astype(np.float64) - centre) @ stretch
        return corrupt(observed, Corruption(occlude=0, ghosts=0, jitter=jitter), ghosts=ghosts, rng=rng)
    return corrupt(markers, dataclasses.replace(PAPER, jitter=jitter), rng=rng)


def _stretches(count: int, anisotropy: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Symmetric matrices (B, 3, 3) that stretch along random orthogonal directions."""
    axes, _ = np.linalg.qr(rng.standard_normal((count, 3, 3)))
    factors = np.exp(anisotropy * rng.standard_normal((count, 1, 3)))
    stretches: NDArray[np.float64] = (axes * factors) @ axes.transpose(0, 2, 1)
    return stretches


def _card(
    network: SetLabeler, rows: NDArray[np.void], config: TrainConfig, dataset: Dataset
) -> dict[str, Any]:
    """Model card: where the weights come from and what they reach on held-out simulated frames."""
    markers = rows["markers"].astype(np.float64)
    labeler = TrainedSetLabeler(network, dataset.marker_names)
    figures = {
        name: evaluate_labeler(labeler, markers, corruption, rng=np.random.default_rng(0)).figures
        for name, corruption in (("clean", Corruption(0, 0)), ("occlude 5, ghosts 2", PAPER))
    }
    return {
        "marker_names": list(dataset.marker_names),
        "trained_on": "simulated frames only",
        "handsim": __version__,
        "dataset": dataset.manifest.config,
        "train": dataclasses.asdict(config),
        "held_out_simulated": figures,
    }
