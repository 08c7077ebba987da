"""Many captures as one stack of labeled frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gloves.captures.formats import READABLE, read_capture
from gloves.captures.markers import select_hands
from handsim.errors import CaptureError


def find_captures(paths: Sequence[Path]) -> list[Path]:
    """The capture files among paths, folders searched through.

    Raises:
        CaptureError: There is none, or a folder holds none.
    """
    files = []
    for path in paths:
        inside = (
            sorted(file for file in path.rglob("*") if file.suffix.lower() in READABLE)
            if path.is_dir()
            else [path]
        )
        if not inside:
            raise CaptureError(f"{path} holds no capture; expected files {', '.join(READABLE)}")
        files += inside
    if not files:
        raise CaptureError("no capture was given; expected files or folders")
    return files


def read_markers(files: Sequence[Path], names: Sequence[str]) -> Float[np.ndarray, "T M 3"]:
    """The named markers of labeled captures [m], NaN where missing, hand by hand; no frames without any.

    Raises:
        CaptureError: A file cannot be read or lacks a marker; the file is named.
    """
    markers = np.concatenate([_markers_of(file, names) for file in files])
    shown: Float[np.ndarray, "T M 3"] = markers[np.isfinite(markers).any(axis=(1, 2))]
    return shown


def _markers_of(file: Path, names: Sequence[str]) -> Float[np.ndarray, "T M 3"]:
    try:
        return np.concatenate(select_hands(read_capture(file), names))
    except CaptureError as error:
        text = str(error)
        raise CaptureError(text if text.startswith(str(file)) else f"{file}: {text}") from error
