"""How many processes train together and which one this is, as the environment says; without torch."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

from handsim.errors import ArgumentError

RENDEZVOUS: Final = "HANDSIM_RENDEZVOUS"
"""Names the file through which processes of one machine find each other, where handsim started them."""
Starter = Literal["handsim", "torchrun", "srun"]
_TORCHRUN: Final = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")
_SRUN: Final = ("SLURM_PROCID", "SLURM_LOCALID", "SLURM_STEP_NUM_TASKS")
_SRUN_NODES: Final = "SLURM_STEP_NUM_NODES"


@dataclass(frozen=True, slots=True)
class World:
    """The processes that train together, one a device, and this one among them."""

    rank: int = 0
    """Number of this process."""
    local_rank: int = 0
    """Its number on this machine."""
    size: int = 1
    """Number of processes."""
    local_size: int = 1
    """Of these on each machine."""
    starter: Starter | None = None
    """What started several of them."""

    @property
    def nodes(self) -> int:
        """Number of machines."""
        return self.size // self.local_size

    def variables(self) -> dict[str, str]:
        """What torchrun tells such a process."""
        values = (self.rank, self.local_rank, self.size, self.local_size)
        return dict(zip(_TORCHRUN, map(str, values), strict=True))


def world_of(environ: Mapping[str, str] | None = None) -> World:
    """The processes that an environment (this one's by default) speaks of: torchrun's or a job step's.

    A batch script that Slurm runs without srun is one process, however many tasks the job may have.
    """
    environ = os.environ if environ is None else environ
    if all(name in environ for name in _TORCHRUN):
        rank, local_rank, size, local_size = (_count(environ, name) for name in _TORCHRUN)
        starter: Starter = "handsim" if RENDEZVOUS in environ else "torchrun"
    elif all(name in environ for name in _SRUN):
        rank, local_rank, size = (_count(environ, name) for name in _SRUN)
        nodes = _count(environ, _SRUN_NODES) if _SRUN_NODES in environ else 1
        if nodes < 1 or size % nodes:
            raise ArgumentError(
                f"srun started {size} tasks on {nodes} nodes, expected as many on each (--ntasks-per-node)"
            )
        local_size, starter = size // nodes, "srun"
    else:
        return World()
    if not (0 <= rank < size and 0 <= local_rank < local_size <= size) or size % local_size:
        raise ArgumentError(
            f"the environment speaks of process {rank} of {size}, {local_rank} of {local_size} on this "
            "machine, expected numbers from 0 and as many processes on each machine"
        )
    return World(rank, local_rank, size, local_size, starter if size > 1 else None)


def _count(environ: Mapping[str, str], name: str) -> int:
    try:
        return int(environ[name])
    except ValueError as error:
        raise ArgumentError(
            f"{name} is '{environ[name]}' in the environment, expected a whole number"
        ) from error
