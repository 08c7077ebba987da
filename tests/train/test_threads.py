"""The number of threads that training chooses, by a clock that the test moves."""

from __future__ import annotations

import pytest
import torch

from train.threads import TrainingThreads


class Machine:
    """Steps that take one second on one thread, and `together` on both."""

    def __init__(self, together: float) -> None:
        self.time, self.alone, self.together = 0.0, 1.0, together

    def train(self, threads: TrainingThreads, steps: int) -> list[int]:
        used = []
        with threads.in_use():
            for _ in range(steps):
                with threads.timed_step():
                    used.append(torch.get_num_threads())
                    self.time += self.alone if used[-1] == 1 else self.together
        return used


@pytest.fixture(autouse=True)
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def new(machine: Machine, given: int | None = None) -> TrainingThreads:
    return TrainingThreads(given, now=lambda: machine.time)


@pytest.mark.parametrize(("together", "chosen"), [(0.6, 2), (0.95, 1), (8.0, 1)])
def test_the_faster_number_is_used_and_the_other_seldom_tried(together, chosen):
    machine = Machine(together)
    used = machine.train(new(machine), 1000)
    assert used[:6] == [1, 1, 1, 2, 2, 2]
    assert used[6:].count(chosen) / len(used[6:]) > 0.94
    assert used[6:].count(3 - chosen) >= 2, "others may end their work: the other number is tried again"
    assert torch.get_num_threads() == 2, "the caller's number is left as it was"


def test_work_of_others_is_noticed_within_a_few_steps():
    machine = Machine(0.6)
    threads = new(machine)
    assert machine.train(threads, 40)[-1] == 2
    machine.together = 6.0
    assert machine.train(threads, 40)[-1] == 1
    machine.together = 0.6
    assert machine.train(threads, 400)[-1] == 2


def test_a_given_number_holds():
    machine = Machine(9.0)
    assert set(machine.train(new(machine, 2), 100)) == {2}
