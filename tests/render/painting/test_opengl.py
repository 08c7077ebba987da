from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from handsim import HandModel, join_qpos
from poses.shapes import gesture
from render import SkinLook
from render.illustrations import view_along
from render.painting import opengl as gl
from render.painting.figures import shade_colors, skin_material
from render.painting.opengl import (
    OPENGL_FROM_OPENCV,
    add_lights,
    frame_with_z,
    is_hardware,
    load_pyrender,
    offscreen_renderer,
    pyrender_material,
)
from render.scenery.lights import STUDIO, Lamp, Lighting
from render.skin.mesh import PosableSkin
from render.skin.texture import skin_texture

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
        "from render.painting.opengl import offscreen_renderer\n"
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
        "from render.painting.opengl import offscreen_renderer as r\n"
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
        "assert choose_painter() in ('compiled', 'opengl')\n"
        "print(sorted({'pyrender', 'OpenGL'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (1.0, -2.0, 0.5), (0.0, -3.0, 0.0)])
def test_frame_with_z(direction: tuple[float, float, float]) -> None:
    frame = frame_with_z(np.array(direction))
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(frame[:, 2], np.array(direction) / np.linalg.norm(direction), atol=1e-12)
    assert np.linalg.det(frame) > 0.0


def draw(lighting: Lighting) -> np.ndarray:
    """A flat hand's back, (200, 200, 4)."""
    pyrender = load_pyrender()
    model = HandModel.named("M")
    skin = PosableSkin(model).posed(join_qpos(gesture("flat")[None])[0])
    view = view_along(np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), skin.vertices, (200, 200))
    scene = pyrender.Scene(bg_color=[0.0] * 4)
    primitive = pyrender.Primitive(
        positions=skin.vertices,
        normals=skin.normals,
        indices=skin.faces,
        texcoord_0=skin.uv,
        color_0=shade_colors(skin.shade),
        material=pyrender_material(skin_material(skin_texture(SkinLook()))),
    )
    scene.add(pyrender.Mesh([primitive]))
    camera = pyrender.PerspectiveCamera(np.deg2rad(24.0), znear=0.05, zfar=10.0)
    scene.add(camera, pose=view.T_world_camera @ OPENGL_FROM_OPENCV)
    add_lights(pyrender, scene, lighting, view.T_world_camera)
    flags = pyrender.RenderFlags
    picture, _ = offscreen_renderer(200, 200).render(scene, flags=flags.RGBA | flags.SHADOWS_DIRECTIONAL)
    return np.asarray(picture)


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
    texture = skin_texture(look)
    own = np.median(texture.color.reshape(-1, 3), axis=0)
    assert np.abs(shown - own).max() < 45.0
