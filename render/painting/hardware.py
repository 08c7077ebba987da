"""Whether OpenGL draws on graphics hardware here; the answer is quick and never an error."""

from __future__ import annotations

import ctypes
import functools
import os
import subprocess
import sys
from typing import Final

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
