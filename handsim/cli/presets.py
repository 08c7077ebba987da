"""Commands whose option defaults come from a preset that is named among their arguments."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


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
