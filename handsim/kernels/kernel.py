"""The decorator of every compiled function."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, overload

import numba

P = ParamSpec("P")
R = TypeVar("R")


@overload
def kernel(function: Callable[P, R], /) -> Callable[P, R]: ...


@overload
def kernel(*, inline: bool) -> Callable[[Callable[P, R]], Callable[P, R]]: ...


def kernel(function: Callable[P, R] | None = None, /, *, inline: bool = False) -> Any:
    """Compile a function with numba at its first call, and keep the machine code on disk.

    A division by zero gives infinity or NaN as in numpy. Sums keep their order (no fast-math), so that
    results are the same on every machine. Arguments are arrays, numbers and other kernels; the body of an
    inline kernel is copied into each kernel that calls it.
    """
    if function is None:
        return lambda function: _compiled(function, inline=inline)
    return _compiled(function, inline=inline)


def _compiled(function: Callable[P, R], *, inline: bool) -> Any:
    compiled = numba.njit(cache=True, error_model="numpy", inline="always" if inline else "never")(function)
    kept = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if kept is not None:
        kept._load_index = functools.partial(_known_kernels, kept._load_index)
    return compiled


def _known_kernels(load: Callable[[], dict[Any, str]]) -> dict[Any, str]:
    """The kernels kept on disk; none if an earlier version kept them under types that moved since."""
    try:
        return load()
    except (ImportError, AttributeError):
        return {}
