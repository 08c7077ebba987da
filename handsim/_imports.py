"""What happens when a package is imported: lazy public names (PEP 562), name conflicts, a place for kernels.

A user may well call a script `train.py` or `render.py`. Python then fails deep inside handsim with a message
that does not name the cause, so a warning about the five generic import names comes first.

Compiled kernels are kept beside their files, else in the user's cache, else in a temporary folder: numba
refuses to import a kernel that it can keep nowhere, as in a read-only installation without a home.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import os
import stat
import sys
import tempfile
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Final

from handsim._process import own_numerics, with_own_numerics


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
        with own_numerics():
            module = importlib.import_module(lazy[name])
        value = getattr(module, name)
        if inspect.isfunction(value):
            value = with_own_numerics(value)
            setattr(module, name, value)
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


SIBLINGS: Final = ("poses", "gloves", "render", "train", "track")
_HOME: Final = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


class ShadowedPackageWarning(UserWarning):
    """Another file or package has an import name that handsim needs."""


def shadowed_siblings(home: str = _HOME) -> dict[str, str]:
    """Locations of siblings that are found elsewhere than in `home`, the folder that holds `handsim`."""
    found = {name: _location(name) for name in SIBLINGS}
    own = {name: os.path.realpath(os.path.join(home, name)) for name in SIBLINGS}
    return {name: place for name, place in found.items() if place and os.path.realpath(place) != own[name]}


def warn_if_shadowed() -> None:
    """Warn once for each sibling that is found elsewhere; nothing is imported."""
    for name, location in shadowed_siblings().items():
        warnings.warn(
            f"handsim needs its own package '{name}', but `import {name}` finds {location}; rename that, "
            "or keep it off the path (python -P leaves out the script's folder)",
            ShadowedPackageWarning,
            stacklevel=3,
        )


def _location(name: str) -> str | None:
    """Folder of a package or file of a module, without importing it; None when there is none."""
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # a module put into sys.modules by hand carries no spec
        return getattr(sys.modules.get(name), "__file__", None) or f"a module made by hand, '{name}'"
    if spec is None:
        return None
    folders = spec.submodule_search_locations
    return str(next(iter(folders))) if folders else spec.origin


VARIABLE: Final = "NUMBA_CACHE_DIR"
_PACKAGE: Final = Path(__file__).parent


def ensure_kernel_cache() -> None:
    """Name a temporary folder for compiled kernels if numba would find no other; workers inherit it."""
    if not os.environ.get(VARIABLE) and not is_writable(_PACKAGE) and not is_writable(_user_cache()):
        os.environ[VARIABLE] = str(_own_folder())


def kernel_cache() -> tuple[Path, bool]:
    """Where kernels are kept, and whether they stay there."""
    given = os.environ.get(VARIABLE)
    if given:
        return Path(given), not Path(given).is_relative_to(tempfile.gettempdir())
    return (_PACKAGE, True) if is_writable(_PACKAGE) else (_user_cache(), True)


def _user_cache() -> Path:
    """The folder of a user's caches, as numba looks for it."""
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))


def is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, or in the first of its parents that exists.

    Such a parent is tried with a nameless file, because some allow new files and refuse them, as /proc does.
    """
    there = next((one for one in (folder, *folder.parents) if os.path.exists(one)), folder)
    if not os.path.isdir(there) or not os.access(there, os.W_OK | os.X_OK):
        return False
    try:
        with nullcontext() if there == folder else tempfile.TemporaryFile(dir=there):
            return True
    except OSError:
        return False


def _own_folder() -> Path:
    """A temporary folder that nobody else can write to: numba unpickles what it finds there."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"handsim-kernels-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return Path(tempfile.mkdtemp(prefix="handsim-kernels-"))
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != user or found.st_mode & 0o077:
        return Path(tempfile.mkdtemp(prefix="handsim-kernels-"))
    return folder
