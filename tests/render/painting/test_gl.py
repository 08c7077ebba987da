"""OpenGL on this machine: one renderer, sentences where it fails, and whether hardware draws."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from render.painting import gl
from render.painting.gl import is_hardware

ROOT = Path(__file__).resolve().parents[3]


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, **environment},
        check=False,
    )


def test_no_driver_is_one_sentence_that_names_the_packages() -> None:
    code = (
        "from handsim.errors import HandSimError\n"
        "from render.painting.gl import offscreen_renderer\n"
        "try:\n    offscreen_renderer(8, 8)\n"
        "except HandSimError as error:\n    print(error)"
    )
    # A device that no machine has stands in for a missing driver.
    result = python(code, PYOPENGL_PLATFORM="egl", EGL_DEVICE_ID="4711")
    assert result.stdout.startswith("drawing without a screen failed (egl: "), result
    assert "apt-get install libegl1" in result.stdout
    assert result.stdout.count("\n") == 1


def test_one_renderer_a_process() -> None:
    code = (
        "from render.painting.gl import offscreen_renderer as r\n"
        "from handsim.errors import HandSimError\n"
        "try:\n    print(r(8, 8) is r(16, 9))\n"
        "except HandSimError:\n    print(True)"
    )
    assert python(code).stdout == "True\n"


def test_glove_commands_that_draw_nothing_load_no_gl() -> None:
    code = (
        "import sys\nfrom handsim.cli.main import main\n"
        "main(['glove', 'list']); main(['glove', 'show', 'dense19'])\n"
        "print(sorted({'pyrender', 'OpenGL', 'torch', 'cv2'} & set(sys.modules)), file=sys.stderr)"
    )
    assert python(code).stderr == "[]\n"


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

    monkeypatch.setattr(gl, "_some_hardware_device", fail)
    assert gl.opengl_has_hardware.__wrapped__() is False


def test_a_device_without_a_working_driver_is_not_hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gl, "_some_hardware_device", lambda: True)
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    monkeypatch.setenv("EGL_DEVICE_ID", "4711")
    assert gl.opengl_has_hardware.__wrapped__() is False


def test_the_check_loads_no_gl() -> None:
    code = (
        "import sys\nfrom render.painting.painter import choose_painter\n"
        "assert choose_painter('auto') in ('compiled', 'opengl')\n"
        "print(sorted({'pyrender', 'OpenGL'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout == "[]\n"
