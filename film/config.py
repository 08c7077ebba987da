"""`FilmConfig`: what is written of a video."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from render.config import FrameConfig


@dataclass(frozen=True, slots=True)
class FilmConfig(FrameConfig):
    """What is written of a video, whose hands wear gloves when nothing else is said.

    Raises:
        ArgumentError: A pass is unknown, or a number is out of range.
    """

    noun: ClassVar[str] = "setting of a video's pictures"

    dress: Literal["skin", "glove"] = "glove"
    """What the hands in the video wear: the marker glove, or nothing."""
