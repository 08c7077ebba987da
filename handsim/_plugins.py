"""Loading of foreign code: optional packages, and functions and classes of users.

Users name their code as `module:name`, or by the name of an entry point.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import re
import sys
import traceback
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Final
from urllib.parse import parse_qsl

from handsim.errors import ArgumentError, HandSimError, choices, shortened

_QUALIFIED_NAME: Final = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")
_MEMORY_ADDRESS: Final = re.compile(r" at 0x[0-9a-f]+")
EGL_PACKAGES: Final = "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1 libopengl0"
"""Packages of Debian and Ubuntu, which pip cannot install, for OpenGL without a screen."""


def is_plugin(name: str) -> bool:
    """Whether a name is written like `module:name`."""
    return _QUALIFIED_NAME.fullmatch(name) is not None


@functools.cache
def list_plugins(group: str) -> tuple[str, ...]:
    """Names of the entry points of a group, as installed packages registered them."""
    return tuple(sorted({point.name for point in metadata.entry_points(group=group)}))


@functools.lru_cache(maxsize=64)
def load_plugin(name: str, *, group: str, noun: str) -> Any:
    """Import the object of a name; a class is instantiated once, without arguments."""
    found = _import_object(name, group, noun)
    try:
        return found() if inspect.isclass(found) else found
    except Exception as error:
        raise ArgumentError(f"{noun} '{name}' cannot be loaded: {_error_text(error)}") from error


def make_plugin(address: str, *, group: str, noun: str) -> Any:
    """Import the class or function of an address, and call it with the options in the address.

    The address is `module:name` or the name of an entry point. Options may follow it, as
    `?option=value&option=value`; their values are strings.
    """
    name, _, options = address.partition("?")
    given = dict(parse_qsl(options, keep_blank_values=True))
    return call_plugin(_import_object(name, group, noun), name, noun, **given)


def plugin_name(value: Any) -> str:
    """The name of a function or an object in records and messages: `module:name`, or a string as it is."""
    if isinstance(value, str):
        return value
    if isinstance(value, functools.partial):
        options = "".join(f", {key}={option!r}" for key, option in value.keywords.items())
        return f"partial({plugin_name(value.func)}{''.join(f', {one!r}' for one in value.args)}{options})"
    if hasattr(value, "__qualname__") and hasattr(value, "__module__"):
        return f"{value.__module__}:{value.__qualname__}"
    shown = repr(value)
    kind = type(value)
    return f"{kind.__module__}:{kind.__qualname__}" if _MEMORY_ADDRESS.search(shown) else shown


def _import_object(name: str, group: str, noun: str) -> Any:
    """Import the object of a name: `module:name`, or an entry point of the group."""
    target = name
    if not is_plugin(name):
        points = {point.name: point.value for point in metadata.entry_points(group=group)}
        if name not in points:
            known = choices(name, points, noun=noun) if points else f"unknown {noun} '{shortened(name)}'"
            raise ArgumentError(
                f"{known}; expected module:name, or a name that a package registers as {group}"
            )
        target = points[name]
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        return resolve_name(target)
    except ModuleNotFoundError as error:
        raise ArgumentError(f"{noun} '{name}': {error}; it is looked for in {here} too") from error
    except AttributeError as error:
        raise ArgumentError(f"{noun} '{name}': {error}") from error
    except Exception as error:
        raise ArgumentError(f"{noun} '{name}' cannot be loaded: {_error_text(error)}") from error


def call_plugin(function: Callable[..., Any], name: str, noun: str, /, *args: Any, **options: Any) -> Any:
    """Call a function of the user's; an error becomes one sentence."""
    if not callable(function):
        raise ArgumentError(f"{noun} '{name}' is {type(function).__name__}, expected a function or a class")
    try:
        inspect.signature(function).bind(*args, **options)
    except TypeError as error:
        given = [*("array" if hasattr(one, "shape") else type(one).__name__ for one in args)]
        given += [f"{key}=..." for key in options]
        raise ArgumentError(
            f"{noun} '{name}' does not take the arguments ({', '.join(given)}): {error}"
        ) from error
    except ValueError:  # a builtin without a signature
        pass
    try:
        return function(*args, **options)
    except HandSimError:
        raise
    except Exception as error:
        raise HandSimError(f"{noun} '{name}' failed: {_error_text(error)}") from error


def _error_text(error: Exception) -> str:
    """An error and the line that raised it."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({last.filename}, line {last.lineno})"


def import_extra(module: str, what: str, extra: str) -> Any:
    """Import a module of an optional package; `what` names in messages the feature that needs it."""
    try:
        return importlib.import_module(module)
    except (ImportError, RuntimeError) as error:  # pylsl raises the latter without its library
        raise ArgumentError(
            f"{what} needs the package {module.partition('.')[0]}, which cannot be imported "
            f"({' '.join(str(error).split())}); run `pip install 'handsim[{extra}]'`"
        ) from error
