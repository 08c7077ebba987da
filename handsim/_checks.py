"""Checks at the public edges: each raises one sentence that says what was given and what was expected."""

from __future__ import annotations

import reprlib
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from handsim.errors import ArgumentError, HandSimError, choices


def check_type(
    name: str, value: object, kinds: type | tuple[type, ...], expected: str, valid: Iterable[str] = ()
) -> None:
    """Refuse an argument of another type than `kinds`; True and False are no numbers."""
    accepted = kinds if isinstance(kinds, tuple) else (kinds,)
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in accepted):
        raise unexpected(name, value, expected, valid)


def unexpected(name: str, value: object, expected: str, valid: Iterable[str] = ()) -> ArgumentError:
    """The error for an argument that is not as expected, with the valid names if there are any."""
    names = ", ".join(valid)
    hint = f"; valid names: {names}" if names else ""
    return ArgumentError(f"{name} is {shown_value(value)}, expected {expected}{hint}")


def check_choice(
    given: object, valid: Collection[str], *, noun: str, error: type[HandSimError] = ArgumentError
) -> None:
    """Raise an error that lists the valid names if the given name is none of them."""
    if given not in valid:
        raise error(choices(str(given), valid, noun=noun))


def check_rng(rng: object) -> None:
    """Refuse anything but a generator of numpy as the source of randomness."""
    check_type("rng", rng, np.random.Generator, "a numpy.random.Generator, such as default_rng(0)")


def check_callable(name: str, value: object, expected: str, valid: Iterable[str] = ()) -> None:
    """Refuse an object that cannot be called."""
    if not callable(value):
        raise unexpected(name, value, expected, valid)


def check_methods(name: str, value: object, methods: Iterable[str], expected: str) -> None:
    """Refuse an object that lacks one of these methods."""
    for method in methods:
        if not callable(getattr(value, method, None)):
            raise ArgumentError(f"{name} has no method {method}, expected {expected}")


def shown_value(value: Any) -> str:
    """A value for a sentence: its `repr` if that is short, arrays and objects by their type."""
    if isinstance(value, np.ndarray):
        return f"an array {value.shape}"
    if value is None or isinstance(value, str | bytes | bool | int | float | list | tuple | dict | set):
        return reprlib.repr(value)
    kind = value if isinstance(value, type) else type(value)
    return f"the class {kind.__name__}" if isinstance(value, type) else f"a {kind.__name__}"


def as_numbers(name: str, values: ArrayLike, kind: DTypeLike | None = np.float64) -> NDArray[Any]:
    """`values` as an array of `kind` (None: their own type); masked entries become NaN or -1."""
    try:
        array = as_array(values, kind)
        if array.dtype.kind in "cSU":
            raise TypeError("complex numbers or texts")
        return np.asarray(array, dtype=kind)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # torch raises the last one
        raise unexpected(name, values, "an array of numbers") from error


def as_array(values: ArrayLike, kind: DTypeLike | None) -> NDArray[Any]:
    """`values` as an array of their own type; a tensor of torch loses its gradient.

    Masked entries of an array, or of a list of arrays, become the missing value of `kind` (None: their own
    type): NaN, or -1 in whole numbers. NumPy alone would return the numbers below the mask.
    """
    items = values if isinstance(values, list | tuple) else [values]
    if any(isinstance(item, np.ma.MaskedArray) for item in items):
        masked: np.ma.MaskedArray[Any, Any] = np.ma.array(values, dtype=kind)
        return np.asarray(masked.filled(np.nan if masked.dtype.kind == "f" else -1))
    if hasattr(values, "detach"):
        values = values.detach().cpu()
    return np.asarray(values)


def check_array(name: str, array: ArrayLike, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """`array` as finite float64 whose last dimensions are `shape` (None: any length)."""
    values = as_numbers(name, array)
    tail = values.shape[max(0, values.ndim - len(shape)) :]
    if len(tail) != len(shape) or any(want not in (None, got) for want, got in zip(shape, tail, strict=True)):
        dimensions = ", ".join("any" if length is None else str(length) for length in shape)
        raise ArgumentError(f"{name} has shape {values.shape}, expected (..., {dimensions})")
    if not np.isfinite(values).all():
        raise ArgumentError(f"{name} holds NaN or infinite values, expected finite numbers")
    return values


def check_number(name: str, value: float, low: float, high: float = np.inf, *, above: bool = False) -> None:
    """Refuse a number outside `low` to `high`, NaN or infinity; with `above`, `low` itself too."""
    check_type(name, value, (int, float, np.integer, np.floating), "a number")
    if not (low <= value <= high and value < np.inf) or (above and value == low):
        least = f"a number above {low:g}" if above else f"a number of at least {low:g}"
        both = f"{least}, at most {high:g}" if above else f"a number from {low:g} to {high:g}"
        expected = least if high == np.inf else both
        raise ArgumentError(f"{name} is {value:g}, expected {expected}")


def check_count(name: str, value: Any, low: int, high: float = np.inf) -> None:
    """Refuse anything but a whole number from `low` to `high`."""
    check_type(name, value, (int, np.integer), "a whole number")
    if not low <= value <= high:
        least = f"at least {low}" if low else "0 or more"
        raise ArgumentError(f"{name} is {value}, expected {least if high == np.inf else f'{low} to {high}'}")
