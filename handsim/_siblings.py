"""Watches over the five generic import names that handsim shares with the whole world.

`train`, `render` and their like are names that anybody may give to a script. When one of them leads
elsewhere, Python fails deep inside handsim with a sentence that helps nobody, so this warning comes first.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import warnings
from typing import Final

SIBLINGS: Final = ("poses", "gloves", "render", "train", "track")
_HOME: Final = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


class ShadowedPackageWarning(UserWarning):
    """Another file or package answers to an import name that handsim needs."""


def shadowed_siblings(home: str = _HOME) -> dict[str, str]:
    """Where each sibling leads that does not lie in `home`, the folder that holds `handsim`."""
    strangers = {}
    for name in SIBLINGS:
        place = _place(name)
        if place is not None and not _same(place, os.path.join(home, name)):
            strangers[name] = place
    return strangers


def warn_if_shadowed() -> None:
    """Warn once for each sibling that leads elsewhere; naming only, nothing is imported."""
    for name, place in shadowed_siblings().items():
        warnings.warn(
            f"handsim needs its own package '{name}', but `import {name}` finds {place}; rename that, "
            "or keep it off the path (python -P leaves out the script's folder)",
            ShadowedPackageWarning,
            stacklevel=3,
        )


def _place(name: str) -> str | None:
    """Folder of a package or file of a module, without importing it; None when there is none."""
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # a module put into sys.modules by hand carries no spec
        return getattr(sys.modules.get(name), "__file__", None) or f"a module made by hand, '{name}'"
    if spec is None:
        return None
    if spec.submodule_search_locations:
        return str(next(iter(spec.submodule_search_locations)))
    return spec.origin


def _same(first: str, second: str) -> bool:
    return os.path.normcase(os.path.realpath(first)) == os.path.normcase(os.path.realpath(second))
