"""The errors that handsim raises on purpose: one class for each kind of mistake.

Every message is one sentence with what was given, what was expected and, where there is a list, the valid
names. The command line prints the message alone and exits with code 1.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Final

MAX_MESSAGE_LENGTH: Final = 500
"""Largest number of characters of a message."""


def shortened(text: str, most: int = 40) -> str:
    """A text that a sentence quotes from a file or an argument: its beginning and end, where it is long."""
    if len(text) <= most:
        return text
    end = most // 3
    return f"{text[: most - end - 3]}...{text[-end:]}"


class HandSimError(Exception):
    """Root of every error that handsim raises on purpose; its sentence has a bounded length."""

    def __str__(self) -> str:
        return shortened(super().__str__(), MAX_MESSAGE_LENGTH)


DAMAGE: Final = (
    HandSimError, ValueError, LookupError, TypeError, AttributeError, OverflowError, RuntimeError,
    SyntaxError,
)  # fmt: skip
"""Exceptions that reading the content of a damaged file may raise."""


class HandSimWarning(UserWarning):
    """Something in the data that is probably not what the user meant; the work goes on."""

    def __str__(self) -> str:
        return shortened(super().__str__(), MAX_MESSAGE_LENGTH)


class ArgumentError(HandSimError):
    """An argument of the wrong shape, range or name: a mistake in the call, which handsim never catches."""


class PoseError(HandSimError):
    """A pose, grasp, touch or path that a hand cannot reach."""


class CalibrationError(HandSimError):
    """A capture that does not determine what is calibrated from it."""


class FileError(HandSimError):
    """A file that cannot be read, used or written, or content that no such file may hold."""


class LayoutError(FileError):
    """A marker layout that cannot be read, or whose markers cannot be worn on a hand."""


class RigError(FileError):
    """A camera rig that cannot be read, or whose cameras cannot be set up as stated."""


class ObjectError(FileError):
    """A mesh file that is not an object which a hand can hold."""


class CaptureError(FileError):
    """A marker file or a take that cannot be read or written."""


class DatasetError(FileError):
    """A training set that is damaged, unfinished or made for something else."""


class WeightsError(FileError):
    """A labeler's weights that are damaged or belong to another layout."""


def choices(given: str, valid: Iterable[str], *, noun: str) -> str:
    """Sentence for an unknown name: what was given, the nearest valid name, and all valid names."""
    names = list(valid)
    given = shortened(given, 120)
    near = difflib.get_close_matches(given, names, n=1)
    if not near and given.strip("-"):  # one letter: of another case, or of an option
        near = [one for one in names if one.lower() == given.lower() or one.startswith(f"-{given}")]
    hint = f" (did you mean '{near[0]}'?)" if near else ""
    return f"unknown {noun} '{given}'{hint}; valid names: {', '.join(names)}"


@contextmanager
def errors_of(owner: object, kind: type[HandSimError]) -> Iterator[None]:
    """Within the block an error of ours becomes one of this kind, whose sentence begins with its owner."""
    try:
        yield
    except HandSimError as error:
        raise kind(f"{owner}: {error}") from error
