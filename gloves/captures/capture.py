"""What a marker file holds: named trajectories at a rate; and the choice of a format by suffix."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from handsim.errors import CaptureError, choices
from handsim.io import atomic_write

if TYPE_CHECKING:
    from jaxtyping import Float

READABLE: Final = (".trc", ".c3d", ".csv")
WRITABLE: Final = (".trc", ".c3d")


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Trajectories of a marker file: at least one frame and one trajectory.

    Raises:
        CaptureError: The arrays do not fit together, a position is infinite, or the rate is no rate.
    """

    names: tuple[str, ...]
    """One name a trajectory, never empty; may say nothing about the marker ("*12", "Unlabeled 2379")."""
    positions: Float[np.ndarray, "T N 3"]
    """Positions [m] in the file's axes; NaN, always in all three coordinates, where a marker was not seen."""
    rate: float
    """Frames a second [Hz]."""

    def __post_init__(self) -> None:
        positions = np.array(self.positions, dtype=np.float64)  # a copy: the next lines change it
        if positions.ndim != 3 or positions.shape[1:] != (len(self.names), 3):
            raise CaptureError(
                f"positions have shape {positions.shape}, wanted (T, {len(self.names)}, 3) for "
                f"{len(self.names)} names"
            )
        if 0 in positions.shape:
            raise CaptureError(
                f"a capture needs at least one frame and one marker, got {len(positions)} frames of "
                f"{len(self.names)} markers"
            )
        if np.isinf(positions).any():
            raise CaptureError("positions hold infinite values, wanted finite numbers or NaN")
        if not 0.0 < self.rate < np.inf:
            raise CaptureError(f"the rate is {self.rate:g} Hz, wanted a positive number")
        positions[np.isnan(positions).any(axis=-1)] = np.nan  # two coordinates do not make a point
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "rate", float(self.rate))

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.positions)


def read_capture(path: str | Path) -> Capture:
    """Read a `.trc`, `.c3d` or Motive `.csv` file.

    Raises:
        CaptureError: The suffix is unknown, the file is missing, cut or damaged, or its units are unknown.
    """
    # Here and below: the formats import `Capture` from this module.
    from gloves.captures.c3d import read_c3d
    from gloves.captures.motive_csv import read_motive_csv
    from gloves.captures.trc import read_trc

    path = Path(path)
    check_suffix(path, READABLE)
    readers = dict(zip(READABLE, (read_trc, read_c3d, read_motive_csv), strict=True))
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror}") from error
    if not data:
        raise CaptureError(f"{path}: the file is empty")
    try:
        return readers[path.suffix.lower()](data)
    except CaptureError as error:
        raise CaptureError(f"{path}: {error}") from error


def write_capture(path: str | Path, capture: Capture) -> None:
    """Write a `.trc` or `.c3d` file in millimetres, whole or not at all.

    A TRC keeps positions to 5e-9 m; a C3D keeps single precision (6e-8 of the value).

    Raises:
        CaptureError: The suffix is unknown, a name cannot stand in the file, or the disk says no.
    """
    from gloves.captures.c3d import write_c3d
    from gloves.captures.trc import write_trc

    path = Path(path)
    check_suffix(path, WRITABLE)
    for name in capture.names:
        if not name or name != name.strip() or not name.isprintable():
            raise CaptureError(
                f"{path}: marker name {name!r} cannot be written; wanted printable characters without tabs, "
                "line ends or outer blanks"
            )
    try:
        with atomic_write(path) as temporary:
            if path.suffix.lower() == ".trc":
                write_trc(temporary, capture, title=path.name)
            else:
                write_c3d(temporary, capture)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be written: {error.strerror or error}") from error
    except CaptureError as error:
        raise CaptureError(f"{path}: {error}") from error


def check_suffix(path: Path, valid: tuple[str, ...]) -> None:
    """Raise a `CaptureError` with the valid suffixes unless the path has one of them."""
    if path.suffix.lower() not in valid:
        raise CaptureError(f"{path}: {choices(path.suffix, valid, noun='file type')}")
