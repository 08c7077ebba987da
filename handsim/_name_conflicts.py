"""A warning when one of the five generic import names leads to another file or package than ours.

A user may well call a script `train.py` or `render.py`. Python then fails deep inside handsim with a message
that does not name the cause, so this warning comes first.
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
    """Another file or package has an import name that handsim needs."""


def shadowed_siblings(home: str = _HOME) -> dict[str, str]:
    """Where each sibling leads that does not lie in `home`, the folder that holds `handsim`."""
    found = {name: _location(name) for name in SIBLINGS}
    own = {name: os.path.realpath(os.path.join(home, name)) for name in SIBLINGS}
    return {name: place for name, place in found.items() if place and os.path.realpath(place) != own[name]}


def warn_if_shadowed() -> None:
    """Warn once for each sibling that leads elsewhere; nothing is imported."""
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
