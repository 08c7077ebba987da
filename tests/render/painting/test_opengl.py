from __future__ import annotations

import subprocess

import numpy as np
import pytest

from handsim.space.transforms import frame_with_z
from render import SkinLook
from render.painting import opengl as gl
from render.painting.opengl import is_hardware
from render.scenery.lights import STUDIO, Lamp, Lighting
from render.skin.texture import skin_texture
from tests.programs import run_python
from tests.render.scenes import draw_back


def test_no_driver_is_one_sentence_that_names_the_packages() -> None:
    code = (
        "from handsim.errors import HandSimError\n"
        "from render.painting.opengl import offscreen_renderer\n"
        "try:\n    offscreen_renderer(8, 8)\n"
        "except HandSimError as error:\n    print(error)"
    )
    # A device that no machine has stands in for a missing driver.
    result = run_python(code, check=False, PYOPENGL_PLATFORM="egl", EGL_DEVICE_ID="4711")
    assert result.stdout.startswith("drawing without a screen failed (egl: "), result
    assert "apt-get install libegl1" in result.stdout
    assert result.stdout.count("\n") == 1


def test_one_renderer_a_process() -> None:
    code = (
        "from render.painting.opengl import offscreen_renderer as r\n"
        "from handsim.errors import HandSimError\n"
        "try:\n    print(r(8, 8) is r(16, 9))\n"
        "except HandSimError:\n    print(True)"
    )
    assert run_python(code).stdout == "True\n"


def test_what_draws_nothing_loads_no_gl():
    """Commands about gloves, and the look for hardware."""
    code = (
        "import sys\nfrom handsim.cli.main import main\n"
        "main(['glove', 'list']); main(['glove', 'show', 'dense19'])\n"
        "assert not {'pyrender', 'OpenGL', 'torch', 'cv2'} & set(sys.modules)\n"
        "from render.painting.painter import choose_painter\n"
        "assert choose_painter() in ('compiled', 'opengl')\n"
        "assert not {'pyrender', 'OpenGL'} & set(sys.modules)\n"
    )
    run_python(code)


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


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (1.0, -2.0, 0.5), (0.0, -3.0, 0.0)])
def test_frame_with_z(direction: tuple[float, float, float]) -> None:
    frame = frame_with_z(np.array(direction))
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(frame[:, 2], np.array(direction) / np.linalg.norm(direction), atol=1e-12)
    assert np.linalg.det(frame) > 0.0


def draw(lighting):
    return draw_back("right", skin_texture(SkinLook()), lighting, (200, 200))[0]


@pytest.mark.usefixtures("drawing")
def test_light_comes_from_where_it_is_told_in_its_color() -> None:
    dark = Lighting((), (0.0, 0.0, 0.0))
    hand = draw(STUDIO)[..., 3] == 255
    assert 2000 < hand.sum() < 20_000
    assert draw(dark)[hand, :3].max() == 0
    ahead = Lighting((Lamp((0.0, 0.0, -1.0), 1.0, (1.0, 0.0, 0.0)),), (0.0, 0.0, 0.0))
    red = draw(ahead)[hand].mean(axis=0)
    assert red[0] > 100.0
    assert red[1:3].max() == 0.0
    behind = Lighting((Lamp((0.0, 0.0, 1.0), 1.0),), (0.0, 0.0, 0.0))
    assert draw(behind)[hand, :3].mean() < 15.0
    # Lamps without a shadow are as strong as the one with
    off = Lamp((0.0, 0.0, 1.0), 0.0)
    second = Lighting((off, Lamp((0.0, 0.0, -1.0), 1.0, (1.0, 0.0, 0.0))), (0.0, 0.0, 0.0))
    assert abs(draw(second)[hand].mean(axis=0)[0] - red[0]) < 4.0


@pytest.mark.usefixtures("drawing")
def test_a_white_surface_sends_back_what_a_lamp_gives() -> None:
    """A lamp of strength one shows the skin in about its own color."""
    look = SkinLook(creases=0.0, blotches=0.0, veins=0.0, flush=0.0)
    picture = draw(Lighting((Lamp((0.0, 0.0, -1.0), 1.0),), (0.0, 0.0, 0.0)))
    hand = picture[..., 3] == 255
    shown = np.median(picture[hand, :3], axis=0)
    own = np.median(skin_texture(look).color.reshape(-1, 3), axis=0)
    assert np.abs(shown - own).max() < 45.0
