"""OpenGL on this machine: pyrender with EGL, one off-screen renderer per process, and what it draws on."""

from __future__ import annotations

import ctypes
import functools
import os
import subprocess
import sys
from typing import Any, Final

from handsim._plugins import EGL_PACKAGES
from handsim.errors import HandSimError

_BROKEN_PYRENDER = "0.1.45"  # cannot draw beside NumPy 2 on Python 3.12 and later
_EGL_EXTENSIONS: Final = 0x3055
_MOST_DEVICES: Final = 32
_SECONDS: Final = 60.0  # a first start of pyrender from a slow disk takes some seconds
_SOFTWARE: Final = ("llvmpipe", "softpipe", "swrast", "software", "swiftshader")
_NAME_OF_RENDERER: Final = (
    "from render.painting.gl import offscreen_renderer\n"
    "offscreen_renderer(16, 16)\n"
    "from OpenGL.GL import GL_RENDERER, glGetString\n"
    "print('GL_RENDERER', glGetString(GL_RENDERER).decode())\n"
)


def load_pyrender() -> Any:
    """The pyrender module, which draws without a screen unless PYOPENGL_PLATFORM asks for something else."""
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


@functools.cache
def opengl_has_hardware() -> bool:
    """Whether `render.painting.opengl_painter` would draw on hardware; False where anything fails.

    A list of EGL's devices rules out most machines without hardware within milliseconds. Where there is such
    a device, another process starts OpenGL and reports its renderer, so that a broken driver cannot end this
    process.
    """
    try:
        return _some_hardware_device() and is_hardware(_renderer_name())
    except Exception:  # drivers fail in many ways; our own painter always works
        return False


def is_hardware(renderer: str) -> bool:
    """Whether a string of `GL_RENDERER` names hardware; an empty one does not."""
    name = renderer.lower()
    return bool(name) and not any(software in name for software in _SOFTWARE)


def _some_hardware_device() -> bool:
    """Whether EGL lists a device that is not Mesa's software rasterizer."""
    if os.environ.get("PYOPENGL_PLATFORM", "egl") != "egl":
        return True  # the user's own platform: only its renderer can tell
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    list_devices = ctypes.CFUNCTYPE(
        ctypes.c_uint, ctypes.c_int, ctypes.POINTER(ctypes.c_void_p), ctypes.POINTER(ctypes.c_int)
    )(egl.eglGetProcAddress(b"eglQueryDevicesEXT"))
    device_string = ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int)(
        egl.eglGetProcAddress(b"eglQueryDeviceStringEXT")
    )
    devices, count = (ctypes.c_void_p * _MOST_DEVICES)(), ctypes.c_int(0)
    if not list_devices(_MOST_DEVICES, devices, ctypes.byref(count)):
        return False
    extensions = (device_string(device, _EGL_EXTENSIONS) or b"" for device in devices[: count.value])
    return any(b"EGL_MESA_device_software" not in names.split() for names in extensions)


def _renderer_name() -> str:
    """`GL_RENDERER` of a new process, empty where OpenGL does not start."""
    done = subprocess.run(
        [sys.executable, "-c", _NAME_OF_RENDERER],
        capture_output=True,
        text=True,
        timeout=_SECONDS,
        check=False,
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("GL_RENDERER ")]
    return lines[-1].removeprefix("GL_RENDERER ") if done.returncode == 0 and lines else ""
