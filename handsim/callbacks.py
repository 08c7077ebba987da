"""Callbacks that report the progress of long work, and a base of objects that are closed at its end."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Self

Progress = Callable[[int, int], None]
"""Called with what is done and all there is to do: frames, samples, pictures or steps."""
OnStep = Callable[[str], None]
"""Called with the name of each step of the work when it begins."""


def no_progress(done: int, total: int) -> None:
    """The `Progress` of work that nobody watches."""


def no_step(name: str) -> None:
    """The `OnStep` of work that nobody watches."""


runs_kernels = True
"""Whether this process may call kernels; one that prints help leaves them as they are, and numba out."""
is_command = False
"""Whether this process is a command, which tells that it compiles by itself."""
before_compiling: list[Callable[[], None]] = []
"""Callbacks; the last one is removed and called before a kernel that the cache lacks is compiled."""


class Closing:
    """A base of classes with `close`: the end of a `with` block closes them, whatever ended it."""

    def close(self) -> None:
        """Release what the object holds; to be overridden."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
