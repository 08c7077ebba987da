"""Starts Fabric for a training run in one process, or in several that torchrun or srun started."""

from __future__ import annotations

import atexit
import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import torch
from lightning_fabric import Fabric
from lightning_fabric.loggers.tensorboard import TensorBoardLogger
from lightning_fabric.plugins.environments.cluster_environment import ClusterEnvironment
from lightning_fabric.plugins.environments.lightning import LightningEnvironment
from lightning_fabric.plugins.environments.slurm import SLURMEnvironment
from lightning_fabric.plugins.environments.torchelastic import TorchElasticEnvironment

from handsim.errors import ArgumentError, HandSimError
from train.settings import TrainSettings

_LOOPBACK: Final = {"linux": "lo", "darwin": "lo0"}


def start_fabric(settings: TrainSettings, out: Path) -> Fabric:
    """Start Fabric with this process's device, a GPU if there is one, and the writer of training curves.

    Waits for the other processes of the run.
    """
    environment, here, nodes = _processes()
    if settings.batch < here * nodes:
        raise ArgumentError(
            f"batch is {settings.batch}, expected at least {here * nodes}: a cloud for each device"
        )
    has_gpu = torch.cuda.is_available()
    if has_gpu and torch.cuda.device_count() < here:
        raise ArgumentError(
            f"{here} processes were started on this machine, expected 1 to {torch.cuda.device_count()}: one "
            "for each GPU"
        )
    torch.set_flush_denormal(True)  # Features underflow, and denormal numbers slow a core down.
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # Its messages do not concern users.
    warnings.filterwarnings("ignore", module="lightning_fabric")
    if here > 1 and nodes == 1 and sys.platform in _LOOPBACK:
        # Connections within one machine stay off the network.
        os.environ.setdefault("GLOO_SOCKET_IFNAME", _LOOPBACK[sys.platform])
    fabric = Fabric(
        accelerator="cuda" if has_gpu else "cpu",
        devices=here,
        num_nodes=nodes,
        strategy="ddp" if here * nodes > 1 else "auto",
        plugins=[environment],
        precision="bf16-mixed" if _takes_bf16(settings.precision) else "32-true",
        loggers=TensorBoardLogger(out, name="tensorboard", version=""),
    )
    fabric.launch()
    atexit.register(_end_process_group)
    return fabric


def _processes() -> tuple[ClusterEnvironment, int, int]:
    """The environment of this process, the number of processes per machine, and of machines.

    A batch script run by Slurm without srun is one process, whatever the job's number of tasks.
    """
    if TorchElasticEnvironment.detect():
        here = int(os.environ["LOCAL_WORLD_SIZE"])
        return TorchElasticEnvironment(), here, int(os.environ["WORLD_SIZE"]) // here
    tasks = int(os.environ.get("SLURM_STEP_NUM_TASKS", "1"))
    if tasks == 1:
        return LightningEnvironment(), 1, 1
    nodes = int(os.environ.get("SLURM_STEP_NUM_NODES", "1"))
    if tasks % nodes:
        raise ArgumentError(
            f"srun started {tasks} tasks on {nodes} nodes, expected as many on each (--ntasks-per-node)"
        )
    os.environ.setdefault("SLURM_NTASKS_PER_NODE", str(tasks // nodes))  # srun -n alone does not set this
    return SLURMEnvironment(auto_requeue=False), tasks // nodes, nodes


def _end_process_group() -> None:
    """End gloo's threads before the interpreter ends: a thread that frees a tensor later would abort it."""
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


@contextmanager
def lost_peers_reported() -> Iterator[None]:
    """Turn a broken connection within the block into a `HandSimError`."""
    try:
        yield
    except RuntimeError as error:
        # gloo has no error class for a lost process.
        if not (isinstance(error, torch.distributed.DistError) or "gloo" in str(error)):
            raise
        raise HandSimError("another process of this run ended, and reports why") from error


def _takes_bf16(precision: str) -> bool:
    """Whether the forward pass runs in bf16, which is slow on CPUs without bf16 instructions."""
    if precision != "auto":
        return precision == "bf16"
    if torch.cuda.is_available():
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return bool(torch.cpu.get_capabilities().get("amx_bf16", False))
