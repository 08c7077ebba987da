"""Import of pyrender with EGL, and one off-screen renderer per process."""

from __future__ import annotations

import functools
import os
from typing import Any

from handsim._extras import EGL_PACKAGES
from handsim.errors import HandSimError

_BROKEN_PYRENDER = "0.1.45"  # cannot draw beside NumPy 2 on Python 3.12 and later


def load_pyrender() -> Any:
    """The pyrender module, which draws without a screen unless PYOPENGL_PLATFORM asks for something else.

    Raises:
        HandSimError: pyrender is missing or broken, or there is no OpenGL driver.
    """
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    try:
        import pyrender
    except ModuleNotFoundError as error:
        raise HandSimError(
            f"drawing needs pyrender, and {error}; run `pip install pyrender-maintained`"
        ) from error
    except Exception as error:  # PyOpenGL raises errors of many types
        raise _no_driver(error) from error
    if pyrender.__version__ == _BROKEN_PYRENDER:
        raise HandSimError(
            f"pyrender {_BROKEN_PYRENDER} cannot draw beside today's NumPy; run "
            "`pip uninstall pyrender pyrender-maintained`, then `pip install pyrender-maintained`"
        )
    return pyrender


def offscreen_renderer(width: int, height: int) -> Any:
    """This process's renderer, set to a picture size [px].

    EGL contexts fail when they are made again and again, so there is one, kept until the process ends.

    Raises:
        HandSimError: There is no OpenGL driver, or the size is out of range.
    """
    if not (1 <= width <= 8192 and 1 <= height <= 8192):
        raise HandSimError(f"picture size is {width} x {height}, expected 1 to 8192 pixels each way")
    renderer = _renderer_of(os.getpid())  # a context does not survive a fork
    renderer.viewport_width, renderer.viewport_height = width, height
    return renderer


@functools.cache
def _renderer_of(_process: int) -> Any:
    pyrender = load_pyrender()
    try:
        return pyrender.OffscreenRenderer(64, 64)
    except Exception as error:  # PyOpenGL raises errors of many types
        raise _no_driver(error) from error


def _no_driver(error: Exception) -> HandSimError:
    reason = " ".join(str(error).split())[:120] or type(error).__name__
    platform = os.environ["PYOPENGL_PLATFORM"]
    return HandSimError(
        f"drawing without a screen failed ({platform}: {reason}); run `apt-get install {EGL_PACKAGES}` as "
        "root or install your system's counterparts"
    )
