"""Named hand shapes: joint angles written by us, one file per library in `data`."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim._checks import check_choice
from handsim.errors import ArgumentError, choices
from handsim.files.json_files import package_data

LIBRARIES: Final = ("gestures", "fingerspelling", "numbers", "counting", "grasps", "pinches", "keys")
"""Names of all libraries; no two hold the same name."""
_SPREAD: Final = np.array([12.0, 2.0, -8.0, -18.0])  # [deg] index to little, positive towards the thumb


@cache
def _library(library: str) -> dict[str, NDArray[np.float64]]:
    check_choice(library, LIBRARIES, noun="library")
    data = package_data("poses", library)
    shapes = package_data("poses", "gestures")  # those of single digits serve all libraries
    gestures: dict[str, NDArray[np.float64]] = {}
    for name, entry in data["gestures"].items():
        fingers = np.array([_numbers(finger, shapes["fingers"]) for finger in entry["fingers"]])
        fingers[:, 0] += entry.get("spread", 0.0) * _SPREAD
        thumb = _numbers(entry["thumb"], shapes["thumbs"])
        gestures[name] = np.deg2rad(np.concatenate([thumb, fingers.ravel()]))
    return gestures


def _numbers(digit: str | list[float], shapes: dict[str, list[float]]) -> NDArray[np.float64]:
    """Four angles [deg] of a digit that is named or written out."""
    return np.array(shapes[digit] if isinstance(digit, str) else digit, dtype=np.float64)


def gesture_names(library: str = "gestures") -> tuple[str, ...]:
    """Names of all gestures of one library.

    Raises:
        ArgumentError: There is no such library.
    """
    return tuple(_library(library))


def gesture(name: str) -> Float[np.ndarray, "20"]:
    """Joint angles [rad] of a named gesture of any library, in the order of `topology.JOINTS`.

    Raises:
        ArgumentError: No library holds this name.
    """
    for library in LIBRARIES:
        if name in _library(library):
            return _library(library)[name].copy()
    names = [known for library in LIBRARIES for known in _library(library)]
    raise ArgumentError(choices(name, names, noun="gesture"))


def gestures_of(library: str) -> Float[np.ndarray, "G 20"]:
    """Joint angles [rad] of every gesture of one library, in the order of `gesture_names(library)`.

    Raises:
        ArgumentError: There is no such library.
    """
    return np.stack(list(_library(library).values()))


def load_gestures() -> dict[str, Float[np.ndarray, "20"]]:
    """Joint angles [rad] of every named gesture of all libraries, in the order of `topology.JOINTS`."""
    return {name: angles.copy() for library in LIBRARIES for name, angles in _library(library).items()}


def all_gestures() -> Float[np.ndarray, "G 20"]:
    """Joint angles [rad] of the gestures that random poses are blended from: the library "gestures".

    The other libraries are left out, so that a seed keeps giving the same training set.
    """
    return gestures_of("gestures")
