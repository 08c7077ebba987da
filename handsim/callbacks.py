"""What long work calls to tell how far it is; the same everywhere."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called with what is done and all there is to do: frames, samples, pictures or steps."""
OnStep = Callable[[str], None]
"""Called with the name of each step of the work when it begins."""


def no_progress(done: int, total: int) -> None:
    """The `Progress` of work that nobody watches."""


def no_step(name: str) -> None:
    """The `OnStep` of work that nobody watches."""
