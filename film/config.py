"""What is written of a video when nothing else is said."""

from __future__ import annotations

from typing import Final

from render.config import FrameConfig

FILM_DEFAULTS: Final = FrameConfig(dress="glove")
"""All passes of all frames that fit, of hands in gloves."""
