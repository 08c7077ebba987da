"""Which process this is: torchrun's variables, a Slurm job step's, or one process alone."""

from __future__ import annotations

import pytest

from handsim.errors import ArgumentError
from train.devices.world import RENDEZVOUS, World, world_of

TORCHRUN = {"RANK": "5", "LOCAL_RANK": "1", "WORLD_SIZE": "8", "LOCAL_WORLD_SIZE": "4"}
BATCH_SCRIPT = {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "4", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}
STEP = {**BATCH_SCRIPT, "SLURM_PROCID": "3", "SLURM_LOCALID": "1", "SLURM_STEP_NUM_TASKS": "4"}


@pytest.mark.parametrize(
    ("environ", "world"),
    [
        ({}, World()),
        ({"WORLD_SIZE": "8", "RANK": "1"}, World()),  # some clusters say no more than this
        (TORCHRUN, World(5, 1, 8, 4, "torchrun")),
        ({**TORCHRUN, RENDEZVOUS: "file"}, World(5, 1, 8, 4, "handsim")),
        (dict.fromkeys(TORCHRUN, "0") | {"WORLD_SIZE": "1", "LOCAL_WORLD_SIZE": "1"}, World()),
        (BATCH_SCRIPT, World()),  # without srun there is one process
        ({**STEP, "SLURM_STEP_NUM_NODES": "2"}, World(3, 1, 4, 2, "srun")),
        ({**STEP, "SLURM_LOCALID": "3"}, World(3, 3, 4, 4, "srun")),
        ({**STEP, **TORCHRUN}, World(5, 1, 8, 4, "torchrun")),  # torchrun within a job
    ],
)
def test_the_environment_says_which_process_this_is(environ, world):
    assert world_of(environ) == world
    assert world.nodes * world.local_size == world.size


def test_what_a_process_is_told_it_reads_back():
    world = World(2, 0, 4, 2, "torchrun")
    assert world_of(world.variables()) == world


@pytest.mark.parametrize(
    ("environ", "told"),
    [
        ({**TORCHRUN, "RANK": "first"}, "RANK is 'first' in the environment, expected a whole number"),
        ({**TORCHRUN, "RANK": "8"}, "process 8 of 8, 1 of 4 on this machine, expected numbers from 0"),
        ({**TORCHRUN, "LOCAL_WORLD_SIZE": "3"}, "1 of 3 on this machine, .* as many processes on each"),
        ({**TORCHRUN, "LOCAL_WORLD_SIZE": "0", "LOCAL_RANK": "0"}, "0 of 0 on this machine"),
        ({**STEP, "SLURM_STEP_NUM_NODES": "3"}, "srun started 4 tasks on 3 nodes, expected as many on each"),
        ({**STEP, "SLURM_STEP_NUM_NODES": "0"}, "srun started 4 tasks on 0 nodes"),
    ],
)
def test_variables_that_contradict_each_other_are_told(environ, told):
    with pytest.raises(ArgumentError, match=told):
        world_of(environ)
