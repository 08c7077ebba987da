"""`Film`, a video file, and its pictures in the place of drawn ones."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from jaxtyping import Float

from handsim._checks import check_type
from handsim.errors import CaptureError
from handsim.files.inputs import check_regular
from handsim.files.outputs import plain_path
from handsim.space.camera import Camera, Lens
from render.frames import Bytes, Floats
from render.photographs import quiet_decoder

_USUAL_RATE: Final = 30.0  # [Hz] of a video that does not tell its own
_MOST_FRAMES: Final = 1 << 20


class Film:
    """A video file, read frame by frame, as it is or without the lens of its camera.

    Raises:
        CaptureError: The file is missing, or no video that OpenCV reads.
    """

    def __init__(self, path: str | Path, lens_of: Camera | None = None) -> None:
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
        """As the file tells it, which may be wrong."""
        Camera("film", self.size, np.diag([1.0, 1.0, 1.0]))  # refuses pictures that are too large
        self._maps = None if lens_of is None else straightening(lens_of)

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
        if self._maps is not None:
            picture = cv2.remap(picture, self._maps, None, cv2.INTER_LINEAR)
        return time, np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))

    def picture(self, number: int) -> Bytes:
        """The picture (sRGB) of a frame that the video has."""
        frame = self.frame(number)
        if frame is None:
            raise CaptureError(f"{self.path}: frame {number} cannot be read; was the file changed?")
        return frame[1]


def straightening(camera: Camera) -> Floats:
    """Where `cv2.remap` finds the pixels (H, W, 2) of a pinhole camera in a camera's picture."""
    bent = camera.at(np.eye(4))
    return np.asarray(bent.project(straight(bent).rays()) - 0.5, dtype=np.float32)


def straight(camera: Camera) -> Camera:
    """The camera without its lens."""
    return dataclasses.replace(camera, lens=Lens())


@dataclass(frozen=True, slots=True, eq=False)
class FilmPictures:
    """The pictures of a video in the place of drawn ones, by the numbers of its frames."""

    path: Path
    poses: Float[np.ndarray, "T 4 4"]
    """Pose of the camera in each frame [m]."""
    lens_of: Camera | None = None
    """The camera whose pictures are wanted without its lens; None for pictures as they are."""
