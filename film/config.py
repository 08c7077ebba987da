"""Default settings of the photographs that are made of a video."""

from __future__ import annotations

from typing import Final

from render.config import FrameConfig

FILM_DEFAULTS: Final = FrameConfig(dress="glove")
"""All passes of all frames that fit, with hands in gloves."""
