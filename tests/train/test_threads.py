"""The number of threads that training chooses, by a clock that the test moves, and that labelers use."""

from __future__ import annotations

import pytest
import torch

from handsim.errors import ArgumentError
from train.threads import TrainingThreads, label_on, labeling_threads


class Machine:
    """A clock, and steps that take one second on one thread and `together` on both."""

    def __init__(self, together: float) -> None:
        self.time, self.together = 0.0, together
        self.tried: list[int] = []

    def now(self) -> float:
        return self.time

    def compute(self) -> None:
        self.time += 1.0 if torch.get_num_threads() == 1 else self.together

    def try_step(self) -> None:
        self.tried.append(torch.get_num_threads())
        self.compute()

    def train(self, threads: TrainingThreads, steps: int) -> list[int]:
        """The numbers of threads of so many steps."""
        used = []
        with threads.in_use():
            for _ in range(steps):
                with threads.timed_step():
                    used.append(torch.get_num_threads())
                    self.compute()
        return used


@pytest.fixture(autouse=True)
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def new(machine: Machine, given: int | None = None) -> TrainingThreads:
    return TrainingThreads(given, machine.try_step, now=machine.now)


@pytest.mark.parametrize(("together", "chosen", "tried"), [(0.6, 2, 3), (0.95, 1, 3), (8.0, 1, 2)])
def test_the_faster_number_is_used_and_the_other_seldom_tried(together, chosen, tried):
    machine = Machine(together)
    used = machine.train(new(machine), 1000)
    assert used[:3] == [1, 1, 1] and set(used[3:]) == {chosen}
    assert machine.tried[:tried] == [2] * tried, "a slow step is enough on a busy machine"
    assert set(machine.tried[tried:]) == {3 - chosen}, "others may end their work"
    assert len(machine.tried) * (together if chosen == 1 else 1.0) < 0.07 * machine.time
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
    assert set(machine.train(new(machine, 2), 100)) == {2} and not machine.tried
    for wrong in (0, -2):
        with pytest.raises(ArgumentError, match=f"threads is {wrong}, expected 1 to"):
            new(machine, wrong)


def test_labelers_use_one_thread_unless_told():
    label_on(2)
    try:
        with labeling_threads():
            assert torch.get_num_threads() == 2
    finally:
        label_on(1)
    with labeling_threads():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2
