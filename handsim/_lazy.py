"""Public names of a package, imported when they are first used (PEP 562)."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def lazy_exports(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The `__getattr__` and `__dir__` of a package; its `__all__` is set.

    The public names are those that the package's source imports as themselves (`from module import name as
    name`), which type checkers take as public too. Those under `if TYPE_CHECKING` are imported when they are
    first used, and are ordinary attributes afterwards.
    """
    own = sys.modules[package]
    body = ast.parse(Path(str(own.__file__)).read_text(encoding="utf-8")).body
    lazy = {name: module for one in body if isinstance(one, ast.If) for name, module in _exports(one.body)}
    public = sorted({*lazy, *dict(_exports(body)), "__version__"})
    vars(own)["__all__"] = public

    def load(name: str) -> Any:
        if name not in lazy:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value = getattr(importlib.import_module(lazy[name]), name)
        setattr(own, name, value)
        return value

    return load, lambda: sorted({*vars(own), *public})


def _exports(body: list[ast.stmt]) -> list[tuple[str, str]]:
    """Each name that is imported as itself, and its module."""
    return [
        (alias.name, str(one.module))
        for one in body
        if isinstance(one, ast.ImportFrom)
        for alias in one.names
        if alias.name == alias.asname
    ]
