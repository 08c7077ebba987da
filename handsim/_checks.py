"""Checks at the public edges: each raises one sentence that says what was given and what was expected."""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handsim.errors import ArgumentError


def check_type(
    name: str, value: object, kinds: type | tuple[type, ...], expected: str, valid: Iterable[str] = ()
) -> None:
    """Refuse an argument of another type; the one check of all public functions.

    Args:
        name: The argument.
        value: What was given for it.
        kinds: The types that it may have; a bool is none of them unless it is named.
        expected: What is wanted, in words, such as "a MarkerLayout, or the name or path of one".
        valid: The names that there are.

    Raises:
        ArgumentError: The value is of another type.
    """
    named = kinds if isinstance(kinds, tuple) else (kinds,)
    if isinstance(value, kinds) and (not isinstance(value, bool) or bool in named):
        return
    names = ", ".join(valid)
    raise ArgumentError(
        f"{name} is {shown_value(value)}, expected {expected}" + (f"; valid names: {names}" if names else "")
    )


def shown_value(value: Any) -> str:
    """A value for a sentence: short ones as Python writes them, arrays and objects by their type."""
    if isinstance(value, np.ndarray):
        return f"an array {value.shape}"
    if value is None or isinstance(value, str | bytes | bool | int | float | list | tuple | dict | set):
        return reprlib.repr(value)
    kind = value if isinstance(value, type) else type(value)
    return f"the class {kind.__name__}" if isinstance(value, type) else f"a {kind.__name__}"


def check_array(name: str, array: ArrayLike, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """`array` as finite float64 whose last dimensions are `shape` (None: any length).

    Raises:
        ArgumentError: It has another shape, or holds NaN or infinite values.
    """
    try:
        values = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{name} is {shown_value(array)}, expected an array of numbers") from error
    tail = values.shape[values.ndim - len(shape) :] if values.ndim >= len(shape) else ()
    if len(tail) != len(shape) or any(
        expected is not None and expected != got for expected, got in zip(shape, tail, strict=True)
    ):
        dimensions = ", ".join("any" if length is None else str(length) for length in shape)
        raise ArgumentError(f"{name} has shape {values.shape}, expected (..., {dimensions})")
    if not np.isfinite(values).all():
        raise ArgumentError(f"{name} holds NaN or infinite values, expected finite numbers")
    return values


def check_number(name: str, value: float, low: float, high: float = np.inf, *, above: bool = False) -> None:
    """Refuse a number outside `low` to `high`, NaN or infinity; with `above`, `low` itself too.

    Raises:
        ArgumentError: It is.
    """
    check_type(name, value, (int, float, np.integer, np.floating), "a number")
    inside = low <= value <= high and value < np.inf and not (above and value == low)
    if not inside:
        least = f"a number above {low:g}" if above else f"a number of at least {low:g}"
        both = f"{least}, at most {high:g}" if above else f"a number from {low:g} to {high:g}"
        expected = least if high == np.inf else both
        raise ArgumentError(f"{name} is {value:g}, expected {expected}")


def check_span(name: str, span: tuple[float, float], low: float = 0.0) -> None:
    """Refuse a pair of numbers unless the first is at least `low` and the second, finite, no smaller.

    Raises:
        ArgumentError: The pair is another.
    """
    check_type(name, span, (tuple, list), "two numbers")
    if len(span) != 2 or not low <= span[0] <= span[1] < np.inf:
        raise ArgumentError(f"{name} is {span}, expected two numbers from {low:g} upwards, the smaller first")
