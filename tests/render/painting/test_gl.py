from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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
