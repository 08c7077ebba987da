"""Imports of the packages: lazy public names (PEP 562), name conflicts, and the folder of compiled kernels.

A user may call a script `train.py` or `render.py`. handsim still finds its own packages, also as
`handsim.train`, and warns that `import train` finds the user's file. If the user's `train` is already
imported, handsim raises an error, because Python holds only one module of each name.

Compiled kernels are stored beside their source files, or in the user's cache, or in a temporary folder. numba
cannot import a kernel without a writable cache folder, as in a read-only installation without a home.
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
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from handsim._process import own_numerics, with_own_numerics
from handsim.errors import HandSimError

SIBLINGS: Final = ("poses", "gloves", "render", "train", "track", "film")
_ROOT: Final = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
_IMPORTED_SIBLINGS: Final = {
    "render": ("poses", "gloves"),
    "train": ("poses", "gloves"),
    "track": ("poses", "gloves", "train"),
    "film": ("poses", "gloves", "render"),
}
"""The sibling packages that each package imports."""
_REMEDY: Final = "import handsim.{0} before it, rename it, or keep it off the path"
CACHE_VARIABLE: Final = "NUMBA_CACHE_DIR"
_PACKAGE: Final = Path(__file__).parent


def lazy_exports(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The `__getattr__` and `__dir__` of a package; its `__all__` is set.

    The public names are those that the package's source imports as themselves (`from module import name as
    name`), which type checkers take as public too. Those under `if TYPE_CHECKING` are imported when they are
    first used, and are ordinary attributes afterwards.
    """
    claim(*_IMPORTED_SIBLINGS.get(package, ()))
    module = sys.modules[package]
    lazy, loaded = _public_names(Path(str(module.__file__)))
    public = sorted({*lazy, *loaded, "__version__"})
    vars(module)["__all__"] = public

    def load(name: str) -> Any:
        if package == "handsim" and name in SIBLINGS:
            return importlib.import_module(f"handsim.{name}")
        if name not in lazy:
            raise AttributeError(f"module '{package}' has no attribute '{name}'{_owner_hint(name)}")
        with own_numerics():
            origin = importlib.import_module(lazy[name])
        value = getattr(origin, name)
        if inspect.isfunction(value):
            value = with_own_numerics(value)
            setattr(origin, name, value)
        setattr(module, name, value)
        return value

    return load, lambda: sorted({*vars(module), *public})


