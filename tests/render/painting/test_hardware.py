from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from render.painting import hardware
from render.painting.hardware import is_hardware, opengl_has_hardware

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("renderer", "expected"),
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", False),
        ("softpipe", False),
        ("Software Rasterizer", False),
        ("SWRAST", False),
        ("", False),
        ("NVIDIA H200/PCIe/SSE2", True),
        ("Mesa Intel(R) UHD Graphics 620 (KBL GT2)", True),
        ("AMD Radeon Graphics (radeonsi, navi33)", True),
    ],
)
def test_renderers_of_hardware(renderer: str, expected: bool) -> None:
    assert is_hardware(renderer) is expected


@pytest.mark.parametrize("error", [OSError("no libEGL"), subprocess.TimeoutExpired("python", 60.0)])
def test_a_failing_check_means_no_hardware(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> bool:
        raise error

    monkeypatch.setattr(hardware, "_some_hardware_device", fail)
    assert opengl_has_hardware.__wrapped__() is False


def test_a_device_without_a_working_driver_is_not_hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hardware, "_some_hardware_device", lambda: True)
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    monkeypatch.setenv("EGL_DEVICE_ID", "4711")
    assert opengl_has_hardware.__wrapped__() is False


def test_the_check_loads_no_gl() -> None:
    code = (
        "import sys\nfrom render.painting.painter import choose_painter\n"
        "assert choose_painter('auto') in ('compiled', 'opengl')\n"
        "print(sorted({'pyrender', 'OpenGL'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout == "[]\n"
