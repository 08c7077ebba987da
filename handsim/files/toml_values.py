"""Values of TOML files: type checks, their form in messages, and their form in files.

A wrong value raises a `HandSimError` that names the key; the caller, which knows the file, adds its name.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from handsim.errors import HandSimError, choices, shortened

_LARGEST: Final = 1e9  # in any unit; keeps out NaN, infinity and integers beyond float


def check_keys(
    table: Mapping[str, object], owner: str, valid: Collection[str], *, optional: Collection[str] = ()
) -> None:
    """Raise a `HandSimError` unless a table has all the keys that it must have, and no others."""
    for key in table:
        if key not in valid:
            raise HandSimError(f"{owner} has an {choices(key, valid, noun='key')}")
    for key in valid:
        if key not in table and key not in optional:
            raise HandSimError(f"{owner} lacks the key '{key}'")


def tables_of(table: Mapping[str, object], key: str) -> list[dict[str, Any]]:
    """A list of tables; empty if the key is missing."""
    tables = table.get(key, [])
    if not isinstance(tables, list) or not all(isinstance(entry, dict) for entry in tables):
        raise HandSimError(f"{key} is not a list of tables; expected one [[{key}]] table per {key}")
    return tables


def text_of(table: Mapping[str, object], key: str, prefix: str = "", *, default: str | None = None) -> str:
    """Text of any characters."""
    value = table.get(key, default)
    if not isinstance(value, str):
        raise HandSimError(f"{prefix}{key} is {shown(value)}, expected text in quotes")
    return value


def number_of(
    table: Mapping[str, object], key: str, prefix: str = "", *, default: float | None = None
) -> float:
    """A finite number."""
    return float(numbers(f"{prefix}{key}", table.get(key, default), (), "a number"))


def numbers(owner: str, value: object, shape: tuple[int, ...], expected: str) -> NDArray[np.float64]:
    """Nested lists of finite numbers as an array of exactly this shape; `expected` describes it in words."""
    try:
        array = np.array(value, dtype=object)
    except ValueError:  # rows of different lengths
        array = np.array(None)
    flat = array.ravel().tolist()
    if array.shape != shape or not all(
        isinstance(entry, int | float) and not isinstance(entry, bool) and abs(entry) < _LARGEST
        for entry in flat
    ):
        raise HandSimError(f"{owner} is {shown(value)}, expected {expected}")
    return np.array(flat, dtype=np.float64).reshape(shape)


def number_list(owner: str, value: object) -> tuple[float, ...]:
    """A list of finite numbers, of any length."""
    count = len(value) if isinstance(value, list) else -1
    return tuple(numbers(owner, value, (count,), "a list of numbers").tolist())


def shown(value: object) -> str:
    """A value as a sentence shows it, cut where it is long."""
    return shortened(json.dumps(value, default=str, ensure_ascii=False))


def quoted(text: str) -> str:
    """A TOML basic string, which escapes as JSON does, and the delete character too."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")


def written(value: float) -> str:
    """A TOML float without the noise of unit conversion; never '-0.0'."""
    return repr(round(value, 9) + 0.0)
