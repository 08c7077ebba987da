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
_STEPS: Final = 2  # of each number of threads that are measured, after one to warm up
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

    Args:
        given: A number, which then holds.
        step: Does what a training step does and changes nothing.
        now: Returns the time [s].
    """

    AGAIN: Final = 300.0
    """Time between two measurements [s]: others may begin or end their work."""

    def __init__(
        self, given: int | None, step: Callable[[], None], *, now: Callable[[], float] = time.perf_counter
    ) -> None:
        import torch

        check_threads(given)
        self.count = given or 1
        self._step, self._now = step, now
        self._most = torch.get_num_threads()  # what the cores and OMP_NUM_THREADS allow
        self._measured = -float("inf")
        self._fixed = given is not None or self._most == 1

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Within the block torch and labelers use the chosen number, which `renew` may change."""
        before = _labeling.get()
        with torch_threads(self.count):
            try:
                yield
            finally:
                _labeling.set(before)

    def renew(self) -> None:
        """Choose anew, within `in_use`, if the last choice was long ago."""
        import torch

        if not self._fixed and self._now() - self._measured > self.AGAIN:
            self.count = self._choose()
            self._measured = self._now()
        torch.set_num_threads(self.count)
        _labeling.set(self.count)

    def _choose(self) -> int:
        """One thread, unless all of them are clearly faster."""
        self._time(1)
        alone = min(self._time(1) for _ in range(_STEPS))
        for _ in range(1 + _STEPS):  # the first may start threads
            together = self._time(self._most)
            if together * _GAIN < alone:
                return self._most
            if together > 2.0 * alone:  # a busy machine: no more of these slow steps
                return 1
        return 1

    def _time(self, threads: int) -> float:
        import torch

        torch.set_num_threads(threads)
        start = self._now()
        self._step()
        return self._now() - start
