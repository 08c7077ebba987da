"""How many threads torch uses: one for labeling, the faster number for training.

Torch's own default, a thread a core, makes a small network many times slower where others compute too:
its threads wait for one another in every operation.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

from handsim.errors import ArgumentError

_MOST: Final = 1024
_STEPS: Final = 2  # of each number of threads whose faster one counts, after one to warm up
_SLOWER: Final = 1.5  # times of steps, over the usual one, from which on the other number is tried
_GAIN: Final = 1.15  # by which more threads must be faster to be worth the cores of others
_labeling: ContextVar[int] = ContextVar("labeling", default=1)


def check_threads(threads: int | None) -> None:
    """Refuse a number of threads below one.

    Raises:
        ArgumentError: It is, or is absurdly large.
    """
    if threads is not None and not 1 <= threads <= _MOST:
        raise ArgumentError(f"threads is {threads}, expected 1 to {_MOST}")


def label_on(threads: int) -> None:
    """Have labelers use this many threads from now on; it is one when this is never called.

    Raises:
        ArgumentError: `threads` is less than 1.
    """
    check_threads(threads)
    _labeling.set(threads)


@contextmanager
def labeling_threads() -> Iterator[None]:
    """Within the block torch uses the threads of labelers, which is what `label_on` said."""
    with torch_threads(_labeling.get()):
        yield


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Within the block torch uses this many threads."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class TrainingThreads:
    """The number of threads that training uses: a given one, or the faster of one and all.

    The steps of the training itself tell: now and then, and as soon as they take longer than they did, the
    next few are made with the other number, and the faster of both stays.

    Args:
        given: A number, which then holds.
        now: Returns the time [s].
    """

    AGAIN: Final = 60.0
    """Least time between two trials [s]: others may begin or end their work."""
    SHARE: Final = 20.0
    """Least time between two trials, in times of the trial before; a quarter of it where steps have become
    slower."""

    def __init__(self, given: int | None, *, now: Callable[[], float] = time.perf_counter) -> None:
        import torch

        check_threads(given)
        self.count = given or 1
        self._now = now
        self._most = torch.get_num_threads()  # what the cores and OMP_NUM_THREADS allow
        self._fixed = given is not None or self._most == 1
        self._steps: list[float] = []  # times of the steps since the number changed, the first left out
        self._usual = 0.0  # time of a step with this number; none is known yet
        self._trial: float | None = None  # time of a step with the other number, while this one is tried
        self._due = self._soonest = -float("inf")

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Within the block torch and labelers use the chosen number, which steps may change."""
        before = _labeling.get()
        with torch_threads(self.count):
            try:
                yield
            finally:
                _labeling.set(before)

    @contextmanager
    def timed_step(self) -> Iterator[None]:
        """Around each step, within `in_use`: use the chosen number, and learn from how long it takes."""
        import torch

        torch.set_num_threads(self.count)
        _labeling.set(self.count)
        start = self._now()
        yield
        if not self._fixed:
            self._learn(self._now() - start)

    def _learn(self, took: float) -> None:
        """Begin a trial of the other number if it is due, or end one."""
        self._steps.append(took)
        if len(self._steps) <= _STEPS:  # the first may start threads
            return
        step = min(self._steps[-_STEPS:])
        if self._trial is not None:
            spent = sum(self._steps)
            alone, together = (step, self._trial) if self.count == 1 else (self._trial, step)
            best = self._most if together * _GAIN < alone else 1
            self._usual, self._trial = alone if best == 1 else together, None
            self._due = self._now() + max(self.AGAIN, self.SHARE * spent)
            self._soonest = self._now() + 0.25 * self.SHARE * spent
            self._use(best)
        elif self._now() >= (self._soonest if step > _SLOWER * self._usual else self._due):
            self._trial = step
            self._use(1 if self.count > 1 else self._most)

    def _use(self, count: int) -> None:
        """Use this number from the next step on."""
        if count != self.count:
            self._steps = []
        self.count = count
