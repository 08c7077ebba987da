"""Callbacks that report the progress of long work, and a base of objects that are closed at its end."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Self

Progress = Callable[[int, int], None]
"""Called with the amount done and the total amount: frames, samples, pictures or steps."""
OnStep = Callable[[str], None]
"""Called with the name of each step of the work when it begins."""


def no_progress(done: int, total: int) -> None:
    """The `Progress` of work that nobody watches."""


def no_step(name: str) -> None:
    """The `OnStep` of work that nobody watches."""


runs_kernels = True
"""Whether this process may call kernels; a process that only prints help does not import numba."""
is_command = False
"""Whether this process is a command, which reports by itself that it compiles."""
before_compiling: list[Callable[[], None]] = []
"""Callbacks; before a missing kernel is compiled, the last one is removed and called."""


class Closing:
    """A base of context managers that call `close` at the end of a `with` block, also after an error."""

    def close(self) -> None:
        """Release what the object holds; to be overridden."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
