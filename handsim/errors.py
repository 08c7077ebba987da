"""What a user can get wrong, each told in one sentence.

Every message names what was given, what was wanted and, where there is a list, the valid names.
The command line prints the message alone and exits with code 1.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class HandSimError(Exception):
    """Root of every error that handsim raises on purpose."""


class ArgumentError(HandSimError):
    """A hand, a pose or an array that is not what it should be."""


class PoseError(HandSimError):
    """A pose, grasp, touch or path that a hand cannot reach."""


class LayoutError(HandSimError):
    """A marker layout that cannot be worn."""


class CaptureError(HandSimError):
    """A marker file that cannot be read or written."""


class DatasetError(HandSimError):
    """A training set that is damaged, unfinished or made for something else."""


class WeightsError(HandSimError):
    """A labeler's weights that are damaged or belong to another layout."""


def choices(given: str, valid: Iterable[str], *, noun: str) -> str:
    """Sentence for an unknown name: what was given, the nearest valid name, and all valid names."""
    names = list(valid)
    near = difflib.get_close_matches(given, names, n=1)
    hint = f" (did you mean '{near[0]}'?)" if near else ""
    return f"unknown {noun} '{given}'{hint}; valid names: {', '.join(names)}"