def _public_names(source: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Modules of a package's public names: names that are imported at first use, and the others."""
    body = ast.parse(source.read_text(encoding="utf-8")).body
    typed = [statement for block in body if isinstance(block, ast.If) for statement in block.body]
    return _exported_names(typed), _exported_names(body)


def _owner_hint(name: str) -> str:
    """The end of a sentence that names the package with this public name; empty if there is none."""
    for package in () if name.startswith("_") else ("handsim", *SIBLINGS):
        source = Path(_package_folder(package), "__init__.py")
        if source.exists() and name in _public_names(source)[0]:
            return f"; {package}.{name} has this name"
    return ""


def _exported_names(body: list[ast.stmt]) -> dict[str, str]:
    """The module of each name that is imported as itself."""
    imports = [one for one in body if isinstance(one, ast.ImportFrom)]
    return {
        alias.name: str(one.module) for one in imports for alias in one.names if alias.name == alias.asname
    }


class ShadowedPackageWarning(UserWarning):
    """Another file or package has an import name that handsim needs."""


class ShadowedPackageError(HandSimError, ImportError):
    """Another file or package that is imported already has an import name that handsim needs."""


class _OwnPackages(MetaPathFinder, Loader):
    """Finds claimed packages beside `handsim`, and each `handsim.train.x` as the module `train.x` itself."""

    def __init__(self) -> None:
        self.claimed: set[str] = set()

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """The specification of a module, if it is one of these."""
        if fullname in self.claimed:
            file = os.path.join(_package_folder(fullname), "__init__.py")
            _check_own(fullname, file)
            return importlib.util.spec_from_file_location(fullname, file)
        first, _, inner = fullname.partition(".")
        if first != "handsim" or inner.partition(".")[0] not in SIBLINGS:
            return None
        return ModuleSpec(fullname, self)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module of the name without `handsim.`."""
        name = spec.name.removeprefix("handsim.")
        claim(name.partition(".")[0])
        module = importlib.import_module(name)
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Give a module back its own specification, in whose place Python has put that of the other name."""
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state


_FINDER: Final = _OwnPackages()


def find_own_packages() -> None:
    """Let Python find handsim's packages by their names within `handsim` as well."""
    if _FINDER not in sys.meta_path:
        sys.meta_path.insert(0, _FINDER)


def claim(*names: str) -> None:
    """Make sure that these names stand for handsim's packages from now on.

    Raises:
        ShadowedPackageError: Another module of such a name is imported already.
    """
    for name in names:
        place = _found_location(name) if name in sys.modules else None
        if place and os.path.realpath(place) != os.path.realpath(_package_folder(name)):
            raise ShadowedPackageError(
                f"handsim needs its own package '{name}', but {place} is imported under this name; "
                + _REMEDY.format(name)
            )
        _FINDER.claimed.add(name)


def _package_folder(name: str, home: str = _ROOT) -> str:
    """Folder of one of handsim's packages."""
    return os.path.join(home, name)


def _check_own(name: str, file: str) -> None:
    """Refuse another package's files in place of our own, as the PyPI package `render` leaves them there."""
    try:
        text = Path(file).read_text("utf-8", errors="replace")
    except OSError:
        text = ""
    if "lazy_exports" not in text:
        fault = "belongs to another package" if text else "is missing"
        raise ShadowedPackageError(
            f"handsim needs its own package '{name}', but {file} {fault}; "
            f"run `pip uninstall {name}`, then install handsim anew with pip's --force-reinstall --no-deps"
        )


def shadowed_siblings(home: str = _ROOT) -> dict[str, str]:
    """Locations of siblings that are found elsewhere than in `home`, the folder that holds `handsim`."""
    found = {name: _found_location(name) for name in SIBLINGS}
    own = {name: os.path.realpath(_package_folder(name, home)) for name in SIBLINGS}
    return {name: place for name, place in found.items() if place and os.path.realpath(place) != own[name]}


def warn_if_shadowed() -> None:
    """Warn once for each sibling that is found elsewhere; nothing is imported."""
    for name, location in shadowed_siblings().items():
        warnings.warn(
            f"handsim needs its own package '{name}', but `import {name}` finds {location}; "
            + _REMEDY.format(name),
            ShadowedPackageWarning,
            stacklevel=3,
        )


def _found_location(name: str) -> str | None:
    """Folder of a package or file of a module, as Python finds it without our help; None if there is none."""
    if name in sys.modules:
        module = sys.modules[name]
        spec = module.__spec__
        if spec is None:  # a module put into sys.modules by hand
            return getattr(module, "__file__", None) or f"a module made by hand, '{name}'"
    else:
        finders = (one.find_spec(name, None) for one in sys.meta_path if one is not _FINDER)
        spec = next(filter(None, finders), None)
    if spec is None:
        return None
    folders = spec.submodule_search_locations
    return str(next(iter(folders))) if folders else spec.origin


def ensure_kernel_cache() -> None:
    """Name a temporary folder for compiled kernels if numba would find no other; workers inherit it."""
    if not os.environ.get(CACHE_VARIABLE) and not is_writable(_PACKAGE) and not is_writable(user_cache()):
        os.environ[CACHE_VARIABLE] = str(_private_folder())


def kernel_cache() -> tuple[Path, bool]:
    """Where kernels are kept, and whether they stay there."""
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(given), not Path(given).is_relative_to(tempfile.gettempdir())
    return (_PACKAGE, True) if is_writable(_PACKAGE) else (user_cache(), True)


def user_cache() -> Path:
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


def _private_folder() -> Path:
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
