"""The training loop: rows, corruption, network, checkpoints, weights, and a page about the run."""

from __future__ import annotations

import dataclasses
import logging
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from lightning_fabric import Fabric
from lightning_fabric.loggers.tensorboard import TensorBoardLogger
from torch import nn

from handsim._version import __version__
from handsim.app.interrupts import Stopped, interrupt_flag
from handsim.errors import DatasetError, WeightsError
from handsim.files.json_files import claim
from train.config import Kind, TrainConfig
from train.data.augmentation import Corruption
from train.data.batches import Batch, draw_batch, paper_corruption, right_hands
from train.data.own_corruption import check_corruption
from train.data.shards import Dataset
from train.evaluation.labeler_evaluation import Report, evaluate_labeler, paper_report
from train.evaluation.matching_costs import choose_costs
from train.labelers.cnn_network import DeepLabelCNN
from train.labelers.kinds import labeler_of
from train.labelers.set_network import SetLabeler
from train.labelers.storage import save_network
from train.matching.prior_learning import learn_pose_prior
from train.reports.model_card import UNKNOWN_LICENSE, write_model_card
from train.reports.run_page import write_run_page
from train.threads import TrainingThreads, check_threads
from train.training_state import TrainingState, passed

if TYPE_CHECKING:
    from numpy.typing import NDArray

CHECKPOINT: Final = "checkpoint.pt"
_CONFIG: Final = "train.json"
_HELD_OUT: Final = 0.02  # share of rows, from the end, that training never sees
_MAX_HELD_OUT: Final = 8192
_NUM_EVALUATIONS: Final = 10  # on held-out frames in the course of a run
_CURVE_FRAMES: Final[dict[Kind, int]] = {"set": 512, "cnn": 160}  # of each of these evaluations
_CARD_FRAMES: Final[dict[Kind, int]] = {"set": _MAX_HELD_OUT, "cnn": 1024}  # of the last one
_PRIOR_STRETCH: Final = 0.03  # anisotropy of the hands of the pose prior: people differ more than simulated
_COST_FRAMES: Final = 400  # for the costs of the paper's network

Progress = Callable[[int, int, float], None]
"""Called with samples done, samples expected, and the loss."""


def train_labeler(
    dataset: Dataset,
    config: TrainConfig,
    out: Path,
    *,
    threads: int | None = None,
    progress: Progress | None = None,
    save_every: float = 60.0,
) -> dict[str, Any]:
    """Train a labeler and write weights, card, curves and a page to `out`; continues from a checkpoint there.

    A run there may have had fewer samples. The learning rate then goes on as in a run of the new length.

    Args:
        dataset: The training set.
        config: How to train.
        out: Folder of the run.
        threads: Threads on a CPU; one or all when not given, whichever a few steps show to be faster. Weights
            differ in their last bits with it.
        progress: Called after every step.
        save_every: Time between checkpoints [s].

    Returns:
        The model card.

    Raises:
        DatasetError: The set is too small to train on.
        WeightsError: `out` holds a run of other settings.
        TrainingError: The loss is not finite.
        Stopped: A signal came; the last step is kept in the checkpoint.
    """
    config = _for_labels(config, len(dataset.marker_names))
    check_threads(threads)
    rows, held_out = _split(dataset, config.batch)
    fabric = start_fabric(config, out)
    settings: dict[str, Any] = {"train": dataclasses.asdict(config), "dataset": dataset.manifest.config}
    if config.corruption is None:
        del settings["train"]["corruption"]
    else:
        check_corruption(config.corruption, len(dataset.marker_names))
    with fabric.rank_zero_first():
        claim(out / _CONFIG, settings, noun="training run", error=WeightsError, grows="train.samples")
    torch.manual_seed(config.seed)
    run = _Run(TrainingState(config, fabric, rows), rows, held_out, dataset.marker_names)
    run.state.restore(out / CHECKPOINT)
    if fabric.device.type != "cpu":
        threads = threads or torch.get_num_threads()
    chosen = TrainingThreads(threads, run.try_step)
    with chosen.in_use(), run.kept(out / CHECKPOINT):
        saved = time.monotonic()
        while run.is_unfinished():
            chosen.renew()
            loss = run.step()
            if progress is not None and fabric.is_global_zero:
                progress(min(run.state.done, config.samples), config.samples, loss)
            if time.monotonic() - saved > save_every:
                run.state.save(out / CHECKPOINT)
                saved = time.monotonic()
        run.state.save(out / CHECKPOINT)
        return _finish(run, dataset, out)


