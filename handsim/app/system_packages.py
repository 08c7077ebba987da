"""System packages that pip cannot install, by their names on Debian and Ubuntu."""

from __future__ import annotations

from typing import Final

EGL_PACKAGES: Final = "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1 libopengl0"
"""What drawing through OpenGL without a screen needs."""
