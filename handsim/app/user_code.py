"""Objects of a user's own module, named on the command line: `module:name?option=value&option=value`."""

from __future__ import annotations

import importlib
import re
import sys
from typing import Any, Final
from urllib.parse import parse_qsl

from handsim.errors import ArgumentError

_NAMED: Final = re.compile(r"(?P<module>[^\W\d][\w.]*):(?P<name>[^\W\d]\w*)(?:\?(?P<options>.*))?")


def names_user_code(address: str) -> bool:
    """Whether an address has the form `module:name` or `module:name?option=value`."""
    return _NAMED.fullmatch(address) is not None


def call_user_code(address: str) -> Any:
    """Import what an address names, and call it with the address's options, which are strings.

    Modules of the current folder are found after all installed ones.

    Args:
        address: `module:name?option=value`; `name` is a class or a function.

    Raises:
        ArgumentError: There is no such module or name, or it fails or does not take these options.
    """
    parts = _NAMED.fullmatch(address)
    if parts is None:
        raise ArgumentError(f"'{address}' names nothing, expected module:name or module:name?option=value")
    made = _find(parts["module"], parts["name"])
    options = dict(parse_qsl(parts["options"] or "", keep_blank_values=True))
    try:
        return made(**options)
    except Exception as error:
        raise ArgumentError(
            f"{parts['module']}:{parts['name']}({_listed(options)}) failed ({type(error).__name__}: {error})"
        ) from error


def _find(module: str, name: str) -> Any:
    sys.path.append("")
    try:
        found = importlib.import_module(module)
    except Exception as error:
        raise ArgumentError(
            f"module '{module}' cannot be imported ({type(error).__name__}: {error}), expected a module that "
            "is installed or in this folder"
        ) from error
    finally:
        sys.path.remove("")
    if not callable(getattr(found, name, None)):
        raise ArgumentError(f"module '{module}' has no class or function '{name}'")
    return getattr(found, name)


def _listed(options: dict[str, str]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in options.items())