def _for_labels(config: TrainConfig, num_labels: int) -> TrainConfig:
    """The same settings for a layout of this many markers."""
    return dataclasses.replace(
        config,
        network=dataclasses.replace(config.network, num_labels=num_labels),
        cnn=dataclasses.replace(config.cnn, num_labels=num_labels),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """The state of a run and what it learns from."""

    state: TrainingState
    rows: NDArray[np.void]
    held_out: NDArray[np.void]
    names: tuple[str, ...]

    def is_unfinished(self) -> bool:
        """Whether there are steps to do; an evaluation that is due is done first."""
        state, config = self.state, self.state.config
        evaluated = state.history.accuracies[-1][0] if state.history.accuracies else 0
        due = state.done > evaluated and passed(state.done, config, _NUM_EVALUATIONS)
        if due and state.fabric.is_global_zero:
            state.evaluate(_few(self.held_out, _CURVE_FRAMES[config.labeler]), self.names)
        return state.done < config.samples

    def step(self) -> float:
        """Make a step, whole or not at all, and return its loss."""
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
        state, config, fabric = self.state, self.state.config, self.state.fabric
        # One generator per step, so that a resumed run makes the same draws.
        rng = np.random.default_rng((config.seed, state.done, fabric.global_rank))
        share = dataclasses.replace(config, batch=config.batch // fabric.world_size)
        return draw_batch(self.rows, share, rng=rng), rng

    @contextmanager
    def kept(self, checkpoint: Path) -> Iterator[None]:
        """Write a checkpoint when a signal ends the block, and say so."""
        try:
            yield
        except KeyboardInterrupt as stop:
            self.state.save(checkpoint)
            done, expected = self.state.done, self.state.config.samples
            raise Stopped.again(
                stop,
                f"{min(done, expected)} of {expected} samples are kept in {checkpoint}, and the same command "
                "goes on after them",
            ) from stop


def _finish(run: _Run, dataset: Dataset, out: Path) -> dict[str, Any]:
    """Evaluate the network, write weights, card and page, and return the card."""
    config, held_out = run.state.config, run.held_out
    network = run.state.averaged()
    if isinstance(network, DeepLabelCNN):
        choose_costs(network, run.names, _few(held_out, _COST_FRAMES))
    else:
        assert isinstance(network, SetLabeler)
        rng = np.random.default_rng(config.seed)
        network.prior = learn_pose_prior(right_hands(run.rows, _PRIOR_STRETCH, rng=rng), rng=rng)
    card, report = _card(network, _few(held_out, _CARD_FRAMES[config.labeler]), config, dataset)
    if run.state.fabric.is_global_zero:
        card["curve"] = run.state.history.accuracies
        save_network(out, network, card)
        write_run_page(out, card, run.state.history, report)
        write_model_card(out, card)
    return card


def _split(dataset: Dataset, batch: int) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Rows to train on, and the held-out ones."""
    rows = dataset.rows()
    held_out = min(_MAX_HELD_OUT, max(1, int(_HELD_OUT * len(rows))))
    if len(rows) - held_out < batch:
        raise DatasetError(f"{dataset.path} has {len(rows)} frames, expected at least {batch + held_out + 1}")
    return rows[:-held_out], rows[-held_out:]


def _few(rows: NDArray[np.void], count: int) -> NDArray[np.void]:
    """Every nth of these rows, at most `count`."""
    return rows[:: -(-len(rows) // count)]


def start_fabric(config: TrainConfig, out: Path) -> Fabric:
    """The devices to train on, GPUs where there are any, and the writer of the curves."""
    torch.set_flush_denormal(True)  # distance bumps underflow; denormals make a core many times slower
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # its messages are not about this run
    warnings.filterwarnings("ignore", module="lightning_fabric")
    fabric = Fabric(
        accelerator="cuda" if torch.cuda.is_available() else "cpu",
        devices=config.devices,
        precision="bf16-mixed" if _takes_bf16(config.precision) else "32-true",
        loggers=TensorBoardLogger(out, name="tensorboard", version=""),
    )
    fabric.launch()
    return fabric


def _takes_bf16(precision: str) -> bool:
    """Whether the forward pass runs in bf16; without instructions for it a CPU is many times slower."""
    if precision != "auto":
        return precision == "bf16"
    if torch.cuda.is_available():
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return bool(torch.cpu.get_capabilities().get("amx_bf16", False))


def _card(
    network: nn.Module, rows: NDArray[np.void], config: TrainConfig, dataset: Dataset
) -> tuple[dict[str, Any], Report]:
    """Model card: where the weights come from, and their figures on held-out simulated frames.

    Returns:
        The card, and the evaluation with the paper's corruption.
    """
    labeler = labeler_of(network, dataset.marker_names)
    markers = rows["markers"].astype(np.float64)
    clean = evaluate_labeler(labeler, markers, Corruption(0, 0), rng=np.random.default_rng(0))
    paper, report = paper_corruption(markers.shape[1]), paper_report(labeler, rows)
    card = {
        "marker_names": list(dataset.marker_names),
        "trained_on": "simulated frames only",
        "handsim": __version__,
        "license": UNKNOWN_LICENSE,
        "dataset": dataset.manifest.config,
        "train": dataclasses.asdict(config),
        "held_out_simulated": {
            "clean": clean.figures,
            f"occlude {paper.occlude}, ghosts {paper.ghosts}": report.figures,
        },
    }
    return card, report
