"""A recording as a video file, drawn without a browser."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from track.viewer.point_balls import GHOST_COLOR, label_colors
from track.viewer.recordings import Recording

_RATE: Final = 30.0  # [Hz] at most


def write_video(
    path: Path,
    recording: Recording,
    shown: Float[np.ndarray, "N 3"],
    *,
    write_clip: Callable[..., None],
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Write what a recording shows, at its own pace, with points in the colors of the viewer.

    Args:
        path: The file, .mp4.
        shown: Points [m] that the view holds.
        write_clip: What draws and encodes the pictures, `render.illustrations.write_clip`.
        progress: Called after each picture with the number of pictures and of all.

    Returns:
        The number of pictures.

    Raises:
        ArgumentError: The file's name ends otherwise.
        FileError: It cannot be written.
    """
    rate, frames = chosen_frames(recording.times)
    palette = np.concatenate([label_colors(recording.label_names), np.array([GHOST_COLOR])]) / 255.0

    def pictures() -> Iterator[tuple[Any, ...]]:
        for number, index in enumerate(frames, start=1):
            frame = recording.frame(index)
            hands = list(zip(frame.hands, frame.qpos, strict=True))
            points, labels = frame.points[frame.seen], frame.labels[frame.seen]
            yield hands, points, palette[labels], f"frame {index}, {frame.time:.2f} s"
            if progress is not None:
                progress(number, len(frames))

    there = shown[np.isfinite(shown).all(axis=1)]
    write_clip(path, pictures(), rate=rate, shown=there, radius=recording.radius)
    return len(frames)


def chosen_frames(times: Float[np.ndarray, "T"]) -> tuple[float, list[int]]:
    """The rate of a video [Hz], and the frame of each of its pictures: the last one up to its time.

    Args:
        times: Time of each frame [s], increasing.
    """
    if len(times) < 2:
        return _RATE, [0]
    rate = min(_RATE, 1.0 / float(np.median(np.diff(times))))
    count = int(np.floor((times[-1] - times[0]) * rate + 1e-6)) + 1
    moments: NDArray[np.float64] = times[0] + np.arange(count) / rate
    frames = np.searchsorted(times, moments + 1e-6, side="right") - 1
    return rate, [int(frame) for frame in frames]
