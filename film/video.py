"""`Film` reads a video file; `FilmFootage` gives its pictures to `render` in place of drawn ones."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from jaxtyping import Float

from handsim._checks import check_type
from handsim.errors import CaptureError
from handsim.files.inputs import check_regular
from handsim.files.outputs import plain_path
from handsim.space.camera import Camera
from render.frames import Bytes
from render.photographs import quiet_decoder

_USUAL_RATE: Final = 30.0  # [Hz] frame rate of a video whose file states none
_MOST_FRAMES: Final = 1 << 20


class Film:
    """A video file, read frame by frame; a copy in another process opens the file itself.

    Raises:
        CaptureError: The file is missing, or no video that OpenCV reads.
    """

    def __init__(self, path: str | Path) -> None:
        check_type("video", path, (str, os.PathLike), "the path of a video")
        self.path = Path(path)
        check_regular(self.path, error=CaptureError)
        self._open()
        width, height, rate, count = (
            self._reader.get(which)
            for which in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS,
                          cv2.CAP_PROP_FRAME_COUNT)
        )  # fmt: skip
        self.size = int(width), int(height)
        self.rate = rate if 0.0 < rate < 1e4 else _USUAL_RATE
        self.num_frames = int(min(max(count, 0), _MOST_FRAMES))
        """Number of frames that the file states, which may be wrong."""
        Camera("film", self.size, np.diag([1.0, 1.0, 1.0]))  # refuses pictures that are too large

    def __reduce__(self) -> tuple[type[Film], tuple[Path]]:
        return Film, (self.path.absolute(),)

    def _open(self) -> None:
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # Quiet: the error below says enough.
        with quiet_decoder(), plain_path(self.path) as plain:
            self._reader, self._next = cv2.VideoCapture(str(plain), cv2.CAP_FFMPEG), 0
        if not self._reader.isOpened():
            why = "not a video that can be read, expected an .mp4, .mov or .avi file"
            raise CaptureError(f"{self.path}: {why if self.path.exists() else 'no such file'}")

    def frames(self) -> Iterator[tuple[float, Bytes]]:
        """Time [s] and picture (sRGB) of every frame."""
        for number in range(_MOST_FRAMES):
            frame = self.frame(number)
            if frame is None:
                return
            yield frame
        raise CaptureError(f"{self.path}: more than {_MOST_FRAMES} frames, expected a shorter video")

    def frame(self, number: int) -> tuple[float, Bytes] | None:
        """Time [s] and picture (sRGB) of a frame, None after the last one; reading forward is fast."""
        if number < self._next:
            self._open()
        while self._next <= number:
            if not self._reader.grab():
                return None
            self._next += 1
        done, picture = self._reader.retrieve()
        if not done or picture.shape[1::-1] != self.size:
            raise CaptureError(f"{self.path}: a frame is damaged, or of another size than {self.size}")
        time = 1e-3 * float(self._reader.get(cv2.CAP_PROP_POS_MSEC))
        return time, np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))

    def picture(self, number: int) -> Bytes:
        """The picture (sRGB) of a frame that the video has."""
        frame = self.frame(number)
        if frame is None:
            raise CaptureError(f"{self.path}: frame {number} cannot be read; was the file changed?")
        return frame[1]


@dataclass(frozen=True, slots=True, eq=False)
class FilmFootage:
    """The pictures of a video, which replace drawn colors; see `render.frames.Footage`."""

    film: Film
    poses: Float[np.ndarray, "T 4 4"]
    """Pose of the camera in each frame [m]."""

    @property
    def record(self) -> dict[str, Any]:
        """The origin of the pictures, as JSON."""
        return {"film": self.film.path.name}

    def picture(self, frame: int) -> Bytes:
        """The picture (sRGB) of a frame."""
        return self.film.picture(frame)
