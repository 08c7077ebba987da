"""How commands read options: defaults from a preset that is named among the arguments, objects by name."""

from __future__ import annotations

import argparse
import types
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

_PLAIN: Final = (str, Path, int, float, bool, types.NoneType)


@dataclass(frozen=True, slots=True)
class PresetCommand:
    """A command of the table that reads its arguments once before they are parsed.

    A preset must become the default of the other options: compared afterwards, an option that was given and
    equals the usual default cannot be distinguished from one that was not given.
    """

    choose: Callable[[Sequence[str], str], Callable[..., Any]]
    """From the arguments and the program's name for messages to the function that they are parsed for."""


def given_option(args: Sequence[str], option: str) -> str | None:
    """The value of one option among arguments, None where it is not given; nothing else is checked."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(option, dest="value", nargs="?")
    known, _ = parser.parse_known_args(list(args))
    value: str | None = known.value
    return value


def named_objects() -> ConstructorRegistry:
    """How tyro reads an option that takes an object or its name or path: as text."""
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec

    registry = ConstructorRegistry()

    @registry.primitive_rule
    def read_name(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        parts = typing.get_args(info.type)
        union = typing.get_origin(info.type) in (typing.Union, types.UnionType)
        if not union or str not in parts or all(part in _PLAIN for part in parts):
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="STR",
            instance_from_str=lambda words: words[0],
            is_instance=lambda value: True,
            str_from_instance=lambda value: [str(value)],
        )

    return registry
