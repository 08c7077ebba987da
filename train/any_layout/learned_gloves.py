"""Labelers of gloves that the network for any layout has learned, kept in the user's cache folder.

A labeler is kept under a digest of all that decides it: the layout, the cameras, the shipped weights and the
version. The least recently used ones go when there are too many.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gloves.layout import MarkerLayout
from handsim._version import __version__
from handsim.errors import WeightsError
from handsim.files.atomic import atomic_write
from handsim.files.inputs import checksum
from handsim.space.cameras import CameraRig, as_rig
from train.any_layout.fine_tuning import fine_tuned_labeler
from train.any_layout.layout_labeler import SHIPPED, WEIGHTS, LayoutLabeler
from train.labelers.storage import LEARNED, learned_folder, learned_gloves

MOST: Final = 32
"""Labelers that are kept; one takes about four megabytes."""


def is_learned(layout: MarkerLayout, rig: CameraRig | str = "figure5") -> bool:
    """Whether a glove was learned before."""
    return _file_of(layout, rig).exists()


def learned_labeler(layout: MarkerLayout, rig: CameraRig | str = "figure5") -> LayoutLabeler:
    """The labeler of a glove, learned within a minute the first time and read within a second from then on.

    Args:
        layout: The glove.
        rig: Cameras that see it while it is learned.

    Raises:
        LayoutError: A marker misses the skin.
    """
    file = _file_of(layout, rig)
    found = _read(file, layout)
    if found is not None:
        return found
    learned = fine_tuned_labeler(layout, rig)
    try:
        _write(file, learned)
    except OSError:
        return learned  # a cache that cannot be written costs time, no labels
    return _read(file, layout) or learned


def _file_of(layout: MarkerLayout, rig: CameraRig | str) -> Path:
    return learned_folder() / f"{_digest(layout, rig)}{LEARNED}"


@functools.lru_cache(maxsize=MOST)
def _digest(layout: MarkerLayout, rig: CameraRig | str) -> str:
    """Of all that decides a labeler."""
    decides = {
        "layout": dataclasses.asdict(layout),
        "rig": as_rig(rig).record(),
        "weights": checksum(SHIPPED / WEIGHTS),
        "version": __version__,
    }
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:32]


def _read(file: Path, layout: MarkerLayout) -> LayoutLabeler | None:
    """A kept labeler; None where there is none, or a damaged one, which is removed."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        stored = file.read_bytes()
    except OSError:
        return None
    try:
        labeler = LayoutLabeler.of_tensors(layout, load(stored))
        os.utime(file)
    except (OSError, SafetensorError, WeightsError):
        file.unlink(missing_ok=True)
        return None
    return labeler


def _write(file: Path, labeler: LayoutLabeler) -> None:
    from safetensors.numpy import save

    tensors: dict[str, NDArray[np.generic]] = labeler.tensors()
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(file) as temporary:
        temporary.write_bytes(save(dict(tensors)))
    for old in learned_gloves()[MOST:]:
        old.unlink(missing_ok=True)
