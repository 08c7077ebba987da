"""Named hand shapes: joint angles written by us, in `data/gestures.json`."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Final

import numpy as np

from handsim.errors import ShapeError, choices

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy.typing import NDArray

_SPREAD: Final = np.array([12.0, 2.0, -8.0, -18.0])  # [deg] index to little, positive towards the thumb


@cache
def _library() -> dict[str, NDArray[np.float64]]:
    text = resources.files("poses").joinpath("data/gestures.json").read_text(encoding="utf-8")
    data = json.loads(text)
    library: dict[str, NDArray[np.float64]] = {}
    for name, gesture in data["gestures"].items():
        fingers = np.array([data["fingers"][finger] for finger in gesture["fingers"]], dtype=np.float64)
        fingers[:, 0] += gesture.get("spread", 0.0) * _SPREAD
        thumb = np.array(data["thumbs"][gesture["thumb"]], dtype=np.float64)
        library[name] = np.deg2rad(np.concatenate([thumb, fingers.ravel()]))
    return library


def gesture_names() -> tuple[str, ...]:
    """Names of all gestures."""
    return tuple(_library())


def gesture(name: str) -> Float[np.ndarray, "20"]:
    """Hinge angles [rad] of a named gesture, in the order of `topology.JOINTS`."""
    library = _library()
    if name not in library:
        raise ShapeError(choices(name, library, noun="gesture"))
    return library[name].copy()


def all_gestures() -> Float[np.ndarray, "G 20"]:
    """Hinge angles [rad] of every gesture, in the order of `gesture_names`."""
    return np.stack(list(_library().values()))
