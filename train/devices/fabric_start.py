"""The devices of this process, joined with those of the other processes of a run."""

from __future__ import annotations

import atexit
import logging
import os
import sys
import warnings
from pathlib import Path
from typing import Final

import torch
from lightning_fabric import Fabric
from lightning_fabric.loggers.tensorboard import TensorBoardLogger
from lightning_fabric.plugins.environments.cluster_environment import ClusterEnvironment
from lightning_fabric.plugins.environments.lightning import LightningEnvironment
from lightning_fabric.plugins.environments.slurm import SLURMEnvironment
from lightning_fabric.plugins.environments.torchelastic import TorchElasticEnvironment

from handsim.errors import ArgumentError
from train.devices.world import RENDEZVOUS, World, world_of
from train.settings import TrainSettings

_LOOPBACK: Final = {"linux": "lo", "darwin": "lo0"}
_SRUN_TASKS: Final = "SLURM_NTASKS_PER_NODE"


def start_fabric(config: TrainSettings, out: Path) -> Fabric:
    """The device of this process, a GPU where there is one, and the writer of the curves.

    Waits for the other processes of the run, if there are any.
    """
    world = world_of()
    check_devices(config, world.size, world.local_size)
    if world.size > 1 and config.devices not in (1, world.local_size):
        raise ArgumentError(
            f"devices is {config.devices}, but {world.starter} started {world.local_size} processes on this "
            "machine; leave --devices out"
        )
    torch.set_flush_denormal(True)  # distance bumps underflow; denormals make a core many times slower
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # its messages are not about this run
    warnings.filterwarnings("ignore", module="lightning_fabric")
    fabric = Fabric(
        accelerator=_accelerator(),
        devices=world.local_size,
        num_nodes=world.nodes,
        strategy="ddp" if world.size > 1 else "auto",
        plugins=[_environment(world)],
        precision="bf16-mixed" if _takes_bf16(config.precision) else "32-true",
        loggers=TensorBoardLogger(out, name="tensorboard", version=""),
    )
    _meet_on_this_machine(world)
    fabric.launch()
    if world.size > 1:
        atexit.register(_leave)
    return fabric


def _leave() -> None:
    """End gloo's threads while there is an interpreter: one that drops a tensor later aborts the process."""
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def check_devices(config: TrainSettings, size: int, local_size: int) -> None:
    """Refuse more processes than there are clouds in a batch, or than there are GPUs.

    Args:
        local_size: Of these on this machine.
    """
    if config.batch < size:
        raise ArgumentError(f"batch is {config.batch}, expected at least {size}: a cloud for each device")
    if torch.cuda.is_available() and torch.cuda.device_count() < local_size:
        raise ArgumentError(
            f"devices is {local_size}, expected 1 to {torch.cuda.device_count()}, the GPUs of this machine"
        )


def _accelerator() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"


def _environment(world: World) -> ClusterEnvironment:
    """Fabric's view of the processes; it would take a batch script without srun for one of many."""
    if world.starter == "srun":
        os.environ.setdefault(_SRUN_TASKS, str(world.local_size))  # srun -n alone does not set it
        return SLURMEnvironment(auto_requeue=False)
    return LightningEnvironment() if world.starter is None else TorchElasticEnvironment()


def _meet_on_this_machine(world: World) -> None:
    """Keep the connections of processes on one machine off the network.

    Processes that handsim started meet through a file: torch's store, which the others use, listens on all
    interfaces.
    """
    if world.size == 1 or world.nodes > 1:
        return
    if sys.platform in _LOOPBACK:
        os.environ.setdefault("GLOO_SOCKET_IFNAME", _LOOPBACK[sys.platform])
    if world.starter == "handsim" and not torch.distributed.is_initialized():
        cuda = _accelerator() == "cuda"
        torch.distributed.init_process_group(
            "nccl" if cuda else "gloo",
            init_method=Path(os.environ[RENDEZVOUS]).as_uri(),
            rank=world.rank,
            world_size=world.size,
            device_id=torch.device("cuda", world.local_rank) if cuda else None,
        )


def _takes_bf16(precision: str) -> bool:
    """Whether the forward pass runs in bf16; without instructions for it a CPU is many times slower."""
    if precision != "auto":
        return precision == "bf16"
    if torch.cuda.is_available():
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return bool(torch.cpu.get_capabilities().get("amx_bf16", False))
