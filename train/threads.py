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

from handsim._checks import check_count

_MOST: Final = 1024
_STEPS: Final = 2  # of each number of threads, the faster of which counts, after one to warm up
_SLOWER: Final = 1.5  # times of steps, over the usual one, from which on the other number is tried
_GAIN: Final = 1.15  # by which more threads must be faster to be worth the cores of others
_labeling: ContextVar[int] = ContextVar("labeling", default=1)


def check_threads(threads: int | None) -> None:
    """Refuse a number of threads below one."""
    if threads is not None:
        check_count("threads", threads, 1, _MOST)


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

    The steps of the training tell how long they take with the chosen number. Now and then, and as soon as
    they take longer than they did, the other number is tried.

    Args:
        given: A number, which then holds.
        step: Does what a training step does and changes nothing.
        now: Returns the time [s].
    """

    AGAIN: Final = 60.0
    """Least time between two trials [s]: others may begin or end their work."""
    SHARE: Final = 20.0
    """Least time between two trials, in times of the trial before; a quarter of it where steps have become
    slower."""

    def __init__(
        self, given: int | None, step: Callable[[], None], *, now: Callable[[], float] = time.perf_counter
    ) -> None:
        import torch

        check_threads(given)
        self.count = given or 1
        self._step, self._now = step, now
        self._most = torch.get_num_threads()  # what the cores and OMP_NUM_THREADS allow
        self._fixed = given is not None or self._most == 1
        self._steps: list[
            float
        ] = []  # times of the steps since the number changed; the first may start threads
        self._usual = 0.0  # time of a step with this number when it was chosen; none is known yet
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
        self._steps = [*self._steps[-_STEPS:], self._now() - start]
        if not self._fixed and len(self._steps) > _STEPS:
            step = min(self._steps[1:])
            if self._now() >= (self._soonest if step > _SLOWER * self._usual else self._due):
                self._try_other(step)

    def _try_other(self, step: float) -> None:
        """Choose the other number if it is clearly faster than the chosen one, whose steps take `step`."""
        start = self._now()
        other = 1 if self.count > 1 else self._most
        self._time(other)  # the first may start threads
        tried = self._time(other)
        for _ in range(_STEPS - 1):
            if tried < 2.0 * step:  # else a busy machine: no more of these slow steps
                tried = min(tried, self._time(other))
        alone, together = (step, tried) if self.count == 1 else (tried, step)
        best = self._most if together * _GAIN < alone else 1
        self._usual = together if best > 1 else alone
        if best != self.count:
            self.count, self._steps = best, []
        spent = self._now() - start
        self._due = self._now() + max(self.AGAIN, self.SHARE * spent)
        self._soonest = self._now() + 0.25 * self.SHARE * spent

    def _time(self, threads: int) -> float:
        import torch

        torch.set_num_threads(threads)
        start = self._now()
        self._step()
        return self._now() - start
