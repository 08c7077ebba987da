"""Packages that `pip install handsim` leaves out, imported when something needs them."""

from __future__ import annotations

import importlib
from typing import Any, Final

from handsim.errors import ArgumentError

EGL_PACKAGES: Final = "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1 libopengl0"
"""What drawing through OpenGL without a screen needs of Debian and Ubuntu, which pip cannot install."""


def import_extra(module: str, what: str, extra: str) -> Any:
    """A module of an optional package, for something (`what`, in messages) that needs it."""
    try:
        return importlib.import_module(module)
    except (ImportError, RuntimeError) as error:  # pylsl raises the latter without its library
        raise ArgumentError(
            f"{what} needs the package {module.partition('.')[0]}, which cannot be imported "
            f"({' '.join(str(error).split())}); run `pip install 'handsim[{extra}]'`"
        ) from error
