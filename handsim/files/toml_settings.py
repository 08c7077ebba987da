"""Settings dataclasses from tables of TOML files: unknown keys and wrong types are told with their names."""

from __future__ import annotations

import dataclasses
import re
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

from handsim.errors import HandSimError, choices
from handsim.files.toml_values import shown

Settings = TypeVar("Settings")
_WRONG = re.compile(r"(?P<what>.*?)(?: - at `\$\.?(?P<path>.*)`)?$", re.DOTALL)


def settings_of(kind: type[Settings], table: Mapping[str, Any], owner: str) -> Settings:
    """A settings dataclass with the values of a table; what the table does not have keeps its default.

    Args:
        kind: A dataclass whose fields are numbers, texts, literals, tuples and such dataclasses.
        table: Values by the fields' names; tables for fields that are dataclasses.
        owner: What the table is, for messages.

    Raises:
        HandSimError: A key is unknown, a value has another type, or the dataclass refuses it.
    """
    _check_names(kind, table, owner)
    try:
        return msgspec.convert(dict(table), kind)
    except msgspec.ValidationError as error:
        found = _WRONG.match(str(error))
        what, path = (found["what"], found["path"] or "") if found is not None else (str(error), "")
        raise HandSimError(_sentence(kind, table, f"{owner}.{path}", path, what)) from error


def _check_names(kind: type, table: Mapping[str, Any], owner: str) -> None:
    """Refuse names that are no fields, in tables within the table too."""
    types = typing.get_type_hints(kind)
    for key, value in table.items():
        if key not in types:
            raise HandSimError(f"{owner} has an {choices(key, types, noun='key')}")
        if dataclasses.is_dataclass(types[key]) and isinstance(value, dict):
            _check_names(typing.cast("type", types[key]), value, f"{owner}.{key}")


def _sentence(kind: type, table: Mapping[str, Any], name: str, path: str, what: str) -> str:
    """What is wrong with the value at a path."""
    value: Any = table
    expected: Any = kind
    for part in re.findall(r"\w+", path):
        if isinstance(value, dict) and part in value:
            value, expected = value[part], typing.get_type_hints(expected)[part]
    names = [one for one in typing.get_args(expected) if isinstance(one, str)]
    if isinstance(value, str) and names:
        return choices(value, names, noun=name)
    told = what[:1].lower() + what[1:].replace("`", "").replace(" | null", "")
    return f"{name} is {shown(value)}: {told}"
