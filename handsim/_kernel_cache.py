"""Where compiled kernels are kept: beside their files, else in the user's cache, else in a temporary folder.

numba refuses to import a kernel that it can keep nowhere, as in a read-only installation without a home.
"""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path
from typing import Final

VARIABLE: Final = "NUMBA_CACHE_DIR"
_PACKAGE: Final = Path(__file__).parent


def ensure_kernel_cache() -> None:
    """Name a temporary folder for compiled kernels if numba would find no other; workers inherit it."""
    if not os.environ.get(VARIABLE) and not _is_writable(_PACKAGE) and not _is_writable(_user_cache()):
        os.environ[VARIABLE] = str(_own_folder())


def kernel_cache() -> tuple[Path, bool]:
    """Where kernels are kept, and whether they stay there."""
    given = os.environ.get(VARIABLE)
    if given:
        return Path(given), not Path(given).is_relative_to(tempfile.gettempdir())
    return (_PACKAGE, True) if _is_writable(_PACKAGE) else (_user_cache(), True)


def _user_cache() -> Path:
    """The folder of a user's caches, as numba looks for it."""
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))


def _is_writable(folder: Path) -> bool:
    """Whether files can be made in a folder, or in the first of its parents that exists."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


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
